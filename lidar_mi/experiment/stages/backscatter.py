"""The backscatter lidar of an experiment, start to end: a wake, its two pictures, the wind in them."""

import time
from collections.abc import Callable
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import xarray as xr

from lidar_mi import __version__
from lidar_mi.assessment.figures import backscatter as figures
from lidar_mi.assessment.metrics.cores import Core, find_cores, outside_cores
from lidar_mi.assessment.metrics.errors import commonest_flag, truth_at_vectors, wind_metrics
from lidar_mi.assessment.report.page import Chapter, backscatter_chapter
from lidar_mi.assessment.report.vector_map import map_data
from lidar_mi.errors import InputError
from lidar_mi.experiment.run_folder import IMAGES, Log, Notice
from lidar_mi.experiment.schema import Experiment
from lidar_mi.experiment.truth import Flows, Truth, blur_by_beam, make_truth, read_flows
from lidar_mi.instrument.detection import noise_budget, noisy_scan
from lidar_mi.instrument.detector import gate_duration
from lidar_mi.instrument.eye_safety import assess_pulses, scan_hazard_distance
from lidar_mi.instrument.products import linear_depolarization, with_products
from lidar_mi.instrument.scan import ScanPlan, plan_scans
from lidar_mi.instrument.speckle import speckle_modes
from lidar_mi.io import exr
from lidar_mi.io.netcdf import write_netcdf
from lidar_mi.rendering.backscatter import extrude, render_scans
from lidar_mi.rendering.phase import Scatterer, molecules, scatterer
from lidar_mi.rendering.variant import use_variant
from lidar_mi.retrieval.velocimetry.common_grid import resample_pair
from lidar_mi.retrieval.velocimetry.wind import METHODS, retrieve_wind, wind_bound
from lidar_mi.retrieval.velocimetry.windows import Windows

# what winds are retrieved from behind a detector, beside the noise-free picture
NOISY = "backscatter_noisy"

# what no instrument has seen
EXACT = ("extinction", "extinction_without_texture")

# time of looking into the beams, s, where no sensor says another
EXPOSURE = 10.0

# relative rms of the sub-grid texture for which `texture_sweep` says how good winds get
TEXTURE_SWEEP = (0.0, 0.02, 0.05, 0.1, 0.2, 0.4)


def prepare(
    experiment: Experiment, beside: str | Path, notice: Notice
) -> Callable[[Path, Log], tuple[dict[str, float], Chapter]]:
    """Read and check everything that is needed; what it returns runs the rest into a folder.

    Raises
    ------
    InputError
        Bad input.
    """
    timing = {}
    use_variant(experiment.render.variant)
    with _timed(timing, "truth"):
        notice("reading the wake", None)
        flows = read_flows(experiment, beside)
        truth = make_truth(experiment, beside, flows)
        plans = scan_plans(experiment, truth)
    notice("reading how the air scatters", None)
    air = scatterer(experiment.scattering, beside, experiment.lidar.wavelength, notice)
    fields = _solid(experiment, truth, plans)
    settings, image = experiment.retrieval, (len(plans[0].z), len(plans[0].y))
    Windows(image, settings.template, settings.search, settings.stride)
    check_ahead(experiment, truth, plans, air)
    return lambda folder, log: _run(
        experiment, folder, flows, truth, plans, air, fields, timing, log
    )


