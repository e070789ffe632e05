"""The Doppler lidar of an experiment, start to end: rings rendered, exposed and read for the wind.

The laser's own light and that of air at every speed are rendered without noise. From these pictures
the CCD draws noisy ones, and every method says which speed it sees in them.
"""

import math
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
import xarray as xr

from lidar_mi import __version__
from lidar_mi.assessment.figures import doppler as doppler_figures
from lidar_mi.assessment.metrics.velocities import velocity_metrics
from lidar_mi.assessment.report.page import Chapter, doppler_chapter
from lidar_mi.atmosphere.line import Line, backscatter_line, laser_line
from lidar_mi.atmosphere.molecules import standard_atmosphere
from lidar_mi.errors import InputError
from lidar_mi.experiment.ring_instrument import air_rings, pixel_noise, ring_model
from lidar_mi.experiment.run_folder import Log
from lidar_mi.experiment.schema import Doppler, Experiment
from lidar_mi.instrument.doppler import photons, solar_background, speckle_modes
from lidar_mi.instrument.etalon import finesse
from lidar_mi.instrument.fringe_camera import CCD, expose, fringe_image, ring_radii
from lidar_mi.io import exr
from lidar_mi.io.netcdf import write_netcdf
from lidar_mi.rendering.fringes import render_fringes, scene_dict
from lidar_mi.rendering.variant import use_variant
from lidar_mi.retrieval.rings import peaks as ring_peaks
from lidar_mi.retrieval.rings.fit import fit_rings
from lidar_mi.retrieval.rings.model import PixelNoise, RingModel, cramer_rao

EMITTED, PHOTONS = "fringes_emitted.exr", "fringes_photons.exr"

FITS = ("annular", "pixels")
# way to the radius and coordinate of the fit, as `ring_peaks.ring_radius` takes them
PEAKS = {"ca": ("ca", "r"), "ca_r2": ("ca", "r2"), "ml": ("ml", "r"), "sg": ("sg", "r")}

# half widths of the fitted piece, in radii, for which the bias of peak fits is looked at
PIECES = tuple(np.linspace(0.1, 0.5, 9).round(3).tolist())

FRAMES = 16  # noisy pictures in memory at a time


class Rings(NamedTuple):
    """What the pictures of a Doppler lidar follow from."""

    line: Line
    model: RingModel
    photons: float
    background: float
    modes: float


class Pictures(NamedTuple):
    """Rendered pictures: of the laser itself, of air at every speed, and photon by photon."""

    emitted: xr.Dataset
    received: list[xr.Dataset]
    photons: xr.Dataset | None


class Exposure(NamedTuple):
    """A picture without noise, and one by the CCD: photoelectrons a pixel of one pulse."""

    emitted: np.ndarray
    received: np.ndarray
    noisy: np.ndarray


def prepare(experiment: Experiment) -> Callable[[Path, Log], tuple[dict[str, float], Chapter]]:
    """Check everything that can be checked ahead; what it returns runs the rest into a folder.

    Raises
    ------
    InputError
        Values that do not go together.
    """
    rings = ring_instrument(experiment.doppler)
    use_variant(experiment.doppler.render.variant)
    for line, settings in ((rings.line, experiment.doppler.render), _photon_by_photon(experiment)):
        scene_dict(experiment.doppler.etalon, experiment.doppler.camera, line, settings)
    return lambda folder, log: _run(experiment, rings, folder, log)


def _run(experiment, rings, folder, log) -> tuple[dict[str, float], Chapter]:
    doppler = experiment.doppler
    use_variant(doppler.render.variant)
    start = [time.perf_counter()]
    seen = pictures(experiment, rings.line, folder, log)
    start.append(time.perf_counter())
    expected = [_expected(picture, rings.photons) for picture in seen.received]
    found = velocities(doppler, rings, seen, expected, experiment.seed, log)
    found.attrs |= {
        "title": f"Line-of-sight wind of the experiment {experiment.name}",
        "source": f"lidar-mi {__version__}",
    }
    write_netcdf(found, folder / "v_los.nc")
    _warn_of_failures(found, log)
    log("computing the Cramer-Rao bound")
    metrics = _instrument(doppler, rings) | _noise_free(rings, seen, expected)
    metrics |= _bounds(doppler, rings) | velocity_metrics(found)
    start.append(time.perf_counter())
    log("drawing figures of the rings")
    exposure = Exposure(
        _expected(seen.emitted, rings.photons).numpy(),
        expected[0].numpy(),
        exposed_frames(doppler, rings, expected[0], 1, experiment.seed, [0])[0].numpy(),
    )
    drawn = doppler_figures.draw_all(
        folder / "figures", doppler, exposure, seen.photons, found, metrics, log
    )
    start.append(time.perf_counter())
    took = np.diff(start).round(3).tolist()
    names = ("render", "retrieve", "figures")
    metrics |= {f"timing.doppler_{name}_s": value for name, value in zip(names, took)}
    return metrics, doppler_chapter(doppler, metrics, drawn)


