"""Analytic wake vortices: swirl profiles, the flow of any set of them, the wake pair.

Frame: x forward, y to port (left), z up. A vortex with positive circulation rotates about +x,
from +y towards +z.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike

from lidar_mi.errors import InputError

Model = Literal["lamb_oseen", "burnham_hallock"]
MODELS: tuple[str, ...] = get_args(Model)

# Root of 1 + 2 a = exp(a): the Lamb-Oseen swirl has its maximum at r = core_radius.
LAMB_OSEEN_CONSTANT = 1.2564


@dataclass(frozen=True)
class Vortex:
    """A straight vortex along x.

    circulation: Gamma in m^2 s^-1; positive rotates about +x (port vortex of a wake).
    core_radius: radius of the largest tangential speed, m, > 0.
    y, z: position of the axis, m.
    model {"lamb_oseen", "burnham_hallock"}: swirl profile, see `tangential_speed`.

    Raises InputError: for a core radius that is not positive, values that are not finite, an
    unknown model.
    """

    circulation: float
    core_radius: float
    y: float
    z: float
    model: Model = "lamb_oseen"

    def __post_init__(self) -> None:
        for name in ("circulation", "y", "z"):
            value = getattr(self, name)
            if not np.isfinite(value):
                raise InputError(f"vortex.{name}: {value} is not allowed; any finite number is")
        _check_profile(self.core_radius, self.model)


def _check_profile(core_radius: float, model: str) -> None:
    if not (np.isfinite(core_radius) and core_radius > 0):
        raise InputError(f"vortex.core_radius: {core_radius} m is not allowed; it must be > 0 m")
    if model not in MODELS:
        raise InputError(f"vortex.model: {model!r} is not known; allowed: {', '.join(MODELS)}")


def angular_velocity(
    r2: ArrayLike, circulation: ArrayLike, core_radius: float, model: Model = "lamb_oseen"
) -> np.ndarray:
    """Tangential speed over radius, s^-1, from the squared radius (m^2): finite on the axis."""
    s = np.asarray(r2, dtype=float) / core_radius**2
    if model == "lamb_oseen":
        # expm1, as 1 - exp(-x) loses its digits near the axis, where the limit is the constant
        profile = np.divide(
            -np.expm1(-LAMB_OSEEN_CONSTANT * s),
            s,
            out=np.full_like(s, LAMB_OSEEN_CONSTANT),
            where=s > 0,
        )
    else:
        profile = 1.0 / (s + 1.0)
    return np.asarray(circulation) / (2 * np.pi * core_radius**2) * profile


def tangential_speed(
    r: ArrayLike, circulation: float, core_radius: float, model: Model = "lamb_oseen"
) -> np.ndarray:
    """Swirl velocity of a single vortex, m/s, of the sign of its circulation (m^2/s); lengths in m.

    Lamb-Oseen: Gamma/(2 pi r) (1 - exp(-1.2564 r^2/r_c^2)).
    Burnham-Hallock: Gamma/(2 pi) r/(r^2 + r_c^2). Zero on the axis (Gerz, Holzäpfel and
    Darracq, Prog. Aerosp. Sci. 38, 2002).
    """
    _check_profile(core_radius, model)
    r = np.asarray(r, dtype=float)
    return r * angular_velocity(r**2, circulation, core_radius, model)


def velocity(
    vortices: Sequence[Vortex], y: ArrayLike, z: ArrayLike
) -> tuple[np.ndarray, np.ndarray]:
    """Cross-flow velocity v, w (m/s) of a set of vortices at places y, z (m), by superposition.

    A vortex at (y0, z0) gives v = -v_t (z - z0)/r and w = +v_t (y - y0)/r.
    """
    y, z = np.broadcast_arrays(np.asarray(y, dtype=float), np.asarray(z, dtype=float))
    v, w = np.zeros(y.shape), np.zeros(y.shape)
    for vortex in vortices:
        dy, dz = y - vortex.y, z - vortex.z
        omega = angular_velocity(
            dy**2 + dz**2, vortex.circulation, vortex.core_radius, vortex.model
        )
        v -= omega * dz
        w += omega * dy
    return v, w


def vortex_pair(
    circulation: float,
    separation: float = 47.1,
    core_radius: float = 3.0,
    y: float = 0.0,
    z: float = 0.0,
    model: Model = "lamb_oseen",
) -> tuple[Vortex, Vortex]:
    """The counter-rotating pair behind an aircraft: port, starboard.

    Port (larger y) has +circulation, starboard -circulation, so the air between them moves
    down. Separation and core radius default to the paper's 47.1 m and 3 m. Both are about (y, z);
    lengths are in m, Gamma_0 > 0 in m^2 s^-1.

    Raises InputError: for a separation or circulation that is not positive.
    """
    _check_pair(circulation, separation)
    half = separation / 2
    return (
        Vortex(circulation, core_radius, y + half, z, model),
        Vortex(-circulation, core_radius, y - half, z, model),
    )


def _check_pair(circulation: float, separation: float) -> None:
    for name, value, unit in (
        ("circulation", circulation, "m^2/s"),
        ("separation", separation, "m"),
    ):
        if not (np.isfinite(value) and value > 0):
            raise InputError(f"vortex pair.{name}: {value} {unit} is not allowed; it must be > 0")


def descent_speed(circulation: float, separation: float) -> float:
    """Speed w_0 = Gamma/(2 pi b_0) at which a pair of point vortices descends, m s^-1.

    With a core, the partner's swirl at b_0 is smaller by exp(-1.2564 b_0^2/r_c^2) (Lamb-Oseen,
    negligible at b_0/r_c = 16) or by 1/(1 + b_0^2/r_c^2) (Burnham-Hallock, 0.4 %).
    """
    _check_pair(circulation, separation)
    return circulation / (2 * np.pi * separation)


def pair_wake(vortices: Sequence[Vortex], y: ArrayLike, z: ArrayLike, x: float = 0.0) -> xr.Dataset:
    """The flow of analytic vortices in the layout of `lidar_mi.io.wake_file.read_wake`.

    vortices: for example from `vortex_pair`.
    y, z: the axes, m, 1-D, ascending.
    x: place of the single plane, m.

    Returns
    -------
    xarray.Dataset
        u (zero), v, w in m s^-1 on dims (x, y, z), x of length 1; no tracer.
    """
    axes = {}
    for name, values in (("y", y), ("z", z)):
        values = np.asarray(values, dtype=float)
        if values.ndim != 1 or values.size < 2 or not (np.diff(values) > 0).all():
            raise InputError(
                f"vortex wake.{name}: shape {values.shape} is not an axis; allowed: "
                "1-D, ascending, 2 values or more"
            )
        axes[name] = values
    v, w = velocity(vortices, axes["y"][:, None], axes["z"][None, :])
    long_names = {
        "u": "velocity along the flight path",
        "v": "velocity across the flight path, positive to port",
        "w": "vertical velocity, positive upwards",
    }
    return xr.Dataset(
        {
            name: (("x", "y", "z"), data[None], {"units": "m s-1", "long_name": long_names[name]})
            for name, data in (("u", np.zeros_like(v)), ("v", v), ("w", w))
        },
        coords={
            "x": ("x", [float(x)], {"units": "m"}),
            "y": ("y", axes["y"], {"units": "m"}),
            "z": ("z", axes["z"], {"units": "m"}),
        },
    )
