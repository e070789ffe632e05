"""Wake files over the features of the CF conventions, stored by four writers, and what they hold.

Values, packing and missing cells are made here, from the text of the conventions: no reader's or
writer's own decoding takes part.
"""

import tempfile
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import h5py
import netCDF4
import numpy as np
import xarray as xr
from scipy.io import netcdf_file

from lidar_mi.errors import InputError
from lidar_mi.io.wake_file import read_wake


@dataclass
class Stored:
    """A variable as its bytes are: packed, with attributes; ``unwritten``: a cell left alone."""

    dims: tuple[str, ...]
    values: np.ndarray
    attributes: dict[str, Any] = field(default_factory=dict)
    unwritten: tuple[int, ...] | None = None

    @property
    def filled(self) -> np.ndarray:
        """The values, with the library's default fill value in the cell that nobody wrote."""
        if self.unwritten is None:
            return self.values
        values = self.values.copy()
        values[self.unwritten] = netCDF4.default_fillvals[values.dtype.str[1:]]
        return values


File = dict[str, Stored]
CLASSIC = ("i1", "S1", "i2", "i4", "f4", "f8")
"""Types of NetCDF-3 classic."""


def sizes_of(file: File) -> dict[str, int]:
    """Length of every dimension."""
    return {d: n for one in file.values() for d, n in zip(one.dims, one.values.shape, strict=True)}


def by_netcdf4(path: Path, file: File, form: str = "NETCDF4", **packing: Any) -> None:
    """By netCDF4: any format, any filter; cells are really left alone."""
    with netCDF4.Dataset(path, "w", format=form) as data:
        for name, size in sizes_of(file).items():
            data.createDimension(name, size)
        for name, one in file.items():
            plain = {k: v for k, v in one.attributes.items() if k != "_FillValue"}
            how = packing if one.values.ndim > 1 else {}
            fill = one.attributes.get("_FillValue")
            made = data.createVariable(
                name, one.values.dtype.newbyteorder("="), one.dims, fill_value=fill, **how
            )
            made.set_auto_maskandscale(False)
            made.setncatts(plain)
            if one.unwritten is None:
                made[...] = one.values
                continue
            for index in np.ndindex(one.values.shape):
                if index != one.unwritten:
                    made[index] = one.values[index]


def by_scipy(path: Path, file: File, version: int = 2) -> None:
    """By SciPy: classic formats."""
    with netcdf_file(path, "w", version=version) as data:
        for name, size in sizes_of(file).items():
            data.createDimension(name, size)
        for name, one in file.items():
            made = data.createVariable(name, one.values.dtype, one.dims)
            if one.dims:
                made[:] = one.filled
            else:
                made.assignValue(one.filled)
            for key, value in one.attributes.items():
                setattr(made, key, value)


def by_h5py(path: Path, file: File, **packing: Any) -> None:
    """By h5py: bare HDF5 with dimension scales."""
    with h5py.File(path, "w") as data:
        for name, one in file.items():
            how = packing if one.values.ndim > 1 else {}
            made = data.create_dataset(name, data=one.filled, **how)
            for key, value in one.attributes.items():
                made.attrs[key] = value
            if one.dims == (name,):
                made.make_scale(name)
        for name, size in sizes_of(file).items():
            if name not in file:
                data.create_dataset(name, data=np.zeros(size, "f4")).make_scale(name)
        for name, one in file.items():
            for axis, dim in enumerate(one.dims):
                if dim != name:
                    data[name].dims[axis].attach_scale(data[dim])


def by_xarray(path: Path, file: File, engine: str = "h5netcdf") -> None:
    """By xarray."""
    variables = {name: (one.dims, one.filled, one.attributes) for name, one in file.items()}
    bare = {
        n: {"_FillValue": None} for n, one in file.items() if "_FillValue" not in one.attributes
    }
    xr.Dataset(variables).to_netcdf(path, engine=engine, encoding=bare)


_FORMATS = (
    "NETCDF4 NETCDF4_CLASSIC NETCDF3_CLASSIC NETCDF3_64BIT_OFFSET NETCDF3_64BIT_DATA"
).split()
_FILTERS = ("zlib", "zstd", "bzip2")


def write(path: Path, file: File, rng: np.random.Generator) -> str:
    """Write by any writer that has the types; its name and settings."""
    classic = all(one.values.dtype.str[1:] in CLASSIC for one in file.values())
    calls: list[tuple[str, Any, dict[str, Any]]] = [
        ("h5py", by_h5py, {}),
        ("h5py", by_h5py, {"compression": "lzf", "shuffle": True, "fletcher32": True}),
        ("xarray", by_xarray, {}),
        ("netCDF4", by_netcdf4, {"compression": str(rng.choice(_FILTERS))}),
        ("netCDF4", by_netcdf4, {"form": str(rng.choice(_FORMATS if classic else _FORMATS[:1]))}),
    ]
    if classic:
        calls += [("scipy", by_scipy, {"version": int(rng.integers(1, 3))})]
    name, writer, settings = calls[rng.integers(len(calls))]
    writer(path, file, **settings)
    return f"{name} {settings}"


