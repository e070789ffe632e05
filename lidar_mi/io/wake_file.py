"""Wake flows from NetCDF files with CF units: read, checked, in SI units on ascending axes."""

import difflib
from collections.abc import Collection, Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from lidar_mi.atmosphere.regrid import even_axis, interpolated, is_even, statement
from lidar_mi.errors import InputError
from lidar_mi.io.netcdf import load_variable, open_netcdf, valid_range
from lidar_mi.io.time_axis import count_unit, listing, state_at, tolerances
from lidar_mi.units import conversion

_DIMENSIONS = ("time", "x", "y", "z")
_VARIABLES = {
    "u": ("m s-1", "velocity along the flight path"),
    "v": ("m s-1", "velocity across the flight path, positive to port"),
    "w": ("m s-1", "vertical velocity, positive upwards"),
    "tracer": (None, "exhaust tracer"),  # any unit: only ratios to its largest value matter
    "aerosol": ("1", "background aerosol relative to its mean"),
}
_REQUIRED = ("v", "w")
# Axes and components, of which a file may have the opposite sign.
_DIRECTED = ("x", "y", "z", "u", "v", "w")


def _scale_to(variable: xr.DataArray, target: str, name: str, path: Path) -> float:
    """Factor from the variable's units to `target`."""
    text = variable.attrs.get("units")
    allowed = f"allowed: {target} or a unit that converts to it"
    if text is None and target == "1":
        return 1.0  # CF section 3.1: no units attribute means dimensionless
    if text is None:
        raise InputError(f"{path}: {name} has no units attribute; {allowed}")
    try:
        return conversion(text, target)
    except ValueError:
        raise InputError(f"{path}: {name} has the unit {text!r}; {allowed}") from None


def _numbers(variable: xr.DataArray, path: Path) -> np.ndarray:
    """A variable's values as float64."""
    if variable.dtype.kind not in "iuf":
        raise InputError(
            f"{path}: variable {variable.name!r} is of type {variable.dtype}; allowed: numbers"
        )
    return load_variable(variable, path).values.astype(float)


def _file_names(names: Mapping[str, str] | None, path: Path) -> tuple[dict[str, str], set[str]]:
    """Our name -> the file's, for all dimensions and variables; and those of opposite sign."""
    allowed = (*_DIMENSIONS, *_VARIABLES)
    names, opposite = dict(names or {}), set()
    for ours, theirs in names.items():
        if ours not in allowed:
            raise InputError(f"wake.names: {ours!r} is not known; allowed: {', '.join(allowed)}")
        if not isinstance(theirs, str):
            raise InputError(f"wake.names.{ours}: {theirs!r} is not allowed; a text is")
        if theirs.startswith("-"):
            if ours not in _DIRECTED:
                raise InputError(
                    f"wake.names.{ours}: {theirs!r} is not allowed; the sign can be changed of "
                    f"{', '.join(_DIRECTED)}"
                )
            names[ours] = theirs[1:].strip()
            opposite.add(ours)
    table = {ours: names.get(ours, ours) for ours in allowed}
    doubled = {t for t in table.values() if list(table.values()).count(t) > 1}
    if doubled:
        raise InputError(
            f"wake.names: {', '.join(sorted(doubled))} of {path} stands for more than one "
            "variable; allowed: one each"
        )
    return table, opposite


def _pick_time(
    data: xr.Dataset, name: str, time: float | None, path: Path
) -> tuple[xr.Dataset, float | None]:
    """The data set at one time, without the dimension, and that time in s (None: unknown)."""
    if name not in data.dims and name not in data.variables:
        if time is None:
            return data, None
        raise InputError(
            f"{path}: time {time:.15g} s is asked for, but there is no {name!r}; it has the "
            f"dimensions {', '.join(map(str, data.dims))}"
        )
    if name not in data.variables:
        if time is None and data.sizes[name] == 1:
            return data.isel({name: 0}), None
        raise InputError(
            f"{path}: dimension {name!r} has no values; allowed: a coordinate variable {name!r}"
        )
    times, rounding = _times(data, name, path)
    if time is None:
        if times.size != 1:
            listed = listing(times, tolerances(times, rounding))
            raise InputError(
                f"{path}: has {times.size} times, and none is chosen; expected wake.time: one of "
                f"{listed} s"
            )
        index = 0
    elif not np.isfinite(time):
        raise InputError(f"wake.time: {time} s is not allowed; any finite time is")
    else:
        index = state_at(time, times, rounding, str(path))
    return data.isel({name: index}) if name in data.dims else data, float(times[index])


