"""The fringe camera's renderer against straightforward methods for the same image.

Forward: against numpy in double precision, with plane waves of random direction and frequency,
Airy's formula and a histogram, for the ideal lens only. From the camera: against Mitsuba's own
``path`` integrator in the same scene, which samples a lobe of the plates and splats into a film;
the time for the same noise. Finally the error of single precision if the whole orders of the gap
are not subtracted.
"""

import mitsuba as mi
import numpy as np

from lidar_mi.atmosphere.air.standard_atmosphere import standard_atmosphere
from lidar_mi.atmosphere.scattering.line import Line, backscatter_line
from lidar_mi.instrument.etalon import Etalon
from lidar_mi.instrument.fringe_camera import FringeCamera
from lidar_mi.rendering.fringes import scene_dict
from lidar_mi.rendering.settings import FringeSettings
from lidar_mi.rendering.variant import use_variant

from .measure import in_turns
from .report import Comparison, row

VARIANT = "llvm_ad_mono"
WAVELENGTH, LIGHT = 354.7e-9, 299_792_458.0
FORWARD = (
    ("forward, the line folded in, ideal lens", {"estimator": "forward"}),
    ("forward, frequencies drawn, ideal lens", {"estimator": "forward", "line_shape": "sampled"}),
    (
        "single photons, frequencies drawn, real lens",
        {"estimator": "analog", "line_shape": "sampled", "lens": "singlet"},
    ),
)


def compare(repeats: int = 5, width: int = 960, height: int = 780, samples: int = 16) -> Comparison:
    """Paths per second, time at equal noise, velocity error of single precision."""
    use_variant(VARIANT)
    pressure, temperature, _ = standard_atmosphere(8500.0)
    line = backscatter_line(WAVELENGTH, temperature, pressure)
    etalon, camera = Etalon(), FringeCamera(width=width, height=height)
    paths = samples * width * height

    def load(**settings):
        settings = FringeSettings(samples_per_pixel=samples, **settings)
        return mi.load_dict(scene_dict(etalon, camera, line, settings))

    def draw(scene, **options):
        return lambda turn: np.array(mi.render(scene, seed=1 + turn, **options))

    def plain(turn):
        return plain_forward(np.random.default_rng(turn), etalon, camera, line, paths // 16)

    lines = []
    for name, settings in FORWARD:
        found = in_turns({"ours": draw(load(**settings)), "plain": plain}, repeats)
        ours = [1e-6 * paths / seconds for seconds, _ in found["ours"]]
        other = [1e-6 * (paths // 16) / seconds for seconds, _ in found["plain"]]
        lines.append(
            row(name, "paths per second", "million", ours, other, "higher", "other: numpy")
        )

    scene = load()
    own = mi.load_dict({"type": "path", "max_depth": 3, "rr_depth": 100})
    found = in_turns(
        {"ours": draw(scene), "path": draw(scene, integrator=own, spp=samples)}, repeats
    )
    noise = [float(np.median(image[..., 4] / image[..., 0])) for _, image in found["ours"]]
    first, second = (image[..., 0] for _, image in (found["path"] * 2)[:2])
    if repeats == 1:  # two images for a difference
        second = draw(scene, integrator=own, spp=samples)(repeats)[..., 0]
    bright = first + second > np.median(first + second)
    other_noise = float(np.std((first - second)[bright] / (first + second)[bright])) * 2**0.5
    case = "from the camera"
    lines += [
        row(
            case,
            "paths per second",
            "million",
            [1e-6 * paths / s for s, _ in found["ours"]],
            [1e-6 * paths / s for s, _ in found["path"]],
            "higher",
            "other: Mitsuba's path",
        ),
        row(
            case,
            f"noise of a pixel at {samples} paths",
            "%",
            [100 * n for n in noise],
            [100 * other_noise],
            "lower",
        ),
        row(
            case,
            "time for 0.1 % noise",
            "s",
            [s * (n / 1e-3) ** 2 for (s, _), n in zip(found["ours"], noise, strict=True)],
            [s * (other_noise / 1e-3) ** 2 for s, _ in found["path"]],
            "lower",
            "extrapolated",
        ),
    ]
    ours, other = velocity_errors(etalon, camera)
    lines.append(
        row(
            "single precision",
            "velocity error of the phase, rms",
            "m/s",
            [ours],
            [other],
            "lower",
            "other: whole orders not subtracted",
        )
    )
    return Comparison(
        f"Fringes ({width} x {height} pixels, {VARIANT}) against straightforward methods",
        "lidar-mi",
        "other",
        tuple(lines),
    )


def plain_forward(
    rng: np.random.Generator, etalon: Etalon, camera: FringeCamera, line: Line, paths: int
) -> np.ndarray:
    """Rings from ``paths`` plane waves in numpy, (height, width)."""
    half = np.hypot(camera.width, camera.height) / 2 * camera.pixel / camera.focal_length
    sine2, turn = np.sin(np.arctan(half)) ** 2 * rng.random(paths), 2 * np.pi * rng.random(paths)
    offset = line.sample(rng, paths)
    cosine = np.sqrt(1 - sine2)
    gap = etalon.tuned_gap(WAVELENGTH) + etalon.surface_rms * rng.standard_normal(paths)
    order = 2 * gap * cosine * (LIGHT / WAVELENGTH + offset) / LIGHT
    reflectivity = etalon.reflectivity
    finesse = 4 * reflectivity / (1 - reflectivity) ** 2
    passed = 1 / (1 + finesse * np.sin(np.pi * order) ** 2)
    radius = camera.focal_length * np.sqrt(sine2) / cosine / camera.pixel
    x, y = camera.centre_pixel
    size = camera.height, camera.width
    image, _, _ = np.histogram2d(
        y + radius * np.sin(turn),
        x + radius * np.cos(turn),
        size,
        [(-0.5, n - 0.5) for n in size],
        weights=passed,
    )
    return image / paths


def velocity_errors(etalon: Etalon, camera: FringeCamera) -> tuple[float, float]:
    """Rms error of the phase over the CCD, as a velocity in m/s: of the plugin and in float32."""
    cosine = camera.cosine(camera.radius_squared()).ravel()
    sine2 = (1 - cosine**2).astype(np.float32)
    gap = etalon.tuned_gap(WAVELENGTH)
    exact = 2 * gap / WAVELENGTH * np.sqrt(1 - sine2.astype(float))
    bsdf = mi.load_dict({"type": "etalon", "gap": gap, "line_shape": "sampled"})
    ours = np.array(bsdf.order_of(mi.Float(sine2), mi.Float(0)), float)
    plain = np.float32(2 * gap) / np.float32(WAVELENGTH) * np.sqrt(1 - sine2)
    speed = LIGHT / (2 * gap) * WAVELENGTH / 2

    def rms(order):
        error = (order - exact + 0.5) % 1 - 0.5
        return float(np.sqrt(np.mean(error**2)) * speed)

    return rms(ours), rms(plain)