def _run(
    experiment, folder, flows, truth, plans, air, fields, timing, log
) -> tuple[dict[str, float], Chapter]:
    """The run from the pictures on; everything before is checked."""
    use_variant(experiment.render.variant)
    _warn_of_wide_beams(experiment, truth, plans, log)
    scans = pictures(experiment, plans, fields, air, folder, log)
    timing["render"] = sum(scan.attrs["render_seconds"] for scan in scans)
    with _timed(timing, "retrieve"):
        log("retrieving winds")
        cores = find_cores(truth.wind)
        found = winds(experiment, truth, plans, scans, log)
        write_netcdf(found, folder / "wind.nc")
        sweep = texture_sweep(experiment, flows, log)
    metrics = verdict(found, scans, cores) | true_wind(found, truth, cores) | sweep
    _warn_of_no_vectors(found, metrics, log)
    if experiment.detector:
        budget = noise_budget(scans[0], experiment.lidar, experiment.detector)
        metrics |= {f"detector.{key}": value for key, value in budget.items()}
    with _timed(timing, "figures"):
        log("drawing figures")
        drawn = figures.draw_all(folder / "figures", truth, scans, found, cores, sweep, log)
    metrics |= safety(experiment, plans[0])
    metrics |= {f"timing.{k}_s": round(v, 3) for k, v in timing.items()}
    source = NOISY if experiment.detector else "backscatter"
    vectors = map_data(found.sel(source=source).isel(algorithm=0), ("v", "w"), cores)
    return metrics, backscatter_chapter(experiment, metrics, cores, drawn, vectors)


def check_ahead(experiment, truth, plans, air: Scatterer) -> None:
    """What would only fail later is said before anything is written."""
    if experiment.detector:
        for plan in plans:
            duration = gate_duration(plan.gate_length())
            speckle_modes(experiment.detector, experiment.lidar, duration, plan.ranges())
    if not max(float(field.max()) for field in truth.extinction) > 0:
        raise InputError(
            "wake.extinction: 0 everywhere is not allowed; expected air that scatters, by its "
            "background, tracer or aerosol"
        )
    if not air.albedo > 0:
        raise InputError("scattering.albedo: 0 is not allowed here; expected above 0, up to 1")


def _solid(experiment, truth, plans) -> list[xr.DataArray]:
    """The extinction at both times as deep and wide as the beams need it."""
    fields = truth.extinction
    if fields[0].sizes["x"] > 1:
        return list(fields)
    reach = max(plans, key=lambda plan: plan.gate_stop)
    return [
        extrude(field.isel(x=0).transpose("z", "y"), reach, experiment.lidar) for field in fields
    ]


def _warn_of_wide_beams(experiment, truth, plans, log) -> None:
    width = 2 * float(experiment.lidar.radius_at(plans[0].centre))
    y = truth.wind["y"].values
    template = experiment.retrieval.template * float(y[1] - y[0])
    if width > template:
        log.remark(
            f"beams are {width:.3g} m wide at {plans[0].centre:g} m, wider than a template of "
            f"{template:g} m: structure that winds could be found from is blurred"
        )


def _warn_of_no_vectors(found: xr.Dataset, metrics, log) -> None:
    """Sources of rendered pictures that gave no valid vector, and which flags say why."""
    for source in (name for name in found["source"].values if name in ("backscatter", NOISY)):
        for method in found["algorithm"].values:
            if metrics[f"{source}.{method}.valid_fraction"] > 0:
                continue
            flag = found["flag"].sel(source=source, algorithm=method)
            log.remark(f"{source}, {method}: no vector is valid; {commonest_flag(flag)}")


def pictures(experiment, plans, fields, air: Scatterer, folder: Path, log) -> list[xr.Dataset]:
    """The two scans: those in the folder, and the missing ones rendered and written to it."""
    paths = [folder / name for name in IMAGES]
    missing = [index for index, path in enumerate(paths) if not path.is_file()]
    if len(missing) < len(paths):
        log(f"using {len(paths) - len(missing)} of {len(paths)} pictures from an earlier run")

    def progress(scan: int, done: int, total: int) -> None:
        log.bar(f"rendering scan {scan + 1} of {len(plans)}", done / total)

    if missing:
        log(f"rendering {len(missing)} scans of {len(plans[0].y)} x {len(plans[0].z)} beams")
    mapping = experiment.wake.extinction
    rendered = render_scans(
        fields,
        plans,
        experiment.lidar,
        mapping.background + mapping.molecules,
        *air,
        experiment.render,
        experiment.seed,
        progress,
        missing,
        molecules(mapping.molecules, experiment.lidar.wavelength, experiment.scattering.band),
    )
    platform = {"platform_speed": experiment.platform.speed, "dt": experiment.platform.dt}
    for index, scan in zip(missing, map(with_products, rendered)):
        scan.attrs |= platform
        if experiment.detector:
            # numbers of their own, apart from those of the light transport
            seed = [experiment.seed, index, 1]
            scan = noisy_scan(scan, experiment.lidar, experiment.detector, seed)
        exr.write_scan(paths[index], scan)
    # read back, so that a resumed run and one that was not see the same float32 values
    return [exr.read_scan(path) for path in paths]


