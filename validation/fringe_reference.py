"""Frames of a fringe-imaging Fabry-Perot with defects, without the program: numpy and scipy alone.

Airy's formula, by quadrature over the line, the roughness and shape of the plates, the filled part
of the pupil, and the area of every pixel. The order of interference has all of its digits, in
extended precision, not only its fraction.

    laser = laser_frame(Instrument(), Defects(tilt=(0.009, 0)), photons=2.4e7)
    air = air_frame(Instrument(), Defects(tilt=(0.009, 0)), v_los=50.0, photons=2.4e7)
    frames = exposures(air, 20, seed=1, read_noise=5.0)

Pixels count from 0, x to the right and y down, from the middle of the top left one. A speed is
positive toward the instrument. The light per area of the camera is even unless a `Light` says
otherwise: the change of a pixel's solid angle by tilt and distortion (below 0.5 %) is left out.
"""

import math
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.polynomial.legendre import leggauss
from scipy.fft import dctn, idctn
from scipy.special import j1

LIGHT = 299792458.0
BOLTZMANN, AIR_MASS = 1.380649e-23, 28.9644e-3 / 6.02214076e23
_FWHM = math.sqrt(8 * math.log(2))
_MARGIN = 16  # px beyond a blur disc, where the mirrored frame replaces the true one


@dataclass(frozen=True)
class Instrument:
    """The nominal instrument, m, Hz and K: that of the experiment `fringes`.

    ``order`` is that of the laser's light at the rings' centre (x, y), which is the middle of the
    camera if not given. The air's line is that of molecules that never collide.
    """

    shape: tuple[int, int] = (780, 960)
    pixel: float = 7.4e-6
    centre: tuple[float, float] | None = None
    focal_length: float = 0.3
    wavelength: float = 354.7e-9
    gap: float = 13.7e-3
    order: float = 77248.5
    reflectivity: float = 0.70
    roughness: float = 2e-9
    expansion: float = 5e-7
    """Of the gap's spacers, 1/K; fused silica."""
    laser_fwhm: float = 100e6
    temperature: float = 232.9

    @property
    def half_diagonal(self) -> float:
        return math.hypot(*self.shape) / 2 * self.pixel

    def binned(self, factor: int) -> "Instrument":
        """The same field of view in pixels ``factor`` times as large."""
        shape = (self.shape[0] // factor, self.shape[1] // factor)
        centre = self.centre and tuple((c - (factor - 1) / 2) / factor for c in self.centre)
        return replace(self, shape=shape, pixel=factor * self.pixel, centre=centre)


@dataclass(frozen=True)
class Light:
    """How the light of laser or air fills the pupil and the camera.

    Parameters
    ----------
    pupil : float
        Radius of the filled disc over the pupil's.
    pupil_shift : float
        Of the disc's middle toward +x, over the pupil's radius.
    half : bool
        Only the disc's half of larger x is filled.
    radius : float
        1/e^2 radius of the illumination about the axis, m: vignetting.
    slope : (float, float)
        Rise of the illumination along x and y over half of the image's diagonal, a fraction.
    """

    pupil: float = 1.0
    pupil_shift: float = 0.0
    half: bool = False
    radius: float = math.inf
    slope: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True)
