"""Reported against true poses, and beams steered by them, by closed forms.

Detects: an error of the wrong sign or axis, latency in the wrong direction, noise that differs
within a scan or agrees between scans, a beam whose true or reported place is off by more than
rounding, a beam fixed to the body that is steered.
"""

import re

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lidar_mi.errors import InputError
from lidar_mi.instrument.beams import Targets, steered_beams
from lidar_mi.instrument.motion import Pose, attitude
from lidar_mi.instrument.reported import Reported, reported_pose

TIME = np.linspace(-0.05, 0.05, 101)
FAR, SPEED = 500.0, 150.0
PLACES = np.stack([np.linspace(-50, 50, 101), np.linspace(30, -30, 101)], -1)


def flight(velocity=(0.0, 0.0, 0.0), rate=(0.0, 0.0, 0.0)):
    """A departure from straight flight that is linear in time, in place and attitude."""

    def pose_at(time):
        turns = np.outer(time, rate)
        moving = np.broadcast_to(velocity, (len(time), 3))
        return Pose(np.outer(time, velocity), moving, attitude(*turns.T))

    return pose_at


def reported(pose_at, scan=0, seed=1, **keys):
    return reported_pose(Reported(**keys), pose_at, TIME, SPEED, seed, scan)


def steered(true, told, *, body_fixed=False, position=0.0, **keys):
    return steered_beams(
        Targets(TIME, PLACES, FAR, position, body_fixed), SPEED, true, told, **keys
    )


def test_nothing_given_is_the_truth():
    pose_at = flight((1, 2, 3), (0.1, 0.2, 0.3))
    found, true = reported(pose_at), pose_at(TIME)
    assert np.array_equal(found.place, true.place)
    assert found.attitude.as_quat() == pytest.approx(true.attitude.as_quat(), abs=1e-15)


def test_latency_of_a_linear_motion_is_its_velocity_times_the_latency():
    pose_at = flight((2, -3, 1), (0.0, 0.0, 0.4))
    found, true = reported(pose_at, latency="20 ms"), pose_at(TIME)
    # along x the whole flight is late
    late = np.tile([(SPEED + 2) * 0.02, -3 * 0.02, 1 * 0.02], (len(TIME), 1))
    assert true.place - found.place == pytest.approx(late)
    turned = (true.attitude * found.attitude.inv()).as_rotvec()
    assert turned == pytest.approx(np.tile([0, 0, 0.4 * 0.02], (len(TIME), 1)), abs=1e-12)


def test_offset_and_drift_are_truth_minus_reported():
    pose_at = flight()
    found = reported(
        pose_at, offset={"y": "3 m", "yaw": "2 mrad"}, drift={"z": "5 m/s", "pitch": "0.1 rad/s"}
    )
    error = pose_at(TIME).place - found.place
    assert error == pytest.approx(np.stack([0 * TIME, 0 * TIME + 3, 5 * TIME], -1))
    assert found.velocity == pytest.approx(np.tile([0, 0, -5], (len(TIME), 1)))
    # the truth is the reported attitude, turned by the error
    missed = attitude(0 * TIME, 0.1 * TIME, 0 * TIME + 2e-3).as_rotvec()
    assert (pose_at(TIME).attitude * found.attitude.inv()).as_rotvec() == pytest.approx(missed)


def test_noise_is_one_error_a_scan():
    found = np.array(
        [
            [reported(flight(), scan, seed, noise={"y": 2.0}).place[:, 1] for scan in (0, 1)]
            for seed in range(300)
        ]
    )
    assert np.ptp(found, axis=2).max() == 0
    first, second = found[:, 0, 0], found[:, 1, 0]
    assert found[..., 0].std() == pytest.approx(2, rel=4 / np.sqrt(2 * 600))
    assert abs(np.corrcoef(first, second)[0, 1]) < 4 / np.sqrt(300)


def test_noise_with_a_bandwidth_is_a_function_of_time():
    keys = {"noise": {"roll": "1 mrad"}, "noise_bandwidth": "40 Hz"}
    one, two = (reported(flight(), scan, **keys).attitude.as_rotvec() for scan in (0, 1))
    assert np.array_equal(one, two) and np.ptp(one[:, 0]) > 1e-4


@pytest.mark.parametrize("angle", [1e-3, -5e-3])
@pytest.mark.parametrize(("axis", "moved"), [("yaw", 0), ("pitch", 1)])
def test_an_unknown_rotation_moves_true_places_by_range_times_angle(axis, moved, angle):
    """For a small angle a, near the axis: range times a; and the reported places are the nodes."""
    true = flight()(TIME)
    told = reported(flight(), offset={axis: f"{angle} rad"})
    beams = steered(true, told)
    assert beams.reported_places(FAR) == pytest.approx(PLACES, abs=1e-10)
    middle = len(TIME) // 2
    shift = (beams.true_places(FAR) - PLACES)[middle]
    assert shift[moved] == pytest.approx(FAR * angle, rel=2 * angle**2 + 1e-6)
    assert abs(shift[1 - moved]) < 1e-9


def test_a_known_rotation_is_steered_against():
    true = flight((0, 4, -2), (0.2, -0.3, 0.1))(TIME)
    beams = steered(true, true, position=7.5)
    assert beams.true_places(FAR + 7.5) == pytest.approx(PLACES, abs=1e-9)
    assert np.array_equal(beams.origin, beams.reported_origin)
    assert beams.origin[:, 0] == pytest.approx(7.5 + SPEED * TIME)


def test_beams_fixed_to_the_body_turn_and_drift_with_it():
    """From a telescope at x, a direction's places are y (distance - x) / distance and its own."""
    true = flight((0, 4, 0))(TIME)
    beams = steered(true, true, body_fixed=True)
    nearer = (FAR - SPEED * TIME) / FAR
    assert beams.true_places(FAR)[:, 0] == pytest.approx(PLACES[:, 0] * nearer + 4 * TIME)
    assert beams.true_places(FAR)[:, 1] == pytest.approx(PLACES[:, 1] * nearer)
    turned = steered(*[flight(rate=(0, 0, 0.5))(TIME)] * 2, body_fixed=True)
    body = np.column_stack([np.full(len(TIME), FAR), PLACES])
    body /= np.linalg.norm(body, axis=1, keepdims=True)
    yaw = 0.5 * TIME
    by_hand = np.cos(yaw) * body[:, 1] + np.sin(yaw) * body[:, 0]
    assert turned.direction[:, 1] == pytest.approx(by_hand)


@pytest.mark.parametrize(
    ("place", "turned", "message"),
    [
        ([505, 0, 0], 0.0, "the true place at -0.033 s, x = 500"),
        (
            [0, 0, 0],
            1.5,
            "the true attitude at 0.001 s turns a beam to 86.1 deg from the axis; expected",
        ),
    ],
)
def test_a_pose_from_which_the_slab_is_not_reached(place, turned, message):
    still = flight()(TIME)
    lost = Pose(
        still.place + place, still.velocity, Rotation.from_rotvec(np.tile([0, 0, turned], (101, 1)))
    )
    with pytest.raises(InputError, match=f"^{re.escape(message)}"):
        steered(lost, still)
