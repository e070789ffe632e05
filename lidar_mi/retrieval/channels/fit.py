"""Line-of-sight speed from the signals of a receiver's channels: maximum likelihood.

For the elements of a fringe detector this is the fit of level and phase of a fringe, with
``aerosol`` or ``temperature`` free of its contrast, too. For two filters it is the speed at which
the ratio of their signals is the one measured.
"""

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import torch

from lidar_mi.errors import InputError
from lidar_mi.retrieval.channels.bound import free_indices
from lidar_mi.retrieval.channels.model import (
    ChannelModel,
    mean_and_jacobian,
    parameter_vector,
    variance,
)
from lidar_mi.retrieval.likelihood.scoring import (
    Fits,
    Limits,
    fisher_matrix,
    scoring,
    standard_deviations,
)
from lidar_mi.retrieval.rings.model import PixelNoise

ITERATIONS = 60
CLOSE = 1e-4  # standard deviations, largest last step of a fit that has converged
STARTS = 16  # speeds tried for each harmonic of the transmission
SIGNIFICANT = 5.0  # standard deviations, the least signal


class ChannelFit(NamedTuple):
    """Retrieved values, tensors of shape (images,), float64.

    v_los, v_los_std: m/s, positive toward the instrument; the standard deviation from the Fisher
        matrix, with all other free parameters unknown.
    level: electrons of the light in front of the receiver.
    temperature, aerosol: K and a fraction; where they are free. A fraction near 0 may come out
        below it.
    std (images, 4): standard deviations of all `PARAMETERS`; 0 where one was not free.
    chi_square: squared misfit over its expectation, 1 where model and noise are right; NaN where
        there are no more channels than unknowns.
    """

    v_los: torch.Tensor
    v_los_std: torch.Tensor
    level: torch.Tensor
    temperature: torch.Tensor
    aerosol: torch.Tensor
    std: torch.Tensor
    chi_square: torch.Tensor


def fit_channels(
    counts: torch.Tensor,
    model: ChannelModel,
    noise: PixelNoise | None = None,
    *,
    free: Sequence[str] = ("v_los", "level"),
    temperature: float | None = None,
    aerosol: float = 0.0,
    prior: Mapping[str, float] | None = None,
    max_chi_square: float = 2.0,
) -> ChannelFit:
    """v_LOS and its standard deviation from every exposure on its own.

    Parameters
    ----------
    counts : torch.Tensor, shape (images, channels) or (channels,)
        Electrons, background included.
    noise : PixelNoise
        Poisson alone if not given.
    free : names out of `lidar_mi.retrieval.channels.model.PARAMETERS`
        Fitted parameters.
    temperature, aerosol : float
        Values of those that are not free, and of their priors.
    prior : dict of float
        Standard deviations known before, by name of a free parameter.
    max_chi_square : float
        Exposures that fit worse are refused, once it is also 5 standard deviations from 1.

    Raises
    ------
    InputError
        Shapes, names or numbers that are not allowed; an exposure that is not finite, without
        signal, or that the model does not describe between its limits.
    """
    prior = dict(prior or {})
    noise = noise or PixelNoise()
    indices, known = free_indices(model, free, prior)
    counts = _checked(counts, model)
    expected = parameter_vector(model, 0.0, 1.0, temperature, aerosol)
    parameters = _start(model, counts, noise, expected)
    parameters, fisher, squares = _scoring(
        model, counts, parameters, noise, indices, known, expected
    )
    std = torch.zeros_like(parameters)
    std[:, indices] = standard_deviations(fisher)
    freedom = counts.shape[1] - len(indices) + len(prior)
    chi_square = torch.full_like(parameters[:, 0], math.nan)
    if freedom > 0:
        off = (parameters - expected)[:, indices]
        chi_square = (squares + ((off @ known) * off).sum(1)) / freedom
        worst = max(max_chi_square, 1 + SIGNIFICANT * math.sqrt(2 / freedom))
        for k, misfit in enumerate(chi_square.tolist()):
            if not misfit <= worst:
                raise InputError(
                    f"counts[{k}]: chi-square {misfit:.3g} is not allowed; expected at most "
                    f"{worst:.3g}: line, receiver or noise are not the model's"
                )
    v, level, warm, dusty = parameters.unbind(1)
    return ChannelFit(v, std[:, 0], level, warm, dusty, std, chi_square)


