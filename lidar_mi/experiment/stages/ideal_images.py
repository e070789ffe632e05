"""Images that the lidar would take without noise: every beam meets the air of its own time."""

from collections.abc import Sequence

import numpy as np
import scipy
import xarray as xr

from lidar_mi.experiment.observation import Observation
from lidar_mi.experiment.truth.blur import blur_by_beam
from lidar_mi.experiment.truth.extinction import Truth
from lidar_mi.experiment.truth.flows import Flows
from lidar_mi.experiment.truth.in_time import air_in_time
from lidar_mi.experiment.truth.slab import slab_mean
from lidar_mi.instrument.lidar import BackscatterLidar
from lidar_mi.instrument.scan import ScanPlan


def slab_images(
    observation: Observation, truth: Truth, flows: Flows | None, plans: Sequence[ScanPlan]
) -> list[xr.DataArray]:
    """The extinction of both scans averaged over the first gate's depth, m^-1.

    Dims (z, y), or (time, z, y) where the air moves during the scan, with ``flows``.
    """
    gates = truth.wind.attrs["gates"]
    images = []
    for which, plan in enumerate(plans):
        # the truth's image is of the scan's reference time, that of all beams here
        if plan.beams is None or flows is None or observation.scan.air == "frozen":
            images.append(truth.image(which))
            continue
        air = air_in_time(observation, truth, flows, which, plan.beams.time)
        images.append(slab_mean(air.astype(float), gates))
    return images


def ideal_scan(
    air: xr.DataArray,
    plan: ScanPlan,
    lidar: BackscatterLidar | None = None,
    depth: float = 0.0,
    *,
    gridded: bool = True,
) -> xr.Dataset:
    """The air as the beams of a scan see it, where they were reported to look, on the nodes.

    air (z, y) or (time, z, y): images of the air on the plan's nodes or around them, at equally
        spaced times (s) from the scan's reference time.
    plan: with its true and its reported beams. Without beams: all at once, to the nodes.
    lidar: whose beams average the air, see `blur_by_beam`. Default: beams without width.
    depth: of the gate, m.
    gridded: whether the beams are resampled to the nodes; else their places are given.

    Returns
    -------
    xr.Dataset, dims (z, y)
        ``Y``, unit of ``air``; with beams also their ``beam_time``, s. From
        `lidar_mi.retrieval.images.gridding.on_nodes`; as this takes it if not ``gridded``.
    """
    from lidar_mi.retrieval.images.gridding import on_nodes

    states = air if "time" in air.dims else air.expand_dims(time=[0.0])
    if lidar is not None:
        blurred = [blur_by_beam(state, lidar, plan.centre, depth) for state in states]
        states = xr.concat(blurred, states["time"])
    states = states.transpose("time", "z", "y")
    nodes = {name: (name, getattr(plan, name), {"units": "m"}) for name in ("z", "y")}
    if plan.beams is None:
        return xr.Dataset({"Y": states[0].drop_vars("time").interp(nodes)})
    middle = plan.position + plan.centre
    reported = plan.beams.reported_places(middle)
    values = _at_beams(states, plan.beams.time, plan.beams.true_places(middle))
    fields = {
        "Y": values,
        "beam_time": plan.beams.time,
        "y_reported": reported[:, 0],
        "z_reported": reported[:, 1],
    }
    scan = xr.Dataset(
        {name: (("z", "y"), plan.as_image(values)) for name, values in fields.items()}, nodes
    )
    return on_nodes(scan) if gridded else scan


def _at_beams(states: xr.DataArray, time: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Values at beams: linear in time as in the renderer, by cubic splines in (y, z) places."""
    axes = [states[name].values for name in ("z", "y")]
    index = np.stack(
        [
            (place - axis[0]) / (axis[1] - axis[0])
            for place, axis in zip(places.T[::-1], axes, strict=True)
        ]
    )
    times = states["time"].values
    values = np.zeros(len(time))
    for state, one in zip(states.values, np.eye(len(times)), strict=True):
        # interpolation of a unit vector gives the weight of its state at every beam
        weight = np.interp(time, times, one)
        met = weight > 0
        if met.any():
            here = scipy.ndimage.map_coordinates(state, index[:, met], order=3, mode="nearest")
            values[met] += weight[met] * here
    return values