def winds(experiment: Experiment, truth: Truth, plans, scans, log) -> xr.Dataset:
    """Winds by every method from every image pair, with the truth at their places.

    Returns a data set with dims (source, algorithm, z, y). Sources: the extinction itself, the same
    without sub-grid texture, the extinction blurred by the beam's width (what a noise-free lidar
    would see), the rendered backscatter and, with a detector, the same with its noise.
    """
    settings, lidar = experiment.retrieval, experiment.lidar
    blur = known_blur(experiment, plans[0])
    rendered = rendered_pairs(experiment, scans)
    images = {
        "extinction": [truth.image(k) for k in (0, 1)],
        "extinction_without_texture": [truth.image(k, smooth=True) for k in (0, 1)],
        "extinction_blurred": [
            blur_by_beam(truth.image(k), lidar, plans[k].centre) for k in (0, 1)
        ],
    }
    if experiment.scan.aim == "angles":
        grid = rendered["backscatter"][0][0]
        images = {
            name: [image.interp(y=grid["y"], z=grid["z"]) for image in pair]
            for name, pair in images.items()
        }
    images |= {name: pair for name, (pair, _) in rendered.items()}
    noise = {name: level for name, (_, level) in rendered.items()}
    sources = []
    for index, source in enumerate(images):
        log.bar(f"retrieving winds from {source.replace('_', ' ')}", index / len(images))
        methods = []
        level = noise.get(source, 0.0)
        sizes = {name: getattr(settings, name) for name in ("template", "search", "stride")}
        bound = wind_bound(*images[source], experiment.platform.dt, level, **sizes)
        for method in settings.methods:
            wind = retrieve_wind(
                *images[source],
                dt=experiment.platform.dt,
                method=method,
                **window_settings(settings),
                noise=level,
                # the extinction itself has passed no instrument
                blur=0.0 if source in EXACT else blur,
            )
            wind = wind.assign(
                {name: (field.dims, field.data, field.attrs) for name, field in bound.items()}
            )
            true = truth_at_vectors(wind, truth.wind)
            wind = wind.assign(v_true=true["v"], w_true=true["w"])
            wind = wind.rename({METHODS[method].score[0]: "score"})
            methods.append(wind.reset_coords(["y_vector", "z_vector"]))
        sources.append(xr.concat(methods, "algorithm", combine_attrs="drop_conflicts"))
    found = xr.concat(sources, "source", combine_attrs="drop_conflicts")
    found = found.assign_coords(source=list(images), algorithm=list(settings.methods))
    found["score"].attrs = {
        "long_name": "cc: correlation at the peak; ws: misfit of weight and centre of mass",
        "units": "1",
    }
    found.attrs["title"] = f"Cross-flow wind of the experiment {experiment.name}"
    found.attrs["source"] = f"lidar-mi {__version__}"
    return found


