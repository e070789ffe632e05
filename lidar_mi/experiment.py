"""One experiment, start to end: truth, sensor, picture, estimate, verdict.

A run lives in one folder. Pictures are kept as soon as they are there; a run that was stopped
goes on with those, and everything after them is made again.
"""

import hashlib
import json
import os
import platform
import time
from collections.abc import Callable
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.metadata import version
from importlib.resources import files
from pathlib import Path

import numpy as np
import xarray as xr
import yaml
from scipy import integrate, ndimage, stats

from . import __version__, config
from .assessment import figures, report
from .assessment.cores import Core, find_cores
from .assessment.errors import truth_at_vectors, wind_metrics
from .atmosphere.advection import advect
from .atmosphere.extinction import extinction_from_speed, extinction_from_tracer
from .atmosphere.texture import corrsin_obukhov
from .atmosphere.vortex import pair_wake, vortex_pair
from .atmosphere.wake import centre, read_wake, resample
from .config import Experiment
from .errors import InputError
from .instrument.detector import noise_budget, noisy_scan
from .instrument.scan import ScanPlan, plan_scans
from .rendering import exr
from .rendering.backscatter import extrude, render_scans
from .rendering.phase import albedo, phase_function
from .rendering.variant import use_variant
from .retrieval.images import resample_pair
from .retrieval.wind import retrieve_wind
from .retrieval.windows import Windows

IMAGES = ("image_t1.exr", "image_t2.exr")
# what winds are retrieved from behind a detector, beside the noise-free picture
NOISY = "backscatter_noisy"

# relative rms of the sub-grid texture for which `texture_sweep` says how good winds get
TEXTURE_SWEEP = (0.0, 0.02, 0.05, 0.1, 0.2, 0.4)

Notice = Callable[[str, float | None], None]
"""Called with what is running and how far it is (0 to 1, None: unknown)."""


@dataclass(frozen=True)
class Truth:
    """What the lidar looks at, in the lidar's frame at t1 (metres, m^-1, m s^-1).

    ``extinction`` and ``smooth`` (without sub-grid texture) hold the fields at t1 and t2, dims
    (x, y, z); ``wind`` has v, w on (z, y), averaged over the depth of the first gate.
    """

    extinction: tuple[xr.DataArray, xr.DataArray]
    smooth: tuple[xr.DataArray, xr.DataArray]
    wind: xr.Dataset

    def image(self, which: int, smooth: bool = False) -> xr.DataArray:
        """Extinction averaged over depth as an image (z, y): what an ideal lidar would see."""
        field = (self.smooth if smooth else self.extinction)[which]
        return _slab_mean(field, self.wind.attrs["gates"])


def run(
    experiment: Experiment,
    folder: str | Path,
    beside: str | Path = ".",
    overwrite: bool = False,
    notice: Notice = lambda text, share: None,
) -> dict[str, float]:
    """Run an experiment into a folder and return its metrics.

    Parameters
    ----------
    experiment : Experiment
    folder : path
        Made if missing. If it holds a run of the same experiment, its pictures are used again.
    beside : path
        Folder in which files named by the experiment are looked for first.
    overwrite : bool
        Replace a run of a different experiment instead of refusing.
    notice : callable
        Told what is running.

    Raises
    ------
    InputError
        Bad input, or the folder holds another experiment.
    """
    folder = Path(folder)
    timing = {}
    use_variant(experiment.render.variant)
    with _timed(timing, "truth"):
        notice("reading the wake", None)
        truth = make_truth(experiment, beside)
        plans = _plans(experiment, truth)
    _check_ahead(experiment, truth, plans, beside)
    _claim(folder, experiment, beside, overwrite)
    log = _Log(folder / "log.txt", notice)
    log(f"lidar-mi {__version__}, experiment {experiment.name}, seed {experiment.seed}")
    scans = pictures(experiment, truth, plans, folder, beside, log)
    timing["render"] = sum(scan.attrs["render_seconds"] for scan in scans)
    with _timed(timing, "retrieve"):
        log("retrieving winds")
        cores = find_cores(truth.wind)
        found = winds(experiment, truth, plans, scans, log)
        write_netcdf(found, folder / "wind.nc")
        sweep = texture_sweep(experiment, beside, log)
    metrics = verdict(found, scans, cores) | sweep
    if experiment.detector:
        budget = noise_budget(scans[0], experiment.lidar, experiment.detector)
        metrics |= {f"detector.{key}": value for key, value in budget.items()}
    with _timed(timing, "figures"):
        log("drawing figures")
        drawn = figures.draw_all(folder / "figures", truth, scans, found, cores, sweep, log)
    metrics |= {f"timing.{k}_s": round(v, 3) for k, v in timing.items()}
    _write(
        folder / "metrics.json",
        lambda path: path.write_text(json.dumps(metrics, indent=1, allow_nan=False) + "\n"),
    )
    page = report.page(experiment, config.dump(experiment), metrics, cores, drawn)
    _write(folder / "report.html", lambda path: path.write_text(page))
    log("done")
    return metrics


