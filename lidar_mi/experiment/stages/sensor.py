"""The combined sensor of an experiment: both lidars' winds as one field, and what it is good for.

The Doppler lidar scans the slab that the backscatter lidar has looked at. Every line of sight
gets pictures of rings of its own, which are read for its velocity; all of them and the cross-flow
wind together give (u, v, w).
"""

import math
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
import xarray as xr

from lidar_mi import __version__
from lidar_mi.assessment.metrics.cores import find_cores, outside_cores
from lidar_mi.assessment.metrics.errors import commonest_flag
from lidar_mi.assessment.metrics.requirements import judge, read_requirements
from lidar_mi.assessment.report.page import Chapter
from lidar_mi.assessment.report.sensor import draw_all, sensor_chapter
from lidar_mi.assessment.report.vector_map import map_data
from lidar_mi.errors import InputError
from lidar_mi.experiment.run_folder import Log
from lidar_mi.experiment.schema import Experiment
from lidar_mi.experiment.stages import fringes as fringe_chain
from lidar_mi.experiment.stages.backscatter import NOISY
from lidar_mi.experiment.truth import find_file, make_truth, moves_along
from lidar_mi.instrument.budget import pulse_budget, pulses_for_error
from lidar_mi.instrument.doppler import photons
from lidar_mi.instrument.doppler_scan import PlatformErrors, scan_wind, sight_volumes, wind_at
from lidar_mi.instrument.eye_safety import assess_pulses
from lidar_mi.instrument.fringe_camera import fringe_image
from lidar_mi.instrument.scan import plan_scans
from lidar_mi.io.netcdf import open_netcdf, write_netcdf
from lidar_mi.retrieval.lines.combine import combine
from lidar_mi.retrieval.lines.vectors import COMPONENTS, wind_from_neighbours, wind_from_triples

LINES, WIND = "lines_of_sight.nc", "wind3d.nc"

# Speeds at which pictures without noise are made; those between are interpolated (Chebyshev).
_NODES = 7
# Lines of sight of a least-squares vector of the Doppler lidar alone: one and those around it.
_AROUND = 9
# What counts as no error and no length in a budget of errors, m/s and m.
_SURE, _SHORT = 0.01, 0.1
# First number of the lines' pictures, which make their random streams.
_STREAMS = 1 << 24


def prepare(
    experiment: Experiment, beside: str | Path
) -> Callable[[Path, Log], tuple[dict[str, float], Chapter]]:
    """Check everything that can be checked ahead; what it returns runs the rest into a folder.

    Raises
    ------
    InputError
        Lidars that do not look at the same air, a scan wider than the wake, a bad requirement table.
    """
    lidar = experiment.doppler.lidar
    middle = experiment.scan.range + experiment.scan.thickness / 2
    if abs(lidar.range - middle) > lidar.range_bin / 2:
        raise InputError(
            f"doppler.lidar.range: {lidar.range:g} m is not allowed with sensor; expected the slab of "
            f"scan, {middle - lidar.range_bin / 2:g} to {middle + lidar.range_bin / 2:g} m"
        )
    tables = requirement_tables(experiment, beside)
    truth = true_wind(experiment, beside)
    # lines that leave the wake, bins that reach the telescope
    try:
        wind_at(truth, _volumes(experiment))
    except InputError as error:
        raise InputError(f"sensor.directions: {error}") from None
    fastest = experiment.platform.speed + float(
        np.sqrt(sum(truth[n] ** 2 for n in COMPONENTS)).max()
    )
    limit = fringe_chain.ring_instrument(experiment.doppler).model.velocity_range / 2
    if fastest > limit:
        raise InputError(
            f"platform.speed: {experiment.platform.speed:g} m/s is not allowed with sensor; expected "
            f"less than {limit:.0f} m/s with the wind, half an order of doppler.etalon"
        )
    return lambda folder, log: _run(experiment, truth, tables, folder, log)


def requirement_tables(experiment: Experiment, beside: str | Path) -> dict:
    """The tables that the sensor is held against, as `read_requirements` gives them."""
    path = experiment.sensor.requirements
    if path:
        return read_requirements(find_file(path, beside, "sensor.requirements"))
    # the paper's are those of flight control: nothing to ask of a platform that stands
    return read_requirements() if experiment.platform.speed else {}


def _volumes(experiment: Experiment) -> np.ndarray:
    scan, lidar = experiment.sensor.directions, experiment.doppler.lidar
    return sight_volumes(scan.directions(), scan.ranges(lidar), lidar)[0]