def rendered_pairs(experiment: Experiment, scans) -> dict[str, tuple[list[xr.DataArray], object]]:
    """Pictures that winds are found in, on one grid, and their noise (a map or its level).

    By source: the rendered backscatter, and with a detector the same with its noise.
    """
    noise = apparent_noise(scans[0])
    pairs = {"backscatter": ([scan["Y"] for scan in scans], noise)}
    if experiment.detector:
        noisy = np.hypot(noise, scans[0]["Y_noise_std"])
        pairs[NOISY] = [scan["Y_noisy"] for scan in scans], noisy
    if experiment.scan.aim == "angles":
        # the noise has no structure to interpolate: its level goes along, the rms, as few pixels have
        # most of it where photons are few
        pairs = {
            name: (resample_pair(*pair, experiment.wake.spacing), float((level**2).mean() ** 0.5))
            for name, (pair, level) in pairs.items()
        }
    return pairs


def known_blur(experiment: Experiment, plan: ScanPlan) -> float:
    """Standard deviation (m) of the blur that `retrieval.blur` tells methods of."""
    blur = experiment.retrieval.blur
    return float(experiment.lidar.radius_at(plan.centre)) / 2 if blur == "beam" else blur


def window_settings(settings) -> dict:
    """Window sizes and thresholds, as `retrieve_wind` takes them."""
    return settings.model_dump(exclude={"methods", "error_budget", "blur"})


def texture_sweep(experiment: Experiment, flows: Flows, log) -> dict[str, float]:
    """How well CC does on extinction pairs of more and less sub-grid texture.

    Keys ``texture_sweep.10_percent.rmse_v`` and ``.rmse_w`` (m/s, every vector with a
    displacement) and ``.valid_fraction``.
    """
    settings = experiment.retrieval
    metrics = {}
    for index, rms in enumerate(TEXTURE_SWEEP):
        log.bar(f"retrieving winds at {rms:.0%} texture", index / len(TEXTURE_SWEEP))
        texture = experiment.wake.texture.model_copy(update={"rms": rms})
        wake = experiment.wake.model_copy(update={"texture": texture})
        truth = make_truth(experiment.model_copy(update={"wake": wake}), flows=flows)
        wind = retrieve_wind(
            truth.image(0),
            truth.image(1),
            dt=experiment.platform.dt,
            method="cc",
            **window_settings(settings),
        )
        found = wind_metrics(wind, truth_at_vectors(wind, truth.wind), [])
        for key in ("all.rmse_v", "all.rmse_w", "valid_fraction"):
            if key in found:
                name = key.removeprefix("all.")
                metrics[f"texture_sweep.{round(100 * rms)}_percent.{name}"] = found[key]
    return metrics


def apparent_noise(scan: xr.Dataset) -> xr.DataArray:
    """Standard error of the apparent backscatter Y, same unit."""
    first = scan.isel(gate=0)
    lit = first["S0"] > 0
    return (scan["Y"] * first["S0_stderr"] / first["S0"].where(lit)).fillna(0.0)


def verdict(found: xr.Dataset, scans, cores: list[Core]) -> dict[str, float]:
    """All metrics of a run: ``source.method.quantity``."""
    metrics = {}
    for source in found["source"].values:
        for method in found["algorithm"].values:
            wind = found.sel(source=source, algorithm=method)
            true = wind[["v_true", "w_true"]].rename(v_true="v", w_true="w")
            for key, value in wind_metrics(wind, true, cores).items():
                metrics[f"{source}.{method}.{key}"] = value
            for key, value in efficiency(wind).items():
                metrics[f"{source}.{method}.{key}"] = value
    first = scans[0].isel(gate=0)
    lit = first["S0"].where(first["S0"] > 0)
    metrics["backscatter.mc_relative_error"] = float((first["S0_stderr"] / lit).median())
    if "order1.S0" in first:
        total = float(first["S0"].sum(dtype=float))
        single = float(first["order1.S0"].sum(dtype=float))
        metrics["backscatter.multiple_scattering_fraction"] = 1 - single / total
    if "depolarization" in first:
        s0, s1 = (float(first[name].sum(dtype=float)) for name in ("S0", "S1"))
        metrics["backscatter.depolarization"] = float(linear_depolarization(s0, s1))
        metrics["backscatter.depolarization_stderr"] = float(
            first["depolarization_stderr"].median()
        )
    for core in cores:
        side = "port" if core.circulation > 0 else "starboard"
        for key in ("y", "z", "radius", "circulation"):
            metrics[f"wake.{side}_core.{key}"] = getattr(core, key)
    return metrics


