"""The truth of an experiment: flow and extinction at both times, in the lidar's frame."""

import functools
import math
from collections.abc import Callable
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path

import numpy as np
import xarray as xr
from scipy import constants, integrate, stats

from lidar_mi.arguments import checked_arguments
from lidar_mi.atmosphere.advection import carrier
from lidar_mi.atmosphere.extinction import extinction_from_speed, extinction_from_tracer
from lidar_mi.atmosphere.texture import corrsin_obukhov
from lidar_mi.atmosphere.turbine import TurbineWake, turbine_flow
from lidar_mi.atmosphere.vortex import pair_wake, vortex_pair
from lidar_mi.atmosphere.wake import centre, check_nodes, resample
from lidar_mi.errors import InputError
from lidar_mi.experiment.forecast import most_nodes
from lidar_mi.experiment.schema import Experiment
from lidar_mi.experiment.schema_air import ExtinctionMapping, Wake
from lidar_mi.io.wake_file import read_wake

Flows = tuple[xr.Dataset, xr.Dataset | None]
Advection = Callable[[xr.DataArray], xr.DataArray]


@dataclass(frozen=True)
class Truth:
    """The observed air, in the lidar's frame at t1 (metres, m^-1, m s^-1).

    ``extinction`` and ``smooth`` (without sub-grid texture) hold the fields at t1 and t2, dims
    (x, y, z); ``wind`` has v, w on (z, y), averaged over the depth of the first gate.
    """

    extinction: tuple[xr.DataArray, xr.DataArray]
    smooth: tuple[xr.DataArray, xr.DataArray]
    wind: xr.Dataset

    def image(self, which: int, smooth: bool = False) -> xr.DataArray:
        """Extinction averaged over depth as an image (z, y): that of an ideal lidar."""
        field = (self.smooth if smooth else self.extinction)[which]
        return slab_mean(field, self.wind.attrs["gates"])


@checked_arguments
def make_truth(
    experiment: Experiment,
    beside: str | Path | None = None,
    flows: Flows | None = None,
    advected: Advection | None = None,
) -> Truth:
    """The flow and the extinction at both times, on the scan's grid, in the lidar's frame.

    Parameters
    ----------
    experiment : Experiment
    beside : path, optional
        Folder in which the wake's file is searched first. Default: the experiment's.
    flows : optional
        From `read_flows` of an experiment that differs in extinction and texture alone.
    advected : callable, optional
        From `advection_by` the same flows.

    Returns
    -------
    Truth
        ``wind`` (Dataset, m/s), ``extinction`` (at t1 and at t2, 1/m); ``image(k)`` is the
        extinction over (z, y) as the lidar images it.

    Raises
    ------
    InputError
        A file that is missing or inconsistent with the experiment; an experiment without a wake.

    Examples
    --------
    >>> import lidar_mi as lm
    >>> experiment = lm.load_experiment("wake_backscatter")
    >>> truth = lm.make_truth(experiment)
    >>> truth.wind["v"].dims, len(truth.extinction)
    (('z', 'y'), 2)
    """
    if experiment.wake is None:
        raise InputError(f"wake: missing in {experiment.name}; expected the section of a wake")
    beside = experiment.folder if beside is None else beside
    first, second = flows or read_flows(experiment, beside)
    mapping = experiment.wake.extinction
    smooth1 = extinction_of(first, mapping, first, second)
    flow = mean_flow((first, second))
    advected = advected or advection_by(experiment, (first, second))
    if second is None:
        smooth2 = advected(smooth1)
    else:
        smooth2 = extinction_of(second, mapping, first, second)
    texture = experiment.wake.texture
    if texture.rms > 0:
        x = first["x"].values if first.sizes["x"] > 1 else None
        factor = corrsin_obukhov(
            first["y"].values,
            first["z"].values,
            texture.rms,
            texture.outer_scale,
            experiment.seed,
            x=x,
        )
        if x is None:
            factor = factor.expand_dims(x=first["x"].values)
        factor = factor.assign_coords(first.coords).transpose("x", "y", "z")
        if second is None:
            rough1 = smooth1 * factor
            rough2 = advected(rough1)
        else:
            rough1 = smooth1 * factor
            rough2 = smooth2 * advected(factor)
    else:
        rough1, rough2 = smooth1, smooth2
    # winds are retrieved from the first gate
    depth = experiment.scan.thickness / experiment.scan.gate_count
    gates = (experiment.scan.range, experiment.scan.range + depth)
    components = [name for name in ("u", "v", "w") if name in flow]
    wind = xr.Dataset({name: slab_mean(flow[name], gates) for name in components})
    wind.attrs["gates"] = gates
    rough, smooth = (
        tuple(field.copy(data=field.values + mapping.molecules) for field in pair)
        for pair in ((rough1, rough2), (smooth1, smooth2))
    )
    return Truth(rough, smooth, wind)


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


def extinction_of(
    flow: xr.Dataset, mapping: ExtinctionMapping, first: xr.Dataset, second: xr.Dataset | None
) -> xr.DataArray:
    """Extinction (m^-1) of one state of a flow, scaled by the largest value of both."""
    limits = {"background": mapping.background, "maximum": mapping.maximum}
    states = [s for s in (first, second) if s is not None]
    if mapping.source == "speed":
        fastest = max(float(np.hypot(s["v"], s["w"]).max()) for s in states)
        field = extinction_from_speed(flow, **limits, stretch=mapping.stretch, reference=fastest)
    else:
        # an analytic flow has neither: then there is only the background
        tracer = "tracer" if mapping.tracer and "tracer" in flow else None
        aerosol = "aerosol" if mapping.aerosol and "aerosol" in flow else None
        if tracer is None and aerosol is None:
            field = xr.full_like(flow["v"], mapping.background)
            field.attrs = {"long_name": "extinction coefficient", "units": "m-1"}
            return field.transpose("x", "y", "z")
        densest = max(float(s[tracer].max()) for s in states) if tracer else None
        field = extinction_from_tracer(
            flow,
            **limits,
            stretch=mapping.stretch,
            tracer=tracer,
            aerosol=aerosol,
            reference=densest,
        )
    return field.transpose("x", "y", "z")