class Defects:
    """What differs from the nominal instrument; nothing by default.

    Parameters
    ----------
    tilt : (float, float)
        Of the camera about its x axis, then about y, rad. The axis meets the camera in the rings'
        centre. The ray (X, Y, 1) meets the plane n.(p - f z) = 0; pixels are counted along
        orthonormal axes in that plane.
    defocus : float
        Diameter of the even disc over which the light of a point is spread, pixels.
    distortion : float
        k of r_d = r_u (1 + k (r_u / R)^2), R half of the image's diagonal.
    focal_length, finesse : float
        Factors: the finesse is that of the mirrors, pi R^(1/2) / (1 - R).
    roughness : float
        Rms of the gap in addition to the nominal one, m.
    warming : float
        Of the etalon, K.
    drift : float
        Frequency of the laser at the echo's pulse less that of the reference, Hz.
    bow, wedge : float
        Rms of the gap over the full pupil, m: of a quadratic (positive: the gap is wider at the
        rim) and of a linear deviation (wider toward +x). Both have the mean 0 over the pupil.
    laser, air : Light
    hot_pixels, dead_pixels : int
    hot_electrons : float
        Mean electrons that a hot pixel adds.
    bump : float
        Height of a Gaussian bump of light without rings, over the mean signal of a pixel.
    bump_place : (float, float)
        From the image's middle, in halves of its diagonal.
    bump_width : float
        Standard deviation, in halves of the diagonal.
    aerosol : float
        Fraction of the echo's photons that have the laser's line.
    seed : int
        Of the places of hot and dead pixels.
    """

    tilt: tuple[float, float] = (0.0, 0.0)
    defocus: float = 0.0
    distortion: float = 0.0
    focal_length: float = 1.0
    finesse: float = 1.0
    roughness: float = 0.0
    warming: float = 0.0
    drift: float = 0.0
    bow: float = 0.0
    wedge: float = 0.0
    laser: Light = field(default_factory=Light)
    air: Light = field(default_factory=Light)
    hot_pixels: int = 0
    hot_electrons: float = 5000.0
    dead_pixels: int = 0
    bump: float = 0.0
    bump_place: tuple[float, float] = (0.05, 0.03)
    bump_width: float = 0.25
    aerosol: float = 0.0
    seed: int = 0


@dataclass(frozen=True)
class Frame:
    """Mean electrons of every pixel (float64): light of laser or air, and the rest."""

    signal: np.ndarray
    background: np.ndarray

    @property
    def mean(self) -> np.ndarray:
        return self.signal + self.background


def laser_frame(
    instrument: Instrument,
    defects: Defects,
    photons: float = 2.4e7,
    background: float = 0.0,
    points: int = 2,
) -> Frame:
    """Mean frame of the laser's own light, ``photons`` of it in all.

    ``background`` are electrons per pixel; ``points`` are those of a pixel's quadrature each way.
    """
    line = ((1.0, laser_sigma(instrument)),)
    return _frame(instrument, defects, defects.laser, line, 1, photons, background, points)


def air_frame(
    instrument: Instrument,
    defects: Defects,
    v_los: float = 0.0,
    photons: float = 2.4e7,
    background: float = 0.0,
    points: int = 2,
) -> Frame:
    """Mean frame of the echo of air at the speed ``v_los`` (m/s)."""
    sigma = laser_sigma(instrument)
    air = math.hypot(rayleigh_sigma(instrument), sigma)
    line = ((1 - defects.aerosol, air), (defects.aerosol, sigma))
    drift = np.longdouble(defects.drift) * instrument.wavelength / LIGHT
    frequency = (1 + 2 * np.longdouble(v_los) / LIGHT) * (1 + drift)
    return _frame(instrument, defects, defects.air, line, frequency, photons, background, points)


def exposures(
    frame: Frame, count: int, seed, read_noise: float = 0.0, modes: float = math.inf
) -> np.ndarray:
    """Noisy frames (count, height, width): Poisson, Gaussian read noise, speckle of the light.

    ``modes`` is M of the Gamma distribution of a pixel's laser light; ``read_noise`` in electrons.
    """
    rng = np.random.default_rng(seed)
    settings = rng, read_noise, modes, frame.background
    return np.stack([noisy(frame.mean, *settings) for _ in range(count)])


def noisy(mean, rng, read_noise=0.0, modes=np.inf, background=0.0):
    """One exposure; ``mean`` holds the background, which has no speckle."""
    signal = mean - background
    if np.isfinite(modes):
        signal = signal * rng.gamma(modes, 1 / modes, mean.shape)
    return rng.poisson(signal + background) + read_noise * rng.standard_normal(mean.shape)


