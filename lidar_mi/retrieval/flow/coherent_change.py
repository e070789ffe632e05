"""Structure that moves otherwise than the air in the plane, from what a fitted flow leaves of it.

Wind through the plane moves smoke that is tilted: its rims shift in the image, although the air in
the plane does not. Such differences are alike along a whole rim. A smooth flow follows them, so
that little of them is left in the residuals. Random differences of that kind, sent through the same
fit, tell how little.
"""

from collections.abc import Callable, Iterator
from functools import reduce

import numpy as np
import torch

from lidar_mi.retrieval.flow.flow_spline import Mesh
from lidar_mi.retrieval.flow.likelihood import (
    Images,
    Linear,
    steepness_of_structure,
    without_coarse,
)
from lidar_mi.retrieval.images.windows import averaged, working
from lidar_mi.retrieval.reml import most_likely
from lidar_mi.retrieval.threads import mapped

ResidualOperator = Callable[[torch.Tensor], torch.Tensor]
"""From a difference (z, y) of the images in dt to what the fitted flow leaves of it."""

CORRELATED_AREA = 50.0
"""Area over which structure moves alike, px^2, as noise in waves of several pixels counts it.

Chosen on seeds 41 to 46 of the true second states of ``validation/coverage.py``: 35 to 50 are
alike.
"""

SMOOTH = 3.0
"""Standard deviation of the Gaussian mean that makes a random displacement smooth, px.

Between 3 and 6 px the likelihood of 12 true second states of ``validation/coverage.py`` prefers 3.
"""

# Random differences of each kind that are sent through the fit.
_DRAWS = 4
# Of the Gaussian mean of differences: waves that are coherent pass, noise does not.
_COARSE = 3.0
# Of the Gaussian means between which noise and coherent differences are told apart by place, their
# distance, and the independent squares in the area of each.
_REGION, _APART, _SQUARES = 8.0, 8, 0.57
# Of the mean whose rest is noise, and of the mean of its squares.
_FINE, _LEVEL = 1.5, 6.0
# Least displacement, px, as of `change.unexplained`; gain in the log-likelihood below which there
# is none. One parameter gains 5 by chance in 1 of 1300 cases; filters, outliers and what the prior
# smooths, which the draws do not have, gained up to 9 where nothing but noise of 1 or 2 % was added
# (40 pairs of the shipped wake), and true second states 23 or more in noise of 1 % of each pixel.
_LEAST, _GAIN = 0.03, 10.0
# Largest noise of coarse waves over that of the finest, where noise is not given.
_COARSER = 5.0
# Fraction by which the variance of a given noise may be larger than told.
_TOO_SMALL = 0.25
# Least variance over its mean.
_FLOOR = 1e-3


def residual_operator(
    linear: Linear, mesh: Mesh, response: Callable[[torch.Tensor], torch.Tensor]
) -> ResidualOperator:
    """What a fit leaves of a difference of the images in a plane, to first order.

    Parameters
    ----------
    linear : Linear
        The likelihood about the fitted flow.
    mesh : Mesh
        Of the pixels.
    response : callable
        From a gradient of the log-likelihood (components, knots) to the flow's change.
    """
    slope, weight = working(linear.slope), working(linear.weight)
    damped = working(linear.damped)

    def left(difference: torch.Tensor) -> torch.Tensor:
        difference = working(difference) * linear.valid
        told = without_coarse(difference, linear.coarse, linear.valid)
        change = response(mesh.transposed(-told * damped * weight))
        return (difference + (slope * mesh.field(change)).sum(0)) * linear.valid

    return left


def _white_noise(images: Images, number: int, seed: int) -> Iterator[torch.Tensor]:
    """White noise of unit variance after the images' filter, (z, y); seeded."""
    for draw in normal_fields(images.weight, number, seed):
        yield images.spline.filtered(draw)


