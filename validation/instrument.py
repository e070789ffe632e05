"""Winds from frames of an instrument with defects, before and after its calibration.

The frames are made without the program (`validation.fringe_reference`). A retrieval is a function
of `Frames`: those of a calibration, and a laser and an air frame of every pulse. `uncalibrated`
knows the nominal instrument alone; `calibrated_first` fits it to the frames of the calibration.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cache, lru_cache
from typing import NamedTuple

import numpy as np
import torch

from lidar_mi.errors import InputError
from lidar_mi.experiment.ring_instrument import air_rings, laser_rings, pixel_noise
from lidar_mi.instrument.ccd import CCD
from lidar_mi.instrument.doppler import DopplerLidar
from lidar_mi.instrument.etalon import Etalon
from lidar_mi.instrument.fringe_camera import FringeCamera
from lidar_mi.retrieval.rings.calibration import calibrated
from lidar_mi.retrieval.rings.calibration_fit import calibrate_rings
from lidar_mi.retrieval.rings.likelihood_fit import RingFit, difference, fit_rings
from lidar_mi.retrieval.rings.reference_error import Filling, ReferenceUncertainty

from .fringe_reference import LIGHT, Defects, Instrument, Light, air_frame, exposures, laser_frame
from .report import Check, Row

TITLE = "Fringe imaging with defects"
INTRODUCTION = (
    "Frames of an etalon's rings with one defect each, by quadrature of Airy's formula over line, "
    "plates, pupil and pixels, without the program. Every pulse is a frame of the laser's own "
    "light and one of the echo of air. *Absolute* is the speed of the echo's rings, *difference* "
    "that less the speed of the pulse's own laser frame. The retrieval first knows the nominal "
    "instrument alone, then the instrument as calibrated from frames of the laser. Calibration "
    "mends what the laser's frames show: geometry, focus, finesse, illumination, background, "
    "pixels and the etalon's temperature, to 0.1 m/s, and then 5 to 50 % of aerosol, too. It "
    "cannot mend what differs between the laser's frame and the echo: a drift after the reference, "
    "or defects of the plates where laser and air fill the pupil differently; chi-square is 1 all "
    "the same. These errors are stated from what is known of drifts, plates and pupil beside the "
    "frames, and then cover the truth."
)

SPEED, PHOTONS, READ_NOISE = 50.0, 2.4e7, 5.0
PAIRS, CALIBRATION_FRAMES = 20, 20
BACKGROUND_DEGREE = 8

INSTRUMENT = Instrument()
BINNED = 2
"""Pixels each way in one of the frames, of those of `INSTRUMENT`; 1 with ``--slow``."""
_HUNDREDTH = INSTRUMENT.wavelength / 100

WARMER, DRIFT = "etalon 1 K warmer", "laser drift of 10 MHz after the reference"
BOW = "bow of lambda/100 rms, laser in half of the pupil's radius"
WEDGE = "wedge of lambda/100 rms, air's pupil shifted by 5 %"
CASES: dict[str, Defects] = {
    "none": Defects(),
    "camera tilted by 0.5 deg": Defects(tilt=(math.radians(0.5), 0.0)),
    "defocus, disc of 5 px of 7.4 um": Defects(defocus=5.0),
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
    "aerosol, 50 % of the echo": Defects(aerosol=0.5),
}

_ETALON = {"wavelength": INSTRUMENT.wavelength, "gap": INSTRUMENT.gap}
KNOWN: dict[str, ReferenceUncertainty] = {
    DRIFT: ReferenceUncertainty(**_ETALON, laser_drift=10e6),
    BOW: ReferenceUncertainty(**_ETALON, bow=_HUNDREDTH, laser=Filling(radius=0.5)),
    WEDGE: ReferenceUncertainty(**_ETALON, wedge=_HUNDREDTH, air=Filling(shift=0.05)),
}
"""What frames of the laser cannot show, as it is known beside them."""
MENDED = tuple(case for case in CASES if case not in KNOWN)


class Frames(NamedTuple):
    """Electrons, (frames, height, width); frame k of laser and of air is one pulse.

    The frames of ``calibration`` are of the laser, too, without the pulses of the others.
    """

    calibration: torch.Tensor
    laser: torch.Tensor
    air: torch.Tensor


class Retrieved(NamedTuple):
    """Speeds of the air frames, random and systematic standard errors, m/s; chi-square.

    Arrays (frames,).
    """

    v: np.ndarray
    v_std: np.ndarray
    v_systematic: np.ndarray
    chi_square: np.ndarray


Retrieval = Callable[[Frames], dict[str, Retrieved]]
"""Speeds by the name of their method."""


@cache
def nominal(instrument: Instrument, **told):
    """Models of air and laser, and the noise, as a user of the nominal instrument has them.

    ``told`` is what `air_rings` takes along.
    """
    lidar = DopplerLidar(line_shape="rayleigh")
    height, width = instrument.shape
    camera = FringeCamera(width=width, height=height, pixel=instrument.pixel)
    noise = pixel_noise(CCD(read_noise=READ_NOISE, bits=None))
    return air_rings(lidar, Etalon(), camera, **told), laser_rings(lidar, Etalon(), camera), noise


def _of(frames: torch.Tensor) -> Instrument:
    """The instrument that has frames of this size."""
    return INSTRUMENT.binned(INSTRUMENT.shape[0] // frames.shape[-2])


def uncalibrated(frames: Frames) -> dict[str, Retrieved]:
    """Fits with the nominal instrument."""
    air_model, laser_model, noise = nominal(_of(frames.air))
    air = fit_rings(frames.air, air_model, noise, max_chi_square=math.inf)
    laser = fit_rings(frames.laser, laser_model, noise, max_chi_square=math.inf)
    return _both(air, laser)


def calibrated_first(frames: Frames) -> dict[str, Retrieved]:
    """Fits with the instrument as the frames of the calibration show it.

    Unknown in each echo are the fraction of aerosol, the temperature (known to 10 K), and slopes of
    illumination and background.
    """
    smooth = {"light_degree": 1, "background_degree": BACKGROUND_DEGREE}
    air_model, laser_model, noise = nominal(
        _of(frames.air), aerosol_std=0.5, temperature_std=10.0, **smooth
    )
    found = calibrate_rings(
        frames.calibration, laser_model, noise, background_degree=BACKGROUND_DEGREE
    )
    models = (calibrated(model, found) for model in (air_model, replace(laser_model, **smooth)))
    return _both(
        *(
            fit_rings(
                images,
                model,
                noise,
                centre=model.centre,
                response=torch.from_numpy(found.response),
                max_chi_square=math.inf,
            )
            for images, model in zip((frames.air, frames.laser), models, strict=True)
        )
    )


def _both(air: RingFit, laser: RingFit) -> dict[str, Retrieved]:
    """The absolute speed, and its difference to the pulse's own laser frame."""
    worst = torch.maximum(air.chi_square, laser.chi_square)
    both = {
        "absolute": (air.v_los, air.v_los_std, air.v_los_systematic, air.chi_square),
        "difference": (*difference(air, laser), worst),
    }
    return {name: Retrieved(*(x.numpy() for x in values)) for name, values in both.items()}