def laser_sigma(instrument: Instrument) -> float:
    """Standard deviation of the laser's line, Hz."""
    return instrument.laser_fwhm / _FWHM


def rayleigh_sigma(instrument: Instrument) -> float:
    """Of light scattered back by molecules without collisions: 2 (k T / m)^(1/2) / wavelength."""
    speed = math.sqrt(BOLTZMANN * instrument.temperature / AIR_MASS)
    return 2 * speed / instrument.wavelength


def mirror_reflectivity(instrument: Instrument, defects: Defects) -> float:
    """R of the mirrors whose finesse pi R^(1/2) / (1 - R) is changed by the factor."""
    nominal = instrument.reflectivity
    finesse = defects.finesse * math.pi * math.sqrt(nominal) / (1 - nominal)
    # (1 - R) / R^(1/2) = pi / F, a quadratic equation in R^(1/2)
    half = math.pi / (2 * finesse)
    return (math.sqrt(1 + half**2) - half) ** 2


def pupil_orders(
    instrument: Instrument, defects: Defects, light: Light, radii: int = 12, angles: int = 24
) -> tuple[np.ndarray, np.ndarray]:
    """Orders by which the gap's deviation shifts the light of the pupil's parts, and their weights.

    Gauss points in the squared radius and in the angle of the filled disc.
    """
    node, weight = leggauss(radii)
    rho, angle_node, angle_weight = np.sqrt((1 + node) / 2), *leggauss(angles)
    turn = (math.pi / 2 if light.half else math.pi) * angle_node
    x = light.pupil_shift + light.pupil * np.outer(rho, np.cos(turn))
    y = light.pupil * np.outer(rho, np.sin(turn))
    deviation = defects.bow * math.sqrt(12) * (x**2 + y**2 - 0.5) + defects.wedge * 2 * x
    weights = np.outer(weight, angle_weight) / 4
    return (2 * deviation / instrument.wavelength).ravel(), weights.ravel()


def profile(
    instrument: Instrument, defects: Defects, light: Light, line, count: int = 2**14
) -> tuple[np.ndarray, np.ndarray]:
    """Transmission at ``count`` steps of one order, for a line of Gaussians (fraction, Hz).

    In parts of an order line and roughness are Gaussian; their sum is one Gaussian of the root of
    squares.
    """
    reflectivity = mirror_reflectivity(instrument, defects)
    finesse = 4 * reflectivity / (1 - reflectivity) ** 2
    rough = math.hypot(instrument.roughness, defects.roughness)
    offset = np.linspace(-8, 8, 161)
    weight = np.exp(-(offset**2) / 2)
    weight /= weight.sum()
    order = np.linspace(0, 1, count + 1)
    total = np.zeros_like(order)
    for fraction, sigma in line:
        if fraction:
            width = 2 * math.hypot(sigma * instrument.gap / LIGHT, rough / instrument.wavelength)
            for o, w in zip(offset * width, fraction * weight, strict=True):
                total += w / (1 + finesse * np.sin(np.pi * (order + o)) ** 2)
    if not (defects.bow or defects.wedge):
        return order, total
    parts = zip(*pupil_orders(instrument, defects, light), strict=True)
    return order, sum(w * np.interp((order + shift) % 1, order, total) for shift, w in parts)


