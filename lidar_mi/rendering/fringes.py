"""Images of the fringe camera: a Mitsuba scene from an etalon, a camera and a line."""

import math
import time
from collections.abc import Iterable, Iterator, Sequence
from typing import Any

import numpy as np
import xarray as xr

from lidar_mi import __version__
from lidar_mi.atmosphere.scattering.line import Line
from lidar_mi.errors import InputError
from lidar_mi.instrument.etalon import Etalon
from lidar_mi.instrument.fringe_camera import FringeCamera
from lidar_mi.instrument.lens import singlet
from lidar_mi.io.exr import label_fringes
from lidar_mi.rendering.batches import ALL_IMAGES, Series
from lidar_mi.rendering.memory import samples_at_once
from lidar_mi.rendering.passes import within_memory
from lidar_mi.rendering.settings import FringeSettings

# from the stop to the etalon, m: any distance that is large enough for a lens
_ETALON_AT = 0.05
_UNITS = (
    "Stokes: received energy over the energy sent through the stop; frequencies: Hz; lengths: m"
)


def render_fringes(
    etalon: Etalon,
    camera: FringeCamera,
    line: Line,
    v_los: Sequence[float],
    settings: FringeSettings,
    seed: int = 0,
    series: Series = ALL_IMAGES,
) -> Iterator[xr.Dataset]:
    """Render one velocity after the other in one scene; only the first compiles kernels.

    In Mitsuba's variant in force.

    line: of air at rest.
    v_los: m/s; positive when the air approaches.
    seed: image k uses seed + k * 2^16.
    series: which of the velocities to render; its samples are paths.

    Raises InputError: a velocity that is not finite, or a lens that is too fast or has too wide a
    field.

    Yields
    ------
    xr.Dataset
        S0 ... S3 and S0_stderr, dims (y, x) from the top left, received energy over the energy the
        source sends through the stop; one image at a time, as soon as it is rendered.
    """
    import mitsuba as mi

    speeds = np.asarray(v_los, float).ravel()
    if not np.isfinite(speeds).all():
        wrong = speeds[~np.isfinite(speeds)][0]
        raise InputError(f"v_los: {wrong:g} m/s is not allowed; expected finite speeds")
    scene = mi.load_dict(scene_dict(etalon, camera, line, settings))
    parameters = mi.traverse(scene)
    for index in range(len(speeds)) if series.wanted is None else series.wanted:
        speed = speeds[index]
        parameters["line.v_los"] = float(speed)
        parameters.update()
        if progress := series.progress:
            scene.integrator().progress = lambda done, total, k=index: progress(k, done, total)
        store = series.batches(index) if series.batches else None
        scene.integrator().batches = store
        start = time.perf_counter()
        image = render_image(scene, seed=(seed + (index << 16)) % 2**31)
        image.attrs |= {
            "v_los": float(speed),  # the scene's is rounded to float32
            "lens": settings.lens,
            "render_seconds": (store.seconds if store else 0.0) + time.perf_counter() - start,
        }
        yield image


def scene_dict(
    etalon: Etalon, camera: FringeCamera, line: Line, settings: FringeSettings
) -> dict[str, Any]:
    """The Mitsuba scene of a fringe camera as a dictionary for ``mi.load_dict``."""
    import mitsuba as mi

    wavelength, field = line.wavelength, _field(camera)
    x, y = camera.centre_pixel
    surfaces = lens_surfaces(camera, wavelength, settings)
    # three rows of anything are tried as a colour first
    lens = "ideal" if surfaces is None else mi.TensorXf(surfaces.ravel())
    source = {}
    if math.isfinite(camera.illumination_radius):
        radius = math.atan(camera.illumination_radius / camera.focal_length)
        source["radiance_radius_mrad"] = 1e3 * radius
    # light at any angle of the field meets the plate and then the whole stop
    plate_radius = 1.1 * (settings.stop_radius + _ETALON_AT * math.tan(field))
    place = mi.ScalarTransform4f().translate([_ETALON_AT, 0, 0]).rotate([0, 1, 0], 90)
    return {
        "type": "scene",
        "integrator": {
            "type": "fringes",
            "estimator": settings.estimator,
            "samples_per_pass": samples_at_once(
                settings.given_per_pass, settings.memory, mi.variant()
            ),
        },
        "line": {
            "type": "spectral_line",
            "wavelength": wavelength,
            "weights": _numbers(line.weights),
            "offsets": _numbers(line.offsets),
            "sigmas": _numbers(line.sigmas),
        },
        "source": {
            "type": "plane_waves",
            # a real lens blurs: light from a little beyond the corners falls on the CCD
            "field_half_mrad": 1e3 * field * (1.02 if settings.lens == "singlet" else 1.001),
            "line": {"type": "ref", "id": "line"},
            **source,
        },
        "plates": {
            "type": "disk",
            "to_world": place @ mi.ScalarTransform4f().scale(plate_radius),
            "bsdf": {
                "type": "etalon",
                **_mirrors(etalon),
                "gap": etalon.tuned_gap(wavelength),
                "index": etalon.index,
                "surface_rms": etalon.surface_rms,
                "bow": etalon.bow,
                "line_shape": settings.line_shape,
                "line": {"type": "ref", "id": "line"},
            },
        },
        "sensor": {
            "type": "ccd",
            "focal_length": camera.focal_length,
            "pixel": camera.pixel,
            "centre_x": x,
            "centre_y": y,
            "tilt_x": camera.tilt[0],
            "tilt_y": camera.tilt[1],
            "distortion": camera.distortion,
            "defocus": camera.defocus,
            "stop_radius": settings.stop_radius,
            "lens": lens,
            "film": {
                "type": "hdrfilm",
                "width": camera.width,
                "height": camera.height,
                "pixel_format": "luminance",
                "rfilter": {"type": "box"},
            },
            "sampler": {"type": "independent", "sample_count": settings.samples_per_pixel},
        },
    }


