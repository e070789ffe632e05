"""From images of rings to the wind along the line of sight, by every method."""

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
import xarray as xr

from lidar_mi import __version__
from lidar_mi.assessment.metrics.rings import RingBudget
from lidar_mi.errors import InputError
from lidar_mi.experiment.log import Log
from lidar_mi.experiment.stages.ring_images import (
    RingImages,
    Rings,
    expected_image,
    exposed_frames,
    reference_photons,
)
from lidar_mi.experiment.stages.ring_instrument import pixel_noise
from lidar_mi.experiment.stages.ring_reference import (
    drifts,
    plate_error,
    plate_uncertainty,
    reference_frames,
    reference_uncertainty,
    scrambling_needed,
)
from lidar_mi.instrument.etalon import finesse
from lidar_mi.retrieval.method_names import RingCentre, RingMethod
from lidar_mi.schema.doppler import Doppler
from lidar_mi.variables import variable

if TYPE_CHECKING:
    import torch

    from lidar_mi.retrieval.rings.likelihood_fit import RingFit
    from lidar_mi.retrieval.rings.model import PixelNoise, RingModel


FITS = (RingMethod.ANNULAR, RingMethod.PIXELS)
# method and coordinate of the radius, see `lidar_mi.retrieval.rings.peaks.ring_radius`
PEAKS = {
    RingMethod.CA: ("ca", "r"),
    RingMethod.CA_R2: ("ca", "r2"),
    RingMethod.ML: ("ml", "r"),
    RingMethod.SG: ("sg", "r"),
}

# half widths of the fitted piece, in radii, for which the bias of peak fits is computed
PIECES = tuple(np.linspace(0.1, 0.5, 9).round(3).tolist())

FRAMES = 16  # noisy images in memory at a time
# First number of the laser's own frames, which selects their random streams.
REFERENCES = 1 << 25


def line_of_sight_winds(
    name: str, doppler: Doppler, seed: int, assumed_rings: Rings, lit_rings: RingImages, log: Log
) -> xr.Dataset:
    """Winds by every method from noisy images, and from averages of several; see `velocities`.

    ``assumed_rings`` has the models of the instrument that the retrieval assumes.
    """
    rings = assumed_rings
    expected = [expected_image(image, rings.photons) for image in lit_rings.received]
    winds = velocities(doppler, rings, lit_rings, expected, seed, log)
    winds.attrs |= {
        "title": f"Line-of-sight wind of the experiment {name}",
        "source": f"lidar-mi {__version__}",
    }
    return winds


def ring_budget(doppler: Doppler, rings: Rings, lit_rings: RingImages, log: Log) -> RingBudget:
    """Light, line and etalon of the lidar, and limits of what can be retrieved from its images."""
    import torch

    from lidar_mi.retrieval.rings.likelihood_fit import fit_rings

    log("computing the Cramer-Rao bound")
    images = lit_rings
    expected = [expected_image(image, rings.photons) for image in images.received]
    # few samples leave more than the noise of photons: that shows as an error, not as no image
    v = fit_rings(torch.stack(expected), rings.model, max_chi_square=math.inf).v_los.numpy()
    light = expected_image(images.emitted, reference_photons(doppler, rings))
    zero = fit_rings(light, rings.laser, max_chi_square=math.inf).v_los.numpy()
    errors = v - zero - [image.attrs["v_los"] for image in images.received]
    first = images.received[0]
    relative = (first["S0_stderr"] / first["S0"].where(first["S0"] > 0)).median()
    return RingBudget(
        photons=rings.photons,
        background_photons=rings.background * doppler.camera.width * doppler.camera.height,
        signal=doppler.ccd.quantum_efficiency * rings.photons,
        line_width=rings.line.width,
        free_spectral_range=doppler.etalon.free_spectral_range(doppler.lidar.wavelength),
        finesse=finesse(doppler.etalon, doppler.lidar.wavelength),
        velocity_range=rings.model.velocity_range,
        speckle_modes=rings.modes,
        bound=_bounds(doppler, rings),
        relative_error=float(relative),
        largest_error=float(abs(errors).max()),
        reference_every=doppler.reference.every,
        reference_errors=reference_uncertainty(doppler).terms(),
        scrambling_needed=scrambling_needed(doppler),
    )