def pictures(experiment: Experiment, line: Line, folder: Path, log: Log) -> Pictures:
    """The pictures in the folder; missing ones are rendered and written to it."""
    doppler, seed = experiment.doppler, experiment.seed
    laser = laser_line(doppler.lidar.wavelength, doppler.lidar.laser_width)
    names = [f"fringes_received_{k:02d}.exr" for k in range(len(doppler.v_los))]
    # what to render: line, settings, speeds, files
    plan = [(laser, doppler.render, (0.0,), [EMITTED])]
    if doppler.photon_samples:
        plan.append((*_photon_by_photon(experiment), (0.0,), [PHOTONS]))
    plan.append((line, doppler.render, doppler.v_los, names))
    total = sum(len(files) for *_, files in plan)
    there = sum((folder / name).is_file() for *_, files in plan for name in files)
    if there:
        log(f"using {there} of {total} pictures of rings from an earlier run")
    before = 0
    for line_, settings, speeds, files in plan:
        missing = [k for k, name in enumerate(files) if not (folder / name).is_file()]
        if missing:
            size = f"{doppler.camera.width} x {doppler.camera.height}"
            log(f"rendering {files[missing[0]]} ... {files[missing[-1]]}, {size} pixels")
            # the number of a picture makes its seed: a resumed run renders the same ones
            first, number = missing[0], before + missing[0]
            rendered = render_fringes(
                doppler.etalon,
                doppler.camera,
                line_,
                speeds[first:],
                settings,
                (seed + (number << 16)) % 2**31,
                lambda k, done, paths, n=number: log.bar(
                    f"rendering rings {n + k + 1} of {total}", done / paths
                ),
            )
            for k, picture in enumerate(rendered, first):
                if k in missing:
                    exr.write_fringes(folder / files[k], picture)
        before += len(files)
    # read back, so that a resumed run and one that was not see the same values
    return Pictures(
        exr.read_fringes(folder / EMITTED),
        [exr.read_fringes(folder / name) for name in names],
        exr.read_fringes(folder / PHOTONS) if doppler.photon_samples else None,
    )