def _check_ahead(experiment, truth, plans, beside) -> None:
    """What would only fail later is said before anything is written."""
    phase_function(experiment.scattering, beside, experiment.lidar.wavelength)
    settings, image = experiment.retrieval, (len(plans[0].z), len(plans[0].y))
    Windows(image, settings.template, settings.search, settings.stride)
    if not max(float(field.max()) for field in truth.extinction) > 0:
        raise InputError(
            "wake.extinction: 0 everywhere is not allowed; expected air that scatters, by its "
            "background, tracer or aerosol"
        )
    if not albedo(experiment.scattering, experiment.lidar.wavelength) > 0:
        raise InputError("scattering.albedo: 0 is not allowed here; expected above 0, up to 1")


def make_truth(experiment: Experiment, beside: str | Path = ".") -> Truth:
    """The flow and the extinction at both times, on the scan's grid, in the lidar's frame."""
    first, second = _flows(experiment, beside)
    mapping, dt = experiment.wake.extinction, experiment.platform.dt
    smooth1 = _extinction(first, mapping, first, second)
    if second is None:
        flow = first
        smooth2 = advect(smooth1, flow["v"], flow["w"], dt)
    else:
        flow = (first + second) / 2
        smooth2 = _extinction(second, mapping, first, second)
    texture = experiment.wake.texture
    if texture.rms > 0:
        x = first["x"].values if first.sizes["x"] > 1 else None
        factor = corrsin_obukhov(
            first["y"].values, first["z"].values, texture.rms, texture.outer_scale,
            experiment.seed, x=x,
        )  # fmt: skip
        if x is None:
            factor = factor.expand_dims(x=first["x"].values)
        factor = factor.assign_coords(first.coords).transpose("x", "y", "z")
        if second is None:
            rough1 = smooth1 * factor
            rough2 = advect(rough1, flow["v"], flow["w"], dt)
        else:
            rough1 = smooth1 * factor
            rough2 = smooth2 * advect(factor, flow["v"], flow["w"], dt)
    else:
        rough1, rough2 = smooth1, smooth2
    # winds are retrieved from the first gate
    depth = experiment.scan.thickness / experiment.scan.gate_count
    gates = (experiment.scan.range, experiment.scan.range + depth)
    wind = xr.Dataset({name: _slab_mean(flow[name], gates) for name in ("v", "w")})
    wind.attrs["gates"] = gates
    return Truth((rough1, rough2), (smooth1, smooth2), wind)


def pictures(experiment, truth, plans, folder: Path, beside, log) -> list[xr.Dataset]:
    """The two scans: those in the folder, and the missing ones rendered and written to it."""
    paths = [folder / name for name in IMAGES]
    missing = [index for index, path in enumerate(paths) if not path.is_file()]
    if len(missing) < len(paths):
        log(f"using {len(paths) - len(missing)} of {len(paths)} pictures from an earlier run")
    fields = truth.extinction
    if fields[0].sizes["x"] == 1:
        reach = max(plans, key=lambda plan: plan.gate_stop)
        fields = [
            extrude(field.isel(x=0).transpose("z", "y"), reach, experiment.lidar)
            for field in fields
        ]

    def progress(scan: int, done: int, total: int) -> None:
        log.bar(f"rendering scan {scan + 1} of {len(plans)}", done / total)

    if missing:
        log(f"rendering {len(missing)} scans of {len(plans[0].y)} x {len(plans[0].z)} beams")
    rendered = render_scans(
        fields,
        plans,
        experiment.lidar,
        experiment.wake.extinction.background,
        phase_function(experiment.scattering, beside, experiment.lidar.wavelength),
        albedo(experiment.scattering, experiment.lidar.wavelength),
        experiment.render,
        experiment.seed,
        progress,
        missing,
    )
    for index, scan in zip(missing, rendered):
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
    images = {
        "extinction": [truth.image(k) for k in (0, 1)],
        "extinction_without_texture": [truth.image(k, smooth=True) for k in (0, 1)],
        "extinction_blurred": [
            blur_by_beam(truth.image(k), lidar, plans[k].centre) for k in (0, 1)
        ],
        "backscatter": [scan["Y"] for scan in scans],
    }
    noise = {"backscatter": apparent_noise(scans[0])}
    if experiment.detector:
        images[NOISY] = [scan["Y_noisy"] for scan in scans]
        noise[NOISY] = np.hypot(noise["backscatter"], scans[0]["Y_noise_std"])
    if experiment.scan.aim == "angles":
        # the noise has no structure to interpolate: its level goes along
        noise = {name: float(level.median()) for name, level in noise.items()}
        rendered = {
            name: resample_pair(*images[name], experiment.wake.spacing) for name in noise
        }
        grid = rendered["backscatter"][0]
        images = {
            name: [image.interp(y=grid["y"], z=grid["z"]) for image in pair]
            for name, pair in images.items() if name not in rendered
        } | rendered  # fmt: skip
    sources = []
    for index, source in enumerate(images):
        log.bar(f"retrieving winds from {source.replace('_', ' ')}", index / len(images))
        methods = []
        for method in settings.methods:
            wind = retrieve_wind(
                *images[source],
                dt=experiment.platform.dt,
                method=method,
                **_windows(settings),
                noise=noise.get(source, 0.0),
            )
            true = truth_at_vectors(wind, truth.wind)
            wind = wind.assign(v_true=true["v"], w_true=true["w"])
            wind = wind.rename({"correlation" if method == "cc" else "mismatch": "score"})
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


