"""Line-of-sight wind from all rings of an image at once: maximum likelihood, many images per call.

Every parameter of `lidar_mi.retrieval.rings.model` that is not known is fitted along: the rings'
centre, the level of the light, its fall-off and slopes, the background, the air's temperature and
the fraction of aerosol. Two ways, one fit:

annular  images are first averaged over sectors of annuli of equal steps in r^2: a hundred
         times fewer numbers, 1 % of the information lost
pixels   every pixel takes part (2-D fit), from where the annular fit ended

Images are in electrons, so that their noise follows from their mean.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import torch

from lidar_mi.errors import InputError
from lidar_mi.retrieval.likelihood.scoring import fisher_matrix, standard_deviations
from lidar_mi.retrieval.rings.bound import free_names, prior_information
from lidar_mi.retrieval.rings.cells import annular_sectors
from lidar_mi.retrieval.rings.centre import gradient_centre
from lidar_mi.retrieval.rings.frames import MOST_SPOTS, checked, inside, patches, spots
from lidar_mi.retrieval.rings.mean_image import (
    Waves,
    images_at_once,
    light_on,
    mean_and_jacobian,
    orders,
    pixel_waves,
    reach,
    ring_waves,
    squared_radius,
    strongest,
)
from lidar_mi.retrieval.rings.model import (
    INSTRUMENT,
    PARAMETERS,
    PixelNoise,
    RingModel,
    SpeedsOfRings,
)
from lidar_mi.retrieval.rings.scoring import POOR, Scored, cell_variance, robust_scoring
from lidar_mi.retrieval.threads import mapped, threads_for

METHODS = ("annular", "pixels")

# Annuli per order of interference, for each significant harmonic: pi^2 / 3 / 8^2 = 5 % of the
# information of the highest is lost, 1.3 % and less of the others.
STEPS_PER_HARMONIC = 8
SECTORS = 8
MOVES = 12  # of the cells toward the rings' centre
SIGNIFICANT = 5.0  # standard deviations, the least amplitude of rings
# standard deviations of chi-square above 1 from which stated errors grow with its root
MISFIT = 4.0
_OF_IMAGES = ("values", "std", "chi_square", "rings", "outliers", "sensitivity")


@dataclass(frozen=True, eq=False)
class RingFit:
    """Retrieved values, tensors of shape (images,) unless stated, float64.

    values (images, parameters): all of `lidar_mi.retrieval.rings.model.PARAMETERS`; those that were
        not free have the model's value. x and y are pixels from the top left pixel's centre.
    std (images, parameters): their random standard deviations, from the Fisher matrix with all
        other free parameters unknown, times the root of chi_square where that is significantly
        above 1; 0 where one was not free.
    chi_square: squared misfit over its expectation: 1 where model and noise are right.
    rings: rings that were detected.
    outliers: masked fraction: of the cells that do not fit, plus of the pixels in bright patches.
        Single hot and dead pixels do not count.
    sensitivity (images, 8): change of v_los per error of the model's calibration
        (`RingModel.systematic`).
    systematic (8, 8): covariance of the calibration's error, in the order of `sensitivity`.
    """

    values: torch.Tensor
    std: torch.Tensor
    chi_square: torch.Tensor
    rings: torch.Tensor
    outliers: torch.Tensor
    sensitivity: torch.Tensor
    systematic: torch.Tensor

    def of(self, name: str) -> torch.Tensor:
        """Retrieved values of a parameter."""
        return self.values[:, PARAMETERS.index(name)]

    def std_of(self, name: str) -> torch.Tensor:
        """Random standard deviations of a parameter."""
        return self.std[:, PARAMETERS.index(name)]

    @property
    def v_los(self) -> torch.Tensor:
        """Speed along the line of sight, m/s, positive toward the instrument."""
        return self.of("v_los")

    @property
    def v_los_std(self) -> torch.Tensor:
        """Random standard deviation of v_los, m/s."""
        return self.std_of("v_los")

    @property
    def v_los_systematic(self) -> torch.Tensor:
        """Standard deviation of v_los by the calibration, common to all images, m/s."""
        return _systematic(self.sensitivity, self.systematic)


def difference(received: SpeedsOfRings, emitted: SpeedsOfRings) -> tuple[torch.Tensor, ...]:
    """v_LOS of received images less that of images of the laser itself, with standard deviations.

    An error of the order at the centre, by a drift of etalon or laser, cancels. So does an error of
    the calibration, as far as both images respond equally. In m/s: v_los, its random standard
    deviation, and that by the calibration.
    """
    std = torch.hypot(received.v_los_std, emitted.v_los_std)
    uncommon = received.sensitivity - emitted.sensitivity
    return received.v_los - emitted.v_los, std, _systematic(uncommon, received.systematic)


def fit_rings(
    images: torch.Tensor,
    model: RingModel,
    noise: PixelNoise | None = None,
    *,
    method: str = "annular",
    centre: tuple[float, float] | None = None,
    free: Sequence[str] | None = None,
    response: torch.Tensor | None = None,
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
    noise : PixelNoise
        Poisson alone if not given.
    method : {"annular", "pixels"}
    centre : (float, float), optional
        (x, y) of the rings, pixels: where the fit starts, and where it stays if x and y are not
        free. Default: from the images' gradients if x and y are both free, else that of
        the model.
    free : names out of `lidar_mi.retrieval.rings.model.PARAMETERS`, optional
        Fitted parameters; all that the model has if not given. The others stay at the model's
        values, the background at 0.
    response : torch.Tensor, shape (height, width), optional
        Of the pixels to light, 1 on average; pixels of response 0 are masked. For ``annular``.
    saturation : float, optional
        Electrons from which a pixel is saturated. Images that end in a plateau are refused even
        if it is not given.
    max_chi_square : float
        Images that fit worse are refused; infinite accepts all. The default detects a wrong line
        or noise, not a small error: the standard deviation of chi_square is
        (2 / cells)^(1/2) = 1 to 2 %.

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
    if response is not None and method != "annular":
        raise InputError(f"response: not allowed with method {method}; expected annular")
    used = None if response is None else response > 0
    images = checked(images, saturation, used, shape=model.shape)
    names = free_names(model, free)
    if centre is not None:
        inside(*centre, model.shape, "centre")
    elif not {"x", "y"} <= set(names):
        centre = model.centre
    task = _Task(model, noise or PixelNoise(), names, max_chi_square, centre, response)
    steps = STEPS_PER_HARMONIC * strongest(model)
    size = images_at_once(model, steps * SECTORS if method == "annular" else None)
    # many images: each thread has some of its own; few: all threads sum them up, one fits
    starts = range(0, len(images), size)
    with threads_for(0):
        parts = mapped(lambda k: _fit(images[k : k + size], task, k, method), starts)
    return _joined(parts)


def annular_waves(
    model: RingModel,
    centre: tuple[float, float],
    response: torch.Tensor | None = None,
    device: str | torch.device = "cpu",
    derivatives: bool = False,
) -> Waves:
    """The annular fit's cells about a centre, and the waves of rings over them."""
    step = model.order_spacing / (STEPS_PER_HARMONIC * strongest(model))
    cells = annular_sectors(
        model.shape,
        centre,
        step,
        SECTORS,
        device,
        geometry=model.geometry,
        response=response,
        names=model.smooth,
    )
    return ring_waves(model, cells, derivatives)


