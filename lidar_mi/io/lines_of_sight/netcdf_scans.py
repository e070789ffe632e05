"""NetCDF files of lines of sight: ARM, WindCube (Leosphere, Vaisala), CfRadial 1 and 2, others.

Variables are found by their CF standard names, by the names that the makers use, or by names that
are given. CfRadial 1 and ARM have them in the file, CfRadial 2 and WindCube in a group a sweep.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from lidar_mi.errors import InputError
from lidar_mi.io.lines_of_sight.scan import (
    ANGLES,
    FIELDS,
    Scan,
    dated,
    listed,
    part,
    ratio_of_powers,
    toward_in_words,
)
from lidar_mi.io.netcdf import groups, load_variable, open_netcdf
from lidar_mi.io.text import as_text
from lidar_mi.units import conversion

AWAY = "radial_velocity_of_scatterers_away_from_instrument"
TOWARD = "radial_velocity_of_scatterers_toward_instrument"

NAMES = {
    "time": ("time",),
    "azimuth": ("azimuth", "azi", "az"),
    "elevation": ("elevation", "ele", "el"),
    "range": ("range", "gate_range", "distance"),
    "radial_velocity": (
        "radial_velocity",
        "radial_wind_speed",
        "vel",
        "vr",
        "vrad",
        "velocity",
        "doppler_velocity",
        "dv",
        "v_los",
    ),
    "snr": ("snr", "cnr", "intensity", "signal_to_noise_ratio", "carrier_to_noise_ratio"),
    "spectral_width": ("spectral_width", "doppler_spectrum_width", "width", "sw"),
    "attenuated_backscatter": ("attenuated_backscatter", "beta", "relative_beta"),
    "pitch": ("pitch",),
    "roll": ("roll",),
    "latitude": ("latitude", "lat"),
    "longitude": ("longitude", "lon"),
    "altitude": ("altitude", "alt"),
}
"""Our names, and those of the makers in lower case, the most specific first."""

_UNITS = {name: unit for name, (unit, _) in FIELDS.items()} | {"range": "m", "altitude": "m"}
_EARTH_RADIUS = 6.371e6  # m, mean radius
_MOVED = 100.0  # m, within a scan: more than the error of satellite navigation
_WORDS = ("long_name", "comment", "description", "note", "sign_convention", "positive")
_ARM_MISSING = -9999.0  # ARM's missing value, which not every file declares
_KINDS = (
    ("datastream", "sgp", "ARM"),
    ("dod_version", "dl", "ARM"),
    ("title", "windcube", "WindCube"),
    ("instrument_name", "wls", "WindCube"),
)


def is_lines(path: Path) -> bool:
    """Whether a NetCDF file holds lines of sight under names that are known."""
    with open_netcdf(path) as data:
        if "sweep_group_name" in data.variables:
            return True
        theirs = _file_names(data, {})
        return {"azimuth", "elevation", "range", "radial_velocity"} <= set(theirs) and (
            data[theirs["radial_velocity"]].ndim > 1
        )


def read_netcdf_lines(path: Path, names: Mapping[str, str]) -> list[Scan]:
    """The sweeps of a file.

    names: ours to the file's, before those known; a minus sign before the name of radial_velocity
        turns its sign, a plus sign retains it, whatever the file says of it.

    Raises InputError: as of `open_netcdf`; a variable that is missing or lies on other dimensions,
    a unit that does not convert, times that cannot be decoded.
    """
    with open_netcdf(path) as root:
        about = _about(root, path)
        place = _place(root, names, path)
        sweeps = _sweep_names(root, path)
        if not sweeps:
            return _flat(root, names, about, place, path)
    scans, empty = [], []
    for name in sweeps:
        with open_netcdf(path, name) as data:
            if not data.sizes.get("time", 0):
                empty.append(name)
                continue
            mode = _word(data, "sweep_mode")
            more = {"scan_type": mode} if mode else {}
            with open_netcdf(path) as root:
                reference = _word(data, "time_reference") or _word(root, "time_reference")
            sweep_place = place | _place(data, names, path)
            scans += _flat(data, names, about | more, sweep_place, path, reference)
    if not scans:
        raise InputError(f"{path}: no sweep has a line of sight; it has {listed(sweeps)}")
    if empty:
        scans[0].remarks.append(f"{len(empty)} of {len(sweeps)} sweeps are empty: {listed(empty)}")
    return scans


def _sweep_names(root: xr.Dataset, path: Path) -> list[str]:
    """Groups of the sweeps; empty: the variables are in the root group."""
    present = groups(path)
    if "sweep_group_name" in root.variables:
        names = [as_text(word) for word in np.ravel(load_variable(root["sweep_group_name"], path))]
        return [name for name in names if name in present]
    return sorted(name for name in present if name.lower().startswith("sweep"))


def _about(root: xr.Dataset, path: Path) -> dict[str, str | float]:
    texts = {key: as_text(value) for key, value in root.attrs.items()}
    kind = next((k for key, part, k in _KINDS if part in texts.get(key, "").lower()), "")
    conventions = texts.get("Conventions", texts.get("conventions", "")).replace("/", "")
    if not kind and "cfradial" in conventions.lower():
        kind = "CfRadial 2" if groups(path) else "CfRadial 1"
    about: dict[str, str | float] = {"kind": kind or "NetCDF"}
    if texts.get("tilt"):
        about["tilt"] = texts["tilt"]  # of a data set written by lidar-mi
    for ours, theirs in (
        ("instrument", "instrument_name"),
        ("instrument", "serial_number"),
        ("scan_type", "scan_type"),
        ("datastream", "datastream"),
    ):
        if texts.get(theirs):
            about.setdefault(ours, texts[theirs])
    for ours, theirs in (
        ("gate_length", "range_gate_length"),
        ("gate_length", "gate_length"),
        ("pulse_length", "pulse_length"),
        ("samples_per_gate", "samples_per_gate"),
        ("pulses_per_line", "shots_per_profile"),
        ("velocity_resolution", "radial_velocity_resolution"),
        ("focus_range", "focus_range"),
        ("nyquist_velocity", "nyquist_velocity"),
    ):
        try:
            about[ours] = float(texts[theirs].split()[0])
        except (KeyError, ValueError, IndexError):
            continue
    return about


def _word(data: xr.Dataset, name: str) -> str:
    if name not in data.variables or data[name].size == 0:
        return ""
    values = data[name].values
    # of CfRadial 1, characters along an axis
    return as_text(values if values.dtype.kind == "S" and values.itemsize == 1 else values.flat[0])


def _file_names(data: xr.Dataset, names: Mapping[str, str]) -> dict[str, str]:
    """Our name -> the file's, of every variable in the file."""
    lower = {str(name).lower(): str(name) for name in reversed(list(data.variables))}
    standard = {str(v.attrs.get("standard_name", "")): str(n) for n, v in data.variables.items()}
    file_names = {}
    for ours, candidates in NAMES.items():
        if ours in names:
            file_names[ours] = names[ours].lstrip("+-").strip()
            continue
        theirs = next((lower[name] for name in candidates if name in lower), None)
        if ours == "radial_velocity":
            theirs = standard.get(AWAY) or standard.get(TOWARD) or theirs
        if theirs is not None:
            file_names[ours] = theirs
    return file_names


