"""Mean image of the rings of an etalon, and the smallest possible errors of its parameters.

The mean image is, in electrons per pixel,

    level exp(-falloff r^2 / R^2) g(m) / A_0 + background,
    g(m) = A_0 + 2 sum_n Re(A_n exp(2 pi i n m)),   m = m_0 (1 + 2 v_LOS / c) cos(theta),

with r the distance from the rings' centre, R half the image's diagonal, tan(theta) = r / f and
m the order of interference; the A_n are the etalon's harmonics times the line's characteristic
function (Airy function convolved with the line). Only the part of m_0 beyond its integer enters:
m = m_0 (cos(theta) - 1) + ..., in float64 throughout. Averages over a pixel, and over all pixels
of a cell, are taken to second order in the cell's spread of r^2: A_n falls by
exp(-(2 pi n)^2 var(m) / 2).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from scipy.constants import speed_of_light

from lidar_mi.errors import InputError
from lidar_mi.retrieval.rings.cells import Cells, pixels

PARAMETERS = ("v_los", "x", "y", "level", "background", "temperature", "falloff")
"""Parameters of an image: m/s, px, px, electrons per pixel (mean over an order, at the centre),
electrons per pixel, K, and the exponent of the illumination's fall-off from centre to corner."""

PIXEL_R2 = 1 / 6  # px^2, mean squared distance of a pixel's points from its centre
NEGLIGIBLE = 1e-7  # harmonics below this fraction of A_0 change velocities by less than 1e-4 m/s


