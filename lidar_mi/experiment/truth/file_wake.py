"""The wake of a file, as flights and lidars on the ground meet it: its air and its vortices."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import xarray as xr

from lidar_mi.atmosphere.vortices.cores import find_cores, ring_averages
from lidar_mi.atmosphere.vortices.vortex import Vortex
from lidar_mi.errors import InputError
from lidar_mi.experiment.truth.extinction import extinction_of
from lidar_mi.experiment.truth.flows import tracers_of
from lidar_mi.io.wake_file import read_wake
from lidar_mi.schema.wake import Wake

_OUTER = (15.0, 12.0, 10.0, 8.0)
"""Outer radius of the rings over which circulation and drift of a vortex are averaged, m."""

Pairs = tuple[tuple[Vortex, ...], tuple[Vortex, ...]]
"""Port and starboard vortices, one for each plane."""


def refuse_ages(section: str, ages: Mapping[str, float | None]) -> None:
    """Refuse ages and decay times for the wake of a file.

    Raises InputError: a key of the section has a value.
    """
    for key, value in ages.items():
        if value:
            raise InputError(
                f"{section}.{key}: {value:g} is not allowed with wake.file; expected "
                "wake.vortex_pair"
            )


def read_planes(path: Path, wake: Wake, *, volume: bool = False) -> xr.Dataset:
    """Wind and tracers of the plane ``wake.x``, or of all planes.

    Raises InputError: several planes of which none is named.
    """
    tracers, names = tracers_of(wake)
    flow = read_wake(path, wake.time, names, None if volume else wake.x, require=tracers)
    if not volume and flow.sizes["x"] > 1:
        planes = flow["x"].values
        raise InputError(
            f"wake.x: missing; {path.name} has {planes.size} planes, expected one of "
            f"{planes[0]:g} to {planes[-1]:g} m"
        )
    return flow


def with_extinction(flow: xr.Dataset, wake: Wake) -> xr.Dataset:
    """Wind and extinction (1/m) of a flow with tracers."""
    field = extinction_of(flow, wake.extinction, flow, None)
    return flow[[name for name in "uvw" if name in flow]].assign(extinction=field)


def pairs_in(flow: xr.Dataset, name: str) -> tuple[Pairs, tuple[float, float]]:
    """The vortices in each plane, and the wind v, w (m/s) that advects them, of all planes.

    Raises InputError: a plane without two vortices of opposite sense, or with vortices that are too
    close.
    """
    sides: tuple[list[Vortex], list[Vortex]] = ([], [])
    drifts = []
    for index in range(flow.sizes["x"]):
        section = flow.isel(x=index)
        where = f"in the plane x = {float(section['x']):g} m"
        cores = find_cores(section)
        if len(cores) != 2:
            raise InputError(
                f"wake.file: {name} has {len(cores)} vortices {where}; expected two of opposite "
                "sense in every plane"
            )
        for side, core, partner in zip(sides, cores, cores[::-1], strict=True):
            # the widest rings within the plane and around no other core
            tried = (ring_averages(section, core, [partner], outer=outer) for outer in _OUTER)
            rings = next((averages for averages in tried if averages is not None), None)
            if rings is None:
                raise InputError(
                    f"wake.file: {name} has vortices {where} that are too close to each other or "
                    f"to the edge; expected {_OUTER[-1]:g} m of their own flow about them"
                )
            side.append(Vortex(rings.circulation, core.radius, core.y, core.z))
            drifts.append((rings.v, rings.w))
    v, w = np.mean(drifts, axis=0)
    return (tuple(sides[0]), tuple(sides[1])), (float(v), float(w))