def _checked(counts: torch.Tensor, model: ChannelModel) -> torch.Tensor:
    counts = torch.as_tensor(counts).double()
    counts = counts[None] if counts.ndim == 1 else counts
    if counts.ndim != 2 or counts.shape[1] != len(model.aerosol) or not len(counts):
        raise InputError(
            f"counts: shape {tuple(counts.shape)} is not allowed; expected (images, "
            f"{len(model.aerosol)})"
        )
    if not torch.isfinite(counts).all():
        bad = int((~torch.isfinite(counts)).any(1).nonzero()[0])
        raise InputError(f"counts[{bad}]: NaN or infinity is not allowed; expected electrons")
    return counts


def _start(
    model: ChannelModel, counts: torch.Tensor, noise: PixelNoise, expected: torch.Tensor
) -> torch.Tensor:
    """The best of evenly spaced speeds, each with its own level."""
    number = STARTS * model.aerosol.shape[1]
    low, high = model.span
    tried = expected.repeat(number, 1)
    tried[:, 0] = low + (high - low) * (torch.arange(number) + 0.5) / number
    shape = mean_and_jacobian(model, tried)[1][:, 1]  # by the level
    signal = counts - model.background
    floor = model.background + 1e-3 * signal.mean(1, keepdim=True).clamp(min=0) + 1
    weight = 1 / variance(model, noise, torch.maximum(counts, floor))
    norm = weight @ (shape**2).T
    level = (weight * signal) @ shape.T / norm
    best = (level * ((weight * signal) @ shape.T)).argmax(1)
    best_level = level.gather(1, best[:, None])[:, 0]
    significant = best_level * norm.gather(1, best[:, None])[:, 0].sqrt()
    for k in range(len(counts)):
        if not significant[k] > SIGNIFICANT:
            raise InputError(
                f"counts[{k}]: no signal ({float(significant[k]):.2g} standard deviations); "
                f"expected more than {SIGNIFICANT:g}"
            )
    parameters = tried[best]
    parameters[:, 1] = best_level
    return parameters


def _scoring(
    model: ChannelModel,
    counts: torch.Tensor,
    parameters: torch.Tensor,
    noise: PixelNoise,
    indices: list[int],
    known: torch.Tensor,
    expected: torch.Tensor,
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Parameters, Fisher matrices and squared misfits of the most probable parameters."""
    low, high = model.span
    # a step of more than a radian of the highest harmonic leaves the linear range
    longest = torch.full_like(parameters[0], math.inf)
    longest[0] = model.period / (2 * math.pi * (model.aerosol.shape[1] - 1))
    longest[2], longest[3] = 20.0, 0.2
    longest = longest[indices]
    floor = model.background + 1e-6 * parameters[:, 1, None]

    def expanded(parameters: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        mean, jacobian = mean_and_jacobian(model, parameters)
        spread = variance(model, noise, torch.maximum(mean, floor))
        fisher = fisher_matrix(jacobian, 1 / spread, indices) + known
        score = (jacobian[:, indices] @ ((counts - mean) / spread)[:, :, None])[:, :, 0]
        misfit = ((counts - mean) ** 2 / spread).sum(1)
        return fisher, score - (parameters - expected)[:, indices] @ known, misfit

    def advanced(parameters: torch.Tensor, step: torch.Tensor) -> tuple[torch.Tensor, None]:
        parameters = parameters.clone()
        parameters[:, indices] += step
        parameters[:, 0] = parameters[:, 0].clamp(low, high)
        parameters[:, 1] = parameters[:, 1].clamp(min=1e-9)
        if len(model.temperatures) > 1:
            first, last = model.temperatures[[0, -1]]
            parameters[:, 2] = parameters[:, 2].clamp(first, last)
        return parameters, None

    speeds = f"a speed between {low:.4g} and {high:.4g} m/s and signals as in the model"
    fits = Fits("counts", 0, ("signals of the model", speeds))
    return scoring(expanded, advanced, parameters, Limits(longest, CLOSE, ITERATIONS), fits)