def _windows(settings) -> dict:
    """Window sizes and thresholds, as `retrieve_wind` takes them."""
    return settings.model_dump(exclude={"methods"})


def texture_sweep(experiment: Experiment, beside, log) -> dict[str, float]:
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
        truth = make_truth(experiment.model_copy(update={"wake": wake}), beside)
        wind = retrieve_wind(
            truth.image(0), truth.image(1), dt=experiment.platform.dt, method="cc",
            **_windows(settings),
        )  # fmt: skip
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


def blur_by_beam(image: xr.DataArray, lidar, distance: float) -> xr.DataArray:
    """An image seen by beams of finite width, aimed at its nodes, at a distance.

    Between nodes the air varies linearly, as the renderer's grid does. A beam is a Gaussian with
    the variance per axis of its truncated aperture plus its divergence, so a node k spacings away
    weighs g(k+1) - 2 g(k) + g(k-1), where g(x) is the mean of max(0, x + sigma X) for normal X.
    The spacing adds 1/6 px^2 to the Gaussian's variance: for 0.5 m and the paper's beam, two
    thirds more. What is left out costs less than 0.1 % of a pixel on textured
    air: the aperture's truncation beyond its variance, and the smear of oblique beams over the
    gate's depth.
    """
    w, cut = lidar.beam_radius, lidar.beam_cut
    edge = 2 * (cut / w) ** 2
    lost = edge / np.expm1(edge) if edge < 500 else 0.0
    aperture = w**2 / 4 * (1 - lost)
    metres = np.sqrt(aperture + (lidar.divergence_full / 2 * distance) ** 2 / 4)
    values = image.values
    for axis, name in enumerate(image.dims):
        sigma = metres / float(image[name][1] - image[name][0])
        reach = int(np.ceil(6 * sigma)) + 1
        x = np.arange(-reach - 1, reach + 2)
        g = x * stats.norm.cdf(x / sigma) + sigma * stats.norm.pdf(x / sigma)
        values = ndimage.correlate1d(values, np.diff(g, 2), axis, mode="nearest")
    return image.copy(data=values)


def verdict(found: xr.Dataset, scans, cores: list[Core]) -> dict[str, float]:
    """All metrics of a run: ``source.method.quantity``."""
    metrics = {}
    for source in found["source"].values:
        for method in found["algorithm"].values:
            wind = found.sel(source=source, algorithm=method)
            true = wind[["v_true", "w_true"]].rename(v_true="v", w_true="w")
            for key, value in wind_metrics(wind, true, cores).items():
                metrics[f"{source}.{method}.{key}"] = value
    first = scans[0].isel(gate=0)
    lit = first["S0"].where(first["S0"] > 0)
    metrics["backscatter.mc_relative_error"] = float((first["S0_stderr"] / lit).median())
    if "order1.S0" in first:
        total = float(first["S0"].sum(dtype=float))
        single = float(first["order1.S0"].sum(dtype=float))
        metrics["backscatter.multiple_scattering_fraction"] = 1 - single / total
    for core in cores:
        side = "port" if core.circulation > 0 else "starboard"
        for key in ("y", "z", "radius", "circulation"):
            metrics[f"wake.{side}_core.{key}"] = getattr(core, key)
    return metrics


