"""Rings of the instrument without defects, and closed forms that belong to them.

The images are those of `validation.fringe_reference`, made without the program.
"""

from dataclasses import replace

import numpy as np
from scipy.stats import nbinom, norm, poisson

from validation import fringe_reference
from validation.fringe_reference import LIGHT, Defects, Instrument, Light

NOMINAL = Instrument()
WAVELENGTH, GAP, FOCAL_LENGTH = NOMINAL.wavelength, NOMINAL.gap, NOMINAL.focal_length
PIXEL, SHAPE, ORDER, TEMPERATURE = NOMINAL.pixel, NOMINAL.shape, NOMINAL.order, NOMINAL.temperature

noisy = fringe_reference.noisy


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
    """Mean electrons of every pixel; temperature None is the laser's own light, at rest.

    ``radius`` is the 1/e^2 radius of the light on the camera, m.
    """
    light = Light(radius=radius)
    defects = Defects(laser=light, air=light)
    instrument = Instrument(shape=shape, pixel=pixel, centre=centre)
    if temperature is None:
        assert v_los == 0
        return fringe_reference.laser_frame(instrument, defects, photons, background).mean
    instrument = replace(instrument, temperature=temperature)
    return fringe_reference.air_frame(instrument, defects, v_los, photons, background).mean


def line_sigma(temperature=TEMPERATURE):
    """Standard deviation of the received line, Hz; temperature None is the laser's own."""
    laser = fringe_reference.laser_sigma(NOMINAL)
    if temperature is None:
        return laser
    instrument = Instrument(temperature=temperature)
    return np.hypot(fringe_reference.rayleigh_sigma(instrument), laser)


def harmonics(temperature, count=40):
    """A_n = R^n exp(-2 (pi n)^2 width^2): Fourier series of Airy's formula, textbook form."""
    n = np.arange(count)
    rough = 2 * NOMINAL.roughness / WAVELENGTH
    width2 = (line_sigma(temperature) * 2 * GAP / LIGHT) ** 2 + rough**2
    return NOMINAL.reflectivity**n * np.exp(-2 * (np.pi * n) ** 2 * width2)


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