def velocities(
    doppler: Doppler,
    rings: Rings,
    seen: Pictures,
    expected: Sequence[torch.Tensor],
    seed: int,
    log: Log,
) -> xr.Dataset:
    """What every method reads from noisy pictures, and from averages of several.

    Returns
    -------
    xr.Dataset
        ``tried`` (algorithm), the pictures of every case that were given to it; ``v`` and its standard deviation ``v_std`` as the fit says, m/s, dims (algorithm, centre,
        averaged, v_los, image), NaN where nothing was read; and ``peak_bias`` (coordinate, piece)
        of the innermost ring's peak without any noise, m/s, at the first speed.
    """
    settings, speeds = doppler.retrieval, doppler.v_los
    shape = (
        len(settings.methods),
        len(settings.centre),
        len(settings.averaged),
        len(speeds),
        settings.images,
    )
    v, v_std = np.full((2, *shape), np.nan)
    emitted = seen.emitted["S0"].values.astype(float)
    reference = _emitted_velocity(doppler, seen.emitted, rings.photons)
    radii = {centre: _peak_radii(emitted, doppler, centre) for centre in settings.centre}
    fits = [m for m in settings.methods if m in FITS]
    peaks = [m for m in settings.methods if m in PEAKS]
    places = {name: settings.methods.index(name) for name in settings.methods}
    tried = [settings.images if m == "annular" else settings.slow_images for m in settings.methods]
    done, total = 0, math.prod(shape[2:])
    for j, n in enumerate(settings.averaged):
        noise = summed_noise(doppler.ccd, rings.modes, n)
        for k, speed in enumerate(speeds):
            for first in range(0, settings.images, FRAMES):
                text = f"reading averages of {n} pictures at {speed:g} m/s"
                log.bar(text, done / total)
                images = range(first, min(first + FRAMES, settings.images))
                numbers = [(j * len(speeds) + k) * settings.images + i for i in images]
                frames = exposed_frames(doppler, rings, expected[k], n, seed, numbers)
                few = max(0, min(settings.slow_images - first, len(images)))
                for c, centre in enumerate(settings.centre):
                    for name in fits:
                        count = len(images) if name == "annular" else few
                        if count:
                            place = places[name], c, j, k, slice(first, first + count)
                            read = fitted_speeds(
                                frames[:count], doppler, rings.model, noise, name, centre
                            )
                            v[place], v_std[place] = read
                            v[place] -= reference
                    for i in range(few if peaks else 0):
                        found = _peak_radii(frames[i].numpy(), doppler, centre)
                        for name in peaks:
                            v[places[name], c, j, k, first + i] = ring_peaks.velocity_from_radii(
                                found[name],
                                radii[centre][name],
                                doppler.camera.focal_length,
                                doppler.camera.pixel,
                            )
                done += len(images)
    dims = ("algorithm", "centre", "averaged", "v_los", "image")
    return xr.Dataset(
        {
            "v": (dims, v, {"units": "m s-1", "long_name": "line-of-sight wind that is read"}),
            "v_std": (
                dims,
                v_std,
                {"units": "m s-1", "long_name": "standard deviation that the fit expects"},
            ),
            "tried": ("algorithm", tried, {"units": "1", "long_name": "pictures of every case"}),
            "peak_bias": (
                ("coordinate", "piece"),
                _peak_bias(doppler, seen),
                {
                    "units": "m s-1",
                    "long_name": "error of the innermost ring's peak by circular averaging, no noise",
                },
            ),
        },
        coords={
            "algorithm": list(settings.methods),
            "centre": list(settings.centre),
            "averaged": (
                "averaged",
                list(settings.averaged),
                {"units": "1", "long_name": "pictures of an average"},
            ),
            "v_los": ("v_los", list(speeds), {"units": "m s-1", "long_name": "true wind"}),
            "coordinate": list(ring_peaks.COORDINATES),
            "piece": (
                "piece",
                list(PIECES),
                {"units": "1", "long_name": "half width of the fitted piece in radii"},
            ),
        },
        attrs={"Conventions": "CF-1.11", "title": "Line-of-sight winds read from rings"},
    )


def fitted_speeds(frames, doppler, model, noise, method, centre) -> tuple[np.ndarray, np.ndarray]:
    """v_LOS and its standard deviation by `fit_rings`; NaN of pictures that it refuses."""
    known = {}
    if centre == "known":
        free = [name for name in model.parameters if name not in ("x", "y")]
        known = {"centre": doppler.camera.centre_pixel, "free": free}
    try:
        fit = fit_rings(frames, model, noise, method=method, **known)
    except InputError:
        if len(frames) == 1:
            return np.array([np.nan]), np.array([np.nan])
        alone = [fitted_speeds(f[None], doppler, model, noise, method, centre) for f in frames]
        v, std = zip(*alone)
        return np.concatenate(v), np.concatenate(std)
    return fit.v_los.numpy(), fit.v_los_std.numpy()


def _peak_radii(image: np.ndarray, doppler: Doppler, centre: str) -> dict[str, float]:
    """Innermost ring's radius (px) by all peak methods wanted; NaN where one finds none."""
    methods = [name for name in doppler.retrieval.methods if name in PEAKS]
    centres, radii, near = {}, {}, None
    for name in methods:
        way, coordinate = PEAKS[name]
        finder = "ml" if way == "ml" else "ca"
        try:
            if finder not in centres:
                known = centre == "known"
                centres[finder] = (
                    doppler.camera.centre_pixel if known else ring_peaks.find_centre(image, finder)
                )
            place = centres[finder]
            # the crest to a pixel: what a fit in r is off by goes with the piece about it
            near = near or ring_peaks.ring_radius(image, place, "ca", "r2")
            radii[name] = ring_peaks.ring_radius(image, place, way, coordinate, near)
        except InputError:
            radii[name] = math.nan
    return radii