def _flows(experiment: Experiment, beside) -> tuple[xr.Dataset, xr.Dataset | None]:
    """The flow at t1 and, if it is a state of its own, at t2, centred and refined."""
    wake = experiment.wake
    gate_middle = experiment.scan.range + experiment.scan.thickness / 2
    if wake.vortex_pair:
        pair = wake.vortex_pair
        axes = [
            np.linspace(-extent / 2, extent / 2, _cells(extent, wake.spacing, name) + 1)
            for name, extent in (("width", pair.width), ("height", pair.height))
        ]
        vortices = vortex_pair(
            pair.circulation, pair.separation, pair.core_radius, model=pair.model
        )
        return pair_wake(vortices, *axes, x=gate_middle), None
    mapping = wake.extinction
    # what the extinction is made from goes by our names from here on, and must be in the file
    needed = {"tracer": mapping.tracer, "aerosol": mapping.aerosol}
    needed = {n: t for n, t in needed.items() if t and mapping.source == "tracer"}
    names = wake.names | {n: t for n, t in needed.items() if t != n}
    path = find_file(wake.file, beside, "wake.file")
    if wake.second != "advect" and wake.time is not None:
        passed = wake.second - wake.time
        if abs(passed - experiment.platform.dt) > 1e-3 * experiment.platform.dt:
            raise InputError(
                f"wake.second: {wake.second:g} s is not allowed; expected platform.dt = "
                f"{experiment.platform.dt:g} s after wake.time = {wake.time:g} s"
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
        flow = centre(resample(flow, wake.spacing), y, z).drop_vars("time", errors="ignore")
        middle = wake.x if wake.x is not None else float(flow["x"].mean())
        flows.append(flow.assign_coords(x=flow["x"] - middle + gate_middle))
    return flows[0], flows[1]


def _cells(extent: float, spacing: float, name: str) -> int:
    cells = round(extent / spacing)
    if cells < 1 or abs(cells * spacing - extent) > 1e-6 * extent:
        raise InputError(
            f"wake.vortex_pair.{name}: {extent:g} m is not allowed; expected a multiple of "
            f"wake.spacing = {spacing:g} m"
        )
    return cells


def _extinction(flow, mapping, first, second) -> xr.DataArray:
    """Extinction of one state, scaled by the largest value of both."""
    limits = {"background": mapping.background, "maximum": mapping.maximum}
    states = [s for s in (first, second) if s is not None]
    if mapping.source == "speed":
        fastest = max(float(np.hypot(s["v"], s["w"]).max()) for s in states)
        field = extinction_from_speed(flow, **limits, stretch=mapping.stretch, reference=fastest)
    else:
        # an analytic flow carries neither: then the background is all there is
        tracer = "tracer" if mapping.tracer and "tracer" in flow else None
        aerosol = "aerosol" if mapping.aerosol and "aerosol" in flow else None
        if tracer is None and aerosol is None:
            field = xr.full_like(flow["v"], mapping.background)
            field.attrs = {"long_name": "extinction coefficient", "units": "m-1"}
            return field.transpose("x", "y", "z")
        densest = max(float(s[tracer].max()) for s in states) if tracer else None
        field = extinction_from_tracer(
            flow, **limits, stretch=mapping.stretch, tracer=tracer, aerosol=aerosol,
            reference=densest,
        )  # fmt: skip
    return field.transpose("x", "y", "z")


def _slab_mean(field: xr.DataArray, gates: tuple[float, float]) -> xr.DataArray:
    """Mean over the depth of planar gates, (z, y); linear between planes, as the renderer's grid."""
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
        hats = [np.interp(nodes, x, plane) for plane in np.eye(len(x))]
        weights = integrate.trapezoid(hats, nodes) / (gates[1] - gates[0])
    image = (field * xr.DataArray(weights, dims="x")).sum("x").transpose("z", "y")
    image.attrs = field.attrs
    for axis in ("y", "z"):
        image[axis].attrs["units"] = "m"
    return image


def _plans(experiment: Experiment, truth: Truth) -> list[ScanPlan]:
    flown = experiment.platform.speed * experiment.platform.dt
    return plan_scans(
        experiment.scan, truth.wind["y"].values, truth.wind["z"].values, (0.0, flown)
    )


def find_file(name: str, beside: str | Path, field: str) -> Path:
    """A file named by an experiment: as given, beside the experiment, or shipped."""
    shipped = Path(str(files("lidar_mi.scenes")))
    for candidate in (Path(beside) / name, shipped / name):
        if candidate.is_file():
            return candidate
    raise InputError(
        f"{field}: {name} not found; looked in {Path(beside).resolve()} and the shipped samples "
        f"({', '.join(sorted(p.name for p in shipped.glob('*.nc')))})"
    )


def _claim(folder: Path, experiment: Experiment, beside: str | Path, overwrite: bool) -> None:
    """Make the folder this experiment's, keeping pictures of the very same one."""
    marker = folder / "experiment.yaml"
    libraries = ("mitsuba", "drjit", "numpy", "scipy", "torch", "kornia", "OpenEXR", "xarray")
    record = {
        "experiment": yaml.safe_load(config.dump(experiment)),
        "files": _checksums(experiment, beside),
        "versions": {
            "lidar-mi": __version__,
            "python": platform.python_version(),
            **{name: version(name) for name in libraries},
        },
    }
    if marker.is_file():
        before = read_record(folder)
        if any(before.get(key) != record[key] for key in ("experiment", "files")):
            pictures = [folder / name for name in IMAGES if (folder / name).is_file()]
            if pictures and not overwrite:
                raise InputError(
                    f"{folder}: holds a run of another experiment; expected an empty folder "
                    "(-o DIR), or --overwrite to replace it"
                )
            # nothing of the other experiment may be taken for a result of this one
            old = [folder / name for name in ("wind.nc", "metrics.json", "report.html", "log.txt")]
            for path in (*pictures, *old, *(folder / "figures").glob("*.png")):
                path.unlink(missing_ok=True)
    elif folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise InputError(f"{folder}: is no run folder; expected an empty or a new one (-o DIR)")
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{folder}: cannot be made ({error.strerror})") from None
    _write(marker, lambda path: path.write_text(yaml.safe_dump(record, sort_keys=False)))


def _checksums(experiment: Experiment, beside: str | Path) -> dict[str, str]:
    """SHA-256 of the files an experiment names: a changed file is another experiment."""
    paths = {}
    if experiment.wake.file:
        paths["wake.file"] = find_file(experiment.wake.file, beside, "wake.file")
    if experiment.scattering.table:
        paths["scattering.table"] = Path(phase_function(experiment.scattering, beside)["table"])
    return {field: hashlib.sha256(path.read_bytes()).hexdigest() for field, path in paths.items()}


def read_record(folder: str | Path) -> dict:
    """What a run folder says it holds: ``experiment`` (resolved), ``files`` (checksums), ``versions``.

    Raises
    ------
    InputError
        The folder's experiment.yaml is missing or was not written by a run.
    """
    marker = Path(folder) / "experiment.yaml"
    try:
        record = yaml.safe_load(marker.read_text())
    except OSError:
        raise InputError(f"{folder}: no experiment.yaml in it; expected a run folder") from None
    except (yaml.YAMLError, UnicodeDecodeError):
        record = None
    if not isinstance(record, dict) or not all(
        isinstance(record.get(key), dict) for key in ("experiment", "versions")
    ):
        raise InputError(f"{marker}: not written by a run; expected a run folder")
    return record


def write_netcdf(data: xr.Dataset, path: str | Path) -> None:
    """Write a data set as NetCDF-4 under a temporary name, then rename."""
    path = Path(path)
    if not path.parent.is_dir():
        raise InputError(f"{path}: {path.parent} is no folder; expected one that exists")
    packed = {n: {"zlib": True, "complevel": 4} for n, v in data.data_vars.items() if v.ndim}
    _write(path, lambda part: data.to_netcdf(part, engine="h5netcdf", encoding=packed))


def _write(path: Path, write: Callable[[Path], object]) -> None:
    """Write under a temporary name, then rename: never half a file."""
    temporary = path.with_name(f".{path.stem}.{os.getpid()}{path.suffix}")
    try:
        write(temporary)
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


@contextmanager
def _timed(timing: dict[str, float], name: str):
    start = time.perf_counter()
    yield
    timing[name] = time.perf_counter() - start


class _Log:
    """Lines for the log file and the person in front of the screen."""

    def __init__(self, path: Path, notice: Notice):
        self.path, self.notice = path, notice

    def __call__(self, text: str) -> None:
        with self.path.open("a") as file:
            file.write(f"{time.strftime('%Y-%m-%d %H:%M:%S')} {text}\n")
        self.notice(text, None)

    def bar(self, text: str, share: float) -> None:
        """Progress within a step: shown, not logged."""
        self.notice(text, share)
