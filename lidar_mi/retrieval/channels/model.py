"""Mean signals of a receiver whose channels transmit periodic functions of the frequency.

The elements of a fringe detector, the filters of an edge technique, the annuli of a ring image: all
count, in electrons,

    level Re(C_0 + 2 sum_n C_n exp(2 pi i n v_LOS / period)) + background,
    C_n = (1 - aerosol) M_n(temperature) + aerosol P_n,

with M_n the harmonics of the channel averaged over the line of the molecules and P_n those averaged
over the laser's own line, which aerosol scatters back. A line's Fourier transform makes averages
products, so that nothing here is an integral.
"""

import math
from dataclasses import dataclass, field

import numpy as np
import torch

from lidar_mi.errors import InputError
from lidar_mi.retrieval.rings.model import PixelNoise

PARAMETERS = ("v_los", "level", "temperature", "aerosol")
"""Unknowns: m/s, electrons without a receiver (all channels' light together, all transmitted), K,
and the fraction of the light that aerosol scatters."""


@dataclass(frozen=True, eq=False)
class ChannelModel:
    """The properties of a receiver and a line on which the signals depend.

    Arrays and numbers are converted to tensors.

    molecules (tensor (temperatures, channels, K) or (channels, K), complex): M_n of each channel
        for each of the ``temperatures``, as fractions of the light.
    aerosol (tensor (channels, K), complex): P_n.
    period: speed that moves the line by the period of the transmission, m/s.
    temperatures (temperatures,): K, ascending, a few nodes: harmonics between them follow the
        polynomial through all. One node, or none given: the temperature is not a parameter.
    background (tensor (channels,) or ()): electrons of every channel that are not the laser's,
        known.
    pixels (tensor (channels,) or ()): pixels read out and added in every channel.
    limits: least and largest speed, m/s, between which the signals are those of one speed; default:
        half the period to either side.

    Raises InputError: shapes that do not belong together, numbers out of range.
    """

    molecules: torch.Tensor
    aerosol: torch.Tensor
    period: float
    temperatures: np.ndarray = field(default_factory=lambda: np.empty(0))
    background: torch.Tensor = field(default_factory=lambda: torch.zeros(()))
    pixels: torch.Tensor = field(default_factory=lambda: torch.ones(()))
    limits: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        if not (math.isfinite(self.period) and self.period > 0):
            raise InputError(f"period: {self.period!r} m/s is not allowed; expected above 0")
        low, high = self.span
        if not (math.isfinite(low) and math.isfinite(high) and low < high):
            raise InputError(
                f"limits: {self.span} m/s are not allowed; expected two ascending speeds"
            )
        temperatures = np.atleast_1d(np.asarray(self.temperatures, float))
        if not temperatures.size:
            temperatures = np.array([np.nan])
        elif not (np.all(temperatures > 0) and np.all(np.diff(temperatures) > 0)):
            raise InputError(
                f"temperatures: {temperatures} K are not allowed; expected ascending, above 0"
            )
        molecules = np.asarray(self.molecules, complex)
        molecules = molecules[None] if molecules.ndim == 2 else molecules
        aerosol = np.asarray(self.aerosol, complex)
        expected = (len(temperatures), *aerosol.shape)
        if aerosol.ndim != 2 or min(aerosol.shape) < 2 or molecules.shape != expected:
            raise InputError(
                f"harmonics: shapes {molecules.shape} and {aerosol.shape} are not allowed; "
                f"expected ({len(temperatures)}, channels, K) and (channels, K), two channels and "
                "K = 2 or more"
            )
        for name, value in (("molecules", molecules), ("aerosol", aerosol)):
            if not (np.isfinite(value).all() and (value[..., 0].real > 0).all()):
                raise InputError(
                    f"{name}: expected finite harmonics and a mean transmission above 0"
                )
        channels = np.ones(len(aerosol))
        background = channels * np.asarray(self.background)
        if not (np.isfinite(background) & (background >= 0)).all():
            raise InputError(f"background: {self.background!r} is not allowed; expected 0 or more")
        pixels = channels * np.asarray(self.pixels)
        if not (np.isfinite(pixels) & (pixels > 0)).all():
            raise InputError(f"pixels: {self.pixels!r} is not allowed; expected above 0")
        object.__setattr__(self, "temperatures", temperatures)
        for name, array in (
            ("molecules", molecules),
            ("aerosol", aerosol),
            ("background", background),
            ("pixels", pixels),
        ):
            object.__setattr__(self, name, torch.from_numpy(array))

    @property
    def span(self) -> tuple[float, float]:
        """Least and largest speed, m/s: the limits, or half the period to either side."""
        return self.limits or (-self.period / 2, self.period / 2)

    @property
    def parameters(self) -> tuple[str, ...]:
        """Those of `PARAMETERS` that this model has."""
        known = len(self.temperatures) > 1
        return tuple(name for name in PARAMETERS if known or name != "temperature")

    @property
    def middle_temperature(self) -> float:
        """The middle one of the model's temperatures, K."""
        return float(self.temperatures[len(self.temperatures) // 2])

    def weights(self, temperature: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Lagrange's polynomials of the temperatures (images,), and their derivatives (images, T).

        A harmonic at a temperature is their sum over the model's temperatures.
        """
        nodes = torch.as_tensor(self.temperatures)
        if len(nodes) == 1:
            return torch.ones_like(temperature)[:, None], torch.zeros_like(temperature)[:, None]
        power = torch.arange(len(nodes))
        width = nodes[-1] - nodes[0]
        inverse = torch.linalg.inv(((nodes - nodes[0]) / width)[:, None] ** power)
        place = ((temperature - nodes[0]) / width)[:, None]
        slope = power * place ** (power - 1).clamp(min=0) / width
        return place**power @ inverse, slope @ inverse


def mean_and_jacobian(
    model: ChannelModel, parameters: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Mean electrons (images, channels), and derivatives (images, 4, channels) by `PARAMETERS`."""
    v, level, temperature, aerosol = parameters.T[..., None]
    n = torch.arange(model.aerosol.shape[1], dtype=torch.float64)
    rate = 2 * math.pi / model.period * n
    phases = torch.polar((1 + n.clamp(max=1)).expand(len(v), -1), v * rate)
    nodes, slopes = model.weights(temperature[:, 0])

    def fractions(waves: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Of the light, of every channel: of molecules at the nodes, of aerosol."""
        clear = torch.einsum("tck,ik->itc", model.molecules, waves).real
        return clear, torch.einsum("ck,ik->ic", model.aerosol, waves).real

    def mixed(clear: torch.Tensor, dusty: torch.Tensor, weights: torch.Tensor) -> torch.Tensor:
        return (1 - aerosol) * torch.einsum("it,itc->ic", weights, clear) + aerosol * dusty

    clear, dusty = fractions(phases)
    by_speed = fractions(1j * rate * phases)
    shape = mixed(clear, dusty, nodes)
    return level * shape + model.background, torch.stack(
        [
            level * mixed(*by_speed, nodes),
            shape,
            level * mixed(clear, torch.zeros_like(dusty), slopes),
            level * (dusty - torch.einsum("it,itc->ic", nodes, clear)),
        ],
        1,
    )


def variance(model: ChannelModel, noise: PixelNoise, mean: torch.Tensor) -> torch.Tensor:
    """Electrons^2 of channels with ``mean`` electrons, each a sum of equal pixels."""
    signal = (mean - model.background).clamp(min=0)
    return model.pixels * noise.variance(mean / model.pixels, signal / model.pixels)


def parameter_vector(
    model: ChannelModel,
    v_los: float = 0.0,
    level: float = 1.0,
    temperature: float | None = None,
    aerosol: float = 0.0,
) -> torch.Tensor:
    """Parameters (1, 4); the middle one of the model's temperatures if none is given.

    Raises
    ------
    InputError
        Numbers out of range.
    """
    warm = model.middle_temperature if temperature is None else temperature
    if not (math.isfinite(level) and level > 0):
        raise InputError(f"level: {level!r} is not allowed; expected above 0 electrons")
    if not math.isfinite(v_los):
        raise InputError(f"v_los: {v_los!r} m/s is not allowed; expected a finite speed")
    if not 0 <= aerosol <= 1:
        raise InputError(f"aerosol: {aerosol!r} is not allowed; expected 0 to 1")
    first, last = model.temperatures[[0, -1]]
    if temperature is not None and not first <= temperature <= last:
        raise InputError(
            f"temperature: {temperature!r} K is not allowed; the model is valid from {first:g} to "
            f"{last:g} K"
        )
    return torch.tensor([[v_los, level, warm, aerosol]], dtype=torch.float64)