def safety(experiment: Experiment, plan: ScanPlan) -> dict[str, float]:
    """Eye safety of the beams, if their pulses last: ``safety.*``, J m^-2, m and W.

    Every direction has a pulse each ``platform.dt``; infinite distances are left out.
    """
    lidar, rate = experiment.lidar, 1 / experiment.platform.dt
    if lidar.pulse_duration == 0:
        return {}
    exposure = experiment.sensor.exposure if experiment.sensor else EXPOSURE
    pulse = (lidar.wavelength, lidar.pulse_energy, lidar.pulse_duration)
    beam = (float(lidar.radius_at(0)), lidar.divergence_full)
    one = assess_pulses(*pulse, *beam, rate, exposure)
    spacing = float(np.mean([np.diff(plan.y).mean(), np.diff(plan.z).mean()])) / plan.centre
    beams = len(plan.y) * len(plan.z)
    found = {
        "permissible_exposure": one.limit.exposure,
        "hazard_distance": one.hazard_distance,
        "aided_hazard_distance": one.aided_hazard_distance,
        "scan_hazard_distance": scan_hazard_distance(*pulse, *beam, spacing, beams, rate, exposure),
        "scan_power": lidar.pulse_energy * beams * rate,
    }
    return {f"safety.{key}": value for key, value in found.items() if np.isfinite(value)}


def efficiency(wind: xr.Dataset) -> dict[str, float]:
    """What the images' noise allows over what a method finds, of v and w; valid vectors only.

    ``bound_*``: rms of the Cramer-Rao bound of one template, m/s. ``efficiency_*``: that over the
    rms error; above 1 where a method smooths over more than a template. Nothing without noise.
    """
    metrics = {}
    for name in ("v", "w"):
        error = (wind[name] - wind[f"{name}_true"]).values
        bound = wind[f"{name}_bound"].values
        used = (wind["flag"].values == 0) & np.isfinite(error) & np.isfinite(bound)
        if used.any() and (bound[used] > 0).all():
            least = float(np.sqrt(np.mean(bound[used].astype(float) ** 2)))
            metrics[f"bound_{name}"] = least
            metrics[f"efficiency_{name}"] = least / float(np.sqrt(np.mean(error[used] ** 2)))
    return metrics


def true_wind(found: xr.Dataset, truth: Truth, cores: list[Core]) -> dict[str, float]:
    """How strong the true wind is where vectors are looked for: an error as large is no skill."""
    place = {axis: slice(found[axis].min(), found[axis].max()) for axis in ("y", "z")}
    wind = truth.wind.sel(place)
    far = outside_cores(wind["y"].values, wind["z"].values[:, None], cores)
    rms = {}
    for name in ("v", "w"):
        square = wind[name].transpose("z", "y").values ** 2
        rms[f"true_wind.rms_{name}"] = float(np.sqrt(square.mean()))
        if cores and far.any():
            rms[f"true_wind.outside_cores.rms_{name}"] = float(np.sqrt(square[far].mean()))
    return rms


def scan_plans(experiment: Experiment, truth: Truth) -> list[ScanPlan]:
    """The scans of both pictures."""
    flown = (experiment.platform.speed - experiment.scan.follow) * experiment.platform.dt
    return plan_scans(experiment.scan, truth.wind["y"].values, truth.wind["z"].values, (0.0, flown))


@contextmanager
def _timed(timing: dict[str, float], name: str):
    start = time.perf_counter()
    yield
    timing[name] = time.perf_counter() - start