def _place(data: xr.Dataset, names: Mapping[str, str], path: Path) -> dict[str, float]:
    """Latitude, longitude and altitude: of a moving platform the first."""
    file_names = _file_names(data, names)
    place = {}
    for name in ("latitude", "longitude", "altitude"):
        if file_names.get(name) in data.variables and data[file_names[name]].size:
            place[name] = float(_numbers(data[file_names[name]], name, path).flat[0])
    return {name: value for name, value in place.items() if np.isfinite(value)}


def _moving(data: xr.Dataset, names: Mapping[str, str], time: np.ndarray, path: Path) -> list[str]:
    """A remark on a platform that moves, whose speed is in the velocities."""
    file_names = _file_names(data, names)
    coordinates = [file_names.get(name) for name in ("latitude", "longitude")]
    if any(key not in data.variables or data[key].size != time.size for key in coordinates):
        return []
    latitude, longitude = (
        np.deg2rad(np.ravel(_numbers(data[key], "", path))) for key in coordinates
    )
    finite = np.flatnonzero(np.isfinite(latitude) & np.isfinite(longitude))
    if finite.size < 2:
        return []
    north = _EARTH_RADIUS * (latitude[finite] - latitude[finite[0]])
    east = _EARTH_RADIUS * np.cos(latitude[finite]) * (longitude[finite] - longitude[finite[0]])
    distance = float(np.hypot(np.ptp(north), np.ptp(east)))
    seconds = float((time[finite[-1]] - time[finite[0]]) / np.timedelta64(1, "s"))
    if distance < _MOVED or seconds <= 0:
        return []
    return [
        f"the lidar moves by {distance:.0f} m ({np.hypot(north[-1], east[-1]) / seconds:.2g} m/s): "
        "winds are off by its velocity unless that was subtracted, and of the place in the middle "
        "of the scan"
    ]


