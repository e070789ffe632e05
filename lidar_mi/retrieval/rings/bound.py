"""Cramer-Rao bound of the parameters of an image of rings, from its model's Fisher matrix."""

from collections.abc import Sequence

import torch

from lidar_mi.errors import InputError
from lidar_mi.retrieval.likelihood.scoring import fisher_matrix, standard_deviations
from lidar_mi.retrieval.rings.mean_image import mean_and_jacobian, parameter_vector, pixel_waves
from lidar_mi.retrieval.rings.model import PARAMETERS, PixelNoise, RingModel


def prior_information(
    model: RingModel, names: Sequence[str], device: str | torch.device = "cpu"
) -> torch.Tensor:
    """1 / variance of the model's priors on these parameters; 0 where it has none."""
    variances = [model.priors[name][1] ** -2 if name in model.priors else 0.0 for name in names]
    return torch.tensor(variances, dtype=torch.float64, device=device)


def free_names(model: RingModel, free: Sequence[str] | None) -> list[str]:
    """The named parameters in the order of `PARAMETERS`; all that the model has if None.

    Raises InputError: a name that the model does not have, or v_los not among them.
    """
    names = model.parameters if free is None else tuple(free)
    for name in names:
        if name not in model.parameters:
            raise InputError(f"free: {name!r} is not one of {', '.join(model.parameters)}")
    if "v_los" not in names:
        raise InputError(f"free: {', '.join(names)} is not allowed; expected v_los among them")
    return [name for name in PARAMETERS if name in names]


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
    of the mean by all free parameters, of which no more is known than the model's priors say (van
    Trees 1968, Detection, Estimation, and Modulation Theory, section 2.4). Exact for Poisson noise
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
    return cramer_rao_of(
        model,
        photons,
        noise,
        [free],
        v_los=v_los,
        background=background,
        centre=centre,
        temperature=temperature,
    )[0]


def cramer_rao_of(
    model: RingModel,
    photons: float,
    noise: PixelNoise | None,
    choices: Sequence[Sequence[str] | None],
    *,
    v_los: float = 0.0,
    background: float = 0.0,
    centre: tuple[float, float] | None = None,
    temperature: float | None = None,
) -> list[dict[str, float]]:
    """`cramer_rao` for several choices of the free parameters, in the time of one."""
    chosen = [free_names(model, free) for free in choices]
    names = [name for name in PARAMETERS if any(name in free for free in chosen)]
    vector = parameter_vector(model, v_los, photons, background, centre, temperature)
    fisher = torch.diag(prior_information(model, names))[None]
    for waves in pixel_waves(model, centre):
        mean, jacobian = mean_and_jacobian(model, waves, vector, names)
        variance = (noise or PixelNoise()).variance(mean, mean - background)
        fisher = fisher + fisher_matrix(jacobian, 1 / variance)
    bounds = []
    for free in chosen:
        places = torch.tensor([names.index(name) for name in free])
        bound = standard_deviations(fisher[:, places][:, :, places])[0]
        if not torch.isfinite(bound).all():
            raise InputError(f"free: the image does not determine {', '.join(free)} all together")
        bounds.append({name: float(value) for name, value in zip(free, bound, strict=True)})
    return bounds
