"""The wind expected on the wing as it reaches the slabs, and the wind that it meets."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import xarray as xr

from lidar_mi.atmosphere.vortices.wake_path import WakeAlongPath
from lidar_mi.variables import variable

# Places on the wing, in half spans.
_PLACES = np.linspace(-0.9, 0.9, 7)


@dataclass(frozen=True, eq=False)
class Arrival:
    """The wind expected on the wing in the plane of a slab.

    x, time: m and s.
    y (places,): on the wing, m, path frame.
    z: m.
    wind, stderr (2, places): v and w as expected then, and their standard errors, m/s.
    """

    x: float
    time: float
    y: np.ndarray
    z: float
    wind: np.ndarray
    stderr: np.ndarray


def wing_places(span: float) -> np.ndarray:
    """Places along a wing, from its middle, m."""
    return span / 2 * _PLACES


def arrivals_dataset(arrivals: Sequence[Arrival], air: WakeAlongPath) -> xr.Dataset:
    """The wind on the wing as it was expected and as it is, dims (arrival, place)."""
    if not arrivals:
        return xr.Dataset()
    y, x, z, time = np.broadcast_arrays(
        np.array([one.y for one in arrivals]),
        *(np.array([getattr(one, n) for one in arrivals])[:, None] for n in ("x", "z", "time")),
    )
    _, *truth = air.wind(x, y, z, time)
    each, both = "arrival", ("arrival", "place")
    variables = {
        "arrival_x": variable(each, x[:, 0], "m", "plane of the slab"),
        "arrival_time": variable(each, time[:, 0], "s", "time of arrival"),
        "arrival_y": variable(both, y, "m", "place on the wing"),
    }
    for k, name in enumerate("vw"):
        for suffix, text, values in (
            ("", "expected at arrival", [one.wind[k] for one in arrivals]),
            ("_stderr", "standard error of that", [one.stderr[k] for one in arrivals]),
            ("_true", "as it is", truth[k]),
        ):
            variables[f"arrival_{name}{suffix}"] = variable(
                both, np.asarray(values), "m s-1", f"{name} on the wing, {text}"
            )
    return xr.Dataset(variables)