def _numbers(variable: xr.DataArray, ours: str, path: Path) -> np.ndarray:
    """Values in our unit, NaN where they are missing; outside of the valid range they stay."""
    if variable.dtype.kind not in "iuf":
        raise InputError(f"{path}: {variable.name}: {variable.dtype} is not allowed; numbers are")
    limits = {k: v for k, v in variable.attrs.items() if not k.startswith("valid_")}
    unlimited = variable.copy()
    unlimited.attrs = limits
    values = load_variable(unlimited, path).values.astype(float)
    values = np.where(values == _ARM_MISSING, np.nan, values)
    unit = str(variable.attrs.get("units", "")).strip()
    if ours == "snr":
        return values
    target = "degree" if ours in ANGLES else _UNITS.get(ours)
    if target is None or unit.lower() in ("", "unitless", "none", "1"):
        return values
    try:
        return values * conversion(unit.replace("/(m sr)", "/m/sr"), target)
    except ValueError:
        if ours == "attenuated_backscatter":
            return values  # relative ones are in units of their own
        raise InputError(
            f"{path}: {variable.name} has the unit {unit!r}; allowed: {target} or a unit that "
            "converts to it"
        ) from None


def _times(data: xr.Dataset, name: str, reference: str, path: Path) -> tuple[np.ndarray, list[str]]:
    variable = data[name]
    units = str(variable.attrs.get("units", ""))
    if "since" not in units and variable.dtype.kind in "iuf" and units in ("", "1", "s"):
        return dated(np.ravel(variable.values).astype(float), name, path)
    if reference:
        units = units.replace("time_reference", reference)
    # ARM: "seconds since 2019-10-15 00:00:00 0:00"
    attributes = variable.attrs | {"units": units.removesuffix(" 0:00")}
    try:
        raw = xr.Dataset({"t": ("n", np.ravel(variable.values), attributes)})
        return xr.decode_cf(raw)["t"].values.astype("datetime64[ns]"), []
    except Exception as error:  # any exception of the libraries about units and calendars
        reason = next(iter(str(error).splitlines()), "")
        raise InputError(
            f"{path}: {name}: units {units!r} are no date ({reason}); expected seconds since a date"
        ) from None


def _flat(
    data: xr.Dataset,
    names: Mapping[str, str],
    about: Mapping[str, str | float],
    place: Mapping[str, float],
    path: Path,
    reference: str = "",
) -> list[Scan]:
    """The lines of a file or group, a scan for each of its sweeps."""
    file_names = _file_names(data, names)
    for ours in ("time", "azimuth", "elevation", "range", "radial_velocity"):
        if file_names.get(ours) not in data.variables:
            theirs = f" ({file_names[ours]})" if ours in file_names else ""
            present = listed(list(map(str, data.variables)))
            raise InputError(
                f"{path}: {ours}{theirs} is missing; it has {present}; "
                f"expected names: {{{ours}: its name there}}"
            )
    velocity = data[file_names["radial_velocity"]]
    line = str(data[file_names["time"]].dims[0]) if data[file_names["time"]].ndim else ""
    if line not in velocity.dims and velocity.dims != ("n_points",):
        raise InputError(
            f"{path}: {velocity.name} has the dimensions {tuple(velocity.dims)}; expected those of "
            f"{file_names['time']} and {file_names['range']}"
        )
    lines = data.sizes[line]
    ragged = _Ragged.of(data, path) if velocity.dims == ("n_points",) else None
    fields = {}
    toward, remarks = _is_toward(velocity, names)
    for name in FIELDS:
        if file_names.get(name) in data.variables and data[file_names[name]].dims == velocity.dims:
            values = _numbers(data[file_names[name]], name, path)
            if name == "snr":
                unit = str(data[file_names[name]].attrs.get("units", ""))
                values, more_remarks = ratio_of_powers(values, unit, file_names[name])
                remarks += more_remarks
            if ragged is not None:
                fields[name] = ragged.full(values)
            elif velocity.ndim == 2:
                fields[name] = values if velocity.dims[0] == line else values.T
            else:
                fields[name] = values[:, None]
    if toward:
        fields["radial_velocity"] = -fields["radial_velocity"]
    gates = fields["radial_velocity"].shape[1]
    ranges = _numbers(data[file_names["range"]], "range", path)
    if ranges.shape == (lines,) and gates != lines:
        ranges = ranges[:, None]
    if ranges.ndim == 2 and (ranges == ranges[0]).all():
        ranges = ranges[0]
    if ranges.shape not in ((gates,), (lines, gates)):
        raise InputError(
            f"{path}: {file_names['range']} has the shape {ranges.shape}; expected ({gates},) or "
            f"({lines}, {gates})"
        )
    angles = {}
    for name in ANGLES:
        if file_names.get(name) in data.variables:
            values = _numbers(data[file_names[name]], name, path)
            angles[name] = np.broadcast_to(values, (lines,)).copy()
    attributes: dict[str, Any] = dict(about)
    for name in ("nyquist_velocity", "nyquist"):
        if name in data.variables and data[name].dtype.kind in "iuf":
            nyquist = np.unique(load_variable(data[name], path).values.astype(float))
            # lines of several pulse rates fold at several speeds
            if nyquist.size == 1 and nyquist[0] > 0:
                attributes["nyquist_velocity"] = float(nyquist[0])
    if "range_gate_length" in data.variables:
        attributes["gate_length"] = float(
            np.ravel(load_variable(data["range_gate_length"], path))[0]
        )
    time, more_remarks = _times(data, file_names["time"], reference, path)
    scan = Scan(
        time,
        angles,
        ranges,
        fields,
        dict(place),
        _rejected(data, velocity, path),
        attributes,
        remarks + more_remarks + _moving(data, names, time, path),
    )
    return _sweeps(scan, data, path)


