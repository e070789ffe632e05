"""Winds from frames of an instrument whose defects the retrieval does not know.

The frames are made without the program (`validation.fringe_reference`). A retrieval is a function
of a stack of laser frames and one of air frames; those of `RETRIEVALS` know the nominal instrument
alone. One that calibrates it from the laser frames goes beside them.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from typing import NamedTuple

import numpy as np
import torch

from lidar_mi.atmosphere.line import laser_line
from lidar_mi.experiment.ring_instrument import air_rings, pixel_noise, ring_model
from lidar_mi.instrument.ccd import CCD
from lidar_mi.instrument.doppler import DopplerLidar
from lidar_mi.instrument.etalon import Etalon
from lidar_mi.instrument.fringe_camera import FringeCamera
from lidar_mi.retrieval.rings.likelihood_fit import difference, fit_rings

from .fringe_reference import LIGHT, Defects, Instrument, Light, air_frame, exposures, laser_frame
from .report import Check, Row

TITLE = "Fringe imaging with defects"
INTRODUCTION = (
    "Frames of an etalon's rings with one defect each, by quadrature of Airy's formula over line, "
    "plates, pupil and pixels. The retrieval knows the nominal instrument. Every pulse is a frame "
    "of the laser's own light and one of the echo of air."
)

SPEED, PHOTONS, READ_NOISE = 50.0, 2.4e7, 5.0
PAIRS = 20

INSTRUMENT = Instrument()
_HUNDREDTH = INSTRUMENT.wavelength / 100

WARMER, DRIFT = "etalon 1 K warmer", "laser drift of 10 MHz after the reference"
BOW = "bow of lambda/100 rms, laser in half of the pupil's radius"
WEDGE = "wedge of lambda/100 rms, air's pupil shifted by 5 %"
CASES: dict[str, Defects] = {
    "none": Defects(),
    "camera tilted by 0.5 deg": Defects(tilt=(math.radians(0.5), 0.0)),
    "defocus, disc of 5 px": Defects(defocus=5.0),
    "distortion of 0.1 %": Defects(distortion=1e-3),
    "focal length longer by 0.1 %": Defects(focal_length=1.001),
    "finesse lower by 10 %": Defects(finesse=0.9),
    WARMER: Defects(warming=1.0),
    DRIFT: Defects(drift=10e6),
    BOW: Defects(bow=_HUNDREDTH, laser=Light(pupil=0.5)),
    WEDGE: Defects(wedge=_HUNDREDTH, air=Light(pupil_shift=0.05)),
    "0.1 % hot pixels of 5000 electrons": Defects(hot_pixels=750, hot_electrons=5000.0, seed=1),
    "0.1 % dead pixels": Defects(dead_pixels=750),
    "background bump of 20 %": Defects(bump=0.2),
    "vignetting, 1/e2 radius of 6 mm": Defects(laser=Light(radius=6e-3), air=Light(radius=6e-3)),
    "illumination slope of 5 %": Defects(
        laser=Light(slope=(0.05, 0.0)), air=Light(slope=(0.05, 0.0))
    ),
    "aerosol, 5 % of the echo": Defects(aerosol=0.05),
}


class Retrieved(NamedTuple):
    """Speeds of the air frames, their standard errors (m/s) and chi-square, arrays (frames,)."""

    v: np.ndarray
    v_std: np.ndarray
    chi_square: np.ndarray


Retrieval = Callable[[torch.Tensor, torch.Tensor], Retrieved]
"""From laser frames and air frames, electrons, (frames, height, width); frame k of both is one
pulse."""


@cache
def nominal(instrument: Instrument):
    """Models of air and laser, and the noise, as a user of the nominal instrument has them."""
    lidar = DopplerLidar(line_shape="rayleigh")
    height, width = instrument.shape
    camera = FringeCamera(width=width, height=height, pixel=instrument.pixel)
    line = laser_line(lidar.wavelength, lidar.laser_width)
    noise = pixel_noise(CCD(read_noise=READ_NOISE, bits=None))
    return air_rings(lidar, Etalon(), camera), ring_model(Etalon(), camera, line), noise


def _of(frames: torch.Tensor) -> Instrument:
    """The instrument that has frames of this size."""
    return INSTRUMENT.binned(INSTRUMENT.shape[0] // frames.shape[-2])


def absolute(laser: torch.Tensor, air: torch.Tensor) -> Retrieved:
    """Fit of the echo alone, with the nominal instrument."""
    model, _, noise = nominal(_of(air))
    fit = fit_rings(air, model, noise, max_chi_square=math.inf)
    return Retrieved(*(x.numpy() for x in (fit.v_los, fit.v_los_std, fit.chi_square)))


def to_laser_shot(laser: torch.Tensor, air: torch.Tensor) -> Retrieved:
    """Fit of the echo less that of the pulse's own laser frame."""
    models, noise = nominal(_of(air))[:2], nominal(_of(air))[2]
    received, emitted = (
        fit_rings(frames, model, noise, max_chi_square=math.inf)
        for frames, model in zip((air, laser), models, strict=True)
    )
    v, std, _ = difference(received, emitted)
    worst = torch.maximum(received.chi_square, emitted.chi_square)
    return Retrieved(v.numpy(), std.numpy(), worst.numpy())


