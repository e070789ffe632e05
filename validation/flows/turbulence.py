"""Isotropic turbulence in a plane: Gaussian fields whose spectrum is known in closed form."""

from collections.abc import Callable

import numpy as np
from scipy.ndimage import map_coordinates, spline_filter

Wind = Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]
"""v and w (m s^-1) at positions y and z (m), any shape."""

PERIOD = 256.0
"""Of the turbulence along y and z, m: twice an image's width."""
ORDER = 5
"""Of the splines through the nodes."""
NODES = 6
"""Nodes on the shortest wave, at least."""
QUADRATURE = 24
"""Nodes of the integral over the waves along x."""


def turbulence(
    random: np.random.Generator,
    largest: float,
    smallest: float,
    rms: float,
    slope: float = 5 / 3,
    planar: bool = False,
) -> Wind:
    """A plane of isotropic, divergence-free turbulence with E ~ k^-slope between two wavelengths.

    Three-dimensional turbulence has a divergence in the plane, which the wind through the plane
    balances. Of the waves with one wave vector in the plane and any along x, what is along the wave
    vector and what is across it are independent, with the variances of `plane_spectrum`. The
    wind is the spline through the nodes of the inverse Fourier transform, and periodic.

    Parameters
    ----------
    random : numpy.random.Generator
    largest, smallest : float
        Wavelengths where the spectrum begins and ends, m.
    rms : float
        Of each component, over all planes, m s^-1.
    slope : float
    planar : bool
        Two-dimensional turbulence, without divergence in the plane.
    """
    count = 2 ** int(np.ceil(np.log2(NODES * PERIOD / smallest)))
    step = PERIOD / count
    ky, kz = np.meshgrid(*[2 * np.pi * np.fft.fftfreq(count, step)] * 2, indexing="ij")
    k = np.hypot(ky, kz)
    # the mean over the period is zero, and has no direction
    k[0, 0] = np.inf
    across, along = plane_spectrum(k, largest, smallest, rms, slope, planar)
    cell = (2 * np.pi / PERIOD) ** 2
    # a direction changes its sign with the wave vector, and so does i times a real field
    across, along = (
        1j * np.sqrt(cell * density) * count * np.fft.fft2(random.standard_normal(k.shape))
        for density in (across, along)
    )
    fields = (along * ky - across * kz) / k, (along * kz + across * ky) / k
    splines = [spline_filter(np.fft.ifft2(field).real, ORDER, mode="grid-wrap") for field in fields]

    def wind(y, z):
        places = np.stack([np.asarray(a, float) / step for a in np.broadcast_arrays(y, z)])
        v, w = (
            map_coordinates(s, places, order=ORDER, mode="grid-wrap", prefilter=False)
            for s in splines
        )
        return v, w

    return wind


def plane_spectrum(
    k: np.ndarray, largest: float, smallest: float, rms: float, slope: float, planar: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Densities of variance in the plane of wave vectors, across and along them, m^4 s^-2.

    In three dimensions the density of a component of the unit vector e is E(k) / (4 pi k^2)
    (1 - (e k)^2 / k^2) (Batchelor 1953, The Theory of Homogeneous Turbulence, sect. 3.4), which is
    integrated over the waves along x. In two dimensions it is E(k) / (pi k) across the wave vector.

    Parameters
    ----------
    k : array
        Wave number in the plane, m^-1, above 0.
    """
    low, high = 2 * np.pi / largest, 2 * np.pi / smallest
    decay = 1 - slope
    extent = np.log(high / low) if decay == 0 else (high**decay - low**decay) / decay
    # the integral of E is half of the variance of all components
    level = (1.0 if planar else 1.5) * rms**2 / extent
    if planar:
        within = (k >= low) & (k <= high)
        return np.where(within, level * k ** (-slope - 1) / np.pi, 0.0), np.zeros_like(k)
    # k_x = k tan(angle): a smooth integrand for all k
    first, last = (np.arccos(np.minimum(k / limit, 1.0)) for limit in (low, high))
    nodes, weights = np.polynomial.legendre.leggauss(QUADRATURE)
    across, along = np.zeros_like(k), np.zeros_like(k)
    inside = np.isfinite(k) & (k < high)
    k, first, last = k[inside], first[inside], last[inside]
    middle, half = (last + first) / 2, (last - first) / 2
    for node, weight in zip(nodes, weights, strict=True):
        cosine = np.cos(middle + half * node)
        # both signs of k_x
        part = 2 * weight * half * level * (k / cosine) ** -slope / (4 * np.pi * k)
        across[inside] += part
        along[inside] += part * (1 - cosine**2)
    return across, along