_LENGTHS = {"m": 1.0, "metres": 1.0, "km": 1e3, "cm": 1e-2}
_TIMES = {"s": 1, "seconds": 1, "ms": 1e-3, "minutes": 60, "hours": 3600, "days": 86400}
_DATES = ("1970-01-01", "2000-01-01 00:00:00", "1900-1-1T00:00:00Z", "0000-01-01 00:00:0.0")
_CALENDARS = ("standard", "proleptic_gregorian", "noleap", "360_day", "julian", None)
_SPEEDS = {"m s-1": 1.0, "m/s": 1.0, "cm s-1": 1e-2, "km/h": 1 / 3.6}


def _axis(rng, name, nodes) -> Stored:
    """Nodes (m) in any unit, type and sense."""
    unit = str(rng.choice(list(_LENGTHS)))
    values = nodes / _LENGTHS[unit]
    kind = str(rng.choice(["f8", "f4", "i4", "i2"]))
    if kind[0] == "i" and (np.any(np.rint(values) != values) or np.abs(values).max() > 30000):
        kind = "f8"
    attributes = {"units": unit, "axis": name.upper(), "long_name": name}
    return Stored((name,), values.astype(kind), attributes)


def _time(rng, count) -> tuple[Stored, np.ndarray]:
    """A time axis and the times that it means, s."""
    unit = str(rng.choice(list(_TIMES)))
    step = float(rng.choice([0.1, 0.5, 1.0, 10.0, 3600.0]))
    first = float(rng.choice([0.0, 40.0, 3600.0, 1.6e9, 4.0e6]))
    seconds = first + step * np.arange(count)
    counted = seconds / _TIMES[unit]
    exact = np.rint(counted)
    kind = "i8" if np.allclose(exact, counted, rtol=0, atol=1e-12) and rng.random() < 0.5 else "f8"
    if kind == "f8" and first < 100 and rng.random() < 0.3:
        kind = "f4"
    attributes: dict[str, Any] = {"units": unit}
    if rng.random() < 0.7:
        attributes["units"] = f"{unit} since {rng.choice(_DATES)}"
        calendar = rng.choice(np.array(_CALENDARS, dtype=object))
        attributes |= {"calendar": str(calendar)} if calendar else {}
    stored = (exact if kind == "i8" else counted).astype(kind)
    if kind == "i8" and np.abs(stored).max() < 2**31 and rng.random() < 0.5:
        stored = stored.astype("i4")
    return Stored(("time",), stored, attributes), seconds


def _wind(rng, dims, values, bad) -> tuple[Stored, float]:
    """A wind (m/s) in any unit and packing, and its rounding, m/s; ``bad``: a cell without value.

    Its value is missing by a fill value, by the library's own, or by a limit of valid values.
    """
    unit = str(rng.choice(list(_SPEEDS)))
    own = values / _SPEEDS[unit]
    attributes: dict[str, Any] = {"units": unit}
    kind = str(rng.choice(["f4", "f8", "i2", "i4", "u2", "i1", "u1", "unsigned"]))
    low, high = float(own.min()), float(own.max())
    if kind[0] == "f":
        stored, rounding = own.astype(kind), np.spacing(np.float32(np.abs(own).max()))
        span = np.array([low - 1, high + 1], kind)
    else:
        # room below and above for what is not valid
        least, most = {
            "i1": (-100, 100),
            "u1": (10, 240),
            "unsigned": (10, 240),
            "i2": (-30000, 30000),
            "u2": (100, 65000),
            "i4": (-1000000, 1000000),
        }[kind]
        scale = (high - low) / (most - least) * (-1 if rng.random() < 0.2 else 1)
        offset = (low if scale > 0 else high) - scale * least
        packed = np.rint((own - offset) / scale)
        rounding = abs(scale)
        attributes |= {"scale_factor": scale, "add_offset": offset}
        if kind == "unsigned":
            attributes["_Unsigned"] = "true"
            stored = packed.astype("u1").view("i1")
            span = np.array([least - 1, most + 1], "u1").view("i1")
        else:
            stored = packed.astype(kind)
            span = np.array([least - 1, most + 1], kind)
    ways = ["_FillValue", "missing_value", "valid_range", "valid_end"]
    ways += ["unwritten"] if stored.dtype.itemsize > 1 else []
    ways += ["unpacked"] if kind[0] in "iu" and "scale_factor" in attributes else []
    way, unwritten = str(rng.choice(ways)), None
    wide = {"f4": high + 999, "f8": high + 999, "i1": -120, "u1": 250, "unsigned": -3, "i2": 32000}
    wide |= {"u2": 20, "i4": 2000000}
    outside = stored.dtype.type(wide[kind])
    if way in ("_FillValue", "missing_value"):
        attributes[way] = outside
    elif way == "valid_range":
        attributes[way] = span
    elif way == "valid_end":
        least = (kind == "u2") or (kind == "i1")
        attributes["valid_min" if least else "valid_max"] = span[0 if least else 1]
    elif way == "unpacked":
        attributes["valid_range"] = np.array([low - rounding, high + rounding], "f8")
    if bad is not None and way == "unwritten":
        unwritten = bad
    elif bad is not None:
        stored[bad] = outside
    return Stored(dims, stored, attributes, unwritten), float(rounding * _SPEEDS[unit])