def true_wind(experiment: Experiment, beside: str | Path = ".") -> xr.Dataset:
    """u, v, w on (z, y), averaged over the slab; u is 0 in a wake that has none."""
    wind = make_truth(experiment, beside).wind
    return wind if "u" in wind else wind.assign(u=xr.zeros_like(wind["v"]))


def _run(experiment, truth, tables, folder, log) -> tuple[dict[str, float], Chapter]:
    start = time.perf_counter()
    lines = measure_lines(experiment, truth, log)
    write_netcdf(lines, folder / LINES)
    cores = find_cores(truth)
    metrics = _line_errors(lines)
    log("combining both lidars")
    # what cannot be computed is said, the rest is shown
    try:
        crossflow = _crossflow(experiment, folder)
        found = _combined(experiment, truth, lines, crossflow)
    except InputError as error:
        log.remark(f"no wind from both lidars: {error}")
        (folder / WIND).unlink(missing_ok=True)
        found = None
        metrics |= {"sensor.good_fraction": 0.0, "sensor.vectors": 0}
    else:
        write_netcdf(found, folder / WIND)
        metrics |= errors(found, cores)
        if not metrics["sensor.vectors"]:
            log.remark(f"no vector from both lidars is good; {commonest_flag(found['flag'])}")
        metrics |= budget_of_u(experiment, truth, lines, crossflow, found, cores)
    try:
        alone = _errors_alone("triples", wind_from_triples(lines), truth)
        if not alone:
            raise InputError("no three lines beside each other could be read")
        around = wind_from_neighbours(lines, min(_AROUND, lines.sizes["line"]))
        metrics |= alone | _errors_alone("neighbours", around, truth)
    except InputError as error:
        log.remark(f"no wind from lines of sight alone: {error}")
    metrics |= _costs(experiment, truth) | _pulses_needed(experiment, tables, lines)
    judged = [
        (table, judge(table, measured(experiment, metrics, table))) for table in tables.values()
    ]
    for table, findings in judged:
        for row in findings:
            if not math.isnan(row.margin):
                key = f"sensor.{table.application}.{table.phase}.{row.quantity}.margin"
                metrics[key] = row.margin
    shown = found if metrics["sensor.vectors"] else None
    drawn = draw_all(folder / "figures", shown, lines, cores, log)
    metrics["timing.sensor_s"] = round(time.perf_counter() - start, 3)
    vectors = None if found is None else map_data(found, COMPONENTS, cores)
    return metrics, sensor_chapter(experiment, metrics, judged, drawn, vectors)


def _crossflow(experiment, folder) -> xr.Dataset:
    """The pictures' wind that the folder holds."""
    with open_netcdf(folder / "wind.nc") as winds:
        source = NOISY if experiment.detector else "backscatter"
        return winds.sel(source=source, algorithm=experiment.sensor.method).load()


def _seen_aslant(experiment) -> dict[str, float]:
    """How `combine` is told that pictures show some of the motion along x."""
    if not moves_along(experiment):
        return {}
    scan, platform = experiment.scan, experiment.platform
    # the telescope's distance at mid-time
    flown = (platform.speed - scan.follow) * platform.dt
    distance = scan.range + scan.thickness / 2 - flown / 2
    return {"distance": distance, "gate_speed": scan.follow}


def _combined(experiment, truth, lines, crossflow) -> xr.Dataset:
    """The wind from the lines and from the pictures' wind, with the truth."""
    found = combine(
        crossflow, lines, crossflow_std=experiment.sensor.crossflow_std, **_seen_aslant(experiment)
    )
    for name in COMPONENTS:
        at = {axis: found[axis] for axis in ("z", "y")}
        found[f"{name}_true"] = (
            truth[name]
            .interp(at)
            .assign_attrs(units="m s-1", long_name=f"true {name}, mean over the slab")
        )
    ahead = {
        "units": "m",
        "long_name": "distance ahead of the first picture's telescope",
        "axis": "X",
    }
    found["x"] = (), experiment.scan.range + experiment.scan.thickness / 2, ahead
    found = found.set_coords("x")
    found.attrs |= {
        "title": f"Wind from both lidars of the experiment {experiment.name}",
        "source": f"lidar-mi {__version__}",
    }
    return found


