"""Wind in three dimensions: all gates of two scans as volumes, the flow between them, its errors.

The backscatter lidar looks at the same stack of thin slabs twice. Beams spread from gate to gate,
and the telescope comes nearer between the scans: both stacks are brought onto one grid in the air.
"""

import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import xarray as xr
from scipy.ndimage import map_coordinates

from lidar_mi import __version__
from lidar_mi.assessment.metrics.cores import Core, find_cores, outside_cores
from lidar_mi.assessment.report.page import Chapter
from lidar_mi.assessment.report.volume import draw_all, volume_chapter
from lidar_mi.errors import InputError
from lidar_mi.experiment.run_folder import VOLUME, Log, Notice
from lidar_mi.experiment.schema import Experiment
from lidar_mi.experiment.stages.backscatter import NOISY, check_ahead, pictures, scan_plans
from lidar_mi.experiment.truth import make_truth, read_flows
from lidar_mi.instrument.lidar import BackscatterLidar
from lidar_mi.instrument.scan import ScanPlan
from lidar_mi.instrument.signal import apparent_backscatter
from lidar_mi.io.netcdf import write_netcdf
from lidar_mi.rendering.phase import scatterer
from lidar_mi.rendering.variant import use_variant
from lidar_mi.retrieval.velocimetry.common_grid import resample
from lidar_mi.retrieval.velocimetry.volume import COMPONENTS, retrieve_wind_volume
from lidar_mi.retrieval.velocimetry.volume_windows import VolumeWindows

PASSED = 0.76
"""Share of the variance of white noise that bicubic splines pass, in the mean over all places."""


def prepare(
    experiment: Experiment, beside: str | Path, notice: Notice
) -> Callable[[Path, Log], tuple[dict[str, float], Chapter]]:
    """Read and check everything that is needed; what it returns runs the rest into a folder.

    Raises
    ------
    InputError
        Bad input: a wake without wind along x, gates that reach beyond it, fewer gates or beams
        than a window has voxels.
    """
    start = time.perf_counter()
    use_variant(experiment.render.variant)
    notice("reading the wake", None)
    flows = read_flows(experiment, beside)
    flow = flows[0]
    if "u" not in flow:
        raise InputError("wake.file: no wind along x (u) in it; expected u, v and w for volume")
    _check_gates(experiment, flow)
    truth = make_truth(experiment, beside, flows)
    plans = scan_plans(experiment, truth)
    nodes = grid(experiment, plans)
    settings = experiment.volume
    VolumeWindows(tuple(map(len, nodes)), settings.template, settings.search, settings.stride)
    notice("reading how the air scatters", None)
    air = scatterer(experiment.scattering, beside, experiment.lidar.wavelength, notice)
    check_ahead(experiment, truth, plans, air)
    prepared = time.perf_counter() - start
    return lambda folder, log: _run(
        experiment, folder, flow, truth, plans, air, nodes, prepared, log
    )


def _check_gates(experiment: Experiment, flow: xr.Dataset) -> None:
    scan, x = experiment.scan, flow["x"].values
    half = (x[1] - x[0]) / 2
    if scan.range < x[0] - half or scan.range + scan.thickness > x[-1] + half:
        raise InputError(
            f"scan.thickness: gates from {scan.range:g} to {scan.range + scan.thickness:g} m reach "
            f"beyond the wake, whose planes fill {x[0] - half:g} to {x[-1] + half:g} m; expected "
            "gates inside"
        )


def grid(experiment: Experiment, plans: Sequence[ScanPlan]) -> tuple[np.ndarray, ...]:
    """Nodes x, z, y (m) of the volumes: middles of the gates at t1, and what all gates see.

    Along z and y whole multiples of wake.spacing, inside the beams of the nearest gate.
    """
    scan, spacing = experiment.scan, experiment.wake.spacing
    edges = np.linspace(0, scan.thickness, scan.gate_count + 1)
    x = scan.range + (edges[1:] + edges[:-1]) / 2
    nodes = [x]
    for axis in ("z", "y"):
        places = [_places(plan, axis)[0] for plan in plans]
        low, high = max(p[0] for p in places), min(p[-1] for p in places)
        first = np.ceil(low / spacing - 1e-6)
        nodes.append(spacing * np.arange(first, np.floor(high / spacing + 1e-6) + 1))
    return tuple(nodes)


def _places(plan: ScanPlan, axis: str) -> np.ndarray:
    """Where the beams are in the middles of the gates, (gates, beams), m."""
    edges = np.linspace(plan.gate_start, plan.gate_stop, plan.gate_count + 1)
    middle = (edges[1:] + edges[:-1]) / 2
    return middle[:, None] / plan.centre * getattr(plan, axis)


