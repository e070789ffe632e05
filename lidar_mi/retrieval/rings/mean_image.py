"""Mean image of the rings of an etalon, and its derivatives.

The mean image is, in electrons per pixel,

    level L g(m) + background,    L = exp(-falloff r^2 / R^2 + smooth terms),
    g(m) = 1 + 2 sum_n Re(A_n / A_0 exp(2 pi i n m)),   m = m_0 (1 + 2 v_LOS / c) cos(theta),

with r the distance from the rings' centre in the ideal image, R half the image's diagonal,
tan(theta) = r / f and m the order of interference; the A_n are the etalon's harmonics times the
line's characteristic function (Airy function convolved with the line). Only the part of m_0 beyond
its integer enters: m = m_0 (cos(theta) - 1) + ..., in float64 throughout. Averages over a pixel,
and over all pixels of a cell, are taken to second order in the cell's spread of r^2: A_n falls by
exp(-(2 pi n)^2 var(m) / 2). A point that is blurred to a disc of radius b lowers A_n by
2 J_1(z) / z with z = 2 pi n b |grad m| (Born & Wolf 1999, Principles of Optics, section 8.8), and
adds b^2 / 2 to its mean r^2.

The waves exp(2 pi i n m) of rings about the cells' own centre do not depend on speed, light or
temperature. They are computed once for all images; then g is a product of matrices, and what a
moved centre changes is a Taylor series to third order in the change of m: exact to 1e-4 of the mean
for centres within `reach`.
"""

import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import torch

from lidar_mi.errors import InputError
from lidar_mi.retrieval.rings.cells import Cells, pixels
from lidar_mi.retrieval.rings.geometry import by_tilt_and_distortion
from lidar_mi.retrieval.rings.model import BACKGROUND, LIGHT, PARAMETERS, RingModel

PIXEL_R2 = 1 / 6  # px^2, mean squared distance of a pixel's points from its centre
BLOCK = 1 << 16  # cells at once, where every pixel is one
CHUNK_BYTES = 256e6
AT_ONCE = 64  # images: what they need fits into the cache
SHAPE = ("temperature", "aerosol", "damping", "roughness")  # parameters of the profile of a ring


class Waves(NamedTuple):
    """Cells, and the harmonics of rings at rest about their centre.

    waves (2 K, cells): real and imaginary parts of 2 exp(2 pi i n m), n from 1, averaged over the
        cells.
    by_blur (2 K, cells): their derivative by the squared radius of the blur, 1/px^2.
    order, variance (cells,): m less its integer part at the centre; variance of r^2 over the
        pixels' areas, px^4.
    """

    cells: Cells
    waves: torch.Tensor
    by_blur: torch.Tensor
    order: torch.Tensor
    variance: torch.Tensor


