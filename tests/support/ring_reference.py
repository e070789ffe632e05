"""Images of etalon rings without the program: Airy's formula, quadrature, extended precision."""

import numpy as np
from numpy.polynomial.legendre import leggauss
from scipy.stats import nbinom, norm, poisson

LIGHT = 299792458.0
WAVELENGTH, GAP, FOCAL_LENGTH, PIXEL = 354.7e-9, 13.7e-3, 0.3, 7.4e-6
ORDER, REFLECTIVITY, ROUGHNESS = 77248.5, 0.70, 2e-9
LASER_FWHM, RAYLEIGH_FWHM, TEMPERATURE = 100e6, 3.43e9, 232.9
SHAPE = (780, 960)
_FWHM = np.sqrt(8 * np.log(2))


def line_sigma(temperature=TEMPERATURE):
    """Standard deviation of the received line, Hz; temperature None is the laser's own."""
    rayleigh = 0 if temperature is None else RAYLEIGH_FWHM * np.sqrt(temperature / TEMPERATURE)
    return np.hypot(rayleigh, LASER_FWHM) / _FWHM


def profile(sigma, count=2**14):
    """Transmission over one order, by quadrature of Airy's formula over line and plate defects.

    In parts of an order both are Gaussian; their sum is one Gaussian of the root of squares.
    """
    width = np.hypot(sigma * 2 * GAP / LIGHT, 2 * ROUGHNESS / WAVELENGTH)
    offset = np.linspace(-8, 8, 1001)
    weight = np.exp(-(offset**2) / 2)
    weight /= weight.sum()
    order = np.linspace(0, 1, count + 1)
    finesse = 4 * REFLECTIVITY / (1 - REFLECTIVITY) ** 2
    total = np.zeros_like(order)
    for o, w in zip(offset, weight, strict=True):
        total += w / (1 + finesse * np.sin(np.pi * (order + o * width)) ** 2)
    return order, total


def ring_image(
    v_los=0.0,
    photons=2.4e7,
    centre=None,
    temperature=TEMPERATURE,
    shape=SHAPE,
    pixel=PIXEL,
    background=0.0,
    radius=np.inf,
):
    """Mean electrons of every pixel, averaged over its area by two points each way.

    ``radius`` is the 1/e^2 radius of the light on the camera, m.
    """
    x0, y0 = centre or ((shape[1] - 1) / 2, (shape[0] - 1) / 2)
    order, transmission = profile(line_sigma(temperature))
    total = np.zeros(shape)
    nodes = leggauss(2)[0] / 2
    for u in nodes:
        for w in nodes:
            x = (np.arange(shape[1]) - x0 + u) * pixel
            y = (np.arange(shape[0]) - y0 + w) * pixel
            r2 = (x**2 + y[:, None] ** 2).astype(np.longdouble)
            # all of the order, 77248.something: 19 digits leave 1e-15 of it
            m = np.longdouble(ORDER) * (1 + 2 * np.longdouble(v_los) / LIGHT)
            m = m / np.sqrt(1 + r2 / np.longdouble(FOCAL_LENGTH) ** 2)
            part = np.interp((m % 1).astype(float), order, transmission)
            total += part * np.exp(-2 * r2.astype(float) / radius**2)
    return total * photons / total.sum() + background


def noisy(mean, rng, read_noise=0.0, modes=np.inf, background=0.0):
    """One exposure; ``mean`` holds the background, which has no speckle."""
    signal = mean - background
    if np.isfinite(modes):
        signal = signal * rng.gamma(modes, 1 / modes, mean.shape)
    return rng.poisson(signal + background) + read_noise * rng.standard_normal(mean.shape)


def harmonics(temperature, count=40):
    """A_n = R^n exp(-2 (pi n)^2 width^2): Fourier series of Airy's formula, textbook form."""
    n = np.arange(count)
    width2 = (line_sigma(temperature) * 2 * GAP / LIGHT) ** 2 + (2 * ROUGHNESS / WAVELENGTH) ** 2
    return REFLECTIVITY**n * np.exp(-2 * (np.pi * n) ** 2 * width2)


def information(mean, read_noise, modes):
    """Fisher information on the mean of one pixel times its variance, from the exact density."""
    spread = np.sqrt(mean + mean**2 / modes)
    k = np.arange(int(mean + 14 * spread + 30))
    x = np.linspace(-8 * read_noise - 1, k[-1] + 8 * read_noise, 6000)
    kernel = norm.pdf(x[:, None] - k, scale=read_noise)

    def density(mu):
        counts = (
            poisson.pmf(k, mu) if np.isinf(modes) else nbinom.pmf(k, modes, modes / (modes + mu))
        )
        return kernel @ counts

    step = 1e-3 * mean
    p, slope = density(mean), (density(mean + step) - density(mean - step)) / (2 * step)
    observed = p > 1e-200
    fisher = np.trapezoid(np.where(observed, slope**2 / np.where(observed, p, 1), 0), x)
    return fisher * (spread**2 + read_noise**2)