def cosine(instrument: Instrument, defects: Defects, u, w) -> np.ndarray:
    """Cosine of the angle to the axis of the light at (u, w), m from the axis, on the camera."""
    f = np.longdouble(instrument.focal_length) * np.longdouble(defects.focal_length)
    about_x, about_y = (np.longdouble(angle) for angle in defects.tilt)
    # the camera's own axes: (1, 0, 0) and (0, 1, 0) turned about x, then about y
    along_u = np.cos(about_y), 0, -np.sin(about_y)
    along_w = np.sin(about_x) * np.sin(about_y), np.cos(about_x), np.sin(about_x) * np.cos(about_y)
    x, y, z = (u * a + w * b for a, b in zip(along_u, along_w, strict=True))
    tangent2 = (x**2 + y**2) / (f + z) ** 2
    if defects.distortion:
        # q (1 + k q)^2 = q_d of q = (r_u / R)^2, by Newton's method
        scale, k = (f / instrument.half_diagonal) ** 2, np.longdouble(defects.distortion)
        distorted = tangent2 * scale
        q = distorted.copy()
        for _ in range(4):
            q -= (q * (1 + k * q) ** 2 - distorted) / ((1 + k * q) * (1 + 3 * k * q))
        tangent2 = q / scale
    return 1 / np.sqrt(1 + tangent2)


def _frame(instrument, defects, light, line, frequency, photons, background, points) -> Frame:
    margin = math.ceil(defects.defocus / 2) + _MARGIN if defects.defocus else 0
    signal = _light(instrument, defects, light, line, frequency, points, margin)
    if margin:
        signal = _blurred(signal, defects.defocus / 2)[margin:-margin, margin:-margin]
    signal *= photons / signal.sum()
    rest = np.full(instrument.shape, float(background))
    if defects.bump:
        rest += defects.bump * signal.mean() * _bump(instrument, defects)
    rng = np.random.default_rng(defects.seed)
    places = rng.permutation(signal.size)[: defects.hot_pixels + defects.dead_pixels]
    hot, dead = np.split(places, [defects.hot_pixels])
    rest.flat[hot] += defects.hot_electrons
    signal.flat[dead] = rest.flat[dead] = 0
    return Frame(signal, rest)


def _light(instrument, defects, light, line, frequency, points, margin) -> np.ndarray:
    """Transmitted light, averaged over the pixels' areas; any scale, with a margin of pixels."""
    order, transmission = profile(instrument, defects, light, line)
    at_centre = np.longdouble(instrument.order) * frequency
    at_centre *= 1 + np.longdouble(instrument.expansion) * defects.warming
    height, width = instrument.shape
    x0, y0 = instrument.centre or ((width - 1) / 2, (height - 1) / 2)
    half = instrument.half_diagonal
    total = np.zeros((height + 2 * margin, width + 2 * margin))
    nodes, weights = leggauss(points)
    for a, weight_a in zip(nodes / 2, weights / 2, strict=True):
        for b, weight_b in zip(nodes / 2, weights / 2, strict=True):
            x = (np.arange(-margin, width + margin) - x0 + a) * instrument.pixel
            y = (np.arange(-margin, height + margin)[:, None] - y0 + b) * instrument.pixel
            place = x.astype(np.longdouble), y.astype(np.longdouble)
            m = at_centre * cosine(instrument, defects, *place)
            passed = np.interp((m % 1).astype(float), order, transmission)
            lit = np.exp(-2 * (x**2 + y**2) / light.radius**2)
            lit *= 1 + (light.slope[0] * x + light.slope[1] * y) / half
            total += weight_a * weight_b * lit * passed
    return total


def _blurred(image: np.ndarray, radius: float) -> np.ndarray:
    """Convolution with an even disc, px, by its transform 2 J_1(z) / z; mirrored edges."""
    k, n = (np.arange(size) / (2 * size) for size in image.shape)
    z = 2 * math.pi * radius * np.hypot(k[:, None], n)
    transfer = np.where(z > 0, 2 * j1(z) / np.where(z > 0, z, 1), 1.0)
    return idctn(dctn(image) * transfer)


def _bump(instrument, defects) -> np.ndarray:
    height, width = instrument.shape
    scale = instrument.half_diagonal / instrument.pixel
    x = (np.arange(width) - (width - 1) / 2) / scale - defects.bump_place[0]
    y = (np.arange(height)[:, None] - (height - 1) / 2) / scale - defects.bump_place[1]
    return np.exp(-(x**2 + y**2) / (2 * defects.bump_width**2))
