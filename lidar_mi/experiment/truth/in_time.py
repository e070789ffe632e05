"""The truth during a scan: the extinction at the times of its beams."""

import math
from collections.abc import Sequence

import numpy as np
import xarray as xr

from lidar_mi.atmosphere.advection import advect_to
from lidar_mi.errors import InputError
from lidar_mi.experiment.observation import Observation
from lidar_mi.experiment.truth.extinction import Truth
from lidar_mi.experiment.truth.flows import Flows, mean_flow
from lidar_mi.instrument.scan import ScanPlan

LARGEST_STEP = 0.25
"""Largest motion of the air from one state to the next, node spacings.

Between states the renderer is linear in time. A wave of 4 nodes, the shortest that a grid carries,
is then displaced by 0.63 * 0.25^3 / 4^2 = 0.0006 nodes at most, and its amplitude is 2 % smaller
half way between two states.
"""
MOST_VALUES = 2.5e8  # values of all states of a scan: 1 GB in the renderer


def state_times(observation: Observation, flows: Flows, times: np.ndarray) -> np.ndarray:
    """Equally spaced times, s, at which the air is computed for beams at ``times``.

    The middle one is that of the middle of the scan.

    Raises InputError: more states than the memory holds.
    """
    flow = mean_flow(flows)
    first, last = float(np.min(times)), float(np.max(times))
    if first == last:
        return np.array([first])
    moved = (last - first) * _speed_in_nodes(flow, _along(observation, flow))
    # an odd number
    count = 2 * max(2, math.ceil(moved / LARGEST_STEP / 2)) + 1
    values = count * flow["v"].size
    if values > MOST_VALUES:
        raise InputError(
            f"scan.air: moving is not allowed here: air moves by {moved:.3g} nodes within a scan "
            f"of {last - first:.3g} s, its {count} states would have {values:.2g} values, expected "
            f"at most {MOST_VALUES:g} (frozen air, a shorter scan or a coarser wake.spacing)"
        )
    return np.linspace(first, last, count)


def values_of_states(observation: Observation, flows: Flows, plans: Sequence[ScanPlan]) -> int:
    """Values of all states of the scan that has most; 0: air is frozen or beams have one time."""
    if observation.scan.air != "moving":
        return 0
    timed = [plan.beams.time for plan in plans if plan.beams is not None]
    counts = [state_times(observation, flows, times).size for times in timed]
    return max(counts, default=0) * flows[0]["v"].size


def air_in_time(
    observation: Observation, truth: Truth, flows: Flows, which: int, times: np.ndarray
) -> xr.DataArray:
    """The extinction of scan ``which`` at the times of its beams, m^-1, dims (time, x, y, z).

    The truth of the scan's reference time, advected by the same flow as the air from t1 to t2. With
    a stored state at t2, the mean of both states advected to the time, weighted linearly in time.

    times: of the beams, s, from the scan's reference time.

    Returns
    -------
    xarray.DataArray
        float32, at `state_times`, for linear interpolation. Without ``time`` where air is uniform.
    """
    if all(float(field.min()) == float(field.max()) for field in truth.extinction):
        return truth.extinction[which]
    flow, dt = mean_flow(flows), observation.platform.dt
    u = _along(observation, flow)
    molecules = truth.molecules
    taus = state_times(observation, flows, times)

    def advected(state: int) -> xr.DataArray:
        # molecules are everywhere, and no undershoot of a spline may remove them
        field = truth.extinction[state] - molecules
        passed = taus + (which - state) * dt
        moved = advect_to(field, flow["v"], flow["w"], passed, u=u) + molecules
        return moved.assign_coords(time=taus).astype(np.float32)

    if flows[1] is None:
        return advected(which)
    weight = xr.DataArray(np.clip((taus + which * dt) / dt, 0, 1), {"time": taus}, "time")
    return ((1 - weight) * advected(0) + weight * advected(1)).astype(np.float32)


def _along(observation: Observation, flow: xr.Dataset) -> xr.DataArray | None:
    """Speed of the air along x in the frame of the gates, m/s; None: it is uniform along x."""
    return flow["u"] - observation.scan.follow if observation.moves_along else None


def _speed_in_nodes(flow: xr.Dataset, u: xr.DataArray | None) -> float:
    """Largest speed of the air on its grid, node spacings a second."""
    squared = xr.DataArray(0.0)
    for speed, axis in ((u, "x"), (flow["v"], "y"), (flow["w"], "z")):
        if speed is None:
            continue
        spacing = float(flow[axis][1] - flow[axis][0])
        squared = squared + (speed / spacing) ** 2
    return math.sqrt(float(squared.max()))