def scan_volume(
    s0: xr.DataArray,
    plan: ScanPlan,
    lidar: BackscatterLidar,
    environment: float,
    nodes: tuple[np.ndarray, ...],
) -> xr.DataArray:
    """Apparent backscatter (m^-1 sr^-1) of all gates on one grid in the air, dims (x, z, y).

    Gate by gate by bicubic splines, from where the beams are to the nodes. A beam is as wide as
    its gate is thin or wider, so that little is lost; of the variance of white noise `PASSED` is
    left.

    Parameters
    ----------
    s0 : xr.DataArray, dims (gate, z, y)
        Received energy over emitted pulse energy.
    plan : ScanPlan
        Planar gates.
    environment : float
        Extinction coefficient on the way, m^-1.
    nodes : x, z, y of the grid, m
        x in the frame of the air, one a gate; inside the beams of every gate.
    """
    x, z, y = nodes
    values = apparent_backscatter(
        s0.transpose("gate", "z", "y").values, plan, lidar.aperture_area, environment
    )
    volume = np.empty((len(x), len(z), len(y)))
    for gate, (row, column) in enumerate(zip(_places(plan, "z"), _places(plan, "y"))):
        picture = xr.DataArray(
            values[gate],
            {"z": ("z", row, {"units": "m"}), "y": ("y", column, {"units": "m"})},
            ("z", "y"),
        )
        volume[gate] = resample(picture, y, z).values
    coords = {name: (name, axis, {"units": "m"}) for name, axis in zip("xzy", nodes)}
    about = {"long_name": "apparent backscatter coefficient", "units": "m-1 sr-1"}
    return xr.DataArray(volume, coords, ("x", "z", "y"), attrs=about)


def _run(
    experiment, folder, flow, truth, plans, air, nodes, prepared, log
) -> tuple[dict[str, float], Chapter]:
    use_variant(experiment.render.variant)
    timing = {"truth": prepared}
    scans = pictures(experiment, plans, list(truth.extinction), air, folder, log)
    timing["render"] = sum(scan.attrs["render_seconds"] for scan in scans)
    start = time.perf_counter()
    volumes, noise = _volumes(experiment, plans, nodes, scans)
    found = winds(experiment, flow, volumes, noise, log)
    write_netcdf(found, folder / VOLUME)
    timing["retrieve"] = time.perf_counter() - start
    cores = find_cores(truth.wind)
    metrics = errors(found, cores)
    lit = scans[0]["S0"].where(scans[0]["S0"] > 0)
    metrics["backscatter.mc_relative_error"] = float((scans[0]["S0_stderr"] / lit).median())
    start = time.perf_counter()
    log("drawing figures")
    drawn = draw_all(folder / "figures", found, volumes["backscatter"], cores, log)
    timing["figures"] = time.perf_counter() - start
    metrics |= {f"timing.{name}_s": round(value, 3) for name, value in timing.items()}
    return metrics, volume_chapter(experiment, metrics, drawn)


def _volumes(experiment, plans, nodes, scans) -> tuple[dict[str, list], dict[str, float]]:
    """Both volumes and the level of their noise, by source."""
    lidar = experiment.lidar
    way = experiment.wake.extinction.background + experiment.wake.extinction.molecules

    def volume(number: int, s0: xr.DataArray) -> xr.DataArray:
        return scan_volume(s0, plans[number], lidar, way, nodes)

    def level(error: xr.DataArray) -> float:
        oblique = apparent_backscatter(
            error.transpose("gate", "z", "y").values, plans[0], lidar.aperture_area, way
        )
        return float(np.sqrt(PASSED * (oblique**2).mean()))

    first = scans[0]
    volumes = {"backscatter": [volume(k, scan["S0"]) for k, scan in enumerate(scans)]}
    noise = {"backscatter": level(first["S0_stderr"])}
    if experiment.detector:
        volumes[NOISY] = [volume(k, scan["S0_noisy"]) for k, scan in enumerate(scans)]
        noise[NOISY] = level(np.hypot(first["S0_stderr"], first["S0_noise_std"]))
    return volumes, noise