def _peak_bias(doppler: Doppler, seen: Pictures) -> np.ndarray:
    """Error of the first speed by the innermost ring's peak, (coordinates, PIECES), m/s.

    From pictures without noise, about the true centre; NaN where a piece holds no peak.
    """
    camera = doppler.camera
    images = [p["S0"].values.astype(float) for p in (seen.received[0], seen.emitted)]

    def error(coordinate, piece):
        try:
            radii = [
                ring_peaks.ring_radius(i, camera.centre_pixel, "ca", coordinate, piece=piece)
                for i in images
            ]
        except InputError:
            return math.nan
        v = ring_peaks.velocity_from_radii(*radii, camera.focal_length, camera.pixel)
        return v - doppler.v_los[0]

    return np.array([[error(c, p) for p in PIECES] for c in ring_peaks.COORDINATES])


def _emitted_velocity(doppler: Doppler, emitted: xr.Dataset, total: float) -> float:
    """What the fit reads from the laser's own picture: the zero of all speeds.

    As many of its pictures can be averaged as one likes: it has no noise here.
    """
    line = laser_line(doppler.lidar.wavelength, doppler.lidar.laser_width)
    model = ring_model(doppler.etalon, doppler.camera, line)
    return float(fit_rings(_expected(emitted, total)[None], model).v_los)


def ring_instrument(doppler: Doppler) -> Rings:
    """What the pictures follow from, checked."""
    lidar, etalon, camera, ccd = doppler.lidar, doppler.etalon, doppler.camera, doppler.ccd
    pressure, temperature = standard_atmosphere(lidar.altitude)
    line = backscatter_line(
        lidar.wavelength,
        temperature,
        pressure,
        lidar.laser_width,
        lidar.aerosol_share,
        lidar.line_shape,
    )
    model = air_rings(lidar, etalon, camera)
    for speed in doppler.v_los:
        if not abs(speed) < model.velocity_range / 2:
            raise InputError(
                f"doppler.v_los: {speed:g} m/s is not allowed; expected less than "
                f"{model.velocity_range / 2:.0f} m/s each way, half an order of the etalon"
            )
        radii = ring_radii(camera, etalon, lidar.wavelength, speed)
        if len(radii) < 2:
            raise InputError(
                f"doppler.camera: {len(radii)} ring(s) at {speed:g} m/s are not allowed; expected "
                "2 or more: a larger CCD, a shorter focal_length or a wider gap of the etalon"
            )
    modes = doppler.speckle_modes
    if modes == "derived":
        modes = speckle_modes(lidar, camera, etalon, line)
    image = fringe_image(
        camera, etalon, line, doppler.v_los[0], photons(lidar), lidar.counted, subsamples=1
    )
    background = solar_background(lidar, etalon) / (camera.width * camera.height)
    crest = ccd.quantum_efficiency * (float(image.max()) + background)
    digits = math.inf if ccd.bits is None else (2**ccd.bits - 1 - ccd.bias) * ccd.gain
    full = min(ccd.full_well, digits)
    # crests of the noisiest pixels stay below
    if not crest + 6 * math.sqrt(crest + crest**2 / modes + ccd.read_noise**2) < full:
        raise InputError(
            f"doppler.ccd: a pixel that holds {full:.3g} photoelectrons is not allowed; expected "
            f"more, as the rings' crests have {crest:.3g}"
        )
    return Rings(line, model, float(image.sum()), background, modes)


def _photon_by_photon(experiment: Experiment):
    """The laser's line, and how single photons of it are sent through a real lens."""
    doppler = experiment.doppler
    laser = laser_line(doppler.lidar.wavelength, doppler.lidar.laser_width)
    if not doppler.photon_samples:
        return laser, doppler.render
    return laser, doppler.render.model_copy(
        update={
            "estimator": "analog",
            "line_shape": "sampled",
            "lens": "singlet",
            "samples_per_pixel": doppler.photon_samples,
        }
    )


def _expected(picture: xr.Dataset, total: float) -> torch.Tensor:
    """Mean photons a pixel of a picture of ``total`` photons."""
    image = torch.from_numpy(picture["S0"].values.astype(float))
    return image * (total / image.sum())