RETRIEVALS: dict[str, Retrieval] = {"before": uncalibrated, "after": calibrated_first}


@dataclass(frozen=True)
class Outcome:
    """Errors of one retrieval over the pulses of one case, m/s."""

    error: np.ndarray
    stated: np.ndarray
    systematic: np.ndarray
    chi_square: float

    @property
    def bias(self) -> float:
        return float(self.error.mean())

    @property
    def bias_std(self) -> float:
        """Standard error of the bias, of the pulses' scatter alone."""
        return float(self.error.std(ddof=1) / math.sqrt(self.error.size))

    @property
    def normalised(self) -> np.ndarray:
        """Errors over the root sum of squares of both standard errors stated."""
        return self.error / np.hypot(self.stated, self.systematic)

    def coverage(self, limit: float) -> float:
        """Fraction of errors within so many of the combined standard errors stated."""
        return float((np.abs(self.normalised) < limit).mean())


def measured(
    defects: Defects,
    pairs: int,
    seed: int,
    retrieval: Retrieval,
    instrument: Instrument = INSTRUMENT,
    known: ReferenceUncertainty | None = None,
) -> dict[str, Outcome]:
    """The retrieval's errors over ``pairs`` pulses of an instrument with the defects.

    Defects are those on the camera of `INSTRUMENT`. ``known`` is what is known of the reference
    shot beside the frames.
    """
    beside = 0.0 if known is None else known.total
    binning = INSTRUMENT.shape[0] // instrument.shape[0]
    defects = replace(
        defects,
        defocus=defects.defocus / binning,
        hot_pixels=defects.hot_pixels // binning**2,
        dead_pixels=defects.dead_pixels // binning**2,
    )
    found = retrieval(_frames(defects, pairs, seed, instrument))
    return {
        name: Outcome(
            one.v - SPEED, one.v_std, np.hypot(one.v_systematic, beside), one.chi_square.mean()
        )
        for name, one in found.items()
    }


@lru_cache(maxsize=1)
def _frames(defects: Defects, pairs: int, seed: int, instrument: Instrument) -> Frames:
    """The last ones stay, for the next retrieval."""
    laser = laser_frame(instrument, defects, PHOTONS)
    air = air_frame(instrument, defects, SPEED, PHOTONS)
    drawn = ((laser, CALIBRATION_FRAMES), (laser, pairs), (air, pairs))
    return Frames(
        *(
            torch.from_numpy(exposures(mean, count, [seed, k], READ_NOISE).astype(np.float32))
            for k, (mean, count) in enumerate(drawn)
        )
    )


def closed_forms(instrument: Instrument = INSTRUMENT) -> dict[str, tuple[float, float, str]]:
    """Bias of the absolute speed and of the difference, m/s, before calibration, where the physics
    gives them."""
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


