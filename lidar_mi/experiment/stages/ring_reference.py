"""The laser's frames between the pulses: drifts since the last one, and how it fills the pupil.

A frame of the laser precedes every ``reference.every`` pulses. Laser and etalon drift from pulse to
pulse as random walks, which the next frame begins anew: the k-th pulse behind a frame has the sum
of k steps. Errors of pulses behind one frame are correlated, and its noise is common to them.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import scipy

from lidar_mi.errors import InputError
from lidar_mi.schema.doppler import Doppler

if TYPE_CHECKING:
    from lidar_mi.retrieval.rings.reference_error import ReferenceUncertainty


DRIFTS = 2  # selects the random streams of drifts
_CALIBRATION = 1 << 30  # group of pulses that no series has
WANTED = 0.5  # m/s, error for which the required scrambling is stated


def reference_frames(averaged: int, every: int, key: str) -> tuple[int, int]:
    """Frames of the laser in an average of pulses, and averages that share one frame.

    Raises InputError: an average that is neither a multiple nor a divisor of ``every``; ``key`` is
    its name.
    """
    if averaged % every and every % averaged:
        raise InputError(
            f"{key}: {averaged} pulses are not allowed with doppler.reference.every = {every}; "
            "expected a multiple or a divisor of it"
        )
    return max(1, averaged // every), max(1, every // averaged)


def step_speed(doppler: Doppler) -> float:
    """Rms change of the retrieved speed by the drifts from pulse to pulse, m/s."""
    return math.hypot(
        # v = wavelength / 2 times a change of frequency; c / 2 times a relative one, as of the gap
        doppler.lidar.wavelength / 2 * doppler.reference.laser_drift,
        scipy.constants.speed_of_light
        / 2
        * doppler.reference.expansion
        * doppler.reference.etalon_drift,
    )


def drifts(
    doppler: Doppler, averaged: int, seed: Sequence[int], numbers: Sequence[int], key: str
) -> tuple[np.ndarray, np.ndarray]:
    """Drift in the speed of averages of pulses, and its standard deviation, m/s.

    averaged: pulses of an average.
    numbers: of the averages, counted from the first pulse of a series.
    key: as of `reference_frames`.
    """
    every = doppler.reference.every
    frames, sharing = reference_frames(averaged, every, key)
    step = step_speed(doppler)
    group, slot = np.divmod(np.asarray(numbers, dtype=int), sharing)
    weight = _reached(slot, averaged, frames, every) / frames
    walked = np.empty(len(weight))
    for one in np.unique(group):
        steps = np.random.default_rng([*seed, DRIFTS, int(one)]).standard_normal((frames, every))
        walked[group == one] = weight[group == one] @ steps.sum(0)
    return step * walked, step * np.sqrt(frames * (weight**2).sum(1))


def _reached(slot: np.ndarray, averaged: int, frames: int, every: int) -> np.ndarray:
    """Fraction of the pulses of an average that come after each step of the walks, (n, every)."""
    return np.clip(1 + (slot[:, None] * averaged - np.arange(every)) * frames / averaged, 0, 1)


def shared_covariance(
    doppler: Doppler, averaged: int, laser_std: np.ndarray, key: str
) -> np.ndarray | None:
    """Covariance of the errors of averages of pulses, beyond each one's own, (m/s)^2.

    Averages behind one frame of the laser share its noise, and the drifts before the earlier one.
    Each average has ``averaged`` pulses, and ``laser_std`` (m/s) of its laser's frame; the key is
    that of `reference_frames`. 0 on the diagonal; None where every average has frames of its own.
    """
    every = doppler.reference.every
    _, sharing = reference_frames(averaged, every, key)
    if sharing == 1:
        return None
    group, slot = np.divmod(np.arange(len(laser_std)), sharing)
    weight = _reached(slot, averaged, 1, every)
    covariance = np.outer(laser_std, laser_std) + step_speed(doppler) ** 2 * weight @ weight.T
    covariance[group[:, None] != group] = 0
    np.fill_diagonal(covariance, 0)
    return covariance


def calibration_drift(doppler: Doppler, frames: int, seed: int) -> np.ndarray:
    """Drift in the speed of frames of a calibration, one a pulse, (frames,), m/s.

    The random walk is about its middle frame, to which laser and etalon are set.
    """
    steps = np.random.default_rng([seed, DRIFTS, _CALIBRATION]).standard_normal(frames)
    walk = step_speed(doppler) * steps.cumsum()
    return walk - walk[frames // 2]


def reference_uncertainty(doppler: Doppler) -> "ReferenceUncertainty":
    """Errors of a pulse, the middle one behind its frame of the laser, that no image shows."""
    from lidar_mi.retrieval.rings.reference_error import Filling, ReferenceUncertainty

    known, etalon = doppler.reference, doppler.etalon
    # (every + 1) / 2 steps on average
    steps = math.sqrt((known.every + 1) / 2)
    return ReferenceUncertainty(
        wavelength=doppler.lidar.wavelength,
        gap=etalon.index * etalon.tuned_gap(doppler.lidar.wavelength),
        laser_drift=steps * known.laser_drift,
        etalon_drift=steps * known.etalon_drift,
        expansion=known.expansion,
        # from the rim to the middle, of a parabola over a disc
        bow=etalon.bow / math.sqrt(12),
        wedge=known.wedge,
        laser=Filling(radius=known.laser_pupil),
        air=Filling(shift=known.echo_shift),
        scrambling=known.scrambling,
    )


def plate_error(doppler: Doppler) -> float:
    """Error of every speed by bow and wedge where laser and echo fill the pupil differently, m/s.

    Positive: the echo passes a wider gap than the laser.
    """
    from lidar_mi.retrieval.rings.reference_error import Filling

    terms = reference_uncertainty(doppler).terms()
    sides = {
        # the gap of an etalon with a bow is widest in the middle
        "bow and pupil": Filling(radius=doppler.reference.laser_pupil).bow
        - Filling(shift=doppler.reference.echo_shift).bow,
        "wedge and pupil": doppler.reference.echo_shift,
    }
    return sum(math.copysign(terms[name], side) for name, side in sides.items())


def plate_uncertainty(doppler: Doppler) -> float:
    """Stated systematic standard error by the same, m/s."""
    terms = reference_uncertainty(doppler).terms()
    return math.hypot(terms["bow and pupil"], terms["wedge and pupil"])


def scrambling_needed(doppler: Doppler) -> float:
    """Fraction of the light to be scrambled for an error by plates and pupil of `WANTED`."""
    plates = replace(reference_uncertainty(doppler), laser_drift=0.0, etalon_drift=0.0)
    return plates.scrambling_for(WANTED)
