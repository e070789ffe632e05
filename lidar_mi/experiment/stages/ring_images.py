"""From the Doppler lidar to its images of rings: rendered without noise, exposed on the CCD."""

import math
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Annotated, NamedTuple

import numpy as np
import xarray as xr

from lidar_mi.atmosphere.scattering.line import Line, backscatter_line, laser_line
from lidar_mi.errors import InputError
from lidar_mi.experiment.graph import Only, Store, bundle
from lidar_mi.experiment.log import Log
from lidar_mi.experiment.stages.rendering import batches_of
from lidar_mi.experiment.stages.ring_instrument import air_rings, laser_rings, pixel_noise
from lidar_mi.experiment.stages.ring_reference import reference_frames
from lidar_mi.experiment.truth.clear_air import air_of
from lidar_mi.instrument.ccd import CCD, expose
from lidar_mi.instrument.doppler import DopplerLidar, photons, solar_background, speckle_modes
from lidar_mi.instrument.etalon import Etalon
from lidar_mi.instrument.fringe_camera import FringeCamera, fringe_values, ring_radii
from lidar_mi.rendering.batches import Series
from lidar_mi.rendering.fringes import lens_surfaces, render_fringes
from lidar_mi.rendering.memory import PER_PIXEL, PER_SAMPLE, PROGRAM, check_memory, host_bytes
from lidar_mi.rendering.settings import FringeSettings
from lidar_mi.rendering.variant import check_variant, use_variant
from lidar_mi.schema.doppler import Doppler
from lidar_mi.schema.rings import Assumed

if TYPE_CHECKING:
    import torch

    from lidar_mi.retrieval.rings.model import RingModel


EMITTED, PHOTONS = "fringes_emitted", "fringes_photons"


class Rings(NamedTuple):
    """Instrument and air of a Doppler lidar's images.

    ``model`` and ``laser`` are of air and laser by the true instrument, or by the one that a
    retrieval assumes. ``response`` is that of the pixels, where a calibration leaves some out.
    """

    line: Line
    model: "RingModel"
    laser: "RingModel"
    photons: float
    background: float
    modes: float
    response: "torch.Tensor | None" = None


@dataclass(frozen=True)
class RingImages:
    """Rendered images: of the laser itself, of air at every speed, and of single light paths."""

    emitted: xr.Dataset
    received: list[xr.Dataset]
    photons: xr.Dataset | None


@dataclass(frozen=True)
class Exposure:
    """Images without noise, and one by the CCD: photoelectrons per pixel of one pulse.

    ``received`` and ``noisy`` are of air at the first speed.
    """

    emitted: np.ndarray
    received: np.ndarray
    noisy: np.ndarray


def air_line(
    doppler_lidar: Annotated[
        DopplerLidar,
        Only(
            "wavelength",
            "altitude",
            "temperature",
            "pressure",
            "laser_width",
            "aerosol_fraction",
            "line_shape",
        ),
    ],
) -> Line:
    """The spectral line of the air's light."""
    lidar = doppler_lidar
    pressure, temperature = air_of(lidar)
    return backscatter_line(
        lidar.wavelength,
        temperature,
        pressure,
        lidar.laser_width,
        lidar.aerosol_fraction,
        lidar.line_shape,
    )


