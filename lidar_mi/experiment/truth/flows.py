"""The flow at both times, centred and refined: from a file, or analytic."""

import functools
import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import xarray as xr

from lidar_mi.atmosphere.advection import carrier
from lidar_mi.atmosphere.turbine import TurbineWake, turbine_flow
from lidar_mi.atmosphere.vortex import pair_wake, vortex_pair
from lidar_mi.atmosphere.wake import centre, check_nodes, resample
from lidar_mi.errors import InputError
from lidar_mi.experiment.input_files import find_file
from lidar_mi.experiment.memory import most_nodes
from lidar_mi.experiment.schema.experiment import Experiment
from lidar_mi.experiment.schema.wake import Wake
from lidar_mi.io.wake_file import read_wake

Flows = tuple[xr.Dataset, xr.Dataset | None]
Advection = Callable[[xr.DataArray], xr.DataArray]


def mean_flow(flows: Flows) -> xr.Dataset:
    """The flow that carries the air from t1 to t2: steady, or the mean of both states."""
    first, second = flows
    return first if second is None else (first + second) / 2


def moves_along(experiment: Experiment) -> bool:
    """Whether air moves along x between the images; a plane of air is uniform along it."""
    return experiment.wake.turbine is not None or experiment.volume is not None


def advection_by(experiment: Experiment, flows: Flows) -> Advection:
    """From a field to the field after dt in the frame of the gates; trajectories are followed once.

    They are followed when they are first needed: a field of one value stays.
    """
    flow, dt = mean_flow(flows), experiment.platform.dt

    @functools.cache
    def carry() -> Advection:
        along = flow["u"] - experiment.scan.follow if moves_along(experiment) else None
        return carrier(flow["v"], flow["w"], dt, u=along)

    def advected(field: xr.DataArray) -> xr.DataArray:
        return field if float(field.min()) == float(field.max()) else carry()(field)

    return advected


def read_flows(experiment: Experiment, beside: str | Path = ".") -> Flows:
    """The flow at t1 and, if it is a state of its own, at t2, centred and refined."""
    wake, most = experiment.wake, most_nodes(experiment)
    gate_middle = experiment.scan.range + experiment.scan.thickness / 2
    if wake.vortex_pair:
        pair = wake.vortex_pair
        axes = analytic_axes(wake, "vortex_pair", most)
        vortices = vortex_pair(
            pair.circulation, pair.separation, pair.core_radius, model=pair.model
        )
        return pair_wake(vortices, *axes, x=gate_middle), None
    if wake.turbine:
        return _turbine(experiment, gate_middle), None
    needed, names = tracers_of(wake)
    path = find_file(wake.file, beside, "wake.file")
    if wake.second != "advect" and wake.time is not None:
        passed = wake.second - wake.time
        if abs(passed - experiment.platform.dt) > 1e-3 * experiment.platform.dt:
            raise InputError(
                f"wake.second: {wake.second:.15g} s is not allowed; expected platform.dt = "
                f"{experiment.platform.dt:g} s after wake.time = {wake.time:.15g} s"
            )
    flows = []
    for when in (wake.time, None if wake.second == "advect" else wake.second):
        if flows and when is None:
            return flows[0], None
        plane = wake.x if wake.depth == "plane" else None
        flow = read_wake(path, when, names, plane, require=needed)
        if wake.depth == "plane" and flow.sizes["x"] > 1:
            places = flow["x"].values
            raise InputError(
                f"wake.x: missing; {path.name} has {len(places)} planes, expected one of "
                f"{places[0]:g} to {places[-1]:g} m (or wake.depth: volume)"
            )
        y, z = wake.centre or (None, None)
        axes = "xyz" if experiment.volume else "yz"
        fine = resample(flow, wake.spacing, axes, most)
        flow = centre(fine, y, z).drop_vars("time", errors="ignore")
        middle = wake.x if wake.x is not None else float(flow["x"].mean())
        flows.append(flow.assign_coords(x=flow["x"] - middle + gate_middle))
    return flows[0], flows[1]


def tracers_of(wake: Wake) -> tuple[dict[str, str], dict[str, str]]:
    """Variables that the extinction needs of a wake's file; names of all in the file.

    Tracers of the extinction have our names once they are read.
    """
    mapping = wake.extinction
    named = {"tracer": mapping.tracer, "aerosol": mapping.aerosol}
    needed = {n: t for n, t in named.items() if t and mapping.source == "tracer"}
    return needed, wake.names | {n: t for n, t in needed.items() if t != n}


def _turbine(experiment: Experiment, gate_middle: float) -> xr.Dataset:
    """Wind behind a turbine on planes that contain the gates and the air that passes them."""
    wake, turbine, scan = experiment.wake, experiment.wake.turbine, experiment.scan
    mean = TurbineWake(
        **turbine.model_dump(
            include={"diameter", "thrust", "tip_speed_ratio", "wind_speed", "growth", "hub_core"}
        ),
        downstream=turbine.downstream or gate_middle,
    )
    # air from beyond the ends must not reach the gates: the wake's air moves at 0 to the full wind
    fastest = max(abs(scan.follow), abs(turbine.wind_speed - scan.follow))
    margin = fastest * experiment.platform.dt + 2 * wake.spacing
    half = math.ceil((scan.thickness / 2 + margin) / wake.spacing)
    x = gate_middle + wake.spacing * np.arange(-half, half + 1)
    return turbine_flow(
        mean,
        x,
        *analytic_axes(wake, "turbine", most_nodes(experiment)),
        turbine.turbulence,
        turbine.outer_scale,
        experiment.seed,
    )


def analytic_axes(wake, key: str, most: int) -> list[np.ndarray]:
    """y and z of the nodes of an analytic wake, m, about the scan's axis.

    Parameters
    ----------
    wake : Wake
    key : "vortex_pair" or "turbine"
    most : int
        Nodes that are allowed.

    Raises
    ------
    InputError
        An extent that is not a multiple of the spacing, too many nodes.
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
