"""Cramer-Rao bound of what an image of rings tells, from its model's Fisher matrix."""

from collections.abc import Sequence

import torch

from lidar_mi.errors import InputError
from lidar_mi.retrieval.rings.cells import pixels
from lidar_mi.retrieval.rings.model import (
    PARAMETERS,
    PixelNoise,
    RingModel,
    mean_and_jacobian,
    parameter_vector,
)


def fisher_matrix(
    jacobian: torch.Tensor, weight: torch.Tensor, free: Sequence[int]
) -> torch.Tensor:
    """sum_i w_i J_i J_i^T over the free parameters, shape (images, free, free)."""
    part = jacobian[:, list(free)]
    return (part * weight[:, None]) @ part.transpose(1, 2)


def standard_deviations(fisher: torch.Tensor) -> torch.Tensor:
    """Roots of the diagonal of the inverse, NaN where there is none, shape (images, free)."""
    scale = fisher.diagonal(dim1=1, dim2=2).rsqrt()
    inverse, info = torch.linalg.inv_ex(fisher * scale[:, :, None] * scale[:, None, :])
    found = inverse.diagonal(dim1=1, dim2=2).sqrt() * scale
    return torch.where(info[:, None] == 0, found, torch.nan)


def free_indices(model: RingModel, free: Sequence[str] | None) -> list[int]:
    """Places of the named parameters in `PARAMETERS`; of all that the model has if None.

    Raises
    ------
    InputError
        A name that the model does not have, or v_los not among them.
    """
    names = model.parameters if free is None else tuple(free)
    for name in names:
        if name not in model.parameters:
            raise InputError(f"free: {name!r} is not one of {', '.join(model.parameters)}")
    if "v_los" not in names:
        raise InputError(f"free: {', '.join(names)} is not allowed; expected v_los among them")
    return [i for i, name in enumerate(PARAMETERS) if name in names]


def cramer_rao(
    model: RingModel,
    photons: float,
    noise: PixelNoise | None = None,
    *,
    v_los: float = 0.0,
    background: float = 0.0,
    centre: tuple[float, float] | None = None,
    temperature: float | None = None,
    free: Sequence[str] | None = None,
) -> dict[str, float]:
    """Smallest standard deviation that an unbiased estimate from one image can have.

    The inverse of the Fisher matrix F = sum over pixels of J J^T / variance, J the derivatives
    of the mean by all free parameters, none of which is known. Exact for Poisson noise
    and Poisson with speckle; with read noise up to 2 % above the exact bound, see
    `PixelNoise.variance`.

    Parameters
    ----------
    photons : float
        Detected, in the whole image.
    noise : PixelNoise
        Poisson alone if not given.
    v_los, background, centre, temperature
        Parameters of the image; see `expected`. The centre may lie outside the image.
    free : names out of `PARAMETERS`, optional
        The unknown parameters; all that the model has if not given.

    Returns
    -------
    dict
        Standard deviation by name of each free parameter: m/s, px, electrons per pixel, K.

    Raises
    ------
    InputError
        Numbers out of range, or an image that does not determine the free parameters.
    """
    indices = free_indices(model, free)
    cells = pixels(model.shape, centre or model.centre)
    vector = parameter_vector(model, cells, v_los, photons, background, temperature)
    mean, jacobian = mean_and_jacobian(model, cells, vector)
    variance = (noise or PixelNoise()).variance(mean, mean - background)
    found = standard_deviations(fisher_matrix(jacobian, 1 / variance, indices))[0]
    if not torch.isfinite(found).all():
        names = ", ".join(PARAMETERS[i] for i in indices)
        raise InputError(f"free: the image does not determine {names} all together")
    return {PARAMETERS[i]: float(value) for i, value in zip(indices, found, strict=True)}