def measure_lines(experiment: Experiment, truth: xr.Dataset, log: Log) -> xr.Dataset:
    """Line-of-sight velocities as the Doppler lidar reads them from its rings.

    Pictures without noise are made at a few speeds and interpolated between them (their rings
    move by far less than an order); each line's are drawn by the CCD and read by the annular fit,
    which says how good it is. A picture that cannot be read leaves NaN.
    """
    sensor, doppler = experiment.sensor, experiment.doppler
    lines = scan_wind(
        truth,
        sensor.directions,
        doppler.lidar,
        0.0,
        experiment.seed,
        experiment.platform.speed,
        sensor.errors,
    )
    true = lines["v_los_true"].values
    log(f"measuring {len(true)} lines of sight, {sensor.pulses} pulses each")
    middle, half = (true.max() + true.min()) / 2, max(np.ptp(true) / 2, 1e-3)
    nodes = np.cos(np.pi * (np.arange(_NODES) + 0.5) / _NODES)
    rings = fringe_chain.ring_instrument(doppler)
    light, counted = photons(doppler.lidar), doppler.lidar.counted
    images = torch.stack(
        [
            fringe_image(doppler.camera, doppler.etalon, rings.line, speed, light, counted)
            for speed in middle + half * nodes
        ]
    )
    noise = fringe_chain.summed_noise(doppler.ccd, rings.modes, sensor.pulses)
    weights = torch.from_numpy(_lagrange(nodes, (true - middle) / half)).to(images.dtype)
    read = np.empty((2, len(true)))
    for start in range(0, len(true), fringe_chain.FRAMES):
        log.bar(f"reading line of sight {start + 1} of {len(true)}", start / len(true))
        chunk = range(start, min(start + fringe_chain.FRAMES, len(true)))
        frames = []
        for index in chunk:
            farther = doppler.lidar.model_copy(update={"range": float(lines["range"][index])})
            image = torch.tensordot(weights[index], images, 1) * (photons(farther) / light)
            # numbers of their own, apart from those of the pictures of the Doppler lidar's chapter
            frames.append(
                fringe_chain.exposed_frames(
                    doppler, rings, image, sensor.pulses, experiment.seed, [_STREAMS + index]
                )
            )
        read[:, start : chunk.stop] = fringe_chain.fitted_speeds(
            torch.cat(frames), doppler, rings.model, noise, "annular", "free"
        )
    v_los, std = read
    return lines.assign(
        v_los=("line", v_los, lines["v_los"].attrs),
        v_los_std=("line", std, lines["v_los_std"].attrs),
    )