def _bounds(doppler: Doppler, rings: Rings) -> dict[str, tuple[float, float]]:
    """Cramer-Rao bounds of one image at the first speed and of its reference, m/s, by centre."""
    from lidar_mi.retrieval.rings.bound import cramer_rao_of

    efficiency, centres = doppler.ccd.quantum_efficiency, doppler.retrieval.centre
    # photoelectrons, as the signal of the bound
    floor = efficiency * rings.background + doppler.ccd.dark_current * doppler.ccd.integration_time
    both = (
        (rings.model, rings.photons, doppler.v_los[0]),
        (rings.laser, reference_photons(doppler, rings), 0.0),
    )
    bounds = [
        cramer_rao_of(
            model,
            efficiency * photons,
            pixel_noise(doppler.ccd, rings.modes),
            [_unknown(model, centre) for centre in centres],
            v_los=speed,
            background=floor,
        )
        for model, photons, speed in both
    ]
    return {
        centre: (air["v_los"], laser["v_los"])
        for centre, air, laser in zip(centres, *bounds, strict=True)
    }


def _unknown(model: "RingModel", centre: str) -> list[str]:
    return [n for n in model.parameters if centre == RingCentre.FREE or n not in ("x", "y")]


def velocities(
    doppler: Doppler,
    rings: Rings,
    rendered: RingImages,
    expected: "Sequence[torch.Tensor]",
    seed: int,
    log: Log,
) -> xr.Dataset:
    """Winds by every method from noisy images, and from averages of several.

    Returns
    -------
    xr.Dataset
        ``tried`` (algorithm), the images of every case that were given to it; ``v`` and its
        random and systematic standard deviations ``v_std`` and ``v_systematic`` as stated, m/s,
        dims (algorithm, centre, averaged, v_los, image), NaN where there is none; and
        ``peak_bias`` (coordinate, piece) of the innermost ring's peak without any noise, m/s, at
        the first speed.
    """
    from lidar_mi.retrieval.rings.peaks import COORDINATES, velocity_from_radii

    settings, speeds = doppler.retrieval, doppler.v_los
    shape = (
        len(settings.methods),
        len(settings.centre),
        len(settings.averaged),
        len(speeds),
        settings.images,
    )
    v, v_std, v_systematic = np.full((3, *shape), np.nan)
    shift, unknown = plate_error(doppler), plate_uncertainty(doppler)
    emitted = expected_image(rendered.emitted, reference_photons(doppler, rings))
    fits = [m for m in settings.methods if m in FITS]
    peaks = [m for m in settings.methods if m in PEAKS]
    places = {name: settings.methods.index(name) for name in settings.methods}
    tried = [
        settings.images if m == RingMethod.ANNULAR else settings.slow_images
        for m in settings.methods
    ]
    done, total = 0, math.prod(shape[2:])
    reasons: dict[str, str] = {}
    for j, n in enumerate(settings.averaged):
        own, sharing = reference_frames(n, doppler.reference.every, "doppler.retrieval.averaged")
        noises = [pixel_noise(doppler.ccd, rings.modes, number) for number in (n, own)]
        for k, true in enumerate(speeds):
            for first in range(0, settings.images, FRAMES):
                text = f"retrieving winds from averages of {n} images at {true:g} m/s"
                log.bar(text, done / total)
                images = range(first, min(first + FRAMES, settings.images))
                # a number, and so a random stream, for every image of every case
                numbers = [(j * len(speeds) + k) * settings.images + i for i in images]
                frames = exposed_frames(doppler, rings, expected[k], n, seed, numbers)
                # those that follow one frame of the laser have the same
                first_of_case = numbers[0] - first
                lasers = sorted({i // sharing for i in images})
                laser = exposed_frames(
                    doppler,
                    rings,
                    emitted,
                    own,
                    seed,
                    [REFERENCES + first_of_case + i for i in lasers],
                )[[lasers.index(i // sharing) for i in images]]
                # as a change of frequency or gap is one of the speed
                drifted, drift_std = drifts(
                    doppler, n, [seed, first_of_case], images, "doppler.retrieval.averaged"
                )
                # slow methods have the first images of a case alone
                few = max(0, min(settings.slow_images - first, len(images)))
                for c, centre in enumerate(settings.centre):
                    for name in fits:
                        count = len(images) if name == RingMethod.ANNULAR else few
                        if count:
                            place = places[name], c, j, k, slice(first, first + count)
                            to_laser = speeds_to_laser(
                                frames[:count],
                                laser[:count],
                                doppler,
                                rings,
                                noises,
                                name,
                                centre,
                                refused=partial(reasons.setdefault, name),
                            )
                            v[place] = to_laser[0] + drifted[:count] + shift
                            v_std[place] = np.hypot(to_laser[1], drift_std[:count])
                            v_systematic[place] = np.hypot(to_laser[2], unknown)
                    for i in range(few if peaks else 0):
                        received, zero = (
                            _peak_radii(one[i].numpy(), doppler, centre) for one in (frames, laser)
                        )
                        for name in peaks:
                            speed = velocity_from_radii(
                                received[name],
                                zero[name],
                                rings.model.focal_length,
                                doppler.camera.pixel,
                            )
                            v[places[name], c, j, k, first + i] = speed + drifted[i] + shift
                done += len(images)
    dims = ("algorithm", "centre", "averaged", "v_los", "image")
    for name, count in zip(settings.methods, tried, strict=True):
        _warn_of_failures(name, v[places[name], ..., :count], reasons.get(name), log)
    return xr.Dataset(
        {
            "v": variable(dims, v, "m s-1", "retrieved line-of-sight wind"),
            "v_std": variable(dims, v_std, "m s-1", "random standard deviation as stated"),
            "v_systematic": variable(
                dims,
                v_systematic,
                "m s-1",
                "systematic standard deviation as stated, common to all images",
            ),
            "tried": variable("algorithm", tried, "1", "images of every case"),
            "peak_bias": variable(
                ("coordinate", "piece"),
                _peak_bias(doppler, rendered),
                "m s-1",
                "error of the innermost ring's peak by circular averaging, no noise",
            ),
        },
        coords={
            "algorithm": list(settings.methods),
            "centre": list(settings.centre),
            "averaged": variable("averaged", list(settings.averaged), "1", "images of an average"),
            "v_los": variable("v_los", list(speeds), "m s-1", "true wind"),
            "coordinate": list(COORDINATES),
            "piece": variable(
                "piece", list(PIECES), "1", "half width of the fitted piece in radii"
            ),
        },
        attrs={"Conventions": "CF-1.11", "title": "Line-of-sight winds retrieved from rings"},
    )


def speeds_to_laser(
    frames: "torch.Tensor",
    laser: "torch.Tensor",
    doppler: Doppler,
    rings: Rings,
    noises: "Sequence[PixelNoise]",
    method: str,
    centre: str,
    *,
    refused: Callable[[str], object] | None = None,
) -> np.ndarray:
    """v_LOS of frames less that of the laser's, and its standard deviations.

    ``noises`` are of the pixels of both; the systematic part is what the calibration leaves;
    ``refused``, if given, is called with the reason for each frame without a speed.

    Returns
    -------
    array (4, frames)
        v_LOS, its random and systematic standard deviation, and the part of the random one by the
        laser's frame, m/s; NaN for images that `fit_rings` refuses.
    """
    from lidar_mi.retrieval.rings.likelihood_fit import difference

    try:
        # the narrow rings of the laser need no 2-D fit: their error is a third of the air's
        emitted = _fit(laser, doppler, rings.laser, rings.response, noises[1], "annular", centre)
        parts = difference(
            _fit(frames, doppler, rings.model, rings.response, noises[0], method, centre), emitted
        )
    except InputError as error:
        if len(frames) == 1:
            if refused:
                refused(str(error).removeprefix("images[0]: "))
            return np.full((4, 1), np.nan)
        # one frame refuses the batch: each is tried by itself
        alone = [
            speeds_to_laser(
                one[None], own[None], doppler, rings, noises, method, centre, refused=refused
            )
            for one, own in zip(frames, laser, strict=True)
        ]
        return np.concatenate(alone, 1)
    return np.stack([part.numpy() for part in (*parts, emitted.v_los_std)])


def _fit(
    frames: "torch.Tensor",
    doppler: Doppler,
    model: "RingModel",
    response: "torch.Tensor | None",
    noise: "PixelNoise",
    method: str,
    centre: str,
) -> "RingFit":
    from lidar_mi.retrieval.rings.likelihood_fit import fit_rings

    return fit_rings(
        frames,
        model,
        noise,
        method=method,
        centre=model.centre if centre == RingCentre.KNOWN else None,
        free=_unknown(model, centre),
        response=response if method == RingMethod.ANNULAR else None,
        max_chi_square=doppler.retrieval.max_chi_square,
    )


def _peak_radii(image: np.ndarray, doppler: Doppler, centre: str) -> dict[str, float]:
    """Innermost ring's radius (px) by the given peak methods; NaN where one fails."""
    from lidar_mi.retrieval.rings.centre import circular_average
    from lidar_mi.retrieval.rings.peaks import find_centre, ring_radius

    methods = [name for name in doppler.retrieval.methods if name in PEAKS]
    places: dict[str, tuple[float, float]] = {}
    averages: dict[str, tuple[np.ndarray, np.ndarray, np.ndarray]] = {}
    radii: dict[str, float] = {}
    near: float | None = None
    for name in methods:
        way, coordinate = PEAKS[name]
        finder = "known" if centre == RingCentre.KNOWN else "ml" if way == "ml" else "ca"
        try:
            if finder not in places:
                known = finder == "known"
                place = doppler.camera.centre_pixel if known else find_centre(image, finder)
                averages[finder] = circular_average(image, place)
                places[finder] = place
            place, average = places[finder], averages[finder]
            # the crest to a pixel: the bias of a fit in r depends on the piece about it
            near = near or ring_radius(image, place, "ca", "r2", average=average)
            radii[name] = ring_radius(image, place, way, coordinate, near, average=average)
        except InputError:
            radii[name] = math.nan
    return radii


def _peak_bias(doppler: Doppler, rendered: RingImages) -> np.ndarray:
    """Error of the first speed by the innermost ring's peak, (coordinates, PIECES), m/s.

    From images without noise, about the true centre; NaN where a piece holds no peak.
    """
    from lidar_mi.retrieval.rings.centre import circular_average
    from lidar_mi.retrieval.rings.peaks import COORDINATES, ring_radius, velocity_from_radii

    camera = doppler.camera
    images = [p["S0"].values.astype(float) for p in (rendered.received[0], rendered.emitted)]
    averages = [circular_average(image, camera.centre_pixel) for image in images]

    def error(coordinate: str, piece: float) -> float:
        try:
            received, emitted = (
                ring_radius(
                    image, camera.centre_pixel, "ca", coordinate, piece=piece, average=average
                )
                for image, average in zip(images, averages, strict=True)
            )
        except InputError:
            return math.nan
        v = velocity_from_radii(received, emitted, camera.focal_length, camera.pixel)
        return v - doppler.v_los[0]

    return np.array([[error(c, p) for p in PIECES] for c in COORDINATES])


def _warn_of_failures(name: str, v: np.ndarray, reason: str | None, log: Log) -> None:
    """The number of images without a speed, and why the first of them has none."""
    missing = int(np.isnan(v).sum())
    if missing:
        why = f"; {reason}" if reason else ""
        log.remark(f"{name}: no wind from {missing} of {v.size} images{why}")
