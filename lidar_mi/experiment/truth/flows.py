"""The flow at both times, centred and refined: from a file, or analytic."""

import functools
import math
from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import numpy as np
import xarray as xr

from lidar_mi.atmosphere.advection import carrier
from lidar_mi.atmosphere.turbine import TurbineWake, turbine_flow
from lidar_mi.atmosphere.vortices.vortex import pair_wake, vortex_pair
from lidar_mi.atmosphere.vortices.wake import centre, check_nodes, resample
from lidar_mi.errors import InputError
from lidar_mi.experiment.graph import Guard, call
from lidar_mi.experiment.log import Log
from lidar_mi.experiment.memory import Footprint
from lidar_mi.experiment.observation import Observation
from lidar_mi.experiment.truth.slab import slab_mean
from lidar_mi.instrument.scan import Scan
from lidar_mi.io.wake_file import read_wake
from lidar_mi.schema.experiment import Experiment
from lidar_mi.schema.input_files import find_file
from lidar_mi.schema.platform import Platform
from lidar_mi.schema.wake import Turbine, Wake

Flows = tuple[xr.Dataset, xr.Dataset | None]
Advection = Callable[[xr.DataArray], xr.DataArray]

_LEAST_PLANES = 4
"""Least planes of a file along x: a cubic spline needs four."""
_EDGE = 2
"""Nodes at either end along x from which no air of the gates may come.

Beyond the ends a spline has the value at the end.
"""
_BEYOND = 4
"""Planes of a file that are read beyond the air of the gates, on either side.

The response of a cubic spline falls by a factor 0.27 a plane: 0.5 % are left.
"""


def mean_flow(flows: Flows) -> xr.Dataset:
    """The flow that carries the air from t1 to t2: steady, or the mean of both states."""
    first, second = flows
    return first if second is None else (first + second) / 2


def advection_by(observation: Observation, flows: Flows) -> Advection:
    """From a field to the field after dt in the frame of the gates; trajectories are followed once.

    They are computed on first use: a uniform field needs none.
    """
    flow, dt = mean_flow(flows), observation.platform.dt

    @functools.cache
    def carry() -> Advection:
        along = flow["u"] - observation.scan.follow if observation.moves_along else None
        return carrier(flow["v"], flow["w"], dt, u=along)

    def advected(field: xr.DataArray) -> xr.DataArray:
        return field if float(field.min()) == float(field.max()) else carry()(field)

    return advected


def flows_of(experiment: Experiment, search_path: Path | None = None) -> Flows:
    """The flows of an experiment, see `read_flows`; files are searched in its folder first."""
    return call(
        read_flows,
        experiment,
        footprint=call(Footprint, experiment),
        search_path=search_path or experiment.folder,
    )


def read_flows(
    observation: Observation,
    seed: int,
    footprint: Annotated[Footprint, Guard],
    search_path: Path,
    log: Log,
) -> Flows:
    """The flow at t1 and, if it is a state of its own, at t2, centred and refined.

    Raises InputError: a wake that cannot be read, or images of it that a run cannot hold: before
    more is made of it.
    """
    log.bar("reading the wake", None)
    scan = observation.scan
    if scan.aim == "angles":
        footprint.check_size(scan.columns, scan.rows)
    flows = _flows(observation, seed, footprint.most_nodes(), search_path)
    if scan.aim == "grid":  # a beam for every node
        footprint.check_size(flows[0].sizes["y"], flows[0].sizes["z"])
    return flows


def _flows(observation: Observation, seed: int, most: int, search_path: Path) -> Flows:
    wake, platform, scan = observation.wake, observation.platform, observation.scan
    gate_middle = scan.range + scan.thickness / 2
    if wake.vortex_pair:
        pair = wake.vortex_pair
        y, z = analytic_axes(wake, "vortex_pair", most)
        vortices = vortex_pair(
            pair.circulation, pair.separation, pair.core_radius, model=pair.model
        )
        return pair_wake(vortices, y, z, x=gate_middle), None
    if wake.turbine:
        return _turbine(observation, wake.turbine, seed, most), None
    assert wake.file is not None  # of the three kinds of wake, the schema asks for one
    tracers, names = tracers_of(wake)
    path = find_file(wake.file, search_path, "wake.file")
    if wake.stored is not None and wake.time is not None:
        passed = wake.stored - wake.time
        if abs(passed - platform.dt) > 1e-3 * platform.dt:
            raise InputError(
                f"wake.second: {wake.stored:.15g} s is not allowed; expected platform.dt = "
                f"{platform.dt:g} s after wake.time = {wake.time:.15g} s"
            )

    along = wake.second == "advect_3d"
    axes = "xyz" if along or observation.moves_along else "yz"

    def state(when: float | None) -> xr.Dataset:
        plane = wake.x if wake.depth == "plane" and not along else None
        flow = read_wake(path, when, names, plane, require=tracers)
        places = flow["x"].values
        if wake.depth == "plane" and wake.x is None and len(places) > 1:
            raise InputError(
                f"wake.x: missing; {path.name} has {len(places)} planes, expected one of "
                f"{places[0]:g} to {places[-1]:g} m (or wake.depth: volume)"
            )
        middle = wake.x if wake.x is not None else float(flow["x"].mean())
        if along:
            first, last = _air_of_gates(wake, platform, scan, flow, middle, path.name)
            if wake.depth == "plane":
                beyond = _BEYOND * (places[1] - places[0])
                flow = flow.sel(x=slice(first - beyond, last + beyond))
        y, z = wake.centre or (None, None)
        fine = resample(flow, wake.spacing, axes, most)
        flow = centre(fine, y, z).drop_vars("time", errors="ignore")
        return flow.assign_coords(x=flow["x"] - middle + gate_middle)

    first = state(wake.time)
    if along and wake.depth == "plane":
        return _advected_along(first, platform, scan)
    return first, None if wake.stored is None else state(wake.stored)


