"""The instrument and the light on which an image of rings depends, and the noise of its pixels.

The mean image itself is in `lidar_mi.retrieval.rings.mean_image`.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Protocol, TypeVar

import numpy as np
from scipy.constants import speed_of_light

from lidar_mi.errors import InputError
from lidar_mi.retrieval.rings.geometry import Geometry
from lidar_mi.retrieval.rings.smooth import MOST_DEGREE, term_names

if TYPE_CHECKING:
    import torch


FRAME = ("v_los", "x", "y", "level", "background", "temperature", "falloff", "aerosol")
"""Parameters of every image: m/s, px, px, electrons per pixel (mean over an order, at the centre),
electrons per pixel, K, the exponent of the illumination's fall-off from centre to corner, and the
fraction of the light that aerosol scatters."""

LIGHT = term_names("light", MOST_DEGREE)
"""Logarithm of uneven illumination, see `lidar_mi.retrieval.rings.smooth`."""

BACKGROUND = term_names("background", MOST_DEGREE)
"""Uneven background, electrons per pixel."""

INSTRUMENT = ("focal_length", "tilt_x", "tilt_y", "distortion", "blur", "damping", "roughness")
"""Departures of the instrument from the model: relative change of the focal length, rad, rad,
distortion at the corner, px^2 (squared radius of the disc of a defocused point), and a and b of the
factor exp(-a n - b n^2) of the n-th harmonic: the mirrors' reflectivity and the plates' defects."""

PARAMETERS = (*FRAME, *LIGHT, *BACKGROUND, *INSTRUMENT)

Electrons = TypeVar("Electrons", float, "torch.Tensor")

NEGLIGIBLE = 1e-7  # harmonics below this fraction of A_0 change velocities by less than 1e-4 m/s
# Of the aerosol's narrow line; the omitted harmonics are nearly orthogonal to a change of speed.
_NEGLIGIBLE_AEROSOL = 1e-4


@dataclass(frozen=True, eq=False)
class RingModel:
    """The properties of an instrument and a line on which the rings depend.

    shape: height and width of the camera, pixels.
    centre: nominal centre of the rings: x to the right, y down, pixels from the top left pixel's
        centre.
    pixel, focal_length, wavelength: m.
    order_at_centre: order of interference of the unshifted line at the centre, with its fraction.
    harmonics (array (T, K) or (K,), complex): A_0 ... A_{K-1} of each of the ``temperatures``; any
        scale, A_0 > 0.
    temperatures (T,): K, ascending, a few nodes: harmonics between them follow the polynomial
        through all. One node, or none given: the temperature is not a parameter.
    falloff: of the illumination: exp(-falloff r^2 / R^2), R half the image's diagonal.
    aerosol_harmonics (array (K,), complex): of the light that aerosol scatters: the laser's own
        line. With them the fraction of that light is a parameter; ``harmonics`` are those of the
        other light.
    tilt, distortion, blur: of the camera and its lens, see `Geometry` and `INSTRUMENT`.
    light: values of terms of `LIGHT`; 0 where one is not given.
    light_degree, background_degree: terms of `LIGHT` and `BACKGROUND` up to this degree are
        unknown, 0 to 8.
    priors (mapping of (mean, standard deviation)): normal distributions of parameters, from other
        sources than the image.
    systematic (8, 8): covariance of the calibration's error, the same in all images: of the speed
        at which the rings are those of order_at_centre (m/s), then of `INSTRUMENT`.

    Raises InputError: numbers out of range, an etalon that transmits nothing or leaves no rings.
    """

    shape: tuple[int, int]
    centre: tuple[float, float]
    pixel: float
    focal_length: float
    wavelength: float
    order_at_centre: float
    harmonics: np.ndarray
    temperatures: np.ndarray = field(default_factory=lambda: np.empty(0))
    falloff: float = 0.0
    aerosol_harmonics: np.ndarray | None = None
    tilt: tuple[float, float] = (0.0, 0.0)
    distortion: float = 0.0
    blur: float = 0.0
    light: Mapping[str, float] = field(default_factory=dict)
    light_degree: int = 0
    background_degree: int = 0
    priors: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    systematic: np.ndarray | None = None

    def __post_init__(self) -> None:
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
        if not temperatures.size or (temperatures.size == 1 and np.isnan(temperatures[0])):
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
        object.__setattr__(self, "harmonics", _relative(harmonics, NEGLIGIBLE))
        object.__setattr__(self, "temperatures", temperatures)
        if self.aerosol_harmonics is not None:
            aerosol = np.atleast_2d(np.asarray(self.aerosol_harmonics, complex))
            object.__setattr__(
                self, "aerosol_harmonics", _relative(aerosol, _NEGLIGIBLE_AEROSOL)[0]
            )
        for name in self.light:
            if name not in LIGHT:
                raise InputError(f"light: {name!r} is not one of {', '.join(LIGHT)}")
        for name, (mean, std) in self.priors.items():
            if name not in PARAMETERS or not (math.isfinite(mean) and std > 0):
                raise InputError(
                    f"priors: {name}: {mean!r} +- {std!r} is not allowed; expected a parameter, a "
                    "finite mean and a standard deviation above 0"
                )
        # raises for impossible degrees
        term_names("light", self.light_degree)
        term_names("background", self.background_degree)

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
        """Those of `PARAMETERS` that are unknown in an image, without the instrument's own."""
        absent = set()
        if len(self.temperatures) < 2:
            absent.add("temperature")
        if self.aerosol_harmonics is None:
            absent.add("aerosol")
        return (
            *(name for name in FRAME if name not in absent),
            *term_names("light", self.light_degree),
            *term_names("background", self.background_degree),
        )

    @property
    def smooth(self) -> tuple[str, ...]:
        """Smooth terms of the model: those of the light, then those of the background."""
        degree = max([self.light_degree, *(int(name.split("_")[1]) for name in self.light)])
        return (*term_names("light", degree), *term_names("background", self.background_degree))

    @property
    def count(self) -> int:
        """The highest harmonic."""
        narrow = 0 if self.aerosol_harmonics is None else len(self.aerosol_harmonics)
        return max(self.harmonics.shape[1], narrow) - 1

    @property
    def middle_temperature(self) -> float:
        """The middle one of the model's temperatures, K."""
        return float(self.temperatures[len(self.temperatures) // 2])

    @property
    def half_diagonal(self) -> float:
        """Half of the image's diagonal, px."""
        return math.hypot(*self.shape) / 2

    @property
    def geometry(self) -> Geometry:
        """Of camera and lens, whose axis meets the camera in the rings' nominal centre."""
        return Geometry(
            self.focal_length / self.pixel,
            self.centre,
            self.half_diagonal,
            self.tilt,
            self.distortion,
        )

    def start(self, device: "str | torch.device" = "cpu") -> "torch.Tensor":
        """Prior means (1, `PARAMETERS`); level 1."""
        import torch

        values = {
            "level": 1.0,
            "temperature": self.middle_temperature,
            "falloff": self.falloff,
            **self.light,
            **{name: mean for name, (mean, _) in self.priors.items()},
        }
        vector = [values.get(name, 0.0) for name in PARAMETERS]
        return torch.tensor([vector], dtype=torch.float64, device=device)

    @cached_property
    def _polynomials(self) -> np.ndarray:
        """Coefficients (T, K) of the harmonics' polynomials over the scaled temperature."""
        nodes = self.temperatures
        if len(nodes) == 1:
            return self.harmonics
        scaled = (nodes - nodes[0]) / (nodes[-1] - nodes[0])
        return np.linalg.solve(np.vander(scaled, increasing=True), self.harmonics)

    def amplitudes(
        self, parameters: "torch.Tensor"
    ) -> "tuple[torch.Tensor, dict[str, torch.Tensor]]":
        """Harmonics A_1 ... of images with these parameters, and their derivatives.

        parameters (images, `PARAMETERS`)

        Returns
        -------
        amplitudes : torch.Tensor, shape (images, K), complex
            Relative to A_0, of light of no speed.
        derivatives : dict
            By temperature and aerosol (where the model has them), damping and roughness.
        """
        import torch

        device = parameters.device
        temperature, aerosol, damping, roughness = (
            parameters[:, PARAMETERS.index(name), None]
            for name in ("temperature", "aerosol", "damping", "roughness")
        )
        table = torch.as_tensor(self._polynomials, device=device)
        by: dict[str, torch.Tensor] = {}
        if len(table) == 1:
            value = table.expand(len(parameters), -1)
        else:
            first, last = self.temperatures[[0, -1]]
            power = torch.arange(len(table), device=device)
            place = (temperature - first) / (last - first)
            slope = power * place ** (power - 1).clamp(min=0) / (last - first)
            value, by["temperature"] = (part.to(table) @ table for part in (place**power, slope))
        if self.aerosol_harmonics is not None:
            narrow = torch.as_tensor(self.aerosol_harmonics, device=device)[None]
            count = max(value.shape[1], narrow.shape[1])
            value, narrow, *warming = (
                torch.nn.functional.pad(part, (0, count - part.shape[1]))
                for part in (value, narrow, *by.values())
            )
            by = {name: part * (1 - aerosol) for name, part in zip(by, warming, strict=True)}
            by["aerosol"] = narrow - value
            value = value * (1 - aerosol) + narrow * aerosol
        n = torch.arange(value.shape[1], device=device)
        factor = torch.exp(-n * damping - n**2 * roughness)
        value = value * factor
        by = {name: (part * factor)[:, 1:] for name, part in by.items()}
        by |= {"damping": (-n * value)[:, 1:], "roughness": (-(n**2) * value)[:, 1:]}
        return value[:, 1:], by


def _relative(harmonics: np.ndarray, negligible: float) -> np.ndarray:
    """Harmonics over their mean A_0, without those that are negligible."""
    if not (np.isfinite(harmonics).all() and (harmonics[:, 0].real > 0).all()):
        raise InputError(
            f"harmonics: mean transmission {harmonics[0, 0]:g} is not allowed; expected "
            "above 0: the etalon must transmit"
        )
    harmonics = harmonics / harmonics[:, :1].real
    strong = np.flatnonzero(np.abs(harmonics).max(0) > negligible)[-1]
    if strong < 1:
        raise InputError("harmonics: all but the mean are 0; expected an etalon that leaves rings")
    return harmonics[:, : strong + 1]


@dataclass(frozen=True)
class PixelNoise:
    """Noise of a pixel, photoelectrons.

    read_noise: standard deviation of the noise that does not depend on the light: root sum of
        squares of the read-out's and of 1 / sqrt(12) of a digitisation step, over the gain before
        them.
    speckle_modes: M of the Gamma distribution that the laser light of a pixel follows; infinite
        without.
    excess: variance of a photoelectron number over Poisson's: the excess noise factor F^2 of a
        multiplication before the read-out, 1 without.

    Raises
    ------
    InputError
    """

    read_noise: float = 0.0
    speckle_modes: float = math.inf
    excess: float = 1.0

    def __post_init__(self) -> None:
        if not (math.isfinite(self.read_noise) and self.read_noise >= 0):
            raise InputError(f"read_noise: {self.read_noise!r} is not allowed; expected 0 or more")
        if not self.speckle_modes > 0:
            raise InputError(
                f"speckle_modes: {self.speckle_modes!r} is not allowed; expected above 0"
            )
        if not (math.isfinite(self.excess) and self.excess >= 1):
            raise InputError(f"excess: {self.excess!r} is not allowed; expected 1 or more")

    def variance(self, mean: Electrons, signal: Electrons) -> Electrons:
        """Electrons^2, of pixels with ``mean`` electrons, ``signal`` of them laser light.

        A Poisson number whose mean is Gamma distributed is negative binomial: mean + signal^2 / M.
        Its likelihood, like Poisson's own, has the score (count - mean) / variance d mean, so that
        weighting by the variance of the fitted mean is maximum likelihood. With read noise the
        exact density is a convolution; the same score then loses less than 1 % of the information
        for a mean of 20 electrons or more and 4 % at worst (5 electrons rms, M = 10 or more). A
        multiplied number has the variance ``excess`` times Poisson's; the score is then that of its
        first two moments.
        """
        return self.excess * mean + signal**2 / self.speckle_modes + self.read_noise**2


class SpeedsOfRings(Protocol):
    """Speeds read from images, by whatever method, as of `RingFit`."""

    @property
    def v_los(self) -> "torch.Tensor": ...  # noqa: D102
    @property
    def v_los_std(self) -> "torch.Tensor": ...  # noqa: D102
    @property
    def sensitivity(self) -> "torch.Tensor": ...  # noqa: D102
    @property
    def systematic(self) -> "torch.Tensor": ...  # noqa: D102