def slab_mean(field: xr.DataArray, gates: tuple[float, float]) -> xr.DataArray:
    """Mean over the depth of planar gates, (..., z, y); linear between planes, as rendered."""
    x = field["x"].values
    weights = np.ones(1)
    if len(x) > 1:
        half = (x[1] - x[0]) / 2
        first, last = x[0] - half, x[-1] + half
        if gates[0] < first - 1e-6 or gates[1] > last + 1e-6:
            raise InputError(
                f"scan.thickness: gates from {gates[0]:g} to {gates[1]:g} m reach beyond the wake, "
                f"whose planes fill {first:g} to {last:g} m; expected gates inside"
            )
        nodes = np.unique([*gates, *x[(x > gates[0]) & (x < gates[1])]])
        linear = [np.interp(nodes, x, plane) for plane in np.eye(len(x))]
        weights = integrate.trapezoid(linear, nodes) / (gates[1] - gates[0])
    image = (field * xr.DataArray(weights, dims="x")).sum("x").transpose(..., "z", "y")
    image.attrs = field.attrs
    for axis in ("y", "z"):
        image[axis].attrs["units"] = "m"
    return image


def find_file(name: str, beside: str | Path, field: str) -> Path:
    """A file named by an experiment: as given, beside the experiment, or shipped."""
    shipped = Path(str(files("lidar_mi.scenes")))
    for candidate in (Path(beside) / name, shipped / name):
        # a reader says what it expects instead of a folder, such as a Zarr store
        if candidate.is_file() or (candidate.is_dir() and candidate.suffix):
            return candidate
    samples = sorted(p.name for p in shipped.glob("*.nc")) if field == "wake.file" else []
    raise InputError(
        f"{field}: {name} not found; looked in {Path(beside).resolve()} and the shipped samples"
        + (f" ({', '.join(samples)})" if samples else "")
    )


def blur_by_beam(image: xr.DataArray, lidar, distance: float, depth: float = 0.0) -> xr.DataArray:
    """An image averaged over beams of finite width, aimed at its nodes, at a distance.

    Between nodes the air varies linearly, as the renderer's grid does. A beam is a Gaussian with
    the variance per axis of its truncated aperture plus its divergence, so a node k spacings away
    has the weight g(k+1) - 2 g(k) + g(k-1), where g(x) is the mean of max(0, x + sigma X) for
    normal X. The spacing adds 1/6 px^2 to the Gaussian's variance: for 0.5 m and the paper's beam,
    two thirds more. Oblique beams also smear the plane over the gate's ``depth`` (m), along the way
    they take through it; a pulse weighs the gate's middle more than its ends. What is left out
    costs less than 0.1 % of a pixel on textured air: the aperture's truncation beyond its variance,
    and that smear where ``depth`` is 0 (500 m, gates of 2.5 m; at 150 m it is wider than the beam).
    """
    metres = lidar.radius_at(distance) / 2
    steps, weights = _depths(lidar, depth)
    total = 0.0
    for step, weight in zip(steps, weights, strict=True):
        values = image.values
        for axis, name in enumerate(image.dims):
            matrix = _beam_weights(image[name].values, 1 + step / distance, metres)
            values = np.moveaxis(np.tensordot(matrix, values, (1, axis)), 0, axis)
        total = total + weight * values
    return image.copy(data=total)


def _depths(lidar, depth: float) -> tuple[np.ndarray, np.ndarray]:
    """Positions along a gate from its middle, m, and their fractions of the light from it."""
    if not depth > 0:
        return np.zeros(1), np.ones(1)
    nodes, weights = np.polynomial.legendre.leggauss(6)
    nodes = nodes * depth / 2
    if lidar.pulse_duration > 0:
        # ranges differ by the position in the pulse, FWHM of a Gaussian
        spread = lidar.pulse_duration * constants.c / 2 / np.sqrt(8 * np.log(2))
        ends = [stats.norm.cdf((end - nodes) / spread) for end in (depth / 2, -depth / 2)]
        weights = weights * (ends[0] - ends[1])
    return nodes, weights / weights.sum()


def _beam_weights(axis: np.ndarray, stretch: float, metres: float) -> np.ndarray:
    """Weights (places, nodes) of an axis' nodes in beams at ``stretch`` times their places."""
    spacing = float(axis[1] - axis[0])
    sigma = metres / spacing
    places = (axis * stretch - axis[0]) / spacing
    reach = int(np.ceil(6 * sigma + np.abs(places - np.arange(len(axis))).max())) + 1
    x = np.arange(-reach - 1, len(axis) + reach + 1) - places[:, None]
    g = x * stats.norm.cdf(x / sigma) + sigma * stats.norm.pdf(x / sigma)
    weights = np.diff(g, 2)
    # beyond the plane the value of its edge
    inside = weights[:, reach:-reach].copy()
    inside[:, 0] += weights[:, :reach].sum(1)
    inside[:, -1] += weights[:, -reach:].sum(1)
    return inside
