"""Cramer-Rao bound of the speed from the signals of a receiver's channels."""

import math
from collections.abc import Mapping, Sequence

import torch

from lidar_mi.errors import InputError
from lidar_mi.retrieval.channels.model import (
    PARAMETERS,
    ChannelModel,
    mean_and_jacobian,
    parameter_vector,
    variance,
)
from lidar_mi.retrieval.likelihood.scoring import fisher_matrix, standard_deviations
from lidar_mi.retrieval.rings.model import PixelNoise


def free_indices(
    model: ChannelModel, free: Sequence[str], prior: Mapping[str, float]
) -> tuple[list[int], torch.Tensor]:
    """Places of the free parameters in `PARAMETERS`, and the information of their priors.

    Raises InputError: a name that the model does not have, v_los not among them, more unknowns than
    channels and priors determine, a prior of what is not free.
    """
    for name in (*free, *prior):
        if name not in model.parameters:
            raise InputError(f"free: {name!r} is not one of {', '.join(model.parameters)}")
    if "v_los" not in free:
        raise InputError(f"free: {', '.join(free)} is not allowed; expected v_los among them")
    for name, sigma in prior.items():
        if name not in free or not sigma > 0:
            raise InputError(
                f"prior: {sigma!r} of {name} is not allowed; expected a standard deviation above 0 "
                "of a free parameter"
            )
    channels = len(model.aerosol)
    if len(free) - len(prior) > channels:
        raise InputError(
            f"free: {channels} channels do not determine {', '.join(free)} all together; expected "
            "a prior or fewer"
        )
    indices = [i for i, name in enumerate(PARAMETERS) if name in free]
    known = [prior.get(PARAMETERS[i], math.inf) ** -2 for i in indices]
    return indices, torch.tensor(known, dtype=torch.float64).diag()


def cramer_rao(
    model: ChannelModel,
    level: float,
    noise: PixelNoise | None = None,
    *,
    v_los: float = 0.0,
    temperature: float | None = None,
    aerosol: float = 0.0,
    free: Sequence[str] = ("v_los", "level"),
    prior: Mapping[str, float] | None = None,
) -> dict[str, float]:
    """Smallest standard deviation that an unbiased estimate from one exposure can have.

    The inverse of F = sum over channels of J J^T / variance, plus the inverse variances of what is
    known before.

    Parameters
    ----------
    level : float
        Electrons of the light in front of the receiver.
    noise : PixelNoise
        Poisson alone if not given.
    v_los, temperature, aerosol : float
        Of the exposure; the model's middle temperature if none is given.
    free : names out of `PARAMETERS`
        The unknowns.
    prior : dict of float
        Standard deviations known before, by name of a free parameter.

    Returns
    -------
    dict
        Standard deviation by name of each free parameter.

    Raises
    ------
    InputError
        Numbers out of range, or channels that do not determine the free parameters.
    """
    indices, known = free_indices(model, free, prior or {})
    vector = parameter_vector(model, v_los, level, temperature, aerosol)
    mean, jacobian = mean_and_jacobian(model, vector)
    weight = 1 / variance(model, noise or PixelNoise(), mean)
    bounds = standard_deviations(fisher_matrix(jacobian, weight, indices) + known)[0]
    if not torch.isfinite(bounds).all():
        raise InputError(f"free: the channels do not determine {', '.join(free)} all together")
    return {PARAMETERS[i]: float(value) for i, value in zip(indices, bounds, strict=True)}
