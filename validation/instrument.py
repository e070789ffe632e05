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
from lidar_mi.experiment.stages.ring_instrument import air_rings, laser_rings, pixel_noise
from lidar_mi.instrument.ccd import CCD
from lidar_mi.instrument.doppler import DopplerLidar
from lidar_mi.instrument.etalon import Etalon
from lidar_mi.instrument.fringe_camera import FringeCamera
from lidar_mi.retrieval.rings.calibration import calibrated
from lidar_mi.retrieval.rings.calibration_fit import calibrate_rings
from lidar_mi.retrieval.rings.likelihood_fit import RingFit, difference, fit_rings
from lidar_mi.retrieval.rings.reference_error import Filling, ReferenceUncertainty

from .fringe_reference import LIGHT, Defects, Instrument, Light, air_frame, exposures, laser_frame
from .report import Check, Comparison, Row
from .scenes import Effort

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
PAIRS, CALIBRATION_FRAMES = 40, 20
CALIBRATIONS, PULSES_OF_EACH = 5, 80
"""After calibration: each with laser frames of its own, and the pulses read with it."""
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


_Outcomes = Mapping[str, Mapping[str, "Outcome"]]
"""By case and method."""

RETRIEVALS: dict[str, Retrieval] = {"before": uncalibrated, "after": calibrated_first}


@dataclass(frozen=True)
class Outcome:
    """Errors of one retrieval over the pulses of one case, m/s.

    Pulses of one calibration, all in a row and as many of each, share its systematic error.
    """

    error: np.ndarray
    stated: np.ndarray
    systematic: np.ndarray
    chi_square: float
    calibrations: int = 1

    @property
    def bias(self) -> float:
        return float(self.error.mean())

    @property
    def bias_std(self) -> float:
        """Standard error of the bias, of the pulses' scatter about their calibration's mean."""
        left = self._by_calibration(self.error)
        left = left - left.mean(1, keepdims=True)
        return float(math.sqrt((left**2).sum() / (left.size - len(left)) / left.size))

    @property
    def normalised(self) -> np.ndarray:
        """Errors over the root sum of squares of both standard errors stated."""
        return self.error / np.hypot(self.stated, self.systematic)

    def coverage(self, limit: float) -> float:
        """Fraction of errors within so many of the combined standard errors stated."""
        return float((np.abs(self.normalised) < limit).mean())

    def coverage_std(self, limit: float) -> float:
        """Standard error of the coverage if the stated errors hold, from the pulses and, where
        that is more, from the scatter over the calibrations."""
        expected = math.erf(limit / math.sqrt(2))
        binomial = math.sqrt(expected * (1 - expected) / self.error.size)
        if self.calibrations == 1:
            return binomial
        each = self._by_calibration(np.abs(self.normalised) < limit).mean(1)
        return max(binomial, float(each.std(ddof=1)) / math.sqrt(len(each)))

    def _by_calibration(self, values: np.ndarray) -> np.ndarray:
        return values.reshape(self.calibrations, -1)


def measured(
    defects: Defects,
    pairs: int,
    seed: int,
    retrieval: Retrieval,
    instrument: Instrument = INSTRUMENT,
    known: ReferenceUncertainty | None = None,
    calibrations: int = 1,
) -> dict[str, Outcome]:
    """The retrieval's errors over ``pairs`` pulses of an instrument with the defects.

    Defects are those on the camera of `INSTRUMENT`. ``known`` is what is known of the reference
    shot beside the frames. Of several ``calibrations``, each has ``pairs`` pulses.
    """
    beside = 0.0 if known is None else known.total
    binning = INSTRUMENT.shape[0] // instrument.shape[0]
    defects = replace(
        defects,
        defocus=defects.defocus / binning,
        hot_pixels=defects.hot_pixels // binning**2,
        dead_pixels=defects.dead_pixels // binning**2,
    )
    found = [
        retrieval(_frames(defects, pairs, (seed, number), instrument))
        for number in range(calibrations)
    ]
    outcomes = {}
    for name in found[0]:
        v, std, systematic, chi_square = map(
            np.concatenate, zip(*(f[name] for f in found), strict=True)
        )
        systematic = np.hypot(systematic, beside)
        outcomes[name] = Outcome(v - SPEED, std, systematic, chi_square.mean(), calibrations)
    return outcomes