def lens_surfaces(
    camera: FringeCamera, wavelength: float, settings: FringeSettings
) -> np.ndarray | None:
    """Surfaces of a real lens as the plugin `ccd` takes them; None: it is ideal.

    Raises InputError: a lens that is too fast or has too wide a field.
    """
    if settings.lens == "ideal":
        return None
    return singlet(camera.focal_length, wavelength, settings.stop_radius, _field(camera))


def _field(camera: FringeCamera) -> float:
    """Angle of the light to a pixel that is farthest from the axis, rad."""
    x, y = camera.centre_pixel
    corner = math.hypot(max(x, camera.width - 1 - x) + 0.5, max(y, camera.height - 1 - y) + 0.5)
    # distortion and defocus let in light from beyond the corner
    corner = corner * camera.pixel * (1 + abs(camera.distortion)) + camera.defocus / 2
    return math.atan(corner / camera.focal_length) * (1 + sum(map(abs, camera.tilt)))


def render_image(scene: Any, samples: int = 0, seed: int = 0) -> xr.Dataset:
    """Render a loaded scene of a `ccd` with the `fringes` integrator and describe the image.

    samples: light paths per pixel; 0: as in the scene.
    """
    import mitsuba as mi

    sensor, integrator = scene.sensors()[0], scene.integrator()
    image = within_memory(integrator, lambda: np.array(mi.render(scene, spp=samples, seed=seed)))
    layers = {name: image[..., k] for k, name in enumerate(integrator.quantities())}
    source, line = scene.environment(), scene.environment().line
    x, y = sensor.centre
    attributes = {
        "software": f"lidar-mi {__version__}",
        "units": _UNITS,
        "variant": mi.variant(),
        "polarized": int(mi.is_polarized),
        "seed": int(seed),
        "samples_per_pixel": samples or sensor.sampler().sample_count(),
        "estimator": integrator.estimator,
        "focal_length": sensor.focal_length,
        "pixel": sensor.pixel,
        "centre_x": x,
        "centre_y": y,
        "tilt_x": sensor.tilt[0],
        "tilt_y": sensor.tilt[1],
        "distortion": sensor.distortion,
        "defocus": sensor.defocus,
        "stop_radius": sensor.stop_radius,
        "lens": "ideal" if sensor.lens is None else "surfaces",
        "wavelength": line.wavelength,
        "v_los": float(line.m_v_los[0]),
        "line_weights": line.gaussians[:, 0],
        "line_offsets": line.gaussians[:, 1],
        "line_sigmas": line.gaussians[:, 2],
        "field_half": source.field_half,
        "stokes_emitted": list(source.stokes),
    }
    bsdfs = [shape.bsdf() for shape in scene.shapes()]
    etalons = [bsdf for bsdf in bsdfs if hasattr(bsdf, "free_spectral_range")]
    attributes["etalons"] = len(etalons)
    if len(etalons) == 1:
        attributes |= etalons[0].description()
    return label_fringes(layers, attributes)


def _mirrors(etalon: Etalon) -> dict[str, Any]:
    if etalon.coatings is None:
        return {"reflectivity": etalon.reflectivity, "absorption": etalon.absorption}
    layers = (f"{n!r} {d!r} {k!r}" for n, d, k in etalon.coatings)
    return {"coating": ", ".join(layers), "plate_index": etalon.plate_index}


def _numbers(values: Iterable[float]) -> str:
    return ", ".join(repr(float(v)) for v in values)