def exposed_frames(doppler, rings, expected, averaged, seed, numbers) -> torch.Tensor:
    """Sums of so many noisy pictures each, photoelectrons."""
    mean, ccd = averaged * expected, summed(doppler.ccd, averaged)
    modes, background = averaged * rings.modes, averaged * rings.background

    def one(number: int) -> torch.Tensor:
        return expose(mean, ccd, seed, [number], modes, background)

    # every picture has a stream of its own, so that it is the same from any thread
    with ThreadPoolExecutor(torch.get_num_threads()) as pool:
        return torch.cat(list(pool.map(one, numbers)))


def summed(ccd: CCD, pictures: int) -> CCD:
    """A CCD whose single picture has the statistics of the sum of several by the given one.

    Poisson numbers, speckle and read noise of several pulses add up to numbers of the same kind;
    rounding by the digitiser is taken as Gaussian noise of a twelfth of a squared step, which holds
    where the read noise is half a step or more. For pixels that are not full.
    """
    if pictures == 1:
        return ccd
    return ccd.model_copy(
        update={
            "read_noise": math.sqrt(pictures) * pixel_noise(ccd).read_noise,
            "integration_time": pictures * ccd.integration_time,
            "full_well": pictures * ccd.full_well,
            "bits": None,
        }
    )


def summed_noise(ccd: CCD, modes: float, pictures: int) -> PixelNoise:
    return PixelNoise(math.sqrt(pictures) * pixel_noise(ccd).read_noise, pictures * modes)


def _instrument(doppler: Doppler, rings: Rings) -> dict[str, float]:
    lidar, etalon, ccd = doppler.lidar, doppler.etalon, doppler.ccd
    speckle = {"doppler.speckle_modes": rings.modes} if math.isfinite(rings.modes) else {}
    return speckle | {
        "doppler.photons": rings.photons,
        "doppler.background_photons": rings.background
        * doppler.camera.width
        * doppler.camera.height,
        "doppler.signal": ccd.quantum_efficiency * rings.photons,
        "doppler.line_width": rings.line.width,
        "doppler.free_spectral_range": etalon.free_spectral_range(lidar.wavelength),
        "doppler.finesse": finesse(etalon, lidar.wavelength),
        "doppler.velocity_range": rings.model.velocity_range,
    }


def _noise_free(rings: Rings, seen: Pictures, expected) -> dict[str, float]:
    """How far the rendered pictures themselves are off: the model is analytic."""
    v = fit_rings(torch.stack(list(expected)), rings.model).v_los.numpy()
    errors = v - [picture.attrs["v_los"] for picture in seen.received]
    first = seen.received[0]
    relative = (first["S0_stderr"] / first["S0"].where(first["S0"] > 0)).median()
    return {
        "doppler.render.mc_relative_error": float(relative),
        "doppler.render.largest_error": float(abs(errors).max()),
    }


def _bounds(doppler: Doppler, rings: Rings) -> dict[str, float]:
    """Cramer-Rao bound at the first speed; of averages by the root of their number."""
    noise = pixel_noise(doppler.ccd, rings.modes)
    efficiency = doppler.ccd.quantum_efficiency
    floor = efficiency * rings.background + doppler.ccd.dark_current * doppler.ccd.integration_time
    metrics = {}
    for centre in doppler.retrieval.centre:
        unknown = [
            name for name in rings.model.parameters if centre == "free" or name not in ("x", "y")
        ]
        bound = cramer_rao(
            rings.model,
            efficiency * rings.photons,
            noise,
            v_los=doppler.v_los[0],
            background=floor,
            free=unknown,
        )["v_los"]
        for n in doppler.retrieval.averaged:
            metrics[f"doppler.bound.centre_{centre}.averaged_{n}.std"] = bound / math.sqrt(n)
    return metrics


def _warn_of_failures(found: xr.Dataset, log: Log) -> None:
    for name in found["algorithm"].values:
        one = found.sel(algorithm=name)
        tried = int(one["tried"]) * one["v"][..., 0].size
        missing = tried - int(one["v"].count())
        if missing:
            log.remark(f"{name}: reads no wind from {missing} of {tried} pictures")
