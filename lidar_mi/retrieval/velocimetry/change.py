"""Air that changes between the images: differences that a displacement in the plane leaves."""

import math

import numpy as np
import torch
from scipy.optimize import nnls

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
# Rounds of the weighted least squares.
_ROUNDS = 30


def displaced(spline: Spline, stack: torch.Tensor, noise: float) -> torch.Tensor:
    """Spectral density, by shells, of differences made by 1 px of displacement across the plane.

    Structure changes by the displacement times its gradient across the plane. If it is isotropic
    in space, its spectral density T gives that of a slice, S(k) = integral T(|(k, q)|) dq, and
    that of the gradient, F(k) = integral q^2 T(|(k, q)|) dq, over the wavenumbers q across the
    plane. Then dF/dk = -k S, so that F(k) is the integral of k' S(k') from k on. It holds more in
    long waves than the gradients in the plane do. As in `warping.mismatch`, the density is half
    that of the difference of two images. Only structure that stands out of the noise counts.

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
        Per px^2.
    """
    known = torch.stack([torch.isfinite(image) for image in stack])
    stack = torch.stack([stored(filled(image)) for image in stack])
    sizes = [odd_fast_len(n + 2 * spline.settings.margin) for n in spline.shape]
    shell = shells(frequencies(sizes, stack), spline.shape)
    settings = spline.settings
    density, uncertainty = shell_means(stack, shell, sizes, settings.smoothing, known)
    wave = wavenumbers(density, spline.shape)
    structure = density > noise**2 * (1 + settings.threshold * uncertainty)
    held = torch.where(structure, wave * (density - noise**2), 0.0)
    return held.flip(0).cumsum(0).flip(0) * (wave[1] - wave[0]) / 2


def unexplained(
    spline: Spline, density: torch.Tensor, per_displacement: torch.Tensor, knots: float
) -> float:
    """Mean square displacement, px^2, across the plane that makes the images differ.

    The density of the differences is fitted by white noise and a multiple of that of `displaced`,
    neither below 0, in the waves shorter than two knots of the flow's splines: no flow in the plane
    absorbs them. Each shell has a relative variance inverse to its number of waves, so that the
    fit, weighted anew in each round, is the one of largest likelihood.

    Parameters
    ----------
    spline : Spline
    density : torch.Tensor, shape (shells,)
        Of the differences, from `warping.mismatch`.
    per_displacement : torch.Tensor, shape (shells,)
        From `displaced`.
    knots : float
        Spacing of the flow's knots, px.

    Returns
    -------
    float
        0 below (0.03 px)^2.
    """
    full = torch.arange(len(density), device=density.device) < min(spline.shape) // 2
    wave = wavenumbers(density, spline.shape)
    use = density.isfinite() & (per_displacement > 0) & (wave > math.pi / knots) & full
    if int(use.sum()) < 3:
        return 0.0
    # a shell's number of waves is proportional to its radius
    found, source, number = (part[use].double() for part in (density, per_displacement, wave))
    scale = float(found.mean() / source.mean())
    if not scale > 0:
        return 0.0
    found, source = found / found.mean(), source / source.mean()
    terms = torch.stack([torch.ones_like(source), source], 1).cpu().numpy()
    found, root = found.cpu().numpy(), number.sqrt().cpu().numpy()
    parts = np.array([0.0, 1.0])
    for _ in range(_ROUNDS):
        weight = root / np.maximum(terms @ parts, 1e-9)
        parts, _rest = nnls(terms * weight[:, None], found * weight)
    square = float(parts[1]) * scale
    return square if square > _LEAST**2 else 0.0