RETRIEVALS: dict[str, Retrieval] = {"absolute": absolute, "difference": to_laser_shot}


@dataclass(frozen=True)
class Outcome:
    """Errors of one retrieval over the pulses of one case, m/s."""

    error: np.ndarray
    stated: np.ndarray
    chi_square: float

    @property
    def bias(self) -> float:
        return float(self.error.mean())

    @property
    def bias_std(self) -> float:
        """Standard error of the bias."""
        return float(self.error.std(ddof=1) / math.sqrt(self.error.size))

    def coverage(self, limit: float) -> float:
        """Fraction of errors within so many of the standard errors stated."""
        return float((np.abs(self.error) < limit * self.stated).mean())


def measured(
    defects: Defects,
    pairs: int,
    seed: int,
    retrievals: Mapping[str, Retrieval] = RETRIEVALS,
    instrument: Instrument = INSTRUMENT,
) -> dict[str, Outcome]:
    """The retrievals' errors over ``pairs`` pulses of an instrument with the defects."""
    means = (
        laser_frame(instrument, defects, PHOTONS),
        air_frame(instrument, defects, SPEED, PHOTONS),
    )
    laser, air = (
        torch.from_numpy(exposures(mean, pairs, [seed, number], READ_NOISE).astype(np.float32))
        for number, mean in enumerate(means)
    )
    found = {name: retrieve(laser, air) for name, retrieve in retrievals.items()}
    return {
        name: Outcome(one.v - SPEED, one.v_std, float(one.chi_square.mean()))
        for name, one in found.items()
    }


def closed_forms(instrument: Instrument = INSTRUMENT) -> dict[str, tuple[float, float, str]]:
    """Bias of the absolute speed and of the difference, m/s, where the physics gives them."""
    per_order = LIGHT / 2 / instrument.order
    thermal = instrument.expansion * LIGHT / 2
    drift = 10e6 * instrument.wavelength / 2
    # mean of rho^2 - 1/2 over half the radius: -3/8
    bowed = -3 / 8 * math.sqrt(12) / 100 * 2 * per_order
    wedged = 0.05 * 2 / 100 * 2 * per_order
    return {
        "none": (0.0, 0.0, "no defect"),
        WARMER: (thermal, 0.0, "alpha dT c / 2"),
        DRIFT: (drift, drift, "lambda / 2 times the drift"),
        BOW: (0.0, -bowed, "mean gap over half the radius"),
        WEDGE: (wedged, wedged, "mean gap over the shifted pupil"),
    }


def before_calibration(effort) -> Check:
    """The table of defects, and rows where a closed form gives the bias."""
    pairs = PAIRS * effort.scale
    found = {case: measured(d, pairs, 500 + k) for k, (case, d) in enumerate(CASES.items())}
    rows = []
    for case, (*expected, source) in closed_forms().items():
        for (name, outcome), value in zip(found[case].items(), expected, strict=True):
            rows.append(
                Row(
                    f"{case}: {name} speed, bias",
                    source,
                    value,
                    outcome.bias,
                    outcome.bias_std,
                    0.05,
                    "m/s",
                )
            )
    return Check(
        "Before calibration",
        "\n".join(
            [
                f"{pairs} pulses at {SPEED:g} m/s, {PHOTONS:.1e} photons in every frame, "
                f"{READ_NOISE:g} electrons of read noise. *Within 1*: fraction of the errors below "
                "the standard error stated (expected 68 %).",
                "",
                *table(found),
            ]
        ),
        tuple(rows),
    )


def table(found: Mapping[str, Mapping[str, Outcome]]) -> list[str]:
    """Markdown: one line a defect, four columns a retrieval."""
    names = list(next(iter(found.values())))
    heads = [f"{name}: bias, m/s | stated | within 1 | chi2" for name in names]
    lines = [f"| defect | {' | '.join(heads)} |", "| --- |" + " ---: |" * (4 * len(names))]
    for case, outcomes in found.items():
        cells = [
            f"{o.bias:+.2f} ± {o.bias_std:.2f} | {np.sqrt((o.stated**2).mean()):.2f} | "
            f"{100 * o.coverage(1):.0f} % | {o.chi_square:.2f}"
            for o in outcomes.values()
        ]
        lines.append(f"| {case} | {' | '.join(cells)} |")
    return lines


CHECKS = (before_calibration,)
