"""Speeds from many images of one instrument, fast: by the score function of a reference.

A fit ends where the score J^T W (d - m) of the data d is 0, with the derivatives J of the mean m
and the weights W at the fitted parameters. Here J and W are those of a reference, once for all
images; only m is that of every image. The end of such a fit is consistent for any J and W (the
estimating equations of Godambe, Ann. Math. Stat. 31, 1960), and as accurate as the fit's where the
reference is near: rings that move by a tenth of their width lose 1 % of the information.
"""

import math
from dataclasses import dataclass, replace
from functools import cached_property

import torch

from lidar_mi.errors import InputError
from lidar_mi.retrieval.likelihood.scoring import fisher_matrix
from lidar_mi.retrieval.rings.bound import free_names, prior_information
from lidar_mi.retrieval.rings.likelihood_fit import MISFIT, RingFit, annular_waves
from lidar_mi.retrieval.rings.mean_image import Waves, mean_and_jacobian, reach
from lidar_mi.retrieval.rings.model import PARAMETERS, PixelNoise, RingModel
from lidar_mi.retrieval.rings.scoring import cell_variance
from lidar_mi.retrieval.threads import threads_for

ITERATIONS = 8
# Standard deviations, largest last step of an image that is read: a further one would be a seventh
# of it or less, of the speed a thirtieth.
CLOSE = 0.4
# Images whose parameters are found together: what they need is near the cache.
_AT_ONCE = 64
# Parameters whose derivatives do not grow with the light.
_ADDED = ("level", "background")
_PLACE = [PARAMETERS.index("x"), PARAMETERS.index("y")]
_LEVEL = PARAMETERS.index("level")