def _times(data: xr.Dataset, name: str, path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Times of a file and by how much they may be rounded, s."""
    coordinate = data[name]
    if coordinate.ndim > 1:
        raise InputError(f"{path}: {name!r} has dims {coordinate.dims}; allowed: one at most")
    counted = coordinate.copy()
    if "units" in counted.attrs:
        counted.attrs["units"] = count_unit(counted.attrs["units"], f"{path}: {name}")
    scale = _scale_to(counted, "s", name, path)
    stored = np.atleast_1d(_numbers(coordinate, path))
    bad = np.flatnonzero(~np.isfinite(stored))
    if bad.size:
        raise InputError(
            f"{path}: {name!r} is not finite at {bad.size} of {stored.size} places, the first at "
            f"index {bad[0]}; allowed: finite numbers"
        )
    return stored * scale, _rounding(coordinate, stored) * scale


def wake_times(path: str | Path, names: Mapping[str, str] | None = None) -> np.ndarray:
    """Times (s) of the states of a file that `read_wake` reads; none: it has no time."""
    path = Path(path)
    name = _file_names(names, path)[0]["time"]
    with open_netcdf(path) as data:
        return _times(data, name, path)[0] if name in data.variables else np.zeros(0)


def _rounding(variable: xr.DataArray, values: np.ndarray) -> np.ndarray:
    """Rounding of a variable's values in the file; integers have none."""
    kind = np.dtype(variable.encoding.get("dtype", variable.dtype))
    half = np.spacing(np.abs(values).astype(kind)) / 2 if kind.kind == "f" else 0.0 * values
    return half.astype(float)


def _axis(
    data: xr.Dataset, name: str, ours: str, path: Path, sign: float
) -> tuple[np.ndarray, bool]:
    """The axis in metres, ascending, exact if it is even, and whether the file's descends."""
    if name not in data.variables:
        raise InputError(
            f"{path}: dimension {name!r} ({ours}) has no values; allowed: a coordinate "
            f"variable {name!r} in m"
        )
    variable = data[name]
    values = _numbers(variable, path) * (sign * _scale_to(variable, "m", name, path))
    bad = np.flatnonzero(~np.isfinite(values))
    if bad.size:
        raise InputError(
            f"{path}: axis {name!r} is not finite at {bad.size} of {values.size} places, the first "
            f"at index {bad[0]}; allowed: finite numbers"
        )
    if values.size == 1:
        return values, False
    steps = np.diff(values)
    if not (np.all(steps > 0) or np.all(steps < 0)):
        worst = int(np.argmin(steps * np.sign(values[-1] - values[0])))
        raise InputError(
            f"{path}: axis {name!r} turns back, the step after index {worst} is "
            f"{steps[worst]:g} m; allowed: values that only rise or only fall"
        )
    falls = bool(steps[0] < 0)
    values = values[::-1] if falls else values
    exact = np.linspace(values[0], values[-1], values.size)
    return (exact if is_even(values) else values), falls


def _positive_down(
    data: xr.Dataset,
    table: Mapping[str, str],
    sign: Mapping[str, float],
    heights: Iterable[str],
    path: Path,
) -> list[str]:
    """Vertical axes that the file states to be depths, unless their name changes the sign."""
    down = [
        name
        for name in heights
        if name in data.variables
        and sign["z"] > 0
        and str(data[name].attrs.get("positive", "")).lower() == "down"
    ]
    upwards = data[table["w"]].attrs.get("standard_name") == "upward_air_velocity"
    if down and sign["w"] > 0 and not upwards:
        z, w = table["z"], table["w"]
        raise InputError(
            f"{path}: axis {down[0]!r} is positive down, and {w!r} is not said to be the "
            f"upward_air_velocity; expected wake.names: {{z: -{z}}}, or {{z: -{z}, w: -{w}}} "
            "where it points down, too"
        )
    return down


def _plane_index(axis: np.ndarray, x: float, path: Path, name: str) -> int:
    """Index of the plane nearest to x, which must lie in one of the planes' cells."""
    half = (axis[1] - axis[0]) / 2 if axis.size > 1 else 0.0
    # rounding of the file's axis, whatever its origin; of a single plane 1 mm
    slack = half * (1 + 1e-3) if half else 1e-3
    if not axis[0] - slack <= x <= axis[-1] + slack:
        raise InputError(
            f"{path}: {name} = {x:.9g} m is outside; allowed: {axis[0] - half:.9g} to "
            f"{axis[-1] + half:.9g} m"
        )
    return int(np.argmin(np.abs(axis - x)))


def _check_values(
    values: np.ndarray,
    axes: Mapping[str, np.ndarray],
    name: str,
    path: Path,
    may_be_negative: bool,
    limits: tuple[float, float],
) -> None:
    """Every value finite and, unless it may, not negative; ``limits``: those of valid values."""
    low, high = limits
    within = f", valid ones are {low:g} to {high:g}" if low > -np.inf or high < np.inf else ""
    for fault, bad, allowed in (
        ("not finite", ~np.isfinite(values), f"nowhere{within}"),
        ("negative", (values < 0) & (not may_be_negative), "nowhere"),
    ):
        count = int(bad.sum())
        if count:
            first = np.unravel_index(int(bad.argmax()), bad.shape)
            place = ", ".join(f"{d} = {axes[d][i]:g} m" for d, i in zip("xyz", first, strict=True))
            raise InputError(
                f"{path}: variable {name!r} is {fault} at {count} of {values.size} places, the "
                f"first at {place}; allowed: {allowed}"
            )


def read_wake(
    path: str | Path,
    time: float | None = None,
    names: Mapping[str, str] | None = None,
    x: float | None = None,
    require: Iterable[str] = (),
) -> xr.Dataset:
    """One instant of a simulated wake from a NetCDF file with CF units.

    The file's variables lie on (time, x, y, z) in any order; time and x may be missing (a slab
    gets one x plane, at its scalar coordinate or at 0). Descending axes are turned round, units
    are converted. The lowest levels are omitted where a variable has no value at any of their
    nodes (the ground). Stretched axes and staggered variables are interpolated to even nodes, see
    `lidar_mi.atmosphere.regrid`; the attribute ``interpolated`` then states with which error.

    path: NetCDF-4 or NetCDF-3 classic.
    time: s; the file must hold it to 1e-3 of the step to the next state and to 1 ms. May be omitted
        where there is one time only. In "seconds since ..." axes the count is meant.
    names: our name to the file's, for time, x, y, z, u, v, w, tracer, aerosol, where they differ:
        {"v": "V_wind", "y": "lateral"}. A variable named here must exist. A minus sign before the
        file's name changes the sign, of a file whose y points to starboard for instance: {"y":
        "-y", "v": "-V"}.
    x: m; keeps the one plane nearest to it. Default: all planes.
    require: variables that must be present in addition to v and w: u, tracer, aerosol.

    Raises InputError: naming file and variable: unreadable, missing, wrong dims or units, values
    that are not finite, a tracer or aerosol that is asked for and negative somewhere, axes that are
    not monotonic, a time or plane that is not there.

    Returns
    -------
    xarray.Dataset
        float64 on dims (x, y, z), ascending, metres: u, v, w in m s^-1, the tracer in the file's
        unit, aerosol dimensionless, as far as the file has them. Scalar coordinate `time` in s if
        known.
    """
    path = Path(path)
    table, opposite = _file_names(names, path)
    sign = {name: -1.0 if name in opposite else 1.0 for name in _DIRECTED}
    for name in require:
        if name not in _VARIABLES:
            raise InputError(
                f"wake: variable {name!r} is not known; allowed: {', '.join(_VARIABLES)}"
            )
    needed = {*_REQUIRED, *require, *(n for n in (names or {}) if n in _VARIABLES)}
    with open_netcdf(path) as data:
        return _read(data, table, sign, needed, time, x, path)


def _hint(name: str, table: Mapping[str, str], present: Iterable[Any]) -> str:
    """A hint: the key that gives the file's name, or the nearest name in the file."""
    if table[name] != name:
        names = [str(candidate) for candidate in present]
        close = difflib.get_close_matches(table[name], names, 1)
        # no similar name: ours may be among them
        close = close or ([name] if name in names else [])
        return f"; did you mean {close[0]}?" if close else ""
    none = f", or wake.extinction.{name}: null" if name in ("tracer", "aerosol") else ""
    return f"; expected wake.names: {{{name}: its name there}}{none}"


def _spatial_dims(
    data: xr.Dataset, table: Mapping[str, str], name: str, spatial: Mapping[str, str]
) -> dict[str, str]:
    """The dimensions in space of a variable, and which of ours each is; empty: others.

    One of them may be staggered: another than that of the other variables, with values of its own.
    """
    dims = [str(d) for d in data[table[name]].dims if d != table["time"]]
    missing = [d for d in spatial if d not in dims]
    extra = [d for d in dims if d not in spatial]
    if len(missing) != len(extra) or len(extra) > 1 or any(d not in data.variables for d in extra):
        return {}
    staggered = dict(zip(extra, missing, strict=True))
    return {d: spatial[staggered.get(d, d)] for d in dims}


def _in_the_ground(variable: xr.DataArray, height: str, path: Path) -> int:
    """Number of lowest levels at which a variable has no value, as solvers mask the ground."""
    last = variable.sizes[height] - 1
    for level in range(last):
        if np.isfinite(_numbers(variable.isel({height: level}), path)).any():
            return level
    return 0


def _read(
    data: xr.Dataset,
    table: Mapping[str, str],
    sign: Mapping[str, float],
    needed: Collection[str],
    time: float | None,
    x: float | None,
    path: Path,
) -> xr.Dataset:
    for name in _VARIABLES:
        if name in needed and table[name] not in data.data_vars:
            raise InputError(
                f"{path}: variable {table[name]!r} ({name}) is missing; it has "
                f"{', '.join(map(str, data.data_vars)) or 'none'}"
                f"{_hint(name, table, data.data_vars)}"
            )
    for name in ("y", "z"):
        if table[name] not in data.dims:
            raise InputError(
                f"{path}: dimension {table[name]!r} ({name}) is missing; it has "
                f"{', '.join(map(str, data.dims)) or 'none'}{_hint(name, table, data.dims)}"
            )
    present = [name for name in _VARIABLES if table[name] in data.data_vars]
    spatial = {table[d]: d for d in ("x", "y", "z") if table[d] in data.dims}
    dims_of = {name: _spatial_dims(data, table, name, spatial) for name in present}
    if unplaced := [table[name] for name in present if not dims_of[name]]:
        missing = next((n for n in ("time", "x", "y", "z") if table[n] not in data.dims), "x")
        raise InputError(
            f"{path}: variable {unplaced[0]!r} has the dimensions "
            f"({', '.join(map(str, data[unplaced[0]].dims))}); allowed: {', '.join(spatial)} "
            f"and, at choice, {table['time']}, in any order, one of them staggered; expected "
            f"wake.names of the others, such as {{{missing}: its name there}}"
        )

    data, seconds = _pick_time(data, table["time"], time, path)
    reverse = []
    places = {theirs: ours for dims in dims_of.values() for theirs, ours in dims.items()} | spatial
    down = _positive_down(data, table, sign, [d for d, ours in places.items() if ours == "z"], path)
    file_nodes = {}
    for theirs, ours in places.items():
        points = sign[ours] * (-1.0 if theirs in down else 1.0)
        file_nodes[theirs], turned = _axis(data, theirs, ours, path, points)
        if turned:
            reverse.append(theirs)
    data = data.isel({theirs: slice(None, None, -1) for theirs in reverse})
    for theirs in [d for d, ours in places.items() if ours == "z"]:
        levels = [
            _in_the_ground(data[table[n]], theirs, path) for n in dims_of if theirs in dims_of[n]
        ]
        above = slice(max(levels, default=0), None)
        data, file_nodes[theirs] = data.isel({theirs: above}), file_nodes[theirs][above]
    axes = {ours: file_nodes[theirs] for theirs, ours in spatial.items()}
    for ours in spatial.values():
        ends = [
            file_nodes[d][[0, -1]]
            for dims in dims_of.values()
            for d, o in dims.items()
            if o == ours
        ]
        low, high = max(end[0] for end in ends), min(end[1] for end in ends)
        axes[ours] = even_axis(axes[ours], low, high)
    if "x" not in axes:
        theirs = table["x"]
        place = 0.0
        if theirs in data.variables and data[theirs].ndim == 0:
            place = float(_numbers(data[theirs], path))
            place *= sign["x"] * _scale_to(data[theirs], "m", theirs, path)
        elif x is not None:
            raise InputError(
                f"{path}: x = {x:g} m is asked for, but there is no {theirs!r}; it has the "
                f"dimensions {', '.join(map(str, data.dims))}"
            )
        axes = {"x": np.array([place]), **axes}
    if x is not None:
        index = _plane_index(axes["x"], x, path, table["x"])
        axes["x"] = axes["x"][index : index + 1]
        # planes that are not needed are not read
        planes = file_nodes.get(table["x"], axes["x"])
        staggered = {o for dims in dims_of.values() for d, o in dims.items() if d not in spatial}
        if planes.size > 1 and is_even(planes) and "x" not in staggered:
            index = int(np.argmin(np.abs(planes - axes["x"][0])))
            data = data.isel({table["x"]: slice(index, index + 1)})
            file_nodes[table["x"]] = axes["x"]

    wake = xr.Dataset(
        coords={d: (d, axes[d], {"units": "m"}) for d in ("x", "y", "z")},
        attrs={"source": path.name},
    )
    errors: dict[str, float] = {}
    for name in present:
        variable = data[table[name]]
        unit, long_name = _VARIABLES[name]
        scale = 1.0
        if unit is None:
            unit = variable.attrs.get("units", "1")
        else:
            scale = _scale_to(variable, unit, f"variable {table[name]!r}", path)
        scale *= sign.get(name, 1.0)
        dims = sorted(dims_of[name], key=lambda theirs: dims_of[name][theirs])
        variable = variable.transpose(*dims)
        along = {dims_of[name][theirs]: file_nodes[theirs] for theirs in dims}
        nodes = [along.get(d, axes[d]) for d in "xyz"]
        values = _numbers(variable, path).reshape([n.size for n in nodes]) * scale
        tracer = name in needed and name in ("tracer", "aerosol")
        where = dict(zip("xyz", nodes, strict=True))
        _check_values(values, where, table[name], path, not tracer, valid_range(variable, path))
        low, high = values.min(), values.max()
        values, errors[name] = interpolated(values, nodes, [axes[d] for d in "xyz"])
        if name in ("tracer", "aerosol"):
            values = values.clip(low, high)
        wake[name] = ("x", "y", "z"), values, {"units": unit, "long_name": long_name}
    if note := statement(errors, {name: wake[name].attrs["units"] for name in present}):
        wake.attrs["interpolated"] = note
    if seconds is not None:
        wake = wake.assign_coords(time=((), seconds, {"units": "s"}))
    return wake
