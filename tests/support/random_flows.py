"""Random flows in a plane whose spectra are known."""

import numpy as np
import torch


def random_flow(shape, rms, turnover, ratio, seed, shortest=3.0):
    """A periodic flow (2, z, y) and the spectral density of a component.

    Its vorticity has the spectral density c / (1 + (k / turnover)^2), its divergence the same over
    `ratio`, in waves of `shortest` px and longer.

    Parameters
    ----------
    shape : (int, int)
    rms : float
        Expected rms of a component, px.
    turnover : float
        rad per px.
    ratio : float
    seed : int
    shortest : float
        px.

    Returns
    -------
    flow : torch.Tensor, shape (2, z, y)
        px.
    density : callable
        Of a wavenumber in rad per px; white noise of variance 1 px^2 has the density 1 px^2.
    """
    random = np.random.default_rng(seed)
    z = 2 * np.pi * np.fft.fftfreq(shape[0])[:, None]
    y = 2 * np.pi * np.fft.rfftfreq(shape[1])
    square = z**2 + y**2

    def plain(square):
        return (1 + 1 / ratio) / (1 + square / turnover**2) / (2 * square)

    used = (square > 0) & (square <= (2 * np.pi / shortest) ** 2)
    safe = np.where(square > 0, square, 1.0)
    # most waves of the real transform stand for two
    both = np.where((y > 0) & (y < np.pi), 2.0, 1.0) * used
    scale = rms**2 / (both * plain(safe)).sum() * np.prod(shape)
    vorticity = np.sqrt(scale / (1 + safe / turnover**2)) * used
    noise = [np.fft.rfft2(random.standard_normal(shape)) for _ in "wd"]
    turning, diverging = noise[0] * vorticity / safe, noise[1] * vorticity / ratio**0.5 / safe
    # u = curl of the stream function + gradient of the potential
    flow = [
        np.fft.irfft2(1j * (-y * turning + z * diverging), s=shape),
        np.fft.irfft2(1j * (z * turning + y * diverging), s=shape),
    ]

    def density(wave):
        return scale * plain(wave**2)

    return torch.as_tensor(np.stack(flow)), density
