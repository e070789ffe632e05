"""How many Monte Carlo samples an image needs, so that its noise is the lidar's own.

The images of a pilot, with few samples of random numbers of its own, give the variance of one
sample of every beam and gate. The number of samples is chosen from them and from the variance of
the detector's noise. The image itself is rendered from the start with that number: none of the
pilot's samples is in it, so that the choice does not bias it.
"""

import math
from typing import NamedTuple

import numpy as np
import xarray as xr

from lidar_mi.rendering.pair_error import pair_stderr
from lidar_mi.rendering.settings import RenderSettings

LEAST = 16
"""Samples of a beam and gate: their standard error is then itself right to 18 %."""
PILOT = 32
"""Samples of a beam and gate of a pilot. Its S0 is in the detector's variance by which ratios
divide: with fewer it is too uncertain where a narrow field of view cuts most samples off."""
_LEAST_PILOT = 4
_PILOT_PART = 1 / 16
"""Of the largest number of samples of an image: a pilot takes hardly any time compared with it."""


class Samples(NamedTuple):
    """A chosen number of Monte Carlo samples per beam.

    needed: with which the fraction asked for is reached; above ``number`` where it is too many.
    fraction, median, upper: variance of the simulation's noise over that of the detector's with
        ``number`` samples, as expected: mean, median and 90 % quantile over the beams, of the gate
        with the largest mean.
    """

    number: int
    needed: int
    fraction: float
    median: float
    upper: float

    @property
    def reached(self) -> bool:
        """Whether the number is as large as is needed."""
        return self.number >= self.needed


def noise_ratio(scan: xr.Dataset) -> np.ndarray:
    """Variance of the simulation's noise over that of the detector's, (gate, z, y).

    scan: with ``S0_stderr``, of common random numbers ``S0_pair_stderr``, which counts then, and
        ``S0_noise_std``. NaN where the detector has no noise.
    """
    simulated, detected = (
        error.transpose("gate", "z", "y").values.astype(float) ** 2
        for error in (pair_stderr(scan), scan["S0_noise_std"])
    )
    return np.divide(simulated, detected, out=np.full(simulated.shape, np.nan), where=detected > 0)


def monte_carlo_fraction(scan: xr.Dataset) -> float:
    """Mean of `noise_ratio` over the beams, of the gate in which it is largest.

    By so much, at most, the simulation's noise increases the variance of a weighted fit to the
    image: with weights 1 / (d + m), for the variances d of the detector and m of the simulation,
    the information of a pixel falls by 1 / (1 + m / d), and the mean of 1 / (1 + x) is at least 1 /
    (1 + mean x). Infinite where the detector has no noise.
    """
    return float(_of_the_worst_gate(noise_ratio(scan)).mean())


def pilot_samples(settings: RenderSettings, beams: int, gates: int) -> int:
    """Samples per beam of a pilot."""
    each = math.floor(_PILOT_PART * settings.max_samples / (beams * gates))
    return gates * min(PILOT, max(_LEAST_PILOT, each))


def choose_samples(
    pilot: xr.Dataset, samples: int, settings: RenderSettings, least: int = 2
) -> Samples:
    """The number of samples that make the simulation's noise small compared with the detector's.

    pilot: a scan with the detector's noise.
    samples: per beam, of which it was rendered.
    settings: with ``monte_carlo_fraction``, and ``max_samples`` that bounds the time.
    least: samples per beam that an image must have whatever its noise.
    """
    gates, beams = pilot.sizes["gate"], pilot.sizes["z"] * pilot.sizes["y"]
    of_one = samples * _of_the_worst_gate(noise_ratio(pilot))
    mean = float(of_one.mean())
    most = settings.most_samples(beams, gates)
    if not math.isfinite(mean):  # a detector without noise: no number is enough
        return Samples(most, 2**31 - 1, math.inf, math.inf, math.inf)
    # two standard errors of the pilot's mean; beams are independent samples
    open_ = 2 * float(of_one.std()) / math.sqrt(of_one.size)
    wanted = (mean + open_) / settings.monte_carlo_fraction
    needed = max(_rounded_up(wanted / gates), LEAST, -(-least // gates)) * gates
    number = min(needed, most) if settings.samples_per_beam == "auto" else most
    spread = np.quantile(of_one, (0.5, 0.9))
    return Samples(number, needed, *(float(x) / number for x in (mean, *spread)))


def _of_the_worst_gate(ratio: np.ndarray) -> np.ndarray:
    """Ratios of the gate in which their mean is largest; infinite where none is known."""
    by_gate = ratio.reshape(len(ratio), -1)
    known = [row[np.isfinite(row)] for row in by_gate]
    known = [row for row in known if row.size]
    return max(known, key=lambda row: row.mean()) if known else np.array([math.inf])


def _rounded_up(number: float) -> int:
    """Up to two significant digits, which rounding errors of another machine do not change."""
    step = 10 ** max(0, math.floor(math.log10(max(number, 1))) - 1)
    return math.ceil(number / step) * step