@dataclass(frozen=True, eq=False)
class MatchedScore:
    """The score function of a reference.

    names: parameters that are fitted.
    waves, single: of the cells about the reference's centre, and the same in single precision.
    values (`PARAMETERS`,): of the reference; x and y from the top left pixel's centre.
    mean, dark (cells,): of the reference, and of the same without its light.
    score (names, cells): J^T W.
    inverse (names, names): of the Fisher matrix with the priors.
    sensitivity, systematic: as of `RingFit`, of one image.
    """

    model: RingModel
    noise: PixelNoise
    names: list[str]
    waves: Waves
    single: Waves
    values: torch.Tensor
    mean: torch.Tensor
    dark: torch.Tensor
    score: torch.Tensor
    inverse: torch.Tensor
    sensitivity: torch.Tensor
    systematic: torch.Tensor

    @cached_property
    def influence(self) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Of the cells' means on the parameters (names, cells), single precision; its squares.

        And the variance (names,) by the priors.
        """
        whole = self.inverse @ self.score
        by_priors = self.inverse**2 @ prior_information(self.model, self.names, whole.device)
        return whole.float(), (whole**2).float(), by_priors


@dataclass(frozen=True, eq=False)
class MatchedRead:
    """Retrieved values, tensors of shape (images,) unless stated, float64.

    values, std (images, `PARAMETERS`): as of `RingFit`; infinite standard deviations where ``read``
        is false.
    read: false where an image does not follow the model near the reference: fit it on its own.
    sensitivity, systematic: as of `RingFit`.
    """

    values: torch.Tensor
    std: torch.Tensor
    chi_square: torch.Tensor
    read: torch.Tensor
    sensitivity: torch.Tensor
    systematic: torch.Tensor

    def of(self, which: torch.Tensor) -> "MatchedRead":
        """Some of the images, in any order."""
        each = ("values", "std", "chi_square", "read", "sensitivity")
        return replace(self, **{name: getattr(self, name)[which] for name in each})

    @property
    def v_los(self) -> torch.Tensor:
        """Speed along the line of sight, m/s, positive toward the instrument."""
        return self.values[:, PARAMETERS.index("v_los")]

    @property
    def v_los_std(self) -> torch.Tensor:
        """Random standard deviation of v_los, m/s."""
        return self.std[:, PARAMETERS.index("v_los")]


def matched_score(
    fit: RingFit,
    model: RingModel,
    noise: PixelNoise | None = None,
    *,
    free: list[str] | None = None,
    response: torch.Tensor | None = None,
) -> MatchedScore:
    """The score function at the mean of fitted images.

    fit: by `fit_rings` with the same ``model``, ``noise``, ``free`` and ``response``.
    """
    noise, names = noise or PixelNoise(), free_names(model, free)
    values = fit.values.mean(0)
    centre = float(values[_PLACE[0]]), float(values[_PLACE[1]])
    waves = annular_waves(model, centre, response, fit.values.device)
    at = values[None].clone()
    at[:, _PLACE] = 0
    mean, jacobian = mean_and_jacobian(model, waves, at, names)
    weight = waves.cells.count / cell_variance(mean, at, noise)
    fisher = fisher_matrix(jacobian, weight)[0]
    fisher = fisher + torch.diag(prior_information(model, names, at.device))
    unit = fisher.diagonal().rsqrt()
    inverse = torch.linalg.inv(fisher * unit[:, None] * unit) * unit[:, None] * unit
    unlit = at.clone()
    unlit[:, _LEVEL] = 0
    dark = mean_and_jacobian(model, waves, unlit)[0][0]
    return MatchedScore(
        model,
        noise,
        names,
        waves,
        _in_single(waves),
        values,
        mean[0],
        dark,
        jacobian[0] * weight,
        inverse,
        fit.sensitivity.mean(0),
        fit.systematic,
    )


def read_matched(images: torch.Tensor, score: MatchedScore) -> MatchedRead:
    """Speeds and all other parameters of images near a reference.

    Frames are summed up over the cells once, which takes most of the time. Unlike in `fit_rings`
    they are not searched for hot pixels or saturated crests: an image with some is not ``read``
    where chi-square is too large. Images (images, height, width) are in electrons.

    Raises InputError: images of another size.
    """
    if images.ndim != 3 or tuple(images.shape[1:]) != tuple(score.model.shape):
        height, width = score.model.shape
        raise InputError(
            f"images: shape {tuple(images.shape)} is not allowed; expected (images, {height}, "
            f"{width}), as of the model"
        )
    with threads_for(0):
        means = score.waves.cells.means(images)
        parts = [_read(part, score) for part in means.split(_AT_ONCE)]
    at, std, chi_square, close = (torch.cat(part) for part in zip(*parts, strict=True))
    columns = _columns(score)
    freedom = means.shape[1] - len(columns)
    values = at.clone()
    values[:, _PLACE] += score.values[_PLACE]
    read = close & (chi_square <= 1 + MISFIT * math.sqrt(2 / freedom))
    read &= at[:, _PLACE].norm(dim=1) <= reach(score.model)
    spread = torch.zeros_like(values)
    spread[:, columns] = std
    spread[~read] = math.inf
    each = score.sensitivity.expand(len(values), -1)
    return MatchedRead(values, spread, chi_square, read, each, score.systematic)


def _read(means: torch.Tensor, score: MatchedScore) -> tuple[torch.Tensor, ...]:
    """Parameters of some images from the cells' centre, errors, chi-square, and convergence.

    From means (images, cells) to (images, `PARAMETERS`), (images, names), (images,) and whether the
    last step was small, (images,). Images whose last step was small are finished.
    """
    model, names, columns = score.model, score.names, _columns(score)
    at, mean = _started(score, means)
    information = prior_information(model, names, means.device)
    middle = model.start(means.device)[:, columns]
    added = torch.tensor([name in _ADDED for name in names], device=means.device)
    influence, squares, by_priors = score.influence
    freedom = means.shape[1] - len(names)
    std, chi_square = at.new_zeros(len(at), len(names)), at.new_zeros(len(at))
    far = torch.arange(len(at), device=at.device)
    for number in range(ITERATIONS):
        current = at[far]
        if number:
            mean = mean_and_jacobian(model, score.single, current.float())[0]
        misfit = (means[far] - mean).float()
        variance = (
            cell_variance(mean.float(), current.float(), score.noise) / score.single.cells.count
        )
        brighter = (current[:, _LEVEL] / score.values[_LEVEL]).clamp(0.1, 10)[:, None]
        grown = torch.where(added, 1.0, brighter)
        std[far] = ((variance @ squares.T).double() + by_priors).sqrt() / grown
        chi_square[far] = (misfit**2 / variance).sum(1).double() / freedom
        total = (misfit @ influence.T).double()
        total += (middle - current[:, columns]) * information @ score.inverse
        step = total / grown
        current[:, columns] += step
        at[far] = current
        far = far[(step.abs() > CLOSE * std[far]).any(1)]
        if not len(far):
            break
    close = torch.ones(len(at), dtype=torch.bool, device=at.device)
    close[far] = False
    return at, std, chi_square, close


def _columns(score: MatchedScore) -> list[int]:
    return [PARAMETERS.index(name) for name in score.names]


def _started(score: MatchedScore, means: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """The reference with the light of every image, and its mean; x and y from the cells' centre."""
    at = score.values.repeat(len(means), 1)
    at[:, _PLACE] = 0
    count = score.waves.cells.count
    signal = score.mean - score.dark
    brighter = (((means - score.dark) @ count) / (signal @ count)).clamp(0.1, 10)
    at[:, _LEVEL] *= brighter
    return at, score.dark + brighter[:, None] * signal


def _in_single(waves: Waves) -> Waves:
    """Waves in single precision: half of the time, 0.005 standard errors of a bright frame off."""
    cells = waves.cells
    spread = None if cells.spread is None else cells.spread.float()
    cells = replace(
        cells,
        count=cells.count.float(),
        x=cells.x.float(),
        y=cells.y.float(),
        r2=cells.r2.float(),
        spread=spread,
        terms=cells.terms.float(),
    )
    return Waves(cells, *(part.float() for part in waves[1:]))
