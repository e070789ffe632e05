"""The speeds of the lines of sight of successive slabs, from their frames."""

from collections.abc import Sequence

import numpy as np
import torch
import xarray as xr

from lidar_mi.encounter.lidar.doppler import DopplerScans, LineFrames
from lidar_mi.errors import InputError
from lidar_mi.experiment.graph import call
from lidar_mi.experiment.log import Log, silent
from lidar_mi.experiment.stages.lines import line_noises, with_speeds
from lidar_mi.experiment.stages.ring_calibration import assumed_rings, calibration_file
from lidar_mi.experiment.stages.ring_velocities import speeds_to_laser
from lidar_mi.retrieval.method_names import RingCentre, RingMethod
from lidar_mi.retrieval.rings.likelihood_fit import difference, fit_rings
from lidar_mi.retrieval.rings.matched import MatchedScore, matched_score, read_matched

# Frames of a slab whose fits are the reference of all.
_REFERENCE = 8
# Fraction of the lines that the reference may miss before the next slab gets a new one.
_MOST_MISSED = 0.5


class LineSpeeds:
    """Reads the speeds of slab after slab by the score function of a reference.

    The reference is the fit of some frames of the first slab, or of a later one once it no longer
    describes half of the lines. Frames that it does not describe are fitted one by one.

    scans: whose frames are read; the instrument is the one that the experiment assumes.
    """

    def __init__(self, scans: DopplerScans) -> None:
        experiment, rings, log = scans.experiment, scans.rings, Log(silent)
        calibration = call(calibration_file, experiment, rings=rings)
        self._experiment, self._doppler = experiment, scans.doppler
        self._assumed = call(
            assumed_rings, experiment, rings=rings, calibration_file=calibration, log=log
        )
        self._pulses = scans.sensor.pulses
        self._noises = line_noises(self._doppler, self._pulses, rings)
        self._scores: list[MatchedScore] | None = None

    def read(self, frames: LineFrames) -> xr.Dataset:
        """The lines with their speeds and standard errors, as `with_speeds` gives them."""
        self._scores = self._scores or self._reference(frames)
        if self._scores is None:
            return self._with(frames, self._fitted(frames, range(len(frames.air))))
        air, laser = (
            read_matched(part, score)
            for part, score in zip((frames.air, frames.laser), self._scores, strict=True)
        )
        own = torch.tensor(frames.own)
        emitted = laser.of(own)
        speeds = torch.stack([*difference(air, emitted), emitted.v_los_std]).numpy()
        missed = np.flatnonzero(~(air.read & laser.read[own]).numpy())
        if missed.size:
            speeds[:, missed] = self._fitted(frames, missed.tolist())
        if missed.size > _MOST_MISSED * len(frames.air):
            self._scores = None
        return self._with(frames, speeds)

    def _reference(self, frames: LineFrames) -> list[MatchedScore] | None:
        """Score functions of air and laser; None where the frames do not fit the model."""
        assumed, settings = self._assumed, self._doppler.retrieval
        emitted = []
        for part, model, noise in zip(
            (frames.air, frames.laser), (assumed.model, assumed.laser), self._noises, strict=True
        ):
            some = torch.linspace(0, len(part) - 1, min(_REFERENCE, len(part))).round().long()
            try:
                fit = fit_rings(
                    part[some],
                    model,
                    noise,
                    response=assumed.response,
                    max_chi_square=settings.max_chi_square,
                )
            except InputError:
                return None
            emitted.append(matched_score(fit, model, noise, response=assumed.response))
        return emitted

    def _fitted(self, frames: LineFrames, lines: Sequence[int]) -> np.ndarray:
        """Speeds (4, lines) of some lines by a fit each; NaN where a fit is refused."""
        some, own = list(lines), [frames.own[line] for line in lines]
        return speeds_to_laser(
            frames.air[some],
            frames.laser[own],
            self._doppler,
            self._assumed,
            self._noises,
            RingMethod.ANNULAR,
            RingCentre.FREE,
        )

    def _with(self, frames: LineFrames, speeds: np.ndarray) -> xr.Dataset:
        return with_speeds(
            frames.lines, speeds, self._doppler, self._pulses, self._experiment.seed, frames.scan
        )
