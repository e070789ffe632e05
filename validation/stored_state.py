"""A stored state of the shipped simulation against advection: wind, and its tracer scheme."""

from collections.abc import Callable
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path

import numpy as np
import xarray as xr
from scipy.ndimage import gaussian_filter

import lidar_mi as lm
from lidar_mi.atmosphere.advection import advect
from lidar_mi.atmosphere.wake import resample
from lidar_mi.experiment.truth.extinction import extinction_of
from lidar_mi.io.wake_file import read_wake

from .report import Check, Comparison, Row
from .scenes import Effort

TITLE = "Stored state of the simulation"
INTRODUCTION = (
    "The shipped simulation has its tracers at 40.0 and 40.1 s in one plane, and at 40.0 s in 20 "
    "planes with the wind. Here they are advected from 40.0 to 40.1 s, on nodes of 0.5 m, by the "
    "mean wind of both times: in the plane, in three dimensions, and by a finite-volume scheme. "
    "The residual is the stored state at 40.1 s less that of three-dimensional advection."
)

SCENES = Path(str(files("lidar_mi.scenes")))
TIMES = (40.0, 40.1)
PLANE = 20.5
"""Of the file with both times, m."""
SPACING = 0.5
NEAR = slice(10.0, 31.0)
"""Planes that are refined, m: air moves by 0.1 m."""
EDGE = 16
"""Nodes along the edges that are not compared: air enters there."""
SMOOTHING = 1.2
"""Of the Gaussian, m: cells of the simulation."""
FIELDS = ("aerosol", "tracer", "extinction")


@dataclass(frozen=True)
class States:
    """A field in the plane, dims (y, z): at t1, advected to t2, and as it is stored there."""

    start: np.ndarray
    in_plane: np.ndarray
    along: np.ndarray
    scheme: np.ndarray
    stored: np.ndarray


@dataclass(frozen=True)
class Fractions:
    """Parts of the change from t1 to t2.

    Attributes
    ----------
    in_plane, along, residual : float
        Of its variance: explained by the wind in the plane, in addition by that along x, by
        neither.
    displacements : (float, float)
        Rms difference from in-plane and from three-dimensional advection over the rms of one
        component of the gradient, m.
    smoothed, scheme_smoothed : float
        Of the variance of the residual and of the scheme's error, after the Gaussian.
    correlation, explained : float
        Of the residual with the error of the scheme; of its variance, explained by this error as it
        is.
    """

    in_plane: float
    along: float
    residual: float
    displacements: tuple[float, float]
    smoothed: float
    scheme_smoothed: float
    correlation: float
    explained: float


def van_leer(
    field: np.ndarray, velocity: tuple[np.ndarray, ...], spacing: float, dt: float, steps: int = 8
) -> np.ndarray:
    """A field after dt by finite volumes with van Leer's limiter, which makes no new extrema.

    Parameters
    ----------
    field : (nx, ny, nz) array
    velocity : three of the same shape
        m/s.
    spacing : float
        m.
    dt : float
        s.
    steps : int
        Third-order Runge-Kutta steps that preserve monotony (Shu and Osher, J. Comput. Phys. 77,
        1988).
    """
    h = dt / steps / spacing
    for _ in range(steps):
        one = field + h * _tendency(field, velocity)
        two = 0.75 * field + 0.25 * (one + h * _tendency(one, velocity))
        field = field / 3 + 2 / 3 * (two + h * _tendency(two, velocity))
    return field


def _tendency(field: np.ndarray, velocity: tuple[np.ndarray, ...]) -> np.ndarray:
    """Change in the time of one cell at unit speed; 0 in the two cells next to an end."""
    change = np.zeros_like(field)
    for axis, component in enumerate(velocity):
        u, f = np.moveaxis(component, axis, 0), np.moveaxis(field, axis, 0)
        # faces, by cubic interpolation
        u = (9 * (u[1:-2] + u[2:-1]) - (u[:-3] + u[3:])) / 16
        ahead = f[2:-1] - f[1:-2]
        behind = np.where(u > 0, f[1:-2] - f[:-3], f[3:] - f[2:-1])
        upwind = np.where(u > 0, f[1:-2], f[2:-1])
        # half of the limited slope, the harmonic mean of both, 0 at extrema
        product, total = ahead * behind, ahead + behind
        slope = np.divide(product, total, out=np.zeros_like(total), where=product > 0)
        face = upwind + np.where(u > 0, slope, -slope)
        inner = np.moveaxis(change, axis, 0)[2:-2]
        # the wind between nodes is not exactly free of divergence, and a uniform field must stay
        inner -= np.diff(u * face, axis=0) - f[2:-2] * np.diff(u, axis=0)
    return change