@cache
def _all_cases(pairs: int, binning: int) -> dict[str, dict[str, dict[str, Outcome]]]:
    """Outcomes by retrieval, case and method."""
    instrument = INSTRUMENT.binned(binning)
    found = {when: {} for when in RETRIEVALS}
    for number, (case, defects) in enumerate(CASES.items()):
        for when, retrieval in RETRIEVALS.items():
            known = KNOWN.get(case) if when == "after" else None
            try:
                one = measured(defects, pairs, 500 + number, retrieval, instrument, known)
            except InputError:
                one = {}  # refused
            found[when][case] = one
    return found


def _size(effort) -> tuple[int, int]:
    """Pulses, and binning of the frames."""
    return (PAIRS, 1) if effort.scale > 1 else (2 * PAIRS, BINNED)


def before_calibration(effort) -> Check:
    """The table of defects, and rows where a closed form gives the bias."""
    pairs, binning = _size(effort)
    found = _all_cases(pairs, binning)["before"]
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
    height, width = INSTRUMENT.binned(binning).shape
    text = (
        f"{pairs} pulses at {SPEED:g} m/s, {PHOTONS:.1e} photons in every frame of {width} x "
        f"{height} pixels, {READ_NOISE:g} electrons of read noise. *Random*: standard error "
        "stated. *Within 1*, *within 1.96*: fraction of the errors "
        "below so many standard errors stated (expected 68 and 95 %)."
    )
    return Check("Before calibration", "\n".join([text, "", *table(found)]), tuple(rows))


def after_calibration(effort) -> Check:
    """The same with the calibrated instrument.

    A bias may differ from 0 by what is stated: the random error of the mean of the pulses, and the
    systematic one that they share.
    """
    pairs, binning = _size(effort)
    found = _all_cases(pairs, binning)["after"]
    rows = []
    for case in MENDED:
        for name, one in found[case].items():
            mean = np.sqrt((one.stated**2).mean() / pairs + (one.systematic**2).mean())
            row = f"{case}: {name} speed, bias"
            rows.append(Row(row, "none", 0.0, one.bias, mean, unit="m/s"))
    for name in next(iter(found.values())):
        z = np.concatenate([found[case][name].normalised for case in MENDED])
        for limit in (1, 1.96):
            covered = math.erf(limit / math.sqrt(2))
            rows.append(
                Row(
                    f"{name} speed: errors within {limit} standard errors, {len(MENDED)} cases",
                    "normal distribution",
                    covered,
                    (np.abs(z) < limit).mean(),
                    math.sqrt(covered * (1 - covered) / z.size),
                )
            )
    for case, known in KNOWN.items():
        one = found[case]["difference"]
        row = f"{case}: bias of the difference"
        source = "systematic error stated from the instrument"
        rows.append(Row(row, source, known.total, abs(one.bias), one.bias_std, 0.05, "m/s"))
    scrambling = {case: KNOWN[case].scrambling_for(0.5) for case in (BOW, WEDGE)}
    text = (
        f"The instrument is fitted to {CALIBRATION_FRAMES} frames of the laser with noise of their "
        f"own. *Systematic*: standard error stated that all pulses share, of the calibration and "
        "of the reference shot. *Within 1*, *within 1.96*: of random and systematic error "
        "together. For 0.5 m/s, light must be scrambled until it fills the pupil evenly but for "
        f"{1 - scrambling[BOW]:.1%} (bow) and {1 - scrambling[WEDGE]:.0%} (wedge) of what it does "
        "here."
    )
    lines = [text, "", *table(found, systematic=True)]
    return Check("After calibration", "\n".join(lines), tuple(rows))


def table(found: Mapping[str, Mapping[str, Outcome]], systematic: bool = False) -> list[str]:
    """Markdown: one line a defect, five or six columns a method."""
    names = list(next(iter(found.values())))
    stated = ["random", "systematic"] if systematic else ["random"]
    heads = [
        " | ".join([f"{name}: bias, m/s", *stated, "within 1", "within 1.96", "chi2"])
        for name in names
    ]
    columns = len(names) * (len(stated) + 4)
    lines = [f"| defect | {' | '.join(heads)} |", "| --- |" + " ---: |" * columns]
    for case, outcomes in found.items():
        cells = [] if outcomes else ["refused"] + [""] * (columns - 1)
        for one in outcomes.values():
            cells += [f"{one.bias:+.2f} ± {one.bias_std:.2f}"]
            errors = (one.stated, one.systematic)[: len(stated)]
            cells += [f"{np.sqrt((error**2).mean()):.2f}" for error in errors]
            cells += [f"{100 * one.coverage(limit):.0f} %" for limit in (1, 1.96)]
            cells += [f"{one.chi_square:.2f}"]
        lines.append(f"| {case} | {' | '.join(cells)} |")
    return lines


CHECKS = (before_calibration, after_calibration)