def ring_instrument(doppler: Doppler) -> Rings:
    """Instrument and air of the images, checked.

    Raises InputError: winds beyond the unambiguous range, fewer than two rings on the CCD, pixels
    that overflow.
    """
    render, pixels = doppler.render, doppler.camera.width * doppler.camera.height
    # samples are traced pass by pass
    samples = host_bytes(pixels * render.samples_per_pixel, render)
    check_memory(
        PROGRAM + PER_PIXEL * pixels + samples,
        render.memory,
        f"doppler.camera: {doppler.camera.width} x {doppler.camera.height} pixels and "
        f"{samples / PER_SAMPLE:.3g} samples at once",
        "fewer pixels or samples_per_pass",
        "doppler.render.memory",
    )
    lidar, etalon, camera, ccd = doppler.lidar, doppler.etalon, doppler.camera, doppler.ccd
    line = air_line(lidar)
    # of the true instrument: nothing is assumed in place of it
    model, laser = ring_models(doppler.model_copy(update={"assumed": Assumed()}))
    for number in doppler.retrieval.averaged:
        reference_frames(number, doppler.reference.every, "doppler.retrieval.averaged")
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
    image = fringe_values(
        camera, etalon, line, doppler.v_los[0], photons(lidar), lidar.counted, subsamples=1
    )
    background = solar_background(lidar, etalon) / (camera.width * camera.height)
    crest = ccd.quantum_efficiency * (float(image.max()) + background)
    noise = pixel_noise(ccd, modes)
    # crests of the noisiest pixels stay below
    spread = math.sqrt(noise.variance(crest, crest))
    if not crest + 6 * spread < ccd.saturation:
        raise InputError(
            f"doppler.ccd: a pixel that holds {ccd.saturation:.3g} photoelectrons is not allowed; "
            f"expected more, as the rings' crests have {crest:.3g}"
        )
    # the image's sum: photons behind the etalon, wherever the lidar equation counts them
    return Rings(line, model, laser, float(image.sum()), background, modes)


def ring_models(doppler: Doppler) -> "tuple[RingModel, RingModel]":
    """What the ring fit assumes of images of air and of the laser."""
    known, assumed = doppler.retrieval, doppler.assumed
    lidar, etalon, camera = doppler.lidar, assumed.of(doppler.etalon), assumed.of(doppler.camera)
    light, background = known.light_degree, known.background_degree
    air = air_rings(
        lidar,
        etalon,
        camera,
        aerosol_std=known.aerosol_std,
        temperature_std=known.temperature_std,
        light_degree=light,
        background_degree=background,
    )
    laser = laser_rings(lidar, etalon, camera)
    return air, replace(laser, light_degree=light, background_degree=background)


def check_rings(doppler: Doppler) -> None:
    """Check that scenes of the rings can be built.

    Raises InputError: a lens that is too fast or has too wide a field; a variant that cannot run
    here.
    """
    check_variant(doppler.render.variant)
    settings = [doppler.render]
    if doppler.path_samples:
        # single paths are traced through a real lens
        settings.append(_path_by_path(doppler.render, doppler.path_samples))
    for render in settings:
        lens_surfaces(doppler.camera, doppler.lidar.wavelength, render)


def ring_image_names(doppler_v_los: tuple[float, ...], doppler_path_samples: int) -> list[str]:
    """Parts of the result of `render_ring_images`."""
    single_paths = [PHOTONS] if doppler_path_samples else []
    return [EMITTED, *single_paths, *_received(doppler_v_los)]


@bundle
class RingScene:
    """The laser's light through etalon and lens onto the CCD, and how its images are rendered."""

    doppler_lidar: Annotated[DopplerLidar, Only("wavelength", "laser_width")]
    doppler_etalon: Etalon
    doppler_camera: FringeCamera
    doppler_render: FringeSettings
    doppler_v_los: tuple[float, ...]
    doppler_path_samples: int


def render_ring_images(
    scene: RingScene,
    seed: int,
    air_line: Line,
    log: Log,
    missing: Sequence[str],
    store: Store | None = None,
) -> Iterator[tuple[str, xr.Dataset]]:
    """Render the laser's own light, single paths of it, and that of air at every speed.

    Yields
    ------
    name : str
        Of `ring_image_names`.
    image : xr.Dataset, dims (y, x)
        From `render_fringes`.
    """
    camera, render, speeds_of_air = scene.doppler_camera, scene.doppler_render, scene.doppler_v_los
    use_variant(render.variant)
    laser = laser_line(scene.doppler_lidar.wavelength, scene.doppler_lidar.laser_width)
    # what to render: line, settings, speeds, names
    plan: list[tuple[Line, FringeSettings, tuple[float, ...], list[str]]]
    plan = [(laser, render, (0.0,), [EMITTED])]
    if scene.doppler_path_samples:
        single = _path_by_path(render, scene.doppler_path_samples)
        plan.append((laser, single, (0.0,), [PHOTONS]))
    plan.append((air_line, render, speeds_of_air, _received(speeds_of_air)))
    total = sum(len(names) for *_, names in plan)
    before = 0
    for line, settings, speeds, names in plan:
        absent = [k for k, name in enumerate(names) if name in missing]
        if absent:
            size = f"{camera.width} x {camera.height}"
            log(f"rendering {names[absent[0]]} ... {names[absent[-1]]}, {size} pixels")
            # the seed depends on the number of an image: a resumed run renders the same ones
            rendered = render_fringes(
                scene.doppler_etalon,
                camera,
                line,
                speeds,
                settings,
                (seed + (before << 16)) % 2**31,
                Series(
                    absent,
                    partial(_show_progress, log, before, total),
                    batches_of(names, store, log),
                ),
            )
            for k, image in zip(absent, rendered, strict=True):
                yield names[k], image
        before += len(names)