@lru_cache(maxsize=1)
def _frames(defects: Defects, pairs: int, seed: tuple[int, int], instrument: Instrument) -> Frames:
    """The last ones stay, for the next retrieval."""
    laser = laser_frame(instrument, defects, PHOTONS)
    air = air_frame(instrument, defects, SPEED, PHOTONS)
    drawn = ((laser, CALIBRATION_FRAMES), (laser, pairs), (air, pairs))
    return Frames(
        *(
            torch.from_numpy(
                exposures(mean, count, [seed[0], k, seed[1]], READ_NOISE).astype(np.float32)
            )
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
def _all_cases(when: str, effort: Effort) -> dict[str, dict[str, Outcome]]:
    """Outcomes by case and method; pulses of a few calibrations once the instrument is known."""
    pairs, calibrations = (PAIRS, 1) if when == "before" else (PULSES_OF_EACH, CALIBRATIONS)
    instrument = INSTRUMENT.binned(_binning(effort))
    found = {}
    for number, (case, defects) in enumerate(CASES.items()):
        known = KNOWN.get(case) if when == "after" else None
        seed = 500 + number
        settings = pairs, seed, RETRIEVALS[when], instrument, known, calibrations
        try:
            found[case] = measured(defects, *settings)
        except InputError:
            found[case] = {}  # refused
    return found


def _binning(effort: Effort) -> int:
    return 1 if effort.scale > 1 else BINNED


def before_calibration(effort: Effort) -> Check:
    """The table of defects, and rows where a closed form gives the bias."""
    found = _all_cases("before", effort)
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
    height, width = INSTRUMENT.binned(_binning(effort)).shape
    text = (
        f"{PAIRS} pulses at {SPEED:g} m/s, {PHOTONS:.1e} photons in every frame of {width} x "
        f"{height} pixels, {READ_NOISE:g} electrons of read noise. *Random*: standard error "
        "stated. *Within 1*, *within 1.96*: fraction of the errors "
        "below so many standard errors stated (expected 68 and 95 %)."
    )
    return Check("Before calibration", "\n".join([text, "", *table(found)]), tuple(rows))


def after_calibration(effort: Effort) -> Check:
    """The same with the calibrated instrument.

    A bias may differ from 0 by what is stated: the random error of the mean of the pulses, and the
    systematic one that they share.
    """
    found = _all_cases("after", effort)
    rows = []
    for case in MENDED:
        for name, one in found[case].items():
            shared = (one.systematic**2).mean() / CALIBRATIONS
            mean = np.sqrt((one.stated**2).mean() / one.error.size + shared)
            row = f"{case}: {name} speed, bias"
            rows.append(Row(row, "none", 0.0, one.bias, mean, unit="m/s"))
            for limit in (1, 1.96):
                rows.append(
                    Row(
                        f"{case}: {name} speed, errors within {limit} standard errors",
                        "normal distribution",
                        math.erf(limit / math.sqrt(2)),
                        one.coverage(limit),
                        one.coverage_std(limit),
                    )
                )
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
        f"{CALIBRATIONS} times the instrument is fitted to {CALIBRATION_FRAMES} frames of the "
        f"laser, and then reads {PULSES_OF_EACH} pulses. *Systematic*: standard error stated that "
        "all of them share, of the calibration and of the reference shot. *Within 1*, *within "
        "1.96*: of random and systematic error together. For 0.5 m/s, light must be scrambled "
        "until it fills the pupil evenly but for "
        f"{1 - scrambling[BOW]:.1%} (bow) and {1 - scrambling[WEDGE]:.0%} (wedge) of what it does "
        "here."
    )
    lines = [text, "", *table(found, systematic=True)]
    both = _in_short(_all_cases("before", effort), found)
    return Check("After calibration", "\n".join(lines), tuple(rows), comparison=both)


def _in_short(before: _Outcomes, after: _Outcomes) -> Comparison:
    """One line a defect: both methods' bias, and how well the stated errors hold afterwards."""
    heads = ["defect", "before: absolute", "difference", "after: absolute", "difference"]
    heads += ["random", "systematic"]
    heads += [
        f"{name}: within {limit}" for name in ("absolute", "difference") for limit in (1, 1.96)
    ]
    lines = []
    for case in CASES:
        cells = [case]
        for found in (before[case], after[case]):
            cells += [f"{one.bias:+.2f} ± {one.bias_std:.2f}" for one in found.values()] or [
                "refused"
            ] * 2
        if absolute := after[case].get("absolute"):
            both = absolute.stated, absolute.systematic
            cells += [f"{np.sqrt((error**2).mean()):.2f}" for error in both]
        for one in after[case].values():
            for limit in (1, 1.96):
                std = f" ± {100 * one.coverage_std(limit):.0f}" if case in MENDED else ""
                cells.append(f"{100 * one.coverage(limit):.0f}{std} %")
        lines.append(tuple(cells + [""] * (len(heads) - len(cells))))
    return Comparison(tuple(heads), tuple(lines))


def table(found: _Outcomes, systematic: bool = False) -> list[str]:
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
