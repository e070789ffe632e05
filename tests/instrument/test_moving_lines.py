"""Lines of sight measured one after the other from a platform that moves, as far as it is told.

Detects: a line measured along its reported direction, from the reported place or with the reported
velocity; a retrieval that is told the true ones; a wrong range from a telescope that has flown on.
"""

from dataclasses import replace

import numpy as np
import pytest
import xarray as xr

from lidar_mi.instrument.beams import Targets, steered_beams
from lidar_mi.instrument.doppler import DopplerLidar
from lidar_mi.instrument.doppler_scan import DopplerScan, scan_wind
from lidar_mi.instrument.motion import Motion, true_pose
from lidar_mi.instrument.reported import Reported, reported_pose
from lidar_mi.retrieval.combined.vectors import line_places, wind_from_triples

LIDAR, SCAN, SPEED = DopplerLidar(range=76), DopplerScan(), 150.0
SHAKEN = Motion(
    sinusoids=(
        {"axis": "y", "amplitude": "30 cm", "frequency": "4 Hz"},
        {"axis": "z", "amplitude": "20 cm", "frequency": "7 Hz", "phase": "40 deg"},
        {"axis": "roll", "amplitude": "5 mrad", "frequency": "9 Hz"},
        {"axis": "yaw", "amplitude": "8 mrad", "frequency": "3 Hz", "phase": "1 rad"},
    )
)
WIND = (3.0, -4.0, 2.0)


def uniform(shear=0.0, shift=0.0, width=60.0, height=45.0, count=121):
    y, z = np.linspace(-width, width, count), np.linspace(-height, height, count)
    ones = np.ones((count, count))
    parts = dict(zip("uvw", WIND, strict=True))
    found = xr.Dataset(
        {name: (("z", "y"), value * ones) for name, value in parts.items()}, coords={"y": y, "z": z}
    )
    return found.assign(w=found["w"] + shear * (found["y"] - shift))


def beams(motion=SHAKEN, reported=None, seconds=0.09):
    y, z = (LIDAR.range * nodes for nodes in SCAN.nodes())
    z, y = (one.ravel() for one in np.meshgrid(z[::-1], y[::-1], indexing="ij"))
    time = seconds * ((np.arange(63) + 0.5) / 63 - 0.5)

    def pose_at(when):
        return true_pose(motion, when, SPEED, 1)

    told = pose_at(time)
    if reported:
        told = reported_pose(Reported(**reported), pose_at, time, SPEED, 1, 0)
    places = np.stack([y, z], -1)
    targets = Targets(time, places, LIDAR.range, body_fixed=True)
    return steered_beams(targets, SPEED, pose_at(time), told)


def measured(wind, one):
    """Nearly without noise: standard errors must be above 0."""
    return scan_wind(wind, SCAN, LIDAR, 1e-9, 1, SPEED, beams=one)


def test_all_at_once_from_one_place_is_what_it_was():
    at_rest, before = beams(Motion(), seconds=0.0), scan_wind(uniform(), SCAN, LIDAR, 0.5, 3, SPEED)
    found = scan_wind(uniform(), SCAN, LIDAR, 0.5, 3, SPEED, beams=at_rest)
    for name in ("v_los", "v_los_true", "range", "direction"):
        assert found[name].values == pytest.approx(before[name].values, abs=1e-12)


def test_a_uniform_wind_is_exact_from_a_shaken_platform_whose_pose_is_known():
    found = wind_from_triples(measured(uniform(), beams()))
    for name, value in zip("uvw", WIND, strict=True):
        assert found[name].values == pytest.approx(value, abs=1e-4)


def test_middles_stay_in_the_plane_while_the_telescope_flies_on():
    lines = measured(uniform(), beams())
    assert line_places(lines)[:, 0] == pytest.approx(LIDAR.range)
    assert lines["time"].values[[0, -1]] == pytest.approx([-0.09 / 2 * 62 / 63, 0.09 / 2 * 62 / 63])
    # 6.6 m of flight before the middle of the scan
    assert lines["origin"].values[0, 0] == pytest.approx(-SPEED * 0.09 / 2 * 62 / 63)


@pytest.mark.parametrize(("axis", "component", "sign"), [("yaw", "v", 1), ("pitch", "w", 1)])
def test_an_unknown_attitude_turns_the_platforms_speed_into_wind(axis, component, sign):
    """By an angle e, in air at rest: V sin e across, as all directions are turned alike."""
    still = xr.zeros_like(uniform())
    lines = measured(still, beams(Motion(), {"offset": {axis: "2 mrad"}}))
    found = wind_from_triples(lines)
    assert found[component].values == pytest.approx(sign * SPEED * np.sin(2e-3), abs=1e-5)


def test_latency_of_a_steady_climb_is_known_velocity_at_a_late_place():
    """The telescope climbs evenly: velocities are right, the places told are late by v L."""
    climb = Motion(sinusoids=({"axis": "z", "amplitude": "10 m", "frequency": "1 mHz"},))
    lines = measured(uniform(), beams(climb, {"latency": "50 ms"}))
    rate = 10 * 2 * np.pi * 1e-3
    on_time = beams(climb)
    late = on_time.origin[:, 2] - lines["origin"].values[:, 2]
    assert late == pytest.approx(0.05 * rate, rel=1e-6)
    found = wind_from_triples(lines)
    for name, value in zip("uvw", WIND, strict=True):
        assert found[name].values == pytest.approx(value, abs=1e-4)


def test_light_goes_from_the_true_place():
    """A telescope 5 m to port of where it is told sees a shear that is 5 m to starboard."""
    one = beams(Motion())
    moved = replace(one, origin=one.origin + np.array([0, 5.0, 0]))
    found = measured(uniform(shear=0.05), moved)["v_los_true"].values
    expected = measured(uniform(shear=0.05, shift=-5.0), one)["v_los_true"].values
    assert found == pytest.approx(expected, abs=1e-9)
    assert np.abs(found - measured(uniform(shear=0.05), one)["v_los_true"].values).max() > 0.01