def states() -> dict[str, States]:
    """The fields of the shipped wake by name: tracers of the file, and the extinction they make."""
    volume = read_wake(SCENES / "wake_volume_40s.nc", TIMES[0])
    before, after = (read_wake(SCENES / "wake_slab_40s.nc", time) for time in TIMES)
    dt = TIMES[1] - TIMES[0]
    # planes beside this one change by nearly the same in this time
    half = {name: (after[name] - before[name]).isel(x=0, drop=True) / 2 for name in "uvw"}
    volume = volume.assign({name: volume[name] + half[name] for name in "uvw"})
    velocity = tuple(volume[name].values for name in "uvw")
    transported = {name: van_leer(volume[name].values, velocity, 1.0, dt) for name in FIELDS[:2]}
    # rounding beside air without tracer
    scheme = volume.assign(
        {name: volume[name].copy(data=np.maximum(a, 0)) for name, a in transported.items()}
    )
    volume, scheme = (resample(one.sel(x=NEAR), SPACING, "xyz") for one in (volume, scheme))
    plane = volume.sel(x=[PLANE])
    u, v, w = (volume[name] for name in "uvw")
    along = {name: advect(volume[name], v, w, dt, u=u).sel(x=[PLANE]) for name in FIELDS[:2]}
    inside = {name: advect(plane[name], plane["v"], plane["w"], dt) for name in FIELDS[:2]}
    every = {
        "start": plane,
        "in_plane": plane.assign(inside),
        "along": plane.assign(along),
        "scheme": scheme.sel(x=[PLANE]),
        "stored": resample(after, SPACING),
    }
    mapping = lm.load_experiment("wake_changing").wake.extinction
    densest = max(every.values(), key=lambda state: float(state["tracer"].max()))

    def of(name: str) -> Callable[[xr.Dataset], np.ndarray]:
        def values(state: xr.Dataset) -> np.ndarray:
            if name == "extinction":
                return extinction_of(state, mapping, state, densest).values[0]
            return state[name].values[0]

        return values

    return {
        name: States(**{kind: of(name)(state) for kind, state in every.items()}) for name in FIELDS
    }


def fractions(states: States) -> Fractions:
    """Of the change from t1 to t2, away from the edges."""

    def power(values: np.ndarray) -> float:
        return float(np.mean(values[EDGE:-EDGE, EDGE:-EDGE] ** 2))

    plane, residual = states.stored - states.in_plane, states.stored - states.along
    whole = power(states.stored - states.start)
    slope = np.mean([power(one) for one in np.gradient(states.start, SPACING)])
    error = states.scheme - states.along
    inner = (slice(EDGE, -EDGE),) * 2
    return Fractions(
        1 - power(plane) / whole,
        (power(plane) - power(residual)) / whole,
        power(residual) / whole,
        (float(np.sqrt(power(plane) / slope)), float(np.sqrt(power(residual) / slope))),
        *(
            power(gaussian_filter(one, SMOOTHING / SPACING)) / power(one)
            for one in (residual, error)
        ),
        float(np.corrcoef(error[inner].ravel(), residual[inner].ravel())[0, 1]),
        1 - power(residual - error) / power(residual),
    )


def residual(effort: Effort) -> Check:
    found = {name: fractions(state) for name, state in states().items()}
    heads = (
        "change in 0.1 s of",
        "wind in the plane",
        "wind along x",
        "residual",
        "difference from advection in the plane, in three dimensions",
        "residual after a Gaussian of 1.2 m",
        "residual explained by the error of a tracer scheme",
        "correlation",
    )
    lines = tuple(
        (
            name,
            *(f"{100 * part:.1f} %" for part in (one.in_plane, one.along, one.residual)),
            "{:.3f}, {:.3f} m".format(*one.displacements),
            f"{100 * one.smoothed:.0f} %",
            f"{100 * one.explained:.0f} %",
            f"{one.correlation:.2f}",
        )
        for name, one in found.items()
    )
    rows = [
        row
        for name, one in found.items()
        for row in (
            Row(
                f"{name}: correlation of the residual with the error of a tracer scheme",
                "the residual is the error of such a scheme; limiters differ by 0.2",
                1.0,
                one.correlation,
                tolerance=0.2,
            ),
            Row(
                f"{name}: fraction of the residual's variance after a Gaussian of {SMOOTHING} m",
                "that of the error of the tracer scheme",
                one.scheme_smoothed,
                one.smoothed,
                tolerance=0.1,
            ),
        )
    ]
    return Check(
        "Wind and numerics in the change over 0.1 s",
        "Fractions of the variance of the change from 40.0 to 40.1 s in the plane x = 20.5 m, "
        f"without {EDGE * SPACING:g} m along the edges. Differences in metres are rms over the rms "
        "of one component of the gradient. The simulation advects its tracers by a finite-volume "
        "scheme that creates no new extrema. The scheme here is of that kind (van Leer's limiter, "
        "cells of 1 m) and has the same wind. Its error, the difference from three-dimensional "
        "advection, explains most of the residual without any factor: the residual is numerics.",
        tuple(rows),
        comparison=Comparison(heads, lines),
    )


CHECKS = (residual,)