def _show_progress(log: Log, before: int, total: int, index: int, done: int, paths: int) -> None:
    """Progress of an image, which others come before."""
    log.bar(f"rendering rings {before + index + 1} of {total}", done / paths)


def images_by_content(
    doppler_v_los: tuple[float, ...], ring_images: Mapping[str, xr.Dataset]
) -> RingImages:
    """The images by their content."""
    received = [ring_images[name] for name in _received(doppler_v_los)]
    return RingImages(ring_images[EMITTED], received, ring_images.get(PHOTONS))


def exposure(doppler: Doppler, seed: int, rings: Rings, lit_rings: RingImages) -> Exposure:
    """Images at the first speed as the CCD records one pulse, with and without noise."""
    received = expected_image(lit_rings.received[0], rings.photons)
    noisy = exposed_frames(doppler, rings, received, 1, seed, [0])[0]
    emitted = expected_image(lit_rings.emitted, rings.photons)
    return Exposure(emitted.numpy(), received.numpy(), noisy.numpy())


def _received(v_los: Sequence[float]) -> list[str]:
    return [f"fringes_received_{k:02d}" for k in range(len(v_los))]


def _path_by_path(render: FringeSettings, samples: int) -> FringeSettings:
    """How single paths of the laser's light are traced through a real lens."""
    return render.model_copy(
        update={
            "estimator": "analog",
            "line_shape": "sampled",
            "lens": "singlet",
            "samples_per_pixel": samples,
        }
    )


def reference_photons(doppler: Doppler, rings: Rings) -> float:
    """Photons of a frame of the laser's own light."""
    return doppler.reference.photons or rings.photons


def expected_image(image: xr.Dataset, total: float) -> "torch.Tensor":
    """Mean photons per pixel of an image of ``total`` photons."""
    import torch

    light = torch.from_numpy(image["S0"].values.astype(float))
    # rendered light is relative: the image gives the pattern alone
    return light * (total / light.sum())


def exposed_frames(
    doppler: Doppler,
    rings: Rings,
    expected: "torch.Tensor",
    averaged: int,
    seed: int,
    numbers: Sequence[int],
) -> "torch.Tensor":
    """Sums of so many noisy images each, photoelectrons; of one mean, or one each."""
    import torch

    # one draw for all pulses, whose sum has the same statistics
    mean, ccd = averaged * expected, summed(doppler.ccd, averaged)
    modes, background = averaged * rings.modes, averaged * rings.background

    def one(number: int, light: "torch.Tensor") -> "torch.Tensor":
        return expose(light, ccd, seed, [number], modes, background)

    # every image has its own random stream, so that it does not depend on the thread
    each = mean if mean.ndim == 3 else [mean] * len(numbers)
    with ThreadPoolExecutor(torch.get_num_threads()) as pool:
        return torch.cat(list(pool.map(one, numbers, each)))


def summed(ccd: CCD, images: int) -> CCD:
    """A CCD whose single image has the statistics of the sum of several by the given one.

    Poisson numbers, speckle and read noise of several pulses add up to numbers of the same kind;
    rounding by the digitiser is taken as Gaussian noise of 1/12 of a squared step, which holds
    where the read noise is half a step or more. For pixels that are not saturated.
    """
    if images == 1:
        return ccd
    return ccd.model_copy(
        update={
            "read_noise": math.sqrt(images) * ccd.output_noise,
            "integration_time": images * ccd.integration_time,
            "full_well": images * ccd.full_well,
            "register_well": ccd.register_well and images * ccd.register_well,
            "bits": None,
        }
    )