# images of one camera share their cells from call to call
_waves = lru_cache(maxsize=4)(annular_waves)


def _joined(parts: Sequence[RingFit]) -> RingFit:
    joined = {name: torch.cat([getattr(part, name) for part in parts]) for name in _OF_IMAGES}
    return RingFit(**joined, systematic=parts[0].systematic)


def _systematic(sensitivity: torch.Tensor, covariance: torch.Tensor) -> torch.Tensor:
    # rounding may leave less than 0
    return torch.einsum("bi,ij,bj->b", sensitivity, covariance, sensitivity).clamp(min=0).sqrt()


class _Task(NamedTuple):
    """The settings common to all images of a call."""

    model: RingModel
    noise: PixelNoise
    free: list[str]
    max_chi_square: float
    centre: tuple[float, float] | None
    response: torch.Tensor | None
    spots_removed: bool = False
    """Whether hot and dead pixels were masked."""

    @property
    def moves(self) -> bool:
        """Whether the centre is fitted."""
        return "x" in self.free or "y" in self.free

    def without(self, bad: torch.Tensor) -> "_Task":
        given = torch.ones_like(bad).double() if self.response is None else self.response
        return self._replace(response=torch.where(bad, 0.0, given))


def _fit(images: torch.Tensor, task: _Task, number: int, method: str) -> RingFit:
    """`fit_rings` for some of the images, from the ``number``-th on.

    If one is refused, each is fitted alone; those refused again are fitted without their bright
    patches.
    """
    try:
        return _fit_together(images, task, number, method)
    except InputError:
        if len(images) > 1:
            each = enumerate(images[:, None], number)
            return _joined([_fit(image, task, k, method) for k, image in each])
        bright = patches(images[0])
        if method != "annular" or task.spots_removed or not bright.any():
            raise
    fit = _fit_together(images, task.without(bright), number, method)
    return replace(fit, outliers=fit.outliers + bright.double().mean())


