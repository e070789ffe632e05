"""Profiles of the wind as a CF data set."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr

from lidar_mi.flags import WindFlag, flag_attributes

_COMPONENTS = {
    "u": ("eastward_wind", "wind to the east"),
    "v": ("northward_wind", "wind to the north"),
    "w": ("upward_air_velocity", "wind upwards"),
}


MAX_CONDITION = 100.0
"""Largest condition number of the lines of a valid wind.

Beyond it the component that they know least has a hundred times the error of the best.
"""

MIN_FRACTION = 0.5
"""Least fraction of the lines at a height that are valid.

Where most lines see nothing, those few that pass the threshold of the signal are mostly noise.
"""

MAX_STDERR = 5.0
"""Largest standard error of the horizontal vector of a valid wind, m/s: as large as most winds."""


@dataclass(eq=False)
class Profile:
    """Winds of one scan, (levels, ...); heights are in m above the lidar."""

    time: np.datetime64
    heights: np.ndarray
    wind: np.ndarray
    covariance: np.ndarray
    residual: np.ndarray
    condition: np.ndarray
    dof: np.ndarray
    lines: np.ndarray
    outliers: np.ndarray
    flag: np.ndarray


def profile_dataset(profiles: Sequence[Profile], about: Mapping[str, Any]) -> xr.Dataset:
    """All profiles on common heights, in the order of time.

    profiles: heights that differ by less than 1 cm are one.
    about: attributes of the lines of sight.
    """
    heights = np.unique(np.round(np.concatenate([p.heights for p in profiles]), 2))
    profiles = sorted(profiles, key=lambda p: p.time)
    index = [np.searchsorted(heights, np.round(p.heights, 2)) for p in profiles]

    def full(values: Sequence[np.ndarray], missing: float = np.nan) -> np.ndarray:
        table = np.full((len(profiles), heights.size), missing, np.asarray(values[0]).dtype)
        for row, (levels, profile) in enumerate(zip(index, values, strict=True)):
            table[row, levels] = profile
        return table

    wind = {n: full([p.wind[:, k] for p in profiles]) for k, n in enumerate(_COMPONENTS)}
    data: dict[str, Any] = {}
    for name, (standard, long_name) in _COMPONENTS.items():
        data[name] = _variable(wind[name], long_name, "m s-1", standard_name=standard)
    error = np.stack(
        [
            np.stack([full([p.covariance[:, a, b] for p in profiles]) for b in range(3)], -1)
            for a in range(3)
        ],
        -2,
    )
    stderr = np.sqrt(np.einsum("...aa->...a", error))
    for k, (name, (standard, long_name)) in enumerate(_COMPONENTS.items()):
        data[f"{name}_stderr"] = _variable(
            stderr[..., k],
            f"standard error of the {long_name}",
            "m s-1",
            standard_name=f"{standard} standard_error",
        )
    for a, b in ((0, 1), (0, 2), (1, 2)):
        first, second = "uvw"[a], "uvw"[b]
        data[f"{first}{second}_correlation"] = _variable(
            error[..., a, b] / (stderr[..., a] * stderr[..., b]),
            f"correlation of the errors of {first} and {second}",
            "1",
        )
    speed = np.hypot(wind["u"], wind["v"])
    direction = np.mod(np.rad2deg(np.arctan2(-wind["u"], -wind["v"])), 360.0)
    data["wind_speed"] = _variable(
        speed, "speed of the horizontal wind", "m s-1", standard_name="wind_speed"
    )
    data["wind_from_direction"] = _variable(
        direction,
        "direction from which the wind blows, clockwise from north",
        "degree",
        standard_name="wind_from_direction",
    )
    for name, long_name, unit in (
        ("residual", "rms of the lines' residuals about a uniform wind", "m s-1"),
        ("condition", "condition number of the directions", "1"),
    ):
        data[name] = _variable(full([getattr(p, name) for p in profiles]), long_name, unit)
    for name, long_name in (
        ("dof", "degrees of freedom of the error"),
        ("lines", "lines used"),
        ("outliers", "lines left out as outliers"),
    ):
        values = full([getattr(p, name) for p in profiles], 0).astype(np.int32)
        data[name] = (("time", "height"), values, {"long_name": long_name, "units": "1"})
    missing = WindFlag.TOO_FEW_LINES.value
    data["flag"] = (
        ("time", "height"),
        full([p.flag for p in profiles], missing).astype(np.uint16),
        flag_attributes(WindFlag, "reasons not to use the wind"),
    )
    coords = {
        "time": (
            "time",
            np.array([p.time for p in profiles]).astype("datetime64[ns]"),
            {"long_name": "mean time of the lines (UTC)", "axis": "T"},
        ),
        "height": (
            "height",
            heights,
            {"units": "m", "long_name": "height above the lidar", "axis": "Z", "positive": "up"},
        ),
    }
    names = "instrument", "kind", "scan", "source", "remarks"
    attributes = {name: about[name] for name in names if name in about}
    result = xr.Dataset(
        data, coords, {"Conventions": "CF-1.11", "title": "Winds from lines of sight", **attributes}
    )
    result["time"].encoding |= {"units": "seconds since 1970-01-01T00:00:00", "dtype": "float64"}
    return result


def _variable(values: np.ndarray, long_name: str, units: str, **more: str) -> tuple[Any, ...]:
    about = {"long_name": long_name, "units": units, **more}
    return ("time", "height"), values.astype(np.float32), about