def _air_of_gates(
    wake: Wake, platform: Platform, scan: Scan, flow: xr.Dataset, middle: float, name: str
) -> tuple[float, float]:
    """Ends along x (m, of the file) of the air that is in the gates at t1 or at t2, with `_EDGE`.

    ``middle`` (m) is put into the middle of the gates. A file without u, or whose planes do not
    hold that air, is refused.
    """
    if "u" not in flow:
        raise InputError(
            f"wake.second: advect_3d is not allowed, as {name} has no wind along x (u); expected "
            "u in it, wake.names: {u: its name there}, or wake.second: advect"
        )
    moved = (flow["u"] - scan.follow) * platform.dt
    half, edge = scan.thickness / 2, _EDGE * wake.spacing
    first = middle - half - max(float(moved.max()), 0.0) - edge
    last = middle + half - min(float(moved.min()), 0.0) + edge
    planes = flow["x"].values
    if planes.size < _LEAST_PLANES or planes[0] > first or planes[-1] < last:
        raise InputError(
            f"wake.second: advect_3d is not allowed with {planes.size} planes of {name} from x = "
            f"{planes[0]:g} to {planes[-1]:g} m; expected at least {_LEAST_PLANES}, from "
            f"{first:.4g} m or less to {last:.4g} m or more: scan.thickness, the way of the air "
            f"along x in platform.dt and {_EDGE} wake.spacing at either end"
        )
    return first, last


def _advected_along(flow: xr.Dataset, platform: Platform, scan: Scan) -> Flows:
    """Planes at t1 and t2: a volume, and the same advected by its own wind, means over the gates.

    The wind is that of t1 in both.
    """
    advected = carrier(flow["v"], flow["w"], platform.dt, u=flow["u"] - scan.follow)
    tracers = {name: advected(flow[name]) for name in ("tracer", "aerosol") if name in flow}
    gates = scan.range, scan.range + scan.thickness

    def plane(state: xr.Dataset) -> xr.Dataset:
        mean = state.map(slab_mean, keep_attrs=True, gates=gates)
        return mean.expand_dims(x=[sum(gates) / 2]).transpose("x", "y", "z")

    return plane(flow), plane(flow.assign(tracers))


def tracers_of(wake: Wake) -> tuple[dict[str, str], dict[str, str]]:
    """Variables that the extinction needs of a wake's file; names of all in the file.

    Tracers of the extinction have our names after reading.
    """
    mapping = wake.extinction
    in_file = {"tracer": mapping.tracer, "aerosol": mapping.aerosol}
    tracers = {n: t for n, t in in_file.items() if t and mapping.source == "tracer"}
    return tracers, wake.names | {n: t for n, t in tracers.items() if t != n}


def _turbine(observation: Observation, turbine: Turbine, seed: int, most: int) -> xr.Dataset:
    """Wind behind a turbine on planes that contain the gates and the air that passes them."""
    wake, scan = observation.wake, observation.scan
    gate_middle = scan.range + scan.thickness / 2
    mean = TurbineWake(
        **turbine.model_dump(
            include={"diameter", "thrust", "tip_speed_ratio", "wind_speed", "growth", "hub_core"}
        ),
        downstream=turbine.downstream or gate_middle,
    )
    # air from beyond the ends must not reach the gates: the wake's air moves at 0 to the full wind
    fastest = max(abs(scan.follow), abs(turbine.wind_speed - scan.follow))
    margin = fastest * observation.platform.dt + _EDGE * wake.spacing
    half = math.ceil((scan.thickness / 2 + margin) / wake.spacing)
    y, z = analytic_axes(wake, "turbine", most)
    x = gate_middle + wake.spacing * np.arange(-half, half + 1)
    return turbine_flow(mean, x, y, z, turbine.turbulence, turbine.outer_scale, seed)


def analytic_axes(wake: Wake, key: str, most: int) -> list[np.ndarray]:
    """y and z of at most ``most`` nodes of an analytic wake, m, about the scan's axis.

    Raises InputError: an extent that is not a multiple of the spacing, too many nodes.
    """
    ends = {}
    for axis, name in (("y", "width"), ("z", "height")):
        extent = getattr(getattr(wake, key), name)
        cells = round(extent / wake.spacing)
        if cells < 1 or abs(cells * wake.spacing - extent) > 1e-6 * extent:
            raise InputError(
                f"wake.{key}.{name}: {extent:g} m is not allowed; expected a multiple of "
                f"wake.spacing = {wake.spacing:g} m"
            )
        ends[axis] = (-extent / 2, extent / 2, cells + 1)
    check_nodes(wake.spacing, {axis: count for axis, (*_, count) in ends.items()}, most)
    return [np.linspace(*end) for end in ends.values()]
