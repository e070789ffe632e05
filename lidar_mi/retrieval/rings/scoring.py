"""Scoring of images of rings: the maximum of their likelihood, many images at once."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch

from lidar_mi.retrieval.likelihood.scoring import Fits, Limits, fisher_matrix, scoring
from lidar_mi.retrieval.rings.bound import prior_information
from lidar_mi.retrieval.rings.mean_image import Waves, mean_and_jacobian, reach
from lidar_mi.retrieval.rings.model import PARAMETERS, PixelNoise, RingModel

ITERATIONS = 40
CLOSE = 1e-3  # standard deviations, largest last step of a fit that has converged
# Cells beyond so many standard deviations hold hot pixels or dust and are masked, unless more
# than this fraction is: then the model is wrong, and chi-square shall say so.
OUTLIER, MOST_OUTLIERS = 5.0, 0.03
_FEWEST = "two rings or more as in the model"
POOR = 1.2  # chi-square of a fit that something is wrong with


class Scored(NamedTuple):
    """Where the scoring ended."""

    parameters: torch.Tensor
    fisher: torch.Tensor
    chi_square: torch.Tensor
    freedom: int
    outliers: torch.Tensor
    used: list[torch.Tensor]


def robust_scoring(
    blocks: Sequence[Waves],
    means: Sequence[torch.Tensor],
    parameters: torch.Tensor,
    model: RingModel,
    noise: PixelNoise,
    names: Sequence[str],
    number: int,
) -> Scored:
    """Fisher scoring, again without cells that are far outside the noise."""
    used = [torch.ones_like(part, dtype=torch.bool) for part in means]
    for _ in range(4):
        end = _scoring(blocks, means, used, parameters, model, noise, names, number)
        inside = [
            _residual(waves, part, end.parameters, model, noise).abs() <= OUTLIER
            for waves, part in zip(blocks, means, strict=True)
        ]
        number_of = sum(part.shape[1] for part in inside)
        outside = torch.stack([(~part).sum(1) for part in inside]).sum(0)
        fraction = outside / number_of
        # in an image with too many outliers none is masked
        few = (fraction <= MOST_OUTLIERS)[:, None]
        inside = [part | ~few for part in inside]
        if all(torch.equal(a, b) for a, b in zip(inside, used, strict=True)):
            break
        used, parameters = inside, end.parameters
    # where the remaining cells do not fit either, the model is wrong: none is masked
    wrong = (end.chi_square > POOR) & (end.outliers > 0)
    if wrong.any():
        used = [part | wrong[:, None] for part in end.used]
        end = _scoring(blocks, means, used, end.parameters, model, noise, names, number)
    return end


def cell_variance(
    mean: torch.Tensor,
    parameters: torch.Tensor,
    noise: PixelNoise,
    floor: torch.Tensor | None = None,
) -> torch.Tensor:
    """Variance of a pixel in every cell, (images, cells), from its mean, not below ``floor``.

    The floor is 0.001 of an image's mean if not given.
    """
    background = parameters[:, PARAMETERS.index("background"), None]
    floor = 1e-3 * mean.mean(1, keepdim=True) if floor is None else floor
    mean = torch.maximum(mean, floor)
    return noise.variance(mean, (mean - background).clamp(min=0))


def _residual(
    waves: Waves, means: torch.Tensor, parameters: torch.Tensor, model: RingModel, noise: PixelNoise
) -> torch.Tensor:
    """Misfit of every cell in standard deviations."""
    mean = mean_and_jacobian(model, waves, parameters)[0]
    variance = cell_variance(mean, parameters, noise, 1e-3 * means.mean(1, keepdim=True))
    return (means - mean) * (waves.cells.count / variance).sqrt()


def _scoring(
    blocks: Sequence[Waves],
    means: Sequence[torch.Tensor],
    used: list[torch.Tensor],
    parameters: torch.Tensor,
    model: RingModel,
    noise: PixelNoise,
    names: Sequence[str],
    number: int,
) -> Scored:
    fits = Fits("images", number, ("rings that the model describes", _FEWEST))
    columns = [PARAMETERS.index(name) for name in names]
    parameters = parameters.clone()
    # a background that is not fitted is 0, and the level takes its part of the light
    if "background" not in names:
        place, level = PARAMETERS.index("background"), PARAMETERS.index("level")
        parameters[:, level] += parameters[:, place]
        parameters[:, place] = 0
    longest = _step_limits(model, names, parameters.device)
    information = prior_information(model, names, parameters.device)
    middle = model.start(parameters.device)[:, columns]
    # between rings a mean near 0 would give single cells nearly all of the weight
    floor = 1e-3 * means[0].mean(1, keepdim=True)

    def expanded(parameters: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        fisher = torch.diag(information).repeat(len(parameters), 1, 1)
        score = information * (middle - parameters[:, columns])
        chi_square = torch.zeros_like(score[:, 0])
        for waves, part, use in zip(blocks, means, used, strict=True):
            mean, jacobian = mean_and_jacobian(model, waves, parameters, names)
            variance = cell_variance(mean, parameters, noise, floor)
            weight = use * waves.cells.count / variance
            fisher = fisher + fisher_matrix(jacobian, weight)
            score = score + (jacobian @ (weight * (part - mean))[:, :, None])[:, :, 0]
            chi_square = chi_square + (weight * (part - mean) ** 2).sum(1)
        return fisher, score, chi_square

    def advanced(parameters: torch.Tensor, step: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        parameters = parameters.clone()
        parameters[:, columns] += step
        if "temperature" in names:
            place = PARAMETERS.index("temperature")
            parameters[:, place] = parameters[:, place].clamp(*model.temperatures[[0, -1]])
        # beyond, the waves are not exact: the cells move first
        near, ended = 3 * reach(model), torch.zeros_like(step[:, 0], dtype=torch.bool)
        for name in ("x", "y"):
            place = PARAMETERS.index(name)
            far = parameters[:, place].abs() > near
            parameters[:, place] = parameters[:, place].clamp(-near, near)
            ended |= far & (step.abs() <= 0.1 * longest).all(1)
        return parameters, ended

    end, fisher, chi_square = scoring(
        expanded, advanced, parameters, Limits(longest, CLOSE, ITERATIONS), fits
    )
    freedom = sum(part.shape[1] for part in means) - len(names)
    lost = torch.stack([(~use).sum(1) for use in used]).sum(0)
    outliers = lost / (freedom + len(names))
    return Scored(end, fisher, chi_square / (freedom - lost), freedom, outliers, used)


def _step_limits(model: RingModel, names: Sequence[str], device: torch.device) -> torch.Tensor:
    """Longest steps: one longer than the rings are wide would leave the linear range."""
    widths = {
        "v_los": model.velocity_range / 16,
        "x": 0.04 * math.sqrt(model.order_spacing),
        "y": 0.04 * math.sqrt(model.order_spacing),
        "temperature": 20.0,
        "falloff": 0.3,
        "aerosol": 0.1,
    }
    return torch.tensor([widths.get(name, math.inf) for name in names], device=device).double()
