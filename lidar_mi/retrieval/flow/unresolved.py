"""Motion that splines do not resolve: its variance, from that of the scales that they do."""

import math
from collections.abc import Callable

import torch

from lidar_mi.retrieval.flow.coherent_change import normal_fields
from lidar_mi.retrieval.flow.flow_spline import Axis, Mesh
from lidar_mi.retrieval.flow.likelihood import Linear
from lidar_mi.retrieval.images.windows import averaged

INERTIAL = 2 ** (-2 / 3)
"""Variance of turbulence in an octave of wavenumber over that in the octave of longer waves."""

# Standard deviation of the Gaussian that averages variances, over the spacing of the knots: smooth
# vortices with cores of 4 to 10 px have 0.5 to 1.1 of what splines leave of them.
_WIDTH = 0.8


def unresolved_variance(
    flow: torch.Tensor,
    knots: float,
    known: torch.Tensor | None = None,
    of_noise: torch.Tensor | None = None,
) -> torch.Tensor:
    """Variance of a component of the motion between two knots of a flow's splines and a pixel.

    Splines with knots 2, 4 and 8 times as far apart leave three octaves of the flow. The ratio of
    variances of the last two, times its change from the two before, is that of the next octave to
    the last one; it holds for all octaves down to a pixel. In smooth vortices the ratio falls
    from octave to octave. In the inertial range of turbulence, of spectral density k^(-5/3), it is
    2^(-2/3) (Kolmogorov 1941, Dokl. Akad. Nauk SSSR 30, 301-305; Pope 2000, Turbulent Flows,
    section 6.5). It is taken to be no larger, and not to grow. The extrapolation is ours.

    Parameters
    ----------
    flow : torch.Tensor, shape (components, ...)
        At the pixels; px in dt.
    knots : float
        Spacing of the knots of its splines, px; variances are averaged over a Gaussian of 0.8 of
        it. Wider, what splines leave in vortex cores is stated all around them.
    known : torch.Tensor of bool, shape (...), optional
        Pixels whose flow the images determine: next to them it is what the prior makes of noise.
        Default: all.
    of_noise : torch.Tensor, shape (number, ...), optional
        Components of flows that nothing but the images' noise makes, see `flows_of_noise`. The mean
        variance of their octaves is no motion. Default: none is.

    Returns
    -------
    torch.Tensor, shape (...)
        px^2, mean over the components as of isotropic motion. In vortex cores its root is 0.35 to
        0.8 of what splines leave. Where noise and prior have smoothed the finest octave it is too
        small.
    """
    if known is None:
        known = torch.ones_like(flow[0], dtype=torch.bool)
    octaves = _octaves(flow, knots, known)
    if of_noise is not None:
        octaves = octaves - _octaves(of_noise, knots, known)
    fine, middle, coarse = octaves.clamp(min=1e-30)
    ratio = fine / middle
    change = ratio / (middle / coarse).clamp(max=1)
    ratio = (ratio * change.clamp(max=1)).clamp(max=INERTIAL)
    # sum of ratio^n over the octaves n = 1, 2, ... from the knots to a pixel
    return fine * ratio * (1 - ratio ** math.log2(max(knots, 1.0))) / (1 - ratio)


def flows_of_noise(
    linear: Linear, mesh: Mesh, response: Callable[[torch.Tensor], torch.Tensor], number: int = 4
) -> torch.Tensor:
    """Flows at the pixels that the noise of the images alone makes; seeded.

    Parameters
    ----------
    linear : Linear
        The likelihood about the fitted flow.
    mesh : Mesh
        Of the pixels.
    response : callable
        From a gradient of the log-likelihood (components, knots) to the flow's change.
    number : int

    Returns
    -------
    torch.Tensor, shape (number * components, ...)
        px in dt.
    """
    root = linear.information.sqrt()
    gradients = (
        mesh.transposed(root * draw * linear.damped) for draw in normal_fields(root, number, 3)
    )
    return torch.cat([mesh.field(response(gradient).to(root)) for gradient in gradients])


def _octaves(flow: torch.Tensor, knots: float, known: torch.Tensor) -> torch.Tensor:
    """Variance of a component by octave (3, ...), the finest first."""
    shape = flow.shape[1:]
    places = [torch.arange(n).to(flow) for n in shape]
    octaves, finer = [], flow
    for times in (2, 4, 8):
        mesh = Mesh([Axis(n, times * knots) for n in shape], places)
        coarser = mesh.field(mesh.fitted(flow))
        octaves.append(averaged((finer - coarser).square().mean(0), known, _WIDTH * knots))
        finer = coarser
    return torch.stack(octaves)


def with_unresolved(covariance: torch.Tensor, variance: torch.Tensor) -> torch.Tensor:
    """A covariance (components, components, ...) and the variance (...) of every component."""
    unit = torch.eye(len(covariance)).to(variance)
    return covariance + unit.reshape(*unit.shape, *[1] * variance.ndim) * variance