def winds(experiment, flow: xr.Dataset, volumes, noise, log) -> xr.Dataset:
    """Winds by every method from every pair of volumes, with the truth at their places.

    Returns a data set with dims (source, algorithm, x, z, y): what `retrieve_wind_volume` gives and
    `u_true`, `v_true`, `w_true`.
    """
    settings = experiment.volume
    sources = []
    for source, pair in volumes.items():
        methods = []
        for number, method in enumerate(settings.methods):
            log(f"retrieving winds from {source.replace('_', ' ')} by {method}")
            log.bar(f"retrieving winds by {method}", number / len(settings.methods))
            methods.append(
                retrieve_wind_volume(
                    *pair,
                    experiment.platform.dt,
                    method,
                    settings.template,
                    settings.search,
                    settings.stride,
                    min_correlation=settings.min_correlation,
                    noise=noise[source],
                )
            )
        sources.append(xr.concat(methods, "algorithm", combine_attrs="drop_conflicts"))
    found = xr.concat(sources, "source", combine_attrs="drop_conflicts")
    found = found.assign_coords(source=list(volumes), algorithm=list(settings.methods))
    # the gates go along with a wind that is none in their frame
    about = found["u"].attrs
    found["u"] = (found["u"] + experiment.scan.follow).assign_attrs(about)
    for name, values in true_wind(flow, found).items():
        found[f"{name}_true"] = values
    found.attrs |= {
        "title": f"Wind in three dimensions of the experiment {experiment.name}",
        "source": f"lidar-mi {__version__}",
    }
    return found


def true_wind(flow: xr.Dataset, places: xr.Dataset) -> dict[str, xr.DataArray]:
    """u, v, w of a flow on (x, y, z) at the places x, z, y of a data set, by cubic splines."""
    axes = [flow[axis].values for axis in ("x", "y", "z")]
    at = [(places[axis].values - n[0]) / (n[1] - n[0]) for axis, n in zip("xyz", axes)]
    mesh = np.stack(np.meshgrid(*at, indexing="ij"))
    coords = {axis: places[axis] for axis in ("x", "z", "y")}
    found = {}
    for name in ("u", "v", "w"):
        values = flow[name].transpose("x", "y", "z").values
        values = map_coordinates(values, mesh, order=3, mode="nearest").transpose(0, 2, 1)
        about = {"long_name": f"true {name}", "units": "m s-1"}
        found[name] = xr.DataArray(values.astype(np.float32), coords, ("x", "z", "y"), attrs=about)
    return found


def errors(found: xr.Dataset, cores: Sequence[Core]) -> dict[str, float]:
    """Errors against the truth, ``source.method.quantity``, of valid vectors (flag 0).

    ``rmse_u`` and so on, ``bias_u``, ``stderr_u`` (rms as stated), ``reduced_variance_u`` (of
    errors over standard errors), ``coverage_68_u`` (share within one standard error); ``outside_
    cores.rmse_u`` beyond two core radii, ``all.rmse_u`` over every vector, ``true_wind.rms_u``
    of the wind itself at the same places.
    """
    metrics = {}
    y, z = found["y"].values, found["z"].values[:, None]
    far = np.broadcast_to(outside_cores(y, z, list(cores)), found["u_true"].shape)
    for name in COMPONENTS.values():
        true = found[f"{name}_true"].values
        metrics[f"true_wind.rms_{name}"] = float(np.sqrt((true**2).mean()))
        if cores and far.any():
            metrics[f"true_wind.outside_cores.rms_{name}"] = float(np.sqrt((true[far] ** 2).mean()))
    for source in found["source"].values:
        for method in found["algorithm"].values:
            wind, key = found.sel(source=source, algorithm=method), f"{source}.{method}"
            valid = wind["flag"].values == 0
            metrics[f"{key}.valid_fraction"] = float(valid.mean())
            for name in COMPONENTS.values():
                error = (wind[name] - wind[f"{name}_true"]).values
                stderr = wind[f"{name}_stderr"].values
                for part, chosen in (
                    ("", valid),
                    ("outside_cores.", valid & far),
                    ("all.", np.isfinite(error)),
                ):
                    if chosen.any():
                        rms = float(np.sqrt((error[chosen] ** 2).mean()))
                        metrics[f"{key}.{part}rmse_{name}"] = rms
                if valid.any():
                    reduced = error[valid] / stderr[valid]
                    metrics |= {
                        f"{key}.bias_{name}": float(error[valid].mean()),
                        f"{key}.stderr_{name}": float(np.sqrt((stderr[valid] ** 2).mean())),
                        f"{key}.reduced_variance_{name}": float((reduced**2).mean()),
                        f"{key}.coverage_68_{name}": float((np.abs(reduced) < 1).mean()),
                    }
    return metrics
