"""Air that changes between the images: differences that a displacement in the plane leaves."""

import math
from collections.abc import Sequence

import numpy as np
import torch

from lidar_mi.retrieval.images.band_limit import (
    independent_fraction,
    radii,
    shell_means,
    wavenumbers,
)
from lidar_mi.retrieval.images.quality import filled
from lidar_mi.retrieval.images.spline import Spline, transform_sizes
from lidar_mi.retrieval.images.windows import stored
from lidar_mi.retrieval.reml import most_likely

# Displacements, px, that splines do not resolve in vortex cores: below, no change is assumed.
_LEAST = 0.03
# Largest blur of the images that is not known, standard deviation, px.
_BLUR = 0.8
# Gain in the log-likelihood below which none is. Where nothing moves out of the plane it is 0 to
# 0.5 in noise and 10 at most in images without noise, whose differences are those of splines and of
# unresolved motion; smoke with up to 2 % of texture that does move gains 120 and more.
_GAIN = 20.0


def of_structure(spline: Spline, stack: torch.Tensor, noise: float) -> torch.Tensor:
    """Spectral density of the structure that stands out of the noise, by shells.

    Parameters
    ----------
    spline : Spline
        Of the images.
    stack : torch.Tensor, shape (images, z, y)
    noise : float
        Standard deviation of their white noise.

    Returns
    -------
    torch.Tensor, shape (shells,)
    """
    known = torch.stack([torch.isfinite(image) for image in stack])
    stack = torch.stack([stored(filled(image)) for image in stack])
    settings = spline.settings
    sizes = transform_sizes(spline.shape, settings)
    _, shell = radii(tuple(sizes), spline.shape, stack.dtype, stack.device)
    density, uncertainty = shell_means(stack, shell, sizes, settings.smoothing, known)
    # the means of shells of noise alone scatter about noise^2
    structure = density > noise**2 * (1 + settings.threshold * uncertainty)
    return torch.where(structure, density - noise**2, 0.0)


def displaced(wave: torch.Tensor, structure: torch.Tensor) -> torch.Tensor:
    """Spectral density of differences made by 1 px of displacement across the plane.

    Structure changes by the displacement times its gradient across the plane. If it is isotropic
    in space, its spectral density T gives that of a slice, S(k) = integral T(|(k, q)|) dq, and
    that of the gradient, F(k) = integral q^2 T(|(k, q)|) dq, over the wavenumbers q across the
    plane. Then dF/dk = -k S, so that F(k) is the integral of k' S(k') from k on. It holds more in
    long waves than the gradients in the plane do. As in `spline.mismatch`, the density is half
    that of the difference of two images.

    Parameters
    ----------
    wave, structure : torch.Tensor, shape (shells,)
        Wavenumber, rad/px; S from `of_structure`.

    Returns
    -------
    torch.Tensor, shape (shells,)
        Per px^2.
    """
    return (wave * structure).flip(0).cumsum(0).flip(0) * (wave[1] - wave[0]) / 2


def strained(wave: torch.Tensor, structure: torch.Tensor) -> torch.Tensor:
    """Spectral density of differences made by a blur of 1 px where air is strained by 1 in dt.

    Air advects structure, and not the blur of the instrument: seen along with the air, a blur of
    variance b^2 is stretched by the rate of strain E from image to image, which makes them differ
    by b^2 dt E_ij d2I / dx_i dx_j. For isotropic structure and a strain e along one axis, -e along
    the other, the density is b^4 e^2 dt^2 k^4 S(k) / 4; half that of the difference of two images,
    as in `displaced`.

    Parameters
    ----------
    wave, structure : torch.Tensor, shape (shells,)
        Wavenumber, rad/px; S from `of_structure`.
    """
    return wave**4 * structure / 4


def mean_square_strain(slopes: Sequence[torch.Tensor]) -> float:
    """Of a flow in a plane without its divergence, along the axes of strain.

    Parameters
    ----------
    slopes : sequence of torch.Tensor, shape (2, z, y)
        Of both components along z and along y.
    """
    along_z, along_y = slopes
    stretched, sheared = along_z[0] - along_y[1], along_z[1] + along_y[0]
    # strain e along one axis, -e across: e^2 = (stretched^2 + sheared^2) / 4
    return float((stretched.square() + sheared.square()).mean()) / 4


def unexplained(
    spline: Spline, density: torch.Tensor, structure: torch.Tensor, strain: float, knots: float
) -> tuple[float, float]:
    """Mean square displacement, px^2, across the plane that makes the images differ.

    The density of the differences is fitted by white noise, a multiple of that of `displaced` and
    one of that of `strained`, none below 0, in the waves shorter than two knots of the flow's
    splines: no flow in the plane absorbs them. The blur is 0.8 px at most; what more of it makes
    is taken for motion. (Seen as blur, what smoke without texture changes by would be 1.1 to 1.2
    px.) The fit is that of largest likelihood, which motion has to raise by far.

    Parameters
    ----------
    spline : Spline
    density : torch.Tensor, shape (shells,)
        Of the differences, from `spline.mismatch`.
    structure : torch.Tensor, shape (shells,)
        From `of_structure`.
    strain : float
        Mean square of the flow's strain in dt, along its axes.
    knots : float
        Spacing of the flow's knots, px.

    Returns
    -------
    square : float
        0 below (0.03 px)^2, or where the log-likelihood gains less than 20.
    blurred : float
        Fraction of the differences that blur in strained air makes instead.
    """
    # shells beyond half a cycle per pixel are cut by the corners of the spectrum
    full = torch.arange(len(density), device=density.device) < min(spline.shape) // 2
    wave = wavenumbers(density, spline.shape)
    moved, smeared = displaced(wave, structure), strained(wave, structure)
    use = density.isfinite() & (moved > 0) & (wave > math.pi / knots) & full
    if int(use.sum()) < 3:
        return 0.0, 0.0
    # smoothed shells share the waves of their neighbours
    waves = _independent_waves(spline, density) / spline.settings.smoothing
    found, across, blurred, number = (
        part[use].double().cpu().numpy() for part in (density, moved, smeared, waves)
    )
    if not found.mean() > 0:
        return 0.0, 0.0
    terms = np.stack([np.ones_like(found), blurred, across])
    # above 0, as the solver wants
    limits = np.array([np.inf, strain * _BLUR**4 + 1e-30, np.inf])
    without, still = most_likely(found, terms[:-1], limits[:-1], number)
    with_it, factors = most_likely(found, terms, limits, number)
    square = float(factors[-1])
    if without - with_it < _GAIN or square < _LEAST**2:
        square, factors = 0.0, still
    return square, float(factors[1] * blurred.mean() / found.mean())


def _independent_waves(spline: Spline, density: torch.Tensor) -> torch.Tensor:
    """Of the difference of two images, by shells."""
    sizes = transform_sizes(spline.shape, spline.settings)
    _, shell = radii(tuple(sizes), spline.shape, density.dtype, density.device)
    number = torch.bincount(shell.flatten(), minlength=len(density))[: len(density)]
    return number * independent_fraction(spline.shape, sizes)