@dataclass(frozen=True, eq=False)
class RingModel:
    """The properties of an instrument and a line on which the rings depend.

    Parameters
    ----------
    shape : (int, int)
        Height and width of the camera, pixels.
    centre : (float, float)
        Nominal centre of the rings: x to the right, y down, pixels from the top left pixel's
        centre.
    pixel, focal_length, wavelength : float
        m.
    order_at_centre : float
        Order of interference of the unshifted line at the centre, with its fraction.
    harmonics : array (T, K) or (K,), complex
        A_0 ... A_{K-1} of each of the ``temperatures``; any scale, A_0 > 0.
    temperatures : array (T,)
        K, ascending, a few nodes: harmonics between them follow the polynomial through all. One
        node, or none given: the temperature is not a parameter.
    falloff : float
        Of the illumination, see the module.

    Raises
    ------
    InputError
        Numbers out of range, an etalon that transmits nothing or leaves no rings.
    """

    shape: tuple[int, int]
    centre: tuple[float, float]
    pixel: float
    focal_length: float
    wavelength: float
    order_at_centre: float
    harmonics: np.ndarray
    temperatures: Sequence[float] = ()
    falloff: float = 0.0

    def __post_init__(self):
        for name in ("pixel", "focal_length", "wavelength", "order_at_centre"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0):
                raise InputError(f"{name}: {value!r} is not allowed; expected above 0")
        if not (math.isfinite(self.falloff) and len(self.shape) == 2 and min(self.shape) >= 16):
            raise InputError(
                f"ring model: shape {self.shape} px, falloff {self.falloff!r} are not allowed; "
                "expected 16 px or more each way and a finite falloff"
            )
        harmonics = np.atleast_2d(np.asarray(self.harmonics, complex))
        temperatures = np.atleast_1d(np.asarray(self.temperatures, float))
        if not temperatures.size:
            temperatures = np.array([np.nan])
        elif not (np.all(temperatures > 0) and np.all(np.diff(temperatures) > 0)):
            raise InputError(
                f"temperatures: {temperatures} K are not allowed; expected ascending, above 0"
            )
        if harmonics.shape != (len(temperatures), harmonics.shape[-1]) or harmonics.shape[1] < 2:
            raise InputError(
                f"harmonics: shape {harmonics.shape} is not allowed; expected a row of two or "
                f"more for each of {len(temperatures)} temperatures"
            )
        if not (np.isfinite(harmonics).all() and (harmonics[:, 0].real > 0).all()):
            raise InputError(
                f"harmonics: mean transmission {harmonics[0, 0]:g} is not allowed; expected "
                "above 0: the etalon must transmit"
            )
        harmonics = harmonics / harmonics[:, :1].real
        strong = np.flatnonzero(np.abs(harmonics).max(0) > NEGLIGIBLE)[-1]
        if strong < 1:
            raise InputError(
                "harmonics: all but the mean are 0; expected an etalon that leaves rings"
            )
        object.__setattr__(self, "harmonics", harmonics[:, : strong + 1])
        object.__setattr__(self, "temperatures", temperatures)

    @property
    def order_spacing(self) -> float:
        """Step of r^2 from ring to ring, px^2, next to the centre."""
        return 2 * self.focal_length**2 / (self.order_at_centre * self.pixel**2)

    @property
    def velocity_range(self) -> float:
        """Unambiguous range of v_LOS, one order wide, m/s."""
        return speed_of_light / (2 * self.order_at_centre)

    @property
    def parameters(self) -> tuple[str, ...]:
        """Those of `PARAMETERS` that this model has."""
        known = len(self.temperatures) > 1
        return tuple(name for name in PARAMETERS if known or name != "temperature")

    @property
    def middle_temperature(self) -> float:
        """The middle one of the model's temperatures, K."""
        return float(self.temperatures[len(self.temperatures) // 2])

    def at_temperature(self, temperature: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Harmonics (images, K) and their derivatives by temperature, of temperatures (images,)."""
        nodes = torch.as_tensor(self.temperatures, device=temperature.device)
        table = torch.as_tensor(self.harmonics, device=temperature.device)
        if len(nodes) == 1:
            value = table.expand(len(temperature), -1)
            return value, torch.zeros_like(value)
        width = nodes[-1] - nodes[0]
        power = torch.arange(len(nodes), device=nodes.device)
        scaled = (nodes - nodes[0]) / width
        coefficients = torch.linalg.solve((scaled[:, None] ** power).to(table), table)
        place = ((temperature - nodes[0]) / width)[:, None]
        slope = power * place ** (power - 1).clamp(min=0) / width
        return (place**power).to(table) @ coefficients, slope.to(table) @ coefficients


@dataclass(frozen=True)
class PixelNoise:
    """Noise of a pixel, photoelectrons.

    Parameters
    ----------
    read_noise : float
        Standard deviation of the noise that does not depend on the light: root sum of squares of
        the read-out's and of 1 / sqrt(12) of a digitisation step, over the gain before them.
    speckle_modes : float
        M of the Gamma distribution that the laser light of a pixel follows; infinite without.
    excess : float
        Variance of a photoelectron number over Poisson's: the excess noise factor F^2 of a
        multiplication before the read-out, 1 without.

    Raises
    ------
    InputError
    """

    read_noise: float = 0.0
    speckle_modes: float = math.inf
    excess: float = 1.0

    def __post_init__(self):
        if not (math.isfinite(self.read_noise) and self.read_noise >= 0):
            raise InputError(f"read_noise: {self.read_noise!r} is not allowed; expected 0 or more")
        if not self.speckle_modes > 0:
            raise InputError(
                f"speckle_modes: {self.speckle_modes!r} is not allowed; expected above 0"
            )
        if not (math.isfinite(self.excess) and self.excess >= 1):
            raise InputError(f"excess: {self.excess!r} is not allowed; expected 1 or more")

    def variance(self, mean: torch.Tensor, signal: torch.Tensor) -> torch.Tensor:
        """Electrons^2, of pixels with ``mean`` electrons, ``signal`` of them laser light.

        A Poisson number whose mean is Gamma distributed is negative binomial: mean +
        signal^2 / M. Its likelihood, like Poisson's own, has the score (count - mean) / variance
        d mean, so that weighting by the variance of the fitted mean *is* maximum likelihood.
        With read noise the exact density is a convolution; the same score then loses less than
        1 % of the information for a mean of 20 electrons or more and 4 % at worst (5 electrons
        rms, M = 10 or more). A multiplied number has the variance ``excess`` times Poisson's; the
        score is then that of its first two moments.
        """
        return self.excess * mean + signal**2 / self.speckle_modes + self.read_noise**2


def squared_radius(cells: Cells, dx: torch.Tensor, dy: torch.Tensor) -> torch.Tensor:
    """Mean of r^2 about (dx, dy) from the cells' centre, over the pixels' areas, px^2."""
    return cells.r2 - 2 * (cells.x * dx + cells.y * dy) + dx**2 + dy**2 + PIXEL_R2


def orders(
    model: RingModel, r2: torch.Tensor, v_los: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Cosine of the angle, and the order of interference less the integer part at the centre."""
    scale, centre = (model.pixel / model.focal_length) ** 2, model.order_at_centre
    cosine = (1 + scale * r2).rsqrt()
    # cos - 1 = -tan^2 cos^2 / (1 + cos), without the difference of numbers next to one
    order = centre % 1 - centre * scale * r2 * cosine**2 / (1 + cosine)
    return cosine, order + v_los * cosine / model.velocity_range


def illumination(model: RingModel, r2: torch.Tensor, falloff: torch.Tensor) -> torch.Tensor:
    """Light relative to the rings' centre."""
    return torch.exp(-falloff * r2 / _corner(model))


def _corner(model: RingModel) -> float:
    """Squared half of the image's diagonal, px^2."""
    return (model.shape[0] ** 2 + model.shape[1] ** 2) / 4


def mean_and_jacobian(
    model: RingModel, cells: Cells, parameters: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Mean electrons per pixel in every cell, and their derivatives.

    Parameters
    ----------
    cells : Cells
    parameters : torch.Tensor, shape (images, 7)
        In the order of `PARAMETERS`; x and y from the cells' centre.

    Returns
    -------
    mean : torch.Tensor, shape (images, cells)
    jacobian : torch.Tensor, shape (images, 7, cells)
        By each parameter. The change of a cell's spread of r^2 with the centre is neglected.
    """
    v, dx, dy, level, background, temperature, falloff = parameters.T[..., None]
    r2 = squared_radius(cells, dx, dy)
    variance = (r2 - PIXEL_R2) / 3  # of r2 over a pixel: (2 x)^2 / 12 + (2 y)^2 / 12
    if cells.spread is not None:
        by = torch.cat([-2 * dx, -2 * dy, torch.ones_like(dx)], -1)  # of r2 by (x, y, r2)
        variance = variance + torch.einsum("bi,cij,bj->bc", by, cells.spread, by)
    light = illumination(model, r2, falloff)
    # more light at the inner end of a cell
    cosine, fraction = orders(model, r2 - falloff / _corner(model) * variance, v)
    turn = torch.polar(torch.ones_like(fraction), 2 * torch.pi * fraction)
    per_velocity = cosine / model.velocity_range
    by_r2 = -model.order_at_centre / 2 * (model.pixel / model.focal_length) ** 2 * cosine**3
    damping = torch.exp(-2 * torch.pi**2 * variance * by_r2**2)
    amplitudes, warming = model.at_temperature(temperature[:, 0])
    profile, slope, warmer = (torch.zeros_like(fraction) for _ in range(3))
    wave, blur = torch.ones_like(turn), torch.ones_like(fraction)
    for n in range(1, amplitudes.shape[1]):
        wave = wave * turn
        blur = blur * damping ** (2 * n - 1)  # damping^(n^2) in all
        term = 2 * amplitudes[:, n, None] * wave
        profile += blur * term.real
        slope -= 2 * torch.pi * n * blur * term.imag
        if len(model.temperatures) > 1:
            warmer += blur * 2 * (warming[:, n, None] * wave).real
    profile += 1
    lit = light * profile
    by_r2 = level * light * (slope * by_r2 - profile * falloff / _corner(model))
    return level * lit + background, torch.stack(
        [
            level * light * slope * per_velocity,
            by_r2 * 2 * (dx - cells.x),
            by_r2 * 2 * (dy - cells.y),
            lit,
            torch.ones_like(lit),
            level * light * warmer,
            -level * lit * r2 / _corner(model),
        ],
        1,
    )


def parameter_vector(
    model: RingModel,
    cells: Cells,
    v_los: float = 0.0,
    photons: float = 2.4e7,
    background: float = 0.0,
    temperature: float | None = None,
) -> torch.Tensor:
    """Parameters (1, 7) of an image about the cells' centre with this number of signal electrons.

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
    warm = model.middle_temperature if temperature is None else temperature
    if temperature is not None:
        first, last = model.temperatures[[0, -1]]
        if not first <= temperature <= last:
            raise InputError(
                f"temperature: {temperature!r} K is not allowed; the model is valid from "
                f"{first:g} to {last:g} K"
            )
    vector = torch.tensor(
        [[v_los, 0.0, 0.0, 1.0, 0.0, warm, model.falloff]],
        dtype=torch.float64,
        device=cells.x.device,
    )
    level_one = mean_and_jacobian(model, cells, vector)[0]
    vector[0, 3] = photons / (level_one * cells.count).sum()
    vector[0, 4] = background
    return vector


def expected(
    model: RingModel,
    v_los: float = 0.0,
    photons: float = 2.4e7,
    background: float = 0.0,
    centre: tuple[float, float] | None = None,
    temperature: float | None = None,
    device="cpu",
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
    cells = pixels(model.shape, centre or model.centre, device)
    vector = parameter_vector(model, cells, v_los, photons, background, temperature)
    return mean_and_jacobian(model, cells, vector)[0].reshape(model.shape)