def _lagrange(nodes: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Weights (places, nodes) of values at the nodes in the polynomial through them, at places."""
    others = ~np.eye(len(nodes), dtype=bool)
    return np.stack(
        [
            ((places[:, None] - nodes[o]) / (node - nodes[o])).prod(1)
            for node, o in zip(nodes, others)
        ],
        axis=1,
    )


def errors(found: xr.Dataset, cores) -> dict[str, float]:
    """Errors of good vectors (flag 0), and whether they are what the standard errors say.

    ``rmse_*``, ``bias_*`` (m/s), ``reduced_variance_*`` (1 where errors are as stated),
    ``coverage_68_*`` and ``coverage_95_*`` (share within 1 and 1.96 standard errors);
    ``outside_cores.rmse_*`` beyond two core radii, and ``outside_cores.rms_*`` of the true wind there.
    """
    good = found["flag"].values == 0
    z, y = np.meshgrid(found["z"], found["y"], indexing="ij")
    far = good & outside_cores(y, z, cores)
    metrics = {"sensor.good_fraction": float(good.mean()), "sensor.vectors": int(good.sum())}
    for name in COMPONENTS:
        error = (found[name] - found[f"{name}_true"]).values
        known = good & np.isfinite(error)
        if not known.any():
            continue
        reduced = error[known] / found[f"{name}_stderr"].values[known]
        metrics |= {
            f"sensor.rmse_{name}": float(np.sqrt((error[known] ** 2).mean())),
            f"sensor.bias_{name}": float(error[known].mean()),
            f"sensor.reduced_variance_{name}": float((reduced**2).mean()),
            f"sensor.coverage_68_{name}": float((abs(reduced) < 1).mean()),
            f"sensor.coverage_95_{name}": float((abs(reduced) < 1.96).mean()),
        }
        if (far & known).any():
            true = found[f"{name}_true"].values[far & known]
            for key, values in (("rmse", error[far & known]), ("rms", true)):
                metrics[f"sensor.outside_cores.{key}_{name}"] = float(np.sqrt((values**2).mean()))
    return metrics


def budget_of_u(experiment, truth, lines, crossflow, found, cores) -> dict[str, float]:
    """What limits u: its mean square error without each cause, and without all of them at once.

    Causes: `line_noise` (what the rings' noise leaves), `range_bin` (averaging along it, here over
    `_SHORT`), `crossflow` (errors of v and w) and, where there are any, `pointing` (``sensor.errors``). What
    is left without all of them is the air between the lines (`between_lines`). ``share`` is
    1 - (rms error without it)^2 / (rms error)^2, of the last one what is left; shares need not add up
    to 1. Without a cause the estimate also knows that it is gone, and a share is that of one draw: in
    `wake_sensor` the noise of lines scatters u, over draws, by 9 % of the mean square error; its share
    is 23 % with the draw of seed 1, whose lines are off by 0.05 m/s in the mean (2.9 sigma; seeds 2 to 4
    0.00).

    Returns
    -------
    dict
        ``sensor.error_budget.CAUSE.rmse_u`` (m/s) and ``.share_u``; good vectors, beyond two core radii
        where there are cores. Empty without any.
    """
    at = {axis: crossflow[axis] for axis in ("z", "y")}
    true = {name: truth[name].interp(at).transpose("z", "y").values for name in COMPONENTS}
    surely = {f"{name}_stderr": np.full_like(true[name], _SURE) for name in ("v", "w")}
    surely |= {"v": true["v"], "w": true["w"], "vw_correlation": np.zeros_like(true["v"])}
    known = crossflow.assign({name: (("z", "y"), field) for name, field in surely.items()})
    z, y = np.meshgrid(found["z"], found["y"], indexing="ij")
    chosen = (found["flag"].values == 0) & outside_cores(y, z, cores)

    def square(causes) -> float:
        lidar, missed = experiment.doppler.lidar, experiment.sensor.errors
        if "range_bin" in causes:
            lidar = lidar.model_copy(update={"range_bin": _SHORT})
        if "pointing" in causes:
            missed = PlatformErrors()
        changed = scan_wind(
            truth,
            experiment.sensor.directions,
            lidar,
            0.0,
            experiment.seed,
            experiment.platform.speed,
            missed,
        )
        # lines that were not read stay so
        noise, std = lines["v_los"] - lines["v_los_true"], lines["v_los_std"]
        if "line_noise" in causes:
            noise, std = 0 * noise, xr.full_like(std, _SURE)
        changed = changed.assign(v_los=changed["v_los_true"] + noise, v_los_std=std)
        flow, settings = crossflow, _seen_aslant(experiment)
        if "crossflow" in causes:
            flow, settings = known, {}
        else:
            settings["crossflow_std"] = experiment.sensor.crossflow_std
        u = combine(flow, changed, **settings)["u"].transpose("z", "y").values
        return float(((u - true["u"])[chosen] ** 2).mean())

    if not chosen.any():
        return {}
    full = square(())
    if not full > 0:
        return {}
    causes = ["line_noise", "range_bin", "crossflow"]
    if experiment.sensor.errors != PlatformErrors():
        causes.append("pointing")
    left = {cause: square((cause,)) for cause in causes}
    rest = square(causes)
    metrics = {}
    for cause, value in left.items():
        metrics[f"sensor.error_budget.{cause}.rmse_u"] = math.sqrt(value)
        metrics[f"sensor.error_budget.{cause}.share_u"] = 1 - value / full
    metrics["sensor.error_budget.between_lines.rmse_u"] = math.sqrt(rest)
    metrics["sensor.error_budget.between_lines.share_u"] = rest / full
    return metrics


def _line_errors(lines: xr.Dataset) -> dict[str, float]:
    error = (lines["v_los"] - lines["v_los_true"]).values
    read = np.isfinite(error)
    metrics = {"sensor.lines": len(error), "sensor.lines_read": int(read.sum())}
    if read.any():
        reduced = error[read] / lines["v_los_std"].values[read]
        metrics |= {
            "sensor.rmse_v_los": float(np.sqrt((error[read] ** 2).mean())),
            "sensor.bias_v_los": float(error[read].mean()),
            "sensor.reduced_variance_v_los": float((reduced**2).mean()),
        }
    return metrics


def _errors_alone(key: str, found: xr.Dataset, truth: xr.Dataset) -> dict[str, float]:
    """What the Doppler lidar alone would say."""
    good = found["flag"] == 0
    metrics = {}
    for name in COMPONENTS:
        true = truth[name].interp(z=found["z"], y=found["y"])
        error = (found[name] - true).values[good.values]
        if error.size:
            metrics[f"sensor.{key}.rmse_{name}"] = float(np.sqrt((error**2).mean()))
    return metrics


def measured(experiment: Experiment, metrics: dict[str, float], table) -> dict[str, float | None]:
    """What the sensor does, as `requirements.judge` takes it; errors beyond two core radii.

    Points are lines of sight where velocities along them are asked for, else good vectors whose
    windows do not overlap.
    """
    retrieval = experiment.retrieval
    overlap = min(1.0, retrieval.stride / retrieval.template) ** 2
    along = any(row.quantity == "error_v_los" for row in table.rows)
    points = (
        metrics["sensor.lines_read"] if along else math.floor(overlap * metrics["sensor.vectors"])
    )
    return {
        "range": experiment.scan.range + experiment.scan.thickness / 2,
        "points_per_slab": points,
        "slabs_per_second": experiment.sensor.slabs_per_second,
        "slab_depth": experiment.doppler.lidar.range_bin
        if along
        else max(experiment.doppler.lidar.range_bin, experiment.scan.thickness),
        "error_v_los": metrics.get("sensor.rmse_v_los"),
        **{f"error_{n}": metrics.get(f"sensor.outside_cores.rmse_{n}") for n in COMPONENTS},
    }


def _pulses_needed(experiment: Experiment, tables, lines: xr.Dataset) -> dict[str, int]:
    """Pulses a direction takes for the least error of v_LOS that is asked for; nothing if none is."""
    rows = (row for table in tables.values() for row in table.rows)
    limits = [r.maximum for r in rows if r.quantity == "error_v_los" and math.isfinite(r.maximum)]
    stated = lines["v_los_std"].values[np.isfinite(lines["v_los"].values)]
    if not limits or not stated.size:
        return {}
    one = math.sqrt(experiment.sensor.pulses * float((stated**2).mean()))
    return {"sensor.doppler.pulses_needed": pulses_for_error(one, min(limits))}


def _costs(experiment: Experiment, truth: xr.Dataset) -> dict[str, float]:
    """Pulses, power and hazard distances of both lidars; of the backscatter lidar one pulse a beam."""
    sensor, doppler, lidar = experiment.sensor, experiment.doppler.lidar, experiment.lidar
    far = float(sensor.directions.ranges(doppler).max()) + doppler.range_bin / 2
    directions = sensor.directions.columns * sensor.directions.rows
    rate = sensor.slabs_per_second
    budget = pulse_budget(
        directions, rate, sensor.pulses, doppler.pulse_energy, far, photons(doppler)
    )
    metrics = {
        "sensor.doppler.pulses_per_second": budget.pulses_per_second,
        "sensor.doppler.average_power": budget.average_power,
        "sensor.doppler.beams": budget.beams,
        "sensor.doppler.photons_per_direction": budget.photons_per_direction,
    }
    plan = plan_scans(experiment.scan, truth["y"].values, truth["z"].values, (0.0,))[0]
    pictures = pulse_budget(
        len(plan.y) * len(plan.z),
        1 / experiment.platform.dt,
        1,
        lidar.pulse_energy,
        float((plan.ranges()[-1] + plan.gate_length() / 2).max()),
    )
    metrics |= {
        "sensor.backscatter.pulses_per_second": pictures.pulses_per_second,
        "sensor.backscatter.average_power": pictures.average_power,
        "sensor.backscatter.beams": pictures.beams,
    }
    beams = {"doppler": (doppler, doppler.beam_radius, sensor.pulses * rate)}
    # a pulse of no duration has no limit of exposure
    if lidar.pulse_duration > 0:
        beams["backscatter"] = lidar, float(lidar.radius_at(0)), rate
    for name, (beam, radius, repetition) in beams.items():
        if beam.pulse_duration > 0:
            safety = assess_pulses(
                beam.wavelength,
                beam.pulse_energy,
                beam.pulse_duration,
                radius,
                beam.divergence_full,
                repetition,
                sensor.exposure,
            )
            for key in ("hazard_distance", "aided_hazard_distance"):
                if math.isfinite(getattr(safety, key)):
                    metrics[f"sensor.{name}.{key}"] = getattr(safety, key)
            metrics[f"sensor.{name}.permissible_exposure"] = safety.limit.exposure
    return metrics