def images_at_once(model: RingModel, per_order: int | None = None) -> int:
    """Images in one batch: about 300 bytes a cell for Jacobian and products.

    Cells are the pixels, or ``per_order`` in every order of interference.
    """
    cells = math.prod(model.shape)
    if per_order:
        cells = min(cells, per_order * int(1 + cells // model.order_spacing))
    return max(1, min(AT_ONCE, int(CHUNK_BYTES // (300 * cells))))


def reach(model: RingModel) -> float:
    """Largest distance of an image's centre from that of the cells, px."""
    return 0.01 * math.sqrt(model.order_spacing) / strongest(model)


def strongest(model: RingModel) -> int:
    """The highest harmonic above 0.01 of the mean, 1 at least."""
    rows = [abs(model.harmonics).max(0)]
    if model.aerosol_harmonics is not None:
        # aerosol scatters a part of the light
        rows.append(0.1 * abs(model.aerosol_harmonics))
    return max(1, *(int((row > 0.01).nonzero()[0][-1]) for row in rows))


def ring_waves(model: RingModel, cells: Cells, derivatives: bool = False) -> Waves:
    """Harmonics at rest over the cells; with those by the blur if ``derivatives``."""
    r2 = cells.r2 + _area(model)
    variance = cells.r2 / 3  # of r2 over a pixel: (2 x)^2 / 12 + (2 y)^2 / 12
    if cells.spread is not None:
        variance = variance + cells.spread[:, 2, 2]
    cosine, order = orders(model, r2)
    by_r2 = _by_r2(model, cosine)
    n = torch.arange(1, model.count + 1, dtype=torch.float64, device=r2.device)[:, None]
    # z^2 of the blur's disc, over its squared radius: |grad m| = |dm/dr2| 2 r
    steep = (4 * math.pi * n * by_r2) ** 2 * r2
    # mean of a wave over a spread of its phase, exp(-(2 pi n)^2 var(m) / 2), 2 for n and -n
    size = 2 * torch.exp(-2 * (math.pi * n * by_r2) ** 2 * variance)
    wave = torch.polar(torch.ones_like(order), 2 * math.pi * order)
    # powers of the first harmonic: one sine and cosine for all
    wave = torch.cumprod(wave.expand(model.count, -1), 0)
    waves, by_blur = wave * size, wave[:0]
    if model.blur != 0 or derivatives:
        disc, slope = _disc(steep * model.blur)
        waves, by_blur = waves * disc, waves * (slope * steep)
    return Waves(
        cells,
        torch.cat([waves.real, waves.imag]),
        torch.cat([by_blur.real, by_blur.imag]),
        order,
        variance,
    )


def squared_radius(
    model: RingModel, cells: Cells, dx: torch.Tensor, dy: torch.Tensor
) -> torch.Tensor:
    """Mean of r^2 about (dx, dy) from the cells' centre, over pixels' areas and blur, px^2."""
    of_centre = torch.cat([torch.ones_like(dx), -2 * dx, -2 * dy, dx**2 + dy**2 + _area(model)], -1)
    return of_centre @ torch.stack([cells.r2, cells.x, cells.y, torch.ones_like(cells.r2)])


def _area(model: RingModel) -> float:
    """Mean squared distance of the light on a pixel from its centre: pixel and disc, px^2."""
    return PIXEL_R2 + model.blur / 2


def _cosine_less_one(model: RingModel, r2: torch.Tensor) -> torch.Tensor:
    """Cosine of the angle less 1."""
    tangent2 = (model.pixel / model.focal_length) ** 2 * r2
    secant2 = 1 + tangent2
    # without the difference of numbers next to one
    return -tangent2 / (secant2.sqrt() + secant2)


def orders(model: RingModel, r2: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Cosine of the angle, and the order of light at rest less its integer part at the centre."""
    scale, centre = (model.pixel / model.focal_length) ** 2, model.order_at_centre
    cosine = (1 + scale * r2).rsqrt()
    # cos - 1 = -tan^2 cos^2 / (1 + cos), without the difference of numbers next to one
    return cosine, centre % 1 - centre * scale * r2 * cosine**2 / (1 + cosine)


def light_on(model: RingModel, cells: Cells, parameters: torch.Tensor) -> torch.Tensor:
    """Light relative to the rings' centre, (images, cells)."""
    dx, dy = (parameters[:, PARAMETERS.index(name), None] for name in "xy")
    return _light(model, cells, squared_radius(model, cells, dx, dy), parameters)


def mean_and_jacobian(
    model: RingModel, waves: Waves, parameters: torch.Tensor, names: Sequence[str] = ()
) -> tuple[torch.Tensor, torch.Tensor]:
    """Mean electrons per pixel in every cell, and their derivatives.

    Parameters
    ----------
    waves : Waves
        From `ring_waves`, with derivatives where ``blur`` is among the names.
    parameters : torch.Tensor, shape (images, `PARAMETERS`)
        x and y from the cells' centre.
    names : sequence of str
        Parameters of the derivatives.

    Returns
    -------
    mean : torch.Tensor, shape (images, cells)
    jacobian : torch.Tensor, shape (images, names, cells)
        The change of a cell's spread of r^2 with the centre is neglected.
    """
    cells = waves.cells
    v, dx, dy, level, background, _, falloff = (
        parameters[:, k, None] for k in range(PARAMETERS.index("falloff") + 1)
    )
    area = model.half_diagonal**2
    r2 = squared_radius(model, cells, dx, dy)
    light = _light(model, cells, r2, parameters)
    # more light at the inner end of a cell
    lean = _cosine_less_one(model, torch.addcmul(r2, falloff, waves.variance, value=-1 / area))
    centre = model.order_at_centre
    moved = torch.add(centre % 1 - waves.order, lean, alpha=centre)
    # the phase by the speed on the axis is applied below: this is its decrease with the angle
    moved.addcmul_(v / model.velocity_range, lean)
    amplitudes, by = model.amplitudes(parameters)
    n = torch.arange(1, amplitudes.shape[1] + 1, dtype=torch.float64, device=v.device)
    turned = torch.polar(torch.ones_like(v), 2 * math.pi * v / model.velocity_range) ** n
    # terms of the Taylor series in the order
    powers = torch.stack([(2j * math.pi * n) ** k / math.factorial(k) for k in range(4)])
    terms = _product((powers[:, None] * (amplitudes * turned)).flatten(0, 1), waves.waves).chunk(4)
    profile = terms[3]
    for term in reversed(terms[:3]):
        profile = torch.addcmul(term, moved, profile)
    pattern = light * profile.add_(1)
    mean = torch.addcmul(background, level, pattern)
    uneven = [name for name in model.smooth if name in BACKGROUND]
    if uneven:
        mean += _smooth(model, cells, parameters, uneven)
    jacobian = mean.new_empty((len(mean), len(names), mean.shape[1]))
    if not names:
        return mean, jacobian
    slope = terms[1] + moved * (2 * terms[2] + moved * 3 * terms[3])
    bright, cosine = level * light, 1 + lean
    by_r2 = bright * slope * _by_r2(model, cosine)
    for row, name in zip(jacobian.unbind(1), names, strict=True):
        if name == "v_los":
            row[:] = bright * slope * (cosine / model.velocity_range)
        elif name in ("x", "y"):
            off = dx - cells.x if name == "x" else dy - cells.y
            row[:] = (by_r2 - level * pattern * falloff / area) * 2 * off
        elif name == "level":
            row[:] = pattern
        elif name == "background":
            row[:] = 1
        elif name == "falloff":
            row[:] = -level * pattern * r2 / area
        elif name in SHAPE:
            first = by[name] * turned
            change = _product(first, waves.waves)
            row[:] = bright * (change + moved * _product(first * (2j * math.pi * n), waves.waves))
        elif name in LIGHT:
            row[:] = level * pattern * cells.terms[:, model.smooth.index(name)]
        elif name in BACKGROUND:
            row[:] = cells.terms[:, model.smooth.index(name)]
        elif name == "focal_length":
            # of the relative length: the order depends on r^2 / f^2
            row[:] = -2 * by_r2 * r2
        elif name == "blur":
            # the blur also adds its half to the mean r^2
            row[:] = bright * _product(amplitudes * turned, waves.by_blur) + by_r2 / 2
        else:
            changes = by_tilt_and_distortion(model.geometry, cells.centre, cells.x, cells.y)
            row[:] = by_r2 * changes[("tilt_x", "tilt_y", "distortion").index(name)]
    return mean, jacobian


def parameter_vector(
    model: RingModel,
    v_los: float = 0.0,
    photons: float = 2.4e7,
    background: float = 0.0,
    centre: tuple[float, float] | None = None,
    temperature: float | None = None,
    device: str | torch.device = "cpu",
) -> torch.Tensor:
    """Parameters (1, `PARAMETERS`) of an image with this number of signal electrons.

    x and y are 0: from ``centre``, or the model's.

    Raises
    ------
    InputError
        Photons not above 0, a temperature outside the model's.
    """
    if not (math.isfinite(photons) and photons > 0):
        raise InputError(f"photons: {photons!r} is not allowed; expected above 0")
    if not (math.isfinite(background) and background >= 0):
        raise InputError(f"background: {background!r} is not allowed; expected 0 or more")
    if not math.isfinite(v_los):
        raise InputError(f"v_los: {v_los!r} m/s is not allowed; expected a finite speed")
    vector = model.start(device)
    vector[0, PARAMETERS.index("v_los")] = v_los
    if temperature is not None:
        first, last = model.temperatures[[0, -1]]
        if not first <= temperature <= last:
            raise InputError(
                f"temperature: {temperature!r} K is not allowed; the model is valid from "
                f"{first:g} to {last:g} K"
            )
        vector[0, PARAMETERS.index("temperature")] = temperature
    # the mean is linear in the level, which is 1 at the start
    vector[0, PARAMETERS.index("level")] = photons / float(mean_image(model, vector, centre).sum())
    vector[0, PARAMETERS.index("background")] = background
    return vector


def pixel_waves(
    model: RingModel,
    centre: tuple[float, float] | None = None,
    device: str | torch.device = "cpu",
    derivatives: bool = False,
) -> Iterator[Waves]:
    """Waves over every pixel as a cell of its own, in blocks of rows by row."""
    cells = pixels(
        model.shape, centre or model.centre, device, geometry=model.geometry, names=model.smooth
    )
    for first in range(0, len(cells.count), BLOCK):
        yield ring_waves(model, cells.part(slice(first, first + BLOCK)), derivatives)


def expected(
    model: RingModel,
    v_los: float = 0.0,
    photons: float = 2.4e7,
    background: float = 0.0,
    centre: tuple[float, float] | None = None,
    temperature: float | None = None,
    device: str | torch.device = "cpu",
) -> torch.Tensor:
    """Mean image, electrons, shape (height, width), float64.

    Parameters
    ----------
    v_los : float
        m/s, positive toward the instrument.
    photons : float
        Signal electrons in the whole image (photons detected).
    background : float
        Electrons per pixel that have no rings: sky, dark current.
    centre : (float, float), optional
        (x, y), pixels; the model's if not given.
    temperature : float, optional
        K; the middle one of the model's if not given.
    """
    vector = parameter_vector(model, v_los, photons, background, centre, temperature, device)
    return mean_image(model, vector, centre)


def mean_image(
    model: RingModel, parameters: torch.Tensor, centre: tuple[float, float] | None = None
) -> torch.Tensor:
    """Mean electrons of every pixel, (height, width), for parameters (1, `PARAMETERS`).

    x and y are from ``centre``, or the model's.
    """
    parts = [
        mean_and_jacobian(model, waves, parameters)[0][0]
        for waves in pixel_waves(model, centre, parameters.device)
    ]
    return torch.cat(parts).reshape(model.shape)


def _light(
    model: RingModel, cells: Cells, r2: torch.Tensor, parameters: torch.Tensor
) -> torch.Tensor:
    falloff = parameters[:, PARAMETERS.index("falloff"), None]
    exponent = r2 * (-falloff / model.half_diagonal**2)
    uneven = [name for name in model.smooth if name in LIGHT]
    if uneven:
        exponent += _smooth(model, cells, parameters, uneven)
    return exponent.exp_()


def _smooth(
    model: RingModel, cells: Cells, parameters: torch.Tensor, names: Sequence[str]
) -> torch.Tensor:
    """Sum of smooth terms times their parameters, (images, cells)."""
    # 0 for the others: less work than to pick the terms of all cells
    amplitudes = parameters.new_zeros(len(parameters), len(model.smooth))
    columns = [model.smooth.index(name) for name in names]
    amplitudes[:, columns] = parameters[:, [PARAMETERS.index(name) for name in names]]
    return amplitudes @ cells.terms.T


def _by_r2(model: RingModel, cosine: torch.Tensor) -> torch.Tensor:
    """Derivative of the order by r^2, 1/px^2."""
    return -model.order_at_centre / 2 * (model.pixel / model.focal_length) ** 2 * cosine**3


def _product(amplitudes: torch.Tensor, waves: torch.Tensor) -> torch.Tensor:
    """Real part of sums over harmonics: (images, K) complex and (2 K, cells) to (images, cells)."""
    return torch.cat([amplitudes.real, -amplitudes.imag], 1).to(waves) @ waves


def _disc(square: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """2 J_1(z) / z and its derivative by z^2, from z^2.

    Both are entire functions of z^2, so that a fit may pass through 0; below it they are modified
    Bessel functions.
    """
    # the closed forms cancel near 0: there the series is exact to 1e-9
    value = 1 - square / 8 + square**2 / 192
    slope = -1 / 8 + square / 96 - square**2 / 3072
    for side, zeroth, first, sign in (
        (square >= 1e-2, torch.special.bessel_j0, torch.special.bessel_j1, 1),
        (square <= -1e-2, torch.special.modified_bessel_i0, torch.special.modified_bessel_i1, -1),
    ):
        if side.any():
            z = square[side].abs().sqrt()
            value[side] = 2 * first(z) / z
            # J_2 = 2 J_1 / z - J_0, I_2 = I_0 - 2 I_1 / z
            slope[side] = -sign * (2 * first(z) / z - zeroth(z)) / z**2
    return value, slope
