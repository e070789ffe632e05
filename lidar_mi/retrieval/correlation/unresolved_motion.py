"""Motion that windows do not resolve, from the residuals that it leaves in the images.

A window gives its mean displacement. The displacement u about that mean moves the texture within
the window, so that images matched by the vectors differ by g u, with the slopes g. Noise differs as
well, but not more where slopes are steep.
"""

from typing import NamedTuple

import numpy as np
import torch
from scipy.optimize import lsq_linear

from lidar_mi.retrieval.correlation.known_motion import of_windows
from lidar_mi.retrieval.images.windows import Windows, averaged, linear_weights, separable


class Residuals(NamedTuple):
    """Differences of images matched by vectors, of the given pair and of one of known motion.

    given (shape (z, y), or (x, z, y) of volumes): image 2 less image 1 advected by its vectors.
    added: what the image of known motion has in addition to that motion.
    known: that image less image 1 advected by the vectors from it.
    level: rms of `given` around.
    slopes (axes, ...): of image 1 advected by the vectors of the given pair.
    use: pixels that are known, between valid vectors.
    """

    given: torch.Tensor
    added: torch.Tensor
    known: torch.Tensor
    level: torch.Tensor
    slopes: torch.Tensor
    use: torch.Tensor


class Motion(NamedTuple):
    """The known motion on pixels, and its averages over windows.

    within (axes, ...): the wind less its mean over a window, px.
    response: part of it that vectors lack: 1 if they are means over windows, 0 if they follow it.
    by_errors (axes, ...): the vectors' random errors less their mean over a window, px.
    """

    within: torch.Tensor
    response: float
    by_errors: torch.Tensor


class Unresolved(NamedTuple):
    """Displacement that the vectors lack, and the leverage of the images' differences.

    covariance (axes, axes, *windows.count): of that displacement, px^2.
    leverage: variance of differences of the images over that of their residuals, 1 or more.
    """

    covariance: torch.Tensor
    leverage: float


def unresolved(
    residuals: Residuals,
    motion: Motion,
    windows: Windows,
    valid: torch.Tensor,
    width: float,
    centred: bool,
    fewest: float,
) -> Unresolved:
    """Covariance of the displacement that vectors lack.

    It has two parts. Near the scale of a window it varies as the vectors do: windows are low-pass
    filters, and M is the covariance of the part h (1 - G) d of the displacements d that a second
    window would remove, less that of random errors, over a Gaussian of `width`. Finer motion has
    the same variance everywhere. With the residual r of the given pair, r' that of the known motion
    less the known part, and L the leverage, the mean of

        r^2 - L r'^2 = a s^2 + k (b g M g + c g g),    b >= 1, c >= 0

    gives b M + c 1 by least squares, weighted by the level s^-4. The term a is the part that does
    not vary with the slopes. b >= 1, as the first window has removed what a second would remove. k
    is the visible fraction, see `_visible`.

    windows: of the vectors.
    valid (shape windows.count)
    width: standard deviation of the local means, px.
    centred: whether windows are deformed, see `known_motion.of_windows`.
    fewest: windows that do not overlap from which anything is estimated: of fewer, M and no
        leverage.
    """
    use, slopes = residuals.use, residuals.slopes
    lost = motion.response * motion.within
    total, by_errors = (
        _products(windows.of_centres(part), valid, width / windows.stride)
        for part in (lost, motion.response * motion.by_errors)
    )
    if int(use.sum()) < fewest * windows.template**windows.dims:
        return Unresolved(_without_errors(total, by_errors), 1.0)
    linear, visible = _visible(residuals, motion.within, windows, valid, width, centred)
    weight = residuals.level[use].square().reciprocal()
    # the residual of the known motion contains a part that is known
    known = (residuals.known + linear * (slopes * lost).sum(0))[use].square()
    added = residuals.added[use].square()
    leverage = max(1.0, float((added * weight).sum() / _positive((known * weight).sum())))
    resolved = _without_errors(total, leverage * by_errors)
    same = torch.eye(windows.dims).to(total)
    same = same.reshape(*same.shape, *[1] * windows.dims).expand_as(total)
    square = (residuals.given[use].square() - leverage * known) * weight
    by_motion = [_variance_by_motion(slopes, m, windows)[use] * weight for m in (resolved, same)]
    terms = torch.stack([torch.ones_like(weight), *by_motion])
    b, c = _significant(terms, square, visible) / visible
    return Unresolved(b * resolved + c * same, leverage)