def check(seed: int) -> str | None:
    """Whether a wake file of any features is read as CF says; None: it is, else what is wrong."""
    rng = np.random.default_rng(seed)
    counts = {"x": int(rng.integers(1, 4)), "y": int(rng.integers(4, 8)), "z": 5}
    east = float(rng.choice([0.0, 0.5, 1000.0]))
    nodes = {d: east + np.arange(n) * float(rng.choice([1.0, 0.5])) for d, n in counts.items()}
    timed = bool(rng.random() < 0.7)
    time, seconds = _time(rng, int(rng.integers(1, 5)))
    state = int(rng.integers(seconds.size))
    along = {"time": np.arange(seconds.size), **nodes} if timed else nodes
    dims = tuple(rng.permutation(list(along)))
    grid = dict(zip(dims, np.meshgrid(*(along[d] for d in dims), indexing="ij"), strict=True))
    field = {"v": 3 + grid["y"] - 2 * grid["z"] + 0.5 * grid["x"], "w": 1 - grid["y"] + grid["z"]}
    if timed:
        field = {name: values + 4 * grid["time"] for name, values in field.items()}
    places = {d: state if d == "time" else int(rng.integers(along[d].size)) for d in dims}
    bad = tuple(places[d] for d in dims) if rng.random() < 0.4 else None
    file: File = {d: _axis(rng, d, values) for d, values in nodes.items()}
    roundings = {}
    for name, values in field.items():
        file[name], roundings[name] = _wind(rng, dims, values, bad if name == "v" else None)
    if timed:
        file["time"] = time
    # depths are heights that are counted down
    if rng.random() < 0.2:
        file["z"].values = -file["z"].values
        file["z"].attributes["positive"] = str(rng.choice(["down", "Down"]))
        file["w"].attributes["standard_name"] = "upward_air_velocity"
    for d in ("x", "y", "z"):
        if rng.random() < 0.3:
            file[d].values = file[d].values[::-1].copy()
            for name in field:
                one = file[name]
                axis = one.dims.index(d)
                one.values = np.flip(one.values, axis).copy()
                if one.unwritten:
                    at = list(one.unwritten)
                    at[axis] = counts[d] - 1 - at[axis]
                    one.unwritten = tuple(at)
    if rng.random() < 0.3:
        step = file["y"].values[1] - file["y"].values[0]
        ends = file["y"].values[:, None] + step * np.array([-0.5, 0.5])
        file["y_bounds"] = Stored(("y", "nv"), ends.astype("f8"))
        file["y"].attributes["bounds"] = "y_bounds"
    if rng.random() < 0.3:
        file["lat"] = Stored(("y",), np.linspace(48, 48.1, counts["y"]), {"units": "degrees_north"})
        file["v"].attributes["coordinates"] = "lat"
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "wake.nc")
        by = write(path, file, rng)
        about = f"seed {seed}, by {by}, v {file['v'].attributes}, time {time.attributes}"
        off = float(rng.choice([0.0, 0.0, 0.3])) if timed else 0.0
        asked = None
        if timed:
            step = seconds[1] - seconds[0] if seconds.size > 1 else 10.0
            asked = float(f"{seconds[state] + off * step:.12g}")
        try:
            wake = read_wake(path, asked)
        except InputError as error:
            said = str(error)
            total = nodes["x"].size * nodes["y"].size * nodes["z"].size
            wanted = "is not there; allowed: " if off else f"'v' is not finite at 1 of {total} plac"
            return None if (off or bad) and wanted in said else f"{about}: refused: {said}"
        except Exception as error:
            return f"{about}: {type(error).__name__}: {error}"
    if off or bad:
        return f"{about}: read, {off:g} of a step beside its time, missing cell: {bad}"
    keep = [d for d in dims if d != "time"]
    for d in "xyz":
        if not np.allclose(wake[d], nodes[d], rtol=0, atol=1e-3 * 0.5):
            return f"{about}: axis {d} is {wake[d].values}, not {nodes[d]}"
    for name, values in field.items():
        true = values.take(state, dims.index("time")) if timed else values
        true = np.transpose(true, [keep.index(d) for d in "xyz"])
        # half a step of packing, the rounding of its sum in single precision, of axes in float32
        error = np.abs(wake[name].values - true).max()
        if not error <= 0.51 * roundings[name] + 2e-6 * (1 + np.abs(true).max()) + 1e-4:
            return f"{about}: {name} is wrong by {error:.2g} m/s"
    return None
