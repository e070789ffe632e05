"""The estimate that the lidar delivers at a step."""

from collections.abc import Mapping
from dataclasses import dataclass

import xarray as xr

from lidar_mi.retrieval.vortices.pair import VortexPairFit

SKIPPED = "skipped, as the computer was busy with earlier slabs"
"""Flag of vortices or wind, after their name and a colon."""


@dataclass(frozen=True, eq=False)
class Estimate:
    """Wind and vortices of one slab of air, from the two scans that hold it.

    Attributes
    ----------
    time : float
        When the wind and the vortices are valid: half way between both scans, s.
    delivered : float
        Time at which the vortices are delivered, from the second scan's reference time on, s.
    x : float
        Plane of the slab along the flight path, m.
    wind : xr.Dataset or None
        v, w (z, y), m/s, with v_stderr, w_stderr, vw_correlation and flag; where there is a
        Doppler lidar, u, v, w and their covariance from both (`combined.combine`). None before a
        second scan.
    pair : VortexPairFit or None
        The vortices in the slab's plane, at `time`; look at its `success` and `reasons` first.
    flags : tuple of str
        Limitations of the estimate; empty if there are none.
    seconds : mapping
        Duration of each part of the estimate, s, without the rendering.
    lines : xr.Dataset or None
        Speeds along the lines of sight (line), in the frame of the aircraft half way between both
        scans. None without a Doppler lidar.
    wind_delivered : float or None
        Time at which the wind is delivered, s; None: with the vortices.
    """

    time: float
    delivered: float
    x: float
    wind: xr.Dataset | None
    pair: VortexPairFit | None
    flags: tuple[str, ...]
    seconds: Mapping[str, float]
    lines: xr.Dataset | None = None
    wind_delivered: float | None = None