def _fit_together(images: torch.Tensor, task: _Task, number: int, method: str) -> RingFit:
    """Cells are common, about the middle of the centres; an image far from it gets its own."""
    # the mean image has the least noise
    mean = images.mean(0, dtype=torch.float32)
    centre = task.centre or gradient_centre(mean, task.response)
    inside(*centre, task.model.shape, f"images[{number}]: centre")
    near = reach(task.model)
    for _ in range(MOVES):
        fit = _fit_about(centre, images, task, number, method)
        away = (fit.of("x") - centre[0], fit.of("y") - centre[1])
        # single images that are off must not move the cells of all
        middle = [float(part.median()) for part in away]
        if not task.moves or math.hypot(*middle) <= near:
            break
        centre = (centre[0] + middle[0], centre[1] + middle[1])
        inside(*centre, task.model.shape, f"images[{number}]: centre")
    if task.moves and len(images) > 1:
        far = torch.hypot(*(part - shift for part, shift in zip(away, middle, strict=True))) > near
        for k in far.nonzero()[:, 0].tolist():
            start = float(fit.of("x")[k]), float(fit.of("y")[k])
            alone = _fit(images[k, None], task._replace(centre=start), number + k, method)
            fit = _joined([_part(fit, slice(0, k)), alone, _part(fit, slice(k + 1, None))])
    if method == "annular" and not task.spots_removed:
        fit = _without_spots(fit, images, task, number)
    _check(fit, task, number)
    return fit


def _without_spots(fit: RingFit, images: torch.Tensor, task: _Task, number: int) -> RingFit:
    """Poorly fitted images fitted again without their hot and dead pixels."""
    for k in (fit.chi_square > POOR).nonzero()[:, 0].tolist():
        bad = spots(images[k].double(), task.noise)
        if 0 < bad.sum() < MOST_SPOTS * bad.numel():
            place = float(fit.of("x")[k]), float(fit.of("y")[k])
            clean = task.without(bad)._replace(spots_removed=True, centre=place)
            alone = _fit(images[k, None], clean, number + k, "annular")
            fit = _joined([_part(fit, slice(0, k)), alone, _part(fit, slice(k + 1, None))])
    return fit


def _part(fit: RingFit, which: slice) -> RingFit:
    return replace(fit, **{name: getattr(fit, name)[which] for name in _OF_IMAGES})


def _check(fit: RingFit, task: _Task, number: int) -> None:
    """Raise InputError unless all images have their centre inside, two rings and a good fit."""
    numbers = (values.tolist() for values in (fit.of("x"), fit.of("y"), fit.rings, fit.chi_square))
    for k, (x, y, rings, misfit) in enumerate(zip(*numbers, strict=True)):
        name = f"images[{number + k}]"
        inside(x, y, task.model.shape, f"{name}: centre")
        if rings < 2:
            raise InputError(
                f"{name}: {rings} ring(s) detected; expected at least 2 that follow the model"
            )
        if not misfit <= task.max_chi_square:
            raise InputError(
                f"{name}: chi-square {misfit:.3g} is not allowed; expected at most "
                f"{task.max_chi_square:g}: line, etalon or noise are not the model's"
            )


def _fit_about(
    centre: tuple[float, float], images: torch.Tensor, task: _Task, number: int, method: str
) -> RingFit:
    """`_fit` with cells about the one centre, unchecked."""
    model, noise = task.model, task.noise
    annular = _waves(model, centre, task.response, images.device)
    means = annular.cells.means(images)
    parameters = _start(model, annular, means, noise, number)
    end = robust_scoring([annular], [means], parameters, model, noise, task.free, number)
    in_cells = end
    rings = _detected(model, annular, means, end, noise)
    if method == "pixels":
        blocks = list(pixel_waves(model, centre, images.device))
        split = [len(block.cells.count) for block in blocks]
        every = images.flatten(-2).double().split(split, -1)
        end = robust_scoring(blocks, every, end.parameters, model, noise, task.free, number)
    names, chi_square = task.free, end.chi_square
    std = torch.zeros_like(end.parameters)
    # chi_square of so many degrees of freedom scatters by sqrt(2 / freedom)
    grown = torch.where(
        chi_square > 1 + MISFIT * math.sqrt(2 / end.freedom), chi_square.sqrt(), 1.0
    )
    columns = [PARAMETERS.index(name) for name in names]
    std[:, columns] = standard_deviations(end.fisher) * grown[:, None]
    values = end.parameters.clone()
    # fitted centres are relative to that of the cells
    for name, shift in zip(("x", "y"), centre, strict=True):
        values[:, PARAMETERS.index(name)] += shift
    size = 1 + len(INSTRUMENT)
    covariance = np.zeros((size, size)) if model.systematic is None else model.systematic
    sensitivity = end.parameters.new_zeros((len(images), size))
    if model.systematic is not None:
        end_in_cells = in_cells._replace(parameters=end.parameters)
        sensitivity = _sensitivity(annular, end_in_cells, task)
    systematic = torch.as_tensor(covariance, dtype=torch.float64, device=images.device)
    return RingFit(values, std, chi_square, rings, end.outliers, sensitivity, systematic)