def _is_toward(velocity: xr.DataArray, names: Mapping[str, str]) -> tuple[bool, list[str]]:
    """Whether positive is toward the lidar, and a remark where only words say so, or contradict."""
    sign = names.get("radial_velocity", "")
    if sign.startswith(("+", "-")):
        return sign.startswith("-"), []
    standard = {TOWARD: True, AWAY: False}.get(str(velocity.attrs.get("standard_name", "")))
    texts = {name: text for name in _WORDS if isinstance(text := velocity.attrs.get(name), str)}
    words = toward_in_words("; ".join(texts.values()))
    if words is None or words == standard or (standard is None and not words):
        return bool(standard), []
    wording = "; ".join(text for text in texts.values() if toward_in_words(text) is not None)
    if standard is None:
        use = f"the sign is reversed (names: radial_velocity: '+{velocity.name}' retains it)"
    else:
        opposite = "+" if standard else "-"
        use = (
            "the standard name, which contradicts it, is used: which is right? (names: "
            f"radial_velocity: '{opposite}{velocity.name}' for the words)"
        )
    return bool(words if standard is None else standard), [f"{velocity.name}: {wording!r}: {use}"]


def _rejected(data: xr.Dataset, velocity: xr.DataArray, path: Path) -> np.ndarray | None:
    """What the lidar's own software rejects: WindCube's status, ARM's quality bits."""
    for name, good in ((f"{velocity.name}_status", 1), (f"qc_{velocity.name}", 0)):
        if name in data.variables and data[name].dims == velocity.dims and velocity.ndim == 2:
            bad = load_variable(data[name], path).values != good
            return bad if velocity.dims[0] == data["time"].dims[0] else bad.T
    return None


def _sweeps(scan: Scan, data: xr.Dataset, path: Path) -> list[Scan]:
    """The sweeps of CfRadial 1, from their first and last rays."""
    edges = ("sweep_start_ray_index", "sweep_end_ray_index")
    if not set(edges) <= set(data.variables) or data.sizes.get("sweep", 1) < 2:
        return [scan]
    first, last = (load_variable(data[name], path).values.astype(int) for name in edges)
    lines, used, parts = len(scan.time), np.zeros(len(scan.time), bool), []
    for start, end in zip(first, last + 1, strict=True):
        if not 0 <= start < end <= lines:
            raise InputError(
                f"{path}: a sweep from ray {start} to {end - 1} is not allowed; it has {lines} rays"
            )
        used[start:end] = True
        parts.append(part(scan, slice(start, end)))
    if not used.all():
        scan.remarks.append(
            f"{int((~used).sum())} rays belong to no sweep; they are one of their own"
        )
        parts.append(part(scan, np.flatnonzero(~used)))
    return parts


class _Ragged:
    """Gates of CfRadial 1 that are stored one after another, rays of different lengths."""

    def __init__(self, start: np.ndarray, count: np.ndarray, points: int, gates: int) -> None:
        self.rows = np.repeat(np.arange(len(count)), count)
        first = np.cumsum(count) - count
        self.columns = np.arange(count.sum()) - np.repeat(first, count)
        self.index = np.repeat(start, count) + self.columns
        self.shape = len(count), max(gates, int(count.max(initial=0)))
        self.inside = self.index < points

    @classmethod
    def of(cls, data: xr.Dataset, path: Path) -> "_Ragged":
        names = ("ray_start_index", "ray_n_gates")
        if not set(names) <= set(data.variables):
            raise InputError(
                f"{path}: {' and '.join(names)} are missing, of rays of n_points gates"
            )
        start, count = (load_variable(data[name], path).values.astype(int) for name in names)
        if (start < 0).any() or (count < 0).any() or count.sum() > 2 * data.sizes["n_points"]:
            raise InputError(f"{path}: ray_start_index, ray_n_gates: point beyond n_points")
        return cls(start, count, data.sizes["n_points"], data.sizes.get("range", 0))

    def full(self, values: np.ndarray) -> np.ndarray:
        """Values (lines, gates), NaN behind the end of a ray."""
        table = np.full(self.shape, np.nan)
        table[self.rows[self.inside], self.columns[self.inside]] = values[self.index[self.inside]]
        return table
