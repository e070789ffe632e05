"""Line-of-sight wind from all rings of an image at once: maximum likelihood, many images per call.

Every parameter of `lidar_mi.retrieval.rings.model` that is not known is fitted along: the rings'
centre, the level of the light, its fall-off, the background and the air's temperature. Two ways,
one fit:

annular  images are first averaged over sectors of annuli of equal steps in r^2: a hundred
         times fewer numbers, 0.3 % of the information lost
pixels   every pixel takes part (2-D fit), from where the annular fit ended

Images are in electrons, so that their noise follows from their mean.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch

from lidar_mi.errors import InputError
from lidar_mi.retrieval.rings.bound import fisher_matrix, free_indices, standard_deviations
from lidar_mi.retrieval.rings.cells import annular_sectors, pixels
from lidar_mi.retrieval.rings.centre import gradient_centre
from lidar_mi.retrieval.rings.frames import checked, inside
from lidar_mi.retrieval.rings.model import (
    PARAMETERS,
    PixelNoise,
    RingModel,
    illumination,
    mean_and_jacobian,
    orders,
    squared_radius,
)

METHODS = ("annular", "pixels")

# Annuli per order of interference, for each significant harmonic: pi^2 / 3 / 16^2 = 1.3 % of the
# information of the highest is lost.
STEPS_PER_HARMONIC = 16
SECTORS = 16
REACH = 0.025  # of the first ring's size, largest distance of a centre from the sectors' own
ITERATIONS = 40
CLOSE = 1e-3  # standard deviations, largest last step of a fit that has converged
CHUNK_BYTES = 256e6
SIGNIFICANT = 5.0  # standard deviations, the least amplitude of rings


class RingFit(NamedTuple):
    """Retrieved values, tensors of shape (images,), float64.

    Attributes
    ----------
    v_los, v_los_std : torch.Tensor
        m/s, positive toward the instrument; the standard deviation from the Fisher matrix, with
        all other free parameters unknown.
    x, y : torch.Tensor
        Centre of the rings, pixels to the right and down from the top left pixel's centre.
    level, background : torch.Tensor
        Electrons per pixel.
    temperature : torch.Tensor
        K; NaN where the model has none.
    falloff : torch.Tensor
    std : torch.Tensor, shape (images, 7)
        Standard deviations of all `PARAMETERS`; 0 where one was not free.
    chi_square : torch.Tensor
        Squared misfit over its expectation: 1 where model and noise are right.
    rings : torch.Tensor
        Rings that were detected.
    """

    v_los: torch.Tensor
    v_los_std: torch.Tensor
    x: torch.Tensor
    y: torch.Tensor
    level: torch.Tensor
    background: torch.Tensor
    temperature: torch.Tensor
    falloff: torch.Tensor
    std: torch.Tensor
    chi_square: torch.Tensor
    rings: torch.Tensor


def fit_rings(
    images: torch.Tensor,
    model: RingModel,
    noise: PixelNoise | None = None,
    *,
    method: str = "annular",
    centre: tuple[float, float] | None = None,
    free: Sequence[str] | None = None,
    saturation: float | None = None,
    max_chi_square: float = 2.0,
) -> RingFit:
    """v_LOS and its standard deviation from every image on its own.

    Unambiguous over `RingModel.velocity_range` about 0, +-970 m/s for the default instrument: the
    first harmonic of the image over the order gives the start.

    Parameters
    ----------
    images : torch.Tensor, shape (images, height, width) or (height, width)
        Electrons (background and read noise included, offset taken off).
    model : RingModel
    noise : PixelNoise
        Poisson alone if not given.
    method : {"annular", "pixels"}
    centre : (float, float), optional
        (x, y) of the rings, pixels: where the fit starts, and where it stays if x and y are not
        free. Found from the images' gradients if not given.
    free : names out of `lidar_mi.retrieval.rings.model.PARAMETERS`, optional
        Fitted parameters; all that the model has if not given. The others stay at the model's
        values, the background at 0.
    saturation : float, optional
        Electrons from which a pixel is saturated. Images that end in a plateau are refused even
        if it is not given.
    max_chi_square : float
        Images that fit worse are refused; infinite accepts all. The default detects a wrong line
        or noise, not a small error: the standard deviation of chi_square is
        (2 / cells)^(1/2) = 1 to 2 %.

    Returns
    -------
    RingFit

    Raises
    ------
    InputError
        Sizes, method or names that are not allowed; an image that is not finite or saturated,
        has fewer than two rings or its centre outside, or does not fit the model.
    """
    if method not in METHODS:
        raise InputError(f"method: {method!r} is not one of {', '.join(METHODS)}")
    if not max_chi_square > 0:
        raise InputError(f"max_chi_square: {max_chi_square!r} is not allowed; expected above 0")
    images = checked(images, saturation)
    if tuple(images.shape[-2:]) != tuple(model.shape):
        sizes = " and ".join(f"{h} x {w}" for h, w in (images.shape[-2:], model.shape))
        raise InputError(f"images: sizes {sizes} px (height x width) of image and model differ")
    indices = free_indices(model, free)
    if centre is not None:
        inside(*centre, model.shape, "centre")
    elif not {"x", "y"} <= {PARAMETERS[i] for i in indices}:
        centre = model.centre
    task = _Task(model, noise or PixelNoise(), indices, max_chi_square, centre)
    size = _chunk(model, method)
    parts = [_fit(images[k : k + size], task, k, method) for k in range(0, len(images), size)]
    return RingFit(*(torch.cat(values) for values in zip(*parts, strict=True)))


def difference(received: RingFit, emitted: RingFit) -> tuple[torch.Tensor, torch.Tensor]:
    """v_LOS and its standard deviation between received images and those of the laser itself.

    An error of the order at the centre, by a drift of etalon or laser, cancels.
    """
    std = torch.hypot(received.v_los_std, emitted.v_los_std)
    return received.v_los - emitted.v_los, std


def _chunk(model: RingModel, method: str) -> int:
    """Images at once: about 250 bytes per cell for Jacobian and waves."""
    cells = math.prod(model.shape)
    if method == "annular":
        cells = min(cells, _steps(model) * SECTORS * (1 + cells // model.order_spacing))
    return max(1, int(CHUNK_BYTES // (250 * cells + 12 * math.prod(model.shape))))


def _steps(model: RingModel) -> int:
    """Annuli per order of interference."""
    strong = (abs(model.harmonics) > 0.01).any(0).nonzero()[0]
    return STEPS_PER_HARMONIC * int(strong[-1])


class _Task(NamedTuple):
    """The settings common to all images of a call."""

    model: RingModel
    noise: PixelNoise
    free: list[int]
    max_chi_square: float
    centre: tuple[float, float] | None


def _fit(images, task: _Task, number: int, method: str) -> RingFit:
    """`fit_rings` for some of the images, from the ``number``-th on.

    They have common cells, about the centre of their mean. An image without rings about that
    centre, or with its own centre too far from it, gets cells of its own.
    """
    centre = task.centre or gradient_centre(images.mean(0, dtype=torch.float32))
    try:
        fit = _fit_about(centre, images, task, number, method)
    except InputError:
        if len(images) == 1:
            raise
        alone = [_fit(one[None], task, number + k, method) for k, one in enumerate(images)]
        return RingFit(*(torch.cat(values) for values in zip(*alone, strict=True)))
    if method == "annular":
        far = torch.hypot(fit.x - centre[0], fit.y - centre[1])
        for k in (far > REACH * math.sqrt(task.model.order_spacing)).nonzero()[:, 0].tolist():
            own = float(fit.x[k]), float(fit.y[k])
            again = _fit_about(own, images[k, None], task, number + k, method)
            for values, value in zip(fit, again, strict=True):
                values[k] = value[0]
    return fit


def _fit_about(centre, images, task: _Task, number: int, method: str) -> RingFit:
    """`_fit` with cells about the one centre."""
    model, noise, free = task.model, task.noise, task.free
    if method == "annular":
        step = model.order_spacing / _steps(model)
        cells = annular_sectors(model.shape, centre, step, SECTORS, images.device)
        means = cells.means(images)
        parameters = _start(model, cells, means, noise, number)
    else:
        near = _fit(images, task, number, "annular")
        parameters = torch.stack(
            [
                near.v_los,
                near.x - centre[0],
                near.y - centre[1],
                near.level,
                near.background,
                near.temperature,
                near.falloff,
            ],
            1,
        )
        cells = pixels(model.shape, centre, images.device)
        means = cells.means(images)
    parameters, mean, jacobian, variance = _scoring(
        model, cells, means, parameters, noise, free, number
    )
    weight = cells.count / variance
    std = torch.zeros_like(parameters)
    std[:, free] = standard_deviations(fisher_matrix(jacobian, weight, free))
    chi_square = (weight * (means - mean) ** 2).sum(1) / (len(cells.count) - len(free))
    rings = _rings(model, cells, means, parameters, mean, variance)
    v, dx, dy, level, background, temperature, falloff = parameters.unbind(1)
    x, y = dx + centre[0], dy + centre[1]
    found = (values.tolist() for values in (x, y, rings, chi_square))
    for name, *place, detected, misfit in zip(
        (f"images[{number + k}]" for k in range(len(x))), *found, strict=True
    ):
        inside(*place, model.shape, f"{name}: centre")
        if detected < 2:
            raise InputError(
                f"{name}: {detected} ring(s) detected; expected at least 2 that follow the model"
            )
        if not misfit <= task.max_chi_square:
            raise InputError(
                f"{name}: chi-square {misfit:.3g} is not allowed; expected at most "
                f"{task.max_chi_square:g}: line, etalon or noise are not the model's"
            )
    return RingFit(
        v, std[:, 0], x, y, level, background, temperature, falloff, std, chi_square, rings
    )


def _start(model, cells, means, noise, number) -> torch.Tensor:
    """Parameters from the first harmonic over the order: a linear fit, no guess needed."""
    fraction = orders(model, cells.r2, means.new_zeros(()))[1]
    waves = torch.stack(
        [
            torch.ones_like(fraction),
            torch.cos(2 * torch.pi * fraction),
            torch.sin(2 * torch.pi * fraction),
        ]
    )
    weight = cells.count
    inverse = torch.linalg.pinv((waves * weight) @ waves.T, hermitian=True)
    found = (means * weight) @ waves.T @ inverse
    # the noise at the image's mean
    spread = noise.variance(found[:, :1].clamp(min=0), found[:, :1].clamp(min=0))
    size = found[:, 1:].norm(dim=1)
    error = (spread[:, 0] * inverse.diagonal()[1:].mean()).sqrt()
    for k in range(len(means)):
        if not (found[k, 0] > 0 and size[k] > SIGNIFICANT * error[k]):
            raise InputError(
                f"images[{number + k}]: no rings detected (contrast {float(size[k]):.3g} electrons "
                f"with {float(error[k]):.2g} of noise); expected rings"
            )
    blank = means.new_tensor([[0, 0, 0, 1, 0, model.middle_temperature, model.falloff]])
    first = model.at_temperature(blank[:, 5])[0][0, 1]
    # level Re(2 A_1 exp(2 pi i (m + s v))) = a cos + b sin: A_1 exp(2 pi i s v) ~ a - i b
    wave = torch.complex(found[:, 1], -found[:, 2])
    v = torch.angle(wave / first) / (2 * torch.pi) * model.velocity_range
    level = size / (2 * abs(first))
    parameters = blank.repeat(len(means), 1)
    parameters[:, 0] = v
    parameters[:, 3] = torch.minimum(level, found[:, 0])
    parameters[:, 4] = found[:, 0] - parameters[:, 3]
    return parameters


def _scoring(model, cells, means, parameters, noise, indices, number):
    """Fisher scoring: weighted least squares, its weights from the mean of the step before."""
    fixed = [i for i in range(len(PARAMETERS)) if i not in indices]
    if PARAMETERS.index("background") in fixed:
        parameters[:, 3] += parameters[:, 4]
        parameters[:, 4] = 0
    # a step longer than the rings are wide leaves the linear range
    limit = torch.full_like(parameters[0], math.inf)
    limit[0], limit[1:3] = model.velocity_range / 16, 0.04 * math.sqrt(model.order_spacing)
    limit[5], limit[6] = 20.0, 0.3
    floor = 1e-3 * means.mean(1, keepdim=True)
    converged = torch.zeros(len(means), dtype=torch.bool, device=means.device)
    for _ in range(ITERATIONS):
        mean, jacobian = mean_and_jacobian(model, cells, parameters)
        signal = (mean - parameters[:, 4, None]).clamp(min=0)
        variance = noise.variance(torch.maximum(mean, floor), signal)
        if converged.all():
            return parameters, mean, jacobian, variance
        weight = cells.count / variance
        fisher = fisher_matrix(jacobian, weight, indices)
        score = (jacobian[:, indices] @ (weight * (means - mean))[:, :, None])[:, :, 0]
        std = standard_deviations(fisher)
        unit = fisher.diagonal(dim1=1, dim2=2).rsqrt()
        normal = fisher * unit[:, :, None] * unit[:, None, :]
        step = torch.linalg.solve_ex(normal, score * unit)[0] * unit
        if not torch.isfinite(step).all():
            bad = number + int((~torch.isfinite(step)).any(1).nonzero()[0])
            raise InputError(
                f"images[{bad}]: the fit fails; expected rings that the model describes"
            )
        parameters = parameters.clone()
        bound = limit[indices]
        parameters[:, indices] += step.clamp(-bound, bound)
        if len(model.temperatures) > 1:
            first, last = model.temperatures[[0, -1]]
            parameters[:, 5] = parameters[:, 5].clamp(first, last)
        converged = (step.abs() <= CLOSE * std).all(1)
    bad = number + int((~converged).nonzero()[0])
    raise InputError(
        f"images[{bad}]: the fit does not converge; expected two rings or more as in the model"
    )


def _rings(model, cells, means, parameters, mean, variance) -> torch.Tensor:
    """Orders whose rings are significant and at least half as strong as fitted."""
    v, dx, dy, level, background, _, falloff = parameters.T[..., None]
    r2 = squared_radius(cells, dx, dy)
    order = orders(model, r2, v)[1].round().long()
    order -= order.min()
    ring = mean - background - level * illumination(model, r2, falloff)
    weight = cells.count / variance
    sums = mean.new_zeros(2, len(mean), int(order.max()) + 1)
    strength = sums[0].scatter_add_(1, order, weight * ring**2)
    misfit = sums[1].scatter_add_(1, order, weight * ring * (means - mean))
    amplitude = 1 + misfit / strength
    return ((amplitude > 0.5) & (amplitude * strength.sqrt() > SIGNIFICANT)).sum(1)