def _start(
    model: RingModel, waves: Waves, means: torch.Tensor, noise: PixelNoise, number: int
) -> torch.Tensor:
    """Parameters from the first harmonic over the order: a linear fit, no guess needed."""
    cells = waves.cells
    fraction = orders(model, cells.r2)[1]
    # the phase of the first harmonic is the fraction of the order, for any finesse
    basis = torch.stack(
        [
            torch.ones_like(fraction),
            torch.cos(2 * torch.pi * fraction),
            torch.sin(2 * torch.pi * fraction),
        ]
    )
    weight = cells.count
    inverse = torch.linalg.pinv((basis * weight) @ basis.T, hermitian=True)
    coefficients = (means * weight) @ basis.T @ inverse
    # the noise at the image's mean
    spread = noise.variance(coefficients[:, :1].clamp(min=0), coefficients[:, :1].clamp(min=0))
    size = coefficients[:, 1:].norm(dim=1)
    error = (spread[:, 0] * inverse.diagonal()[1:].mean()).sqrt()
    for k in range(len(means)):
        if not (coefficients[k, 0] > 0 and size[k] > SIGNIFICANT * error[k]):
            raise InputError(
                f"images[{number + k}]: no rings detected (contrast {float(size[k]):.3g} electrons "
                f"with {float(error[k]):.2g} of noise); expected rings"
            )
    parameters = model.start(means.device).repeat(len(means), 1)
    first = model.amplitudes(parameters[:1])[0][0, 0]
    # 2 level Re(A_1 exp(2 pi i (fraction + v / velocity_range))) = a cos + b sin, so that
    # 2 level A_1 exp(2 pi i v / velocity_range) = a - i b
    wave = torch.complex(coefficients[:, 1], -coefficients[:, 2])
    v = torch.angle(wave / first) / (2 * torch.pi) * model.velocity_range
    # no higher than the mean, so that the background is not negative
    level = torch.minimum(size / (2 * abs(first)), coefficients[:, 0])
    for name, value in (("v_los", v), ("level", level), ("background", coefficients[:, 0] - level)):
        parameters[:, PARAMETERS.index(name)] = value
    return parameters


def _sensitivity(waves: Waves, end: Scored, task: _Task) -> torch.Tensor:
    """Change of the fitted speed per error of the calibration, (images, 8).

    A change d of the instrument moves the fit by -F^-1 J^T W (dmu/dd) d, with the Fisher matrix F,
    the derivatives J of the mean mu by the free parameters, and the weights W.
    """
    model = task.model
    exact = ring_waves(model, waves.cells, derivatives=True)
    mean, jacobian = mean_and_jacobian(model, exact, end.parameters, [*task.free, *INSTRUMENT])
    weight = end.used[0] * waves.cells.count / cell_variance(mean, end.parameters, task.noise)
    free, by_instrument = jacobian.split([len(task.free), len(INSTRUMENT)], 1)
    information = prior_information(model, task.free, mean.device)
    fisher = torch.diag(information) + fisher_matrix(free, weight)
    moved = torch.linalg.solve(fisher, (free * weight[:, None]) @ by_instrument.transpose(1, 2))
    of_speed = moved[:, task.free.index("v_los")]
    # an error of the zero shifts all speeds
    return -torch.cat([torch.ones_like(of_speed[:, :1]), of_speed], 1)


def _detected(
    model: RingModel, waves: Waves, means: torch.Tensor, end: Scored, noise: PixelNoise
) -> torch.Tensor:
    """Number of orders whose rings are significant and at least half as strong as fitted."""
    cells, parameters = waves.cells, end.parameters
    v, dx, dy, level, background = (
        parameters[:, PARAMETERS.index(name), None]
        for name in ("v_los", "x", "y", "level", "background")
    )
    mean = mean_and_jacobian(model, waves, parameters)[0]
    order = orders(model, squared_radius(model, cells, dx, dy))[1] + v / model.velocity_range
    order = order.round().long()
    order -= order.min()
    ring = mean - background - level * light_on(model, cells, parameters)
    weight = cells.count / cell_variance(mean, parameters, noise)
    sums = mean.new_zeros(2, len(mean), int(order.max()) + 1)
    strength = sums[0].scatter_add_(1, order, weight * ring**2)
    misfit = sums[1].scatter_add_(1, order, weight * ring * (means - mean))
    # each ring by linear regression about the fitted one
    amplitude = 1 + misfit / strength
    return ((amplitude > 0.5) & (amplitude * strength.sqrt() > SIGNIFICANT)).sum(1)
