"""Frames of the laser between the pulses: drifts, and how laser and echo fill the pupil.

Detects: a random walk that is not begun anew, pulses behind one frame that drift independently,
stated drifts that are off, a sign of a bow or wedge.
"""

import math

import numpy as np
import pytest
from scipy.constants import speed_of_light

from lidar_mi.errors import InputError
from lidar_mi.experiment.stages.ring_reference import (
    drifts,
    plate_error,
    plate_uncertainty,
    reference_frames,
    reference_uncertainty,
    scrambling_needed,
    shared_covariance,
    step_speed,
)
from lidar_mi.schema.doppler import Doppler

KEY = "averaged"
HALF_FILLED = {"etalon": {"bow": "12.286 nm"}, "reference": {"laser_pupil": 0.5}}


def lidar(**reference):
    return Doppler(reference=reference)


def test_a_step_of_laser_and_etalon():
    """354.7 nm / 2 by 1 MHz is 0.177 m/s; a gap that widens by 1e-9 is 0.150 m/s."""
    assert step_speed(lidar(laser_drift=1e6)) == pytest.approx(0.17735, rel=1e-4)
    found = step_speed(lidar(etalon_drift=2e-3))
    assert found == pytest.approx(speed_of_light / 2 * 1e-9, rel=1e-9)


def test_averages_behind_one_frame_share_its_noise_and_the_drift_before():
    """Pulses 1 to 4 behind a frame: the k-th and a later one share k steps; 5 has its own frame."""
    doppler = lidar(every=4, laser_drift=1e6)
    found = shared_covariance(doppler, 1, np.array([0.2, 0.2, 0.2, 0.2, 0.3]), KEY)
    steps = np.array([[0, 1, 1, 1, 0], [1, 0, 2, 2, 0], [1, 2, 0, 3, 0], [1, 2, 3, 0, 0], [0] * 5])
    np.testing.assert_allclose(
        found, step_speed(doppler) ** 2 * steps + 0.04 * (steps > 0), rtol=1e-9
    )
    assert shared_covariance(doppler, 4, np.ones(2), KEY) is None


def test_shared_drifts_are_as_stated():
    """1500 series of three averages behind one frame: covariances are known to 5 %."""
    doppler, number = lidar(every=6, laser_drift=1e6), 1500
    drawn = np.array([drifts(doppler, 2, [9, k], range(3), KEY)[0] for k in range(number)])
    _, std = drifts(doppler, 2, [9, 0], range(3), KEY)
    stated = shared_covariance(doppler, 2, np.zeros(3), KEY) + np.diag(std**2)
    spread = np.sqrt((np.outer(std, std) ** 2 + stated**2) / number)
    assert (np.abs(drawn.T @ drawn / number - stated) < 4 * spread).all()


@pytest.mark.parametrize(
    ("averaged", "every", "variances"),
    [
        # steps squared: a pulse behind its own frame
        (1, 1, [1, 1]),
        (4, 1, [1 / 4, 1 / 4]),
        # the k-th pulse behind a frame has drifted by k steps; the fourth follows the next frame
        (1, 3, [1, 2, 3, 1]),
        # (4 + 9 / 4 + 4 / 4 + 1 / 4) / 4 = 1.875 for the mean of four: (n + 1)(2 n + 1) / (6 n)
        (4, 4, [1.875, 1.875]),
        (8, 4, [0.9375]),
        # pulses 3 and 4: steps 1, 2, 3 in both, step 4 in one of them
        (2, 4, [1 + 1 / 4, 3 + 1 / 4]),
    ],
)
def test_drift_of_an_average(averaged, every, variances):
    """1500 series: variances are known to 4 %."""
    doppler = lidar(every=every, laser_drift=1e6)
    step, number = step_speed(doppler), 1500
    series = [drifts(doppler, averaged, [7, k], range(len(variances)), KEY) for k in range(number)]
    np.testing.assert_allclose((series[0][1] / step) ** 2, variances, rtol=1e-9)
    score = np.array([values / std for values, std in series])
    assert (abs(score.mean(0)) < 4 / math.sqrt(number)).all()
    assert (abs((score**2).mean(0) - 1) < 4 * math.sqrt(2 / number)).all()


def test_pulses_behind_one_frame_drift_together():
    """Of pulses 1 and 2 of a walk the correlation is 1 / 2^(1/2); behind another frame 0."""
    doppler = lidar(every=2, laser_drift=1e6)
    walks = np.array([drifts(doppler, 1, [3, k], range(3), KEY)[0] for k in range(4000)])
    found = np.corrcoef(walks.T)
    assert found[0, 1] == pytest.approx(math.sqrt(0.5), abs=4 * 0.5 / math.sqrt(4000))
    assert abs(found[1, 2]) < 4 / math.sqrt(4000)


def test_frames_of_an_average():
    assert reference_frames(20, 5, KEY) == (4, 1)
    assert reference_frames(5, 20, KEY) == (1, 4)
    with pytest.raises(InputError, match=r"averaged: 5 pulses .*every = 3; expected a multiple or"):
        reference_frames(5, 3, KEY)


def test_plates_and_pupil():
    """A bow of lambda/100 rms, by averages of the gap over points of both discs."""
    doppler = Doppler(**HALF_FILLED)
    radius = np.sqrt((np.arange(200000) + 0.5) / 200000)
    gap = -12.286e-9 * (radius**2 - radius.mean())
    inner = gap[radius < 0.5].mean()
    expected = speed_of_light / 2 * (gap.mean() - inner) / doppler.etalon.gap
    assert plate_error(doppler) == pytest.approx(expected, rel=1e-4)
    assert plate_error(doppler) == pytest.approx(-50.4, abs=0.1)
    assert plate_uncertainty(doppler) == pytest.approx(50.4, abs=0.1)
    assert scrambling_needed(doppler) == pytest.approx(0.99, abs=1e-3)
    scrambled = Doppler(**HALF_FILLED | {"reference": {"laser_pupil": 0.5, "scrambling": 0.99}})
    assert plate_error(scrambled) == pytest.approx(expected / 100, rel=1e-4)


@pytest.mark.parametrize("shift", [0.05, -0.05])
def test_wedge_has_the_sign_of_the_shift(shift):
    doppler = lidar(wedge=3.547e-9, echo_shift=shift)
    expected = speed_of_light / 2 * 2 * 3.547e-9 * shift / doppler.etalon.gap
    assert plate_error(doppler) == pytest.approx(expected, rel=1e-3)


def test_no_scrambling_is_needed_of_perfect_plates():
    assert scrambling_needed(lidar(laser_drift=10e6)) == 0
    assert plate_error(lidar()) == 0


def test_drift_of_a_pulse_is_that_in_the_middle():
    terms = reference_uncertainty(lidar(every=7, laser_drift=1e6)).terms()
    assert terms["laser drift"] == pytest.approx(2 * 0.17735, rel=1e-4)