def mean_square_displacement(images: Images, linear: Linear, left: ResidualOperator) -> float:
    """Mean square displacement of structure besides that of the air, px^2.

    Differences of the images are taken as noise, as texture that is replaced, and as a smooth
    random displacement e(x) of variance d^2 times the slope of the structure, |grad I| in a
    Gaussian mean of 3 px. All kinds are drawn and sent through the fit. The squares of what is left
    of them, in waves of several pixels, and those of the residual are averaged about places 8 px
    apart. By place the residual's are fitted by the sum of the others', none below 0 (variance
    components; the squares have gamma distributions, so that the weighted least squares are of
    largest likelihood). The noise has the variance of the finest waves at each place, and is at
    least the one that was given. A noise that is given counts 1 to 1.25 times, and a factor
    multiplies noise of what the finest waves differ by beyond it: replaced texture does. (Where
    there is nothing, or the noise contains the misfit, it multiplies the noise itself, as where
    none is given.)

    On the shipped wake d is known: with its own state 0.1 s later, the rms difference over the rms
    slope of smoke without texture is 0.08 px at the true flow. From images with texture of 5 to
    20 % it is estimated as 0.065 to 0.088 px, though the flow absorbs most of such differences;
    with 2 % as 0.15 px. Where the displacement varies over 8 px instead of the 3 px that are
    assumed (standard deviations of Gaussians), the flow follows it better, and the estimate is an
    eighth too small. It does not tell what changes in proportion to the slope from
    what moves, and is one number for the whole image.

    Parameters
    ----------
    images : Images
    linear : Linear
        About the fitted flow.
    left : callable
        See `residual_operator`.

    Returns
    -------
    float
        0 below (0.03 px)^2, or where the log-likelihood gains less than 10.
    """
    valid = linear.valid
    if not bool(valid.any()):
        return 0.0
    time = images.time.to(linear.warped).reshape(-1, 1, 1)
    difference = (time * linear.warped).sum(0) / time.square().sum() * valid
    fine = (difference - averaged(difference, valid, _FINE)).square()
    level = averaged(fine, valid, _LEVEL).sqrt()
    excess = level
    if images.noise_known:
        told = images.noise**2 * images.spline.passed / images.time.square().sum() / images.weight
        beyond = (level.square() - told).clamp(min=0.0).sqrt() * valid
        excess = level = torch.maximum(level, told.sqrt())
        # a noise that contains the misfit has nothing beyond it
        if not images.noise_updated and bool((beyond > 0).any()):
            excess = beyond

    def squares(rest: torch.Tensor) -> torch.Tensor:
        coarse = averaged(rest, valid, _COARSE).square()
        return averaged(coarse, valid, _REGION)[::_APART, ::_APART]

    def noise_left(one: torch.Tensor) -> torch.Tensor:
        rest = one if images.noise_known else one - averaged(one, valid, _FINE)
        return squares(left(level * one / rest.std()))

    def replaced_left(one: torch.Tensor) -> torch.Tensor:
        return squares(left(excess * one))

    noise = _mean(noise_left, _white_noise(images, _DRAWS, 1))
    moved = _mean(lambda one: squares(left(one)), _displacements(linear))
    # the same fit of the same draws, unless there is more than the noise
    replaced = noise
    if excess is not level:
        replaced = _mean(replaced_left, _white_noise(images, _DRAWS, 1))
    found = squares(difference)
    use = (averaged(valid.to(found), torch.ones_like(valid), _REGION)[::_APART, ::_APART] > 0.5) & (
        found > 0
    )
    parts = [part[use] for part in (found, noise, moved, replaced)]
    # identical images, images without structure
    if not all(bool(part.mean() > 0) for part in parts):
        return 0.0
    found_at, noise_at, moved_at, replaced_at = (part.cpu().numpy() for part in parts)
    return _component(found_at, noise_at, moved_at, replaced_at, images.noise_known)


def _component(
    found: np.ndarray, noise: np.ndarray, moved: np.ndarray, replaced: np.ndarray, given: bool
) -> float:
    """Factor b of what `moved`; 0 if it is not significant or small.

    With a noise that is given, found = (1 + c) noise + a replaced + b moved, with c at most 0.25.
    Texture that is replaced has coarse waves and fine ones. A noise that varies as the slopes do,
    of photons or of Monte Carlo samples, has hardly more coarse waves than it says, or it would
    stand for the displacement. Of a noise that is not given, found = a noise + b moved, and a is 5
    at most.
    """
    held: np.ndarray | float
    if given:
        held, others, most = noise, [replaced, noise], [np.inf, _TOO_SMALL]
    else:
        held, others, most = 0.0, [noise], [_COARSER]
    terms, limits = np.stack([*others, moved]), np.array([*most, np.inf])
    without, _ = most_likely(found, terms[:-1], limits[:-1], _SQUARES, held, _FLOOR)
    with_it, factors = most_likely(found, terms, limits, _SQUARES, held, _FLOOR)
    square = float(factors[-1])
    return square if without - with_it > _GAIN and square > _LEAST**2 else 0.0


def square_left(linear: Linear, left: ResidualOperator) -> torch.Tensor:
    """Mean square of what is left of a displacement of 1 px of structure, (z, y).

    Parameters
    ----------
    linear : Linear
        About the fitted flow.
    left : callable
        See `residual_operator`.
    """
    return _mean(lambda one: left(one).square(), _displacements(linear))


def _mean(of_draw: ResidualOperator, draws: Iterator[torch.Tensor]) -> torch.Tensor:
    return reduce(torch.add, mapped(of_draw, draws)) / _DRAWS


def _displacements(linear: Linear) -> Iterator[torch.Tensor]:
    """Differences by smooth random displacements of 1 px rms, (z, y); seeded."""
    steep = steepness_of_structure(working(linear.slope), linear.valid).sqrt()
    everywhere = torch.ones_like(linear.valid)
    for draw in normal_fields(steep, _DRAWS, 2):
        smooth = averaged(draw, everywhere, SMOOTH)
        yield steep * smooth / smooth.std()


def normal_fields(like: torch.Tensor, number: int, seed: int) -> Iterator[torch.Tensor]:
    """Fields of independent standard normal numbers, the same on every device."""
    random = torch.Generator().manual_seed(seed)
    for _ in range(number):
        yield torch.randn(like.shape, generator=random, dtype=like.dtype).to(like.device)
