"""Speeds of lines of sight, slab after slab.

Detects: errors beyond what is stated, frames that do not follow the reference but are read by it,
a frame without rings that stops the flight.
"""

import numpy as np
import pytest

from lidar_mi.encounter.lidar.doppler import Midway, doppler_scans
from lidar_mi.encounter.lidar.line_speeds import LineSpeeds
from lidar_mi.encounter.lidar.slabs import gates_of
from lidar_mi.experiment.truth.wake_along_path import wake_along_path
from tests.support.encounters import both_lidars


@pytest.fixture(scope="module")
def recorded():
    """Frames of six slabs, and the lidar."""
    experiment = both_lidars()
    scans = doppler_scans(experiment, gates_of(experiment))
    wake = wake_along_path(experiment)
    slabs = []
    for number in range(1, 7):
        midway = Midway(np.array([7.5 * number - 3.75, 0, 0]), np.array([75.0, 0, 0]))
        x = 7.5 * (number - 1) + 151.25
        slabs.append(scans.frames(wake, number, x, 0.1 * number - 0.05, midway))
    return scans, slabs


def test_errors_are_as_stated(recorded):
    """72 lines of six slabs: the variance of normalised errors is known to 17 %."""
    scans, slabs = recorded
    speeds = LineSpeeds(scans)
    found = [speeds.read(frames) for frames in slabs]
    off = np.concatenate([(one["v_los"] - one["v_los_true"]).values for one in found])
    std = np.concatenate([one["v_los_std"].values for one in found])
    assert np.mean((off / std) ** 2) == pytest.approx(1, abs=4 * np.sqrt(2 / off.size))
    assert 0.03 < np.median(std) < 0.5
    shared = found[0]["v_los_covariance"].values
    assert (shared[~np.eye(len(shared), dtype=bool)] > 0).all()


def test_frames_that_do_not_follow_are_fitted_alone_or_have_no_speed(recorded):
    scans, slabs = recorded
    speeds = LineSpeeds(scans)
    before = speeds.read(slabs[0])
    damaged = slabs[0]._replace(air=slabs[0].air.clone())
    damaged.air[0] = 1000.0
    damaged.air[1, 60:64, 60:64] += 2000.0
    found = speeds.read(damaged)
    assert np.isnan(float(found["v_los"][0]))
    spots = float(found["v_los"][1] - found["v_los_true"][1]) / float(found["v_los_std"][1])
    assert abs(spots) < 4 or np.isnan(spots)
    np.testing.assert_allclose(found["v_los"][2:], before["v_los"][2:])


def test_a_slab_without_rings_has_no_speeds(recorded):
    scans, slabs = recorded
    speeds = LineSpeeds(scans)
    dark = slabs[0]._replace(air=slabs[0].air * 0 + 100.0)
    assert np.isnan(speeds.read(dark)["v_los"]).all()
    assert np.isfinite(speeds.read(slabs[1])["v_los"]).all()
