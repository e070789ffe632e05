"""Air that changes between the images: differences that a displacement in the plane leaves."""

import math
from collections.abc import Sequence

import numpy as np
import torch
from scipy.optimize import lsq_linear

from lidar_mi.retrieval.velocimetry.band_limit import (
    frequencies,
    odd_fast_len,
    shell_means,
    shells,
    wavenumbers,
)
from lidar_mi.retrieval.velocimetry.quality import filled
from lidar_mi.retrieval.velocimetry.warping import Spline
from lidar_mi.retrieval.velocimetry.windows import stored

# Displacements, px, that splines do not resolve in vortex cores: below, no change is assumed.
_LEAST = 0.03
# Largest blur of the images that is not told, standard deviation, px.
_BLUR = 0.8
# Rounds of the weighted least squares.
_ROUNDS = 30


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
    sizes = [odd_fast_len(n + 2 * spline.settings.margin) for n in spline.shape]
    shell = shells(frequencies(sizes, stack), spline.shape)
    settings = spline.settings
    density, uncertainty = shell_means(stack, shell, sizes, settings.smoothing, known)
    structure = density > noise**2 * (1 + settings.threshold * uncertainty)
    return torch.where(structure, density - noise**2, 0.0)


def displaced(wave: torch.Tensor, structure: torch.Tensor) -> torch.Tensor:
    """Spectral density of differences made by 1 px of displacement across the plane.

    Structure changes by the displacement times its gradient across the plane. If it is isotropic
    in space, its spectral density T gives that of a slice, S(k) = integral T(|(k, q)|) dq, and
    that of the gradient, F(k) = integral q^2 T(|(k, q)|) dq, over the wavenumbers q across the
    plane. Then dF/dk = -k S, so that F(k) is the integral of k' S(k') from k on. It holds more in
    long waves than the gradients in the plane do. As in `warping.mismatch`, the density is half
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

    Air carries structure, and not the blur of the instrument: seen along with the air, a blur of
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
    return float((stretched.square() + sheared.square()).mean()) / 4


def unexplained(
    spline: Spline, density: torch.Tensor, structure: torch.Tensor, strain: float, knots: float
) -> tuple[float, float]:
    """Mean square displacement, px^2, across the plane that makes the images differ.

    The density of the differences is fitted by white noise, a multiple of that of `displaced` and
    one of that of `strained`, none below 0, in the waves shorter than two knots of the flow's
    splines: no flow in the plane absorbs them. The blur is 0.8 px at most; what more of it makes
    is taken for motion. (Seen as blur, what smoke without texture changes by would be 1.1 to 1.2
    px.) Each shell has a relative variance inverse to its number of waves, so that the fit,
    weighted anew in each round, is the one of largest likelihood.

    Parameters
    ----------
    spline : Spline
    density : torch.Tensor, shape (shells,)
        Of the differences, from `warping.mismatch`.
    structure : torch.Tensor, shape (shells,)
        From `of_structure`.
    strain : float
        Mean square of the flow's strain in dt, along its axes.
    knots : float
        Spacing of the flow's knots, px.

    Returns
    -------
    square : float
        0 below (0.03 px)^2.
    blurred : float
        Fraction of the differences that blur in strained air makes instead.
    """
    full = torch.arange(len(density), device=density.device) < min(spline.shape) // 2
    wave = wavenumbers(density, spline.shape)
    across, blurred = displaced(wave, structure), strained(wave, structure)
    use = density.isfinite() & (across > 0) & (wave > math.pi / knots) & full
    if int(use.sum()) < 3:
        return 0.0, 0.0
    # a shell's number of waves is proportional to its radius
    found, across, blurred, root = (
        part[use].double().cpu().numpy() for part in (density, across, blurred, wave.sqrt())
    )
    scale = found.mean() / across.mean()
    if not scale > 0:
        return 0.0, 0.0
    terms = np.stack([np.ones_like(found), across / across.mean(), blurred / found.mean()], 1)
    found = found / found.mean()
    # above 0, as the solver wants
    most = np.array([np.inf, np.inf, strain * _BLUR**4 + 1e-30])
    parts = np.array([0.0, 1.0, 0.0])
    for _ in range(_ROUNDS):
        weight = root / np.maximum(terms @ parts, 1e-9)
        fit = lsq_linear(terms * weight[:, None], found * weight, (0.0, most), method="bvls")
        parts = fit.x
    square = float(parts[1] * scale)
    blurred = float(parts[2] * terms[:, 2].mean())
    return square if square > _LEAST**2 else 0.0, blurred