def _significant(terms: torch.Tensor, square: torch.Tensor, visible: float) -> np.ndarray:
    """Factors (2,) of the last two terms by least squares, as far as they are significant.

    The least values, k and 0, increase the sum of squares by F variances, of which 2 are expected
    by chance, as two factors are fitted: the difference from the least values is multiplied by 1 -
    2 / F (Efron & Morris 1973, J. Am. Stat. Assoc. 68, 117-130).
    """
    least = np.array([visible, 0.0])
    fit = _least_squares(terms, square, [-np.inf, *least])
    without = _least_squares(terms[:1], square - visible * terms[1], -np.inf)
    misfits = [
        float((square - torch.as_tensor(factors).to(terms) @ terms).square().sum())
        for factors in (fit, [*without, *least])
    ]
    gain = misfits[1] / max(misfits[0], np.finfo(float).tiny) - 1
    part = max(0.0, 1 - len(least) / max(gain * len(square), 1e-9))
    return least + part * (fit[1:] - least)


def _visible(
    residuals: Residuals,
    within: torch.Tensor,
    windows: Windows,
    valid: torch.Tensor,
    width: float,
    centred: bool,
) -> tuple[float, float]:
    """Fractions of motion finer than windows that show in the residual: of it, of its variance.

    Windows measure g u and follow it by J^-1 <g g u>, J = <g g>, < > being means over the window:
    this differs by chance from the mean <u>. So the residual is less than g u, most where slopes
    are steep. u is the motion within windows, of one local variance everywhere; the fraction of its
    variance is that of the coefficients of g g in the squares of the residual and of g u.
    """
    slopes, use = residuals.slopes, residuals.use
    square = _products(windows.of_centres(within), valid, width / windows.stride)
    level = _on_pixels(_trace(square), windows) / windows.dims
    fine = within / _positive(level).sqrt()
    weight = residuals.level.square().reciprocal() * use
    difference = (slopes * fine).sum(0)
    matrix = of_windows((slopes[:, None] * slopes * weight).flatten(0, 1), windows, centred)
    matrix = matrix.unflatten(0, (windows.dims,) * 2).movedim((0, 1), (-2, -1))
    # windows without texture follow no motion
    least = 1e-3 * matrix.diagonal(dim1=-2, dim2=-1).mean()
    matrix = matrix + _positive(least) * torch.eye(windows.dims).to(matrix)
    means = of_windows(slopes * difference * weight, windows, centred).movedim(0, -1)
    followed = torch.linalg.solve(matrix, means[..., None])[..., 0].movedim(-1, 0)
    followed = followed - of_windows(fine, windows, centred)
    remaining = difference - (slopes * followed).sum(0)
    part = difference[use], remaining[use]
    weight = weight[use]
    linear = float((part[0] * part[1] * weight).sum() / _positive((part[0] ** 2 * weight).sum()))
    steep = slopes.square().sum(0)[use] * weight
    terms = torch.stack([torch.ones_like(steep), steep])
    whole, visible = (_least_squares(terms, p.square() * weight, -np.inf)[1] for p in part)
    if not 0 < visible <= whole:
        return 1.0, 1.0
    return linear, float(visible / whole)


def _products(field: torch.Tensor, valid: torch.Tensor, width: float) -> torch.Tensor:
    """Local means (axes, axes, ...) of the products of a field's components, where valid."""
    rows = [[averaged(a * b, valid, width) for b in field] for a in field]
    return torch.stack([torch.stack(row) for row in rows])


def _without_errors(total: torch.Tensor, by_errors: torch.Tensor) -> torch.Tensor:
    """A covariance times the fraction of its trace that is not due to errors."""
    part = 1 - _trace(by_errors) / _positive(_trace(total))
    return total * part.clamp(min=0.0)


def _variance_by_motion(
    slopes: torch.Tensor, covariance: torch.Tensor, windows: Windows
) -> torch.Tensor:
    """Variance of the images' difference by motion of some covariance at the vectors."""
    return torch.einsum("i...,j...,ij...->...", slopes, slopes, _on_pixels(covariance, windows))


def _on_pixels(field: torch.Tensor, windows: Windows) -> torch.Tensor:
    """Values (..., *windows.count) of windows on pixels, linearly."""
    weights = [
        linear_weights(windows.centres(axis).to(field), torch.arange(n).to(field))
        for axis, n in enumerate(windows.shape)
    ]
    return separable(field, weights)


def _least_squares(
    terms: torch.Tensor, square: torch.Tensor, least: float | list[float]
) -> np.ndarray:
    """Factors of terms (terms, n) whose sum is nearest to squares (n,), none below its least."""
    a, b = (part.double().cpu().numpy() for part in (terms, square))
    size = np.sqrt(np.square(a).mean(1)).clip(np.finfo(float).tiny ** 0.5)
    low = np.broadcast_to(np.asarray(least), size.shape) * size
    return lsq_linear((a / size[:, None]).T, b, (low, np.inf), method="bvls").x / size


def _trace(covariance: torch.Tensor) -> torch.Tensor:
    return covariance.diagonal().sum(-1)


def _positive(value: torch.Tensor) -> torch.Tensor:
    return value.clamp(min=torch.finfo(value.dtype).tiny ** 0.5)
