"""The platform's motion: attitudes by hand, vibrations, a random attitude's variance and spectrum,
trajectories.

Detects: a sign or an order of rotation, a variance off by 5 %, a spectrum of another bandwidth or
slope, a random attitude that depends on the times asked for, a pose beyond the end of a trajectory.
"""

import re

import numpy as np
import pytest
from pydantic import ValidationError
from scipy.spatial.transform import Rotation

from lidar_mi.errors import InputError
from lidar_mi.instrument.motion import (
    Attitude,
    Motion,
    Sinusoid,
    attitude,
    random_process,
    tilted,
    trajectory,
    true_pose,
)

TIME = np.linspace(-0.05, 0.15, 201)


@pytest.mark.parametrize(
    ("angles", "body", "level"),
    [
        ({"yaw": 0.1}, [1, 0, 0], [np.cos(0.1), np.sin(0.1), 0]),  # nose to port
        ({"pitch": 0.1}, [1, 0, 0], [np.cos(0.1), 0, np.sin(0.1)]),  # nose up
        ({"roll": 0.1}, [0, 1, 0], [0, np.cos(0.1), np.sin(0.1)]),  # port wing up
    ],
)
def test_signs_of_the_attitude(angles, body, level):
    found = attitude(**({"roll": 0.0, "pitch": 0.0, "yaw": 0.0} | angles)).apply(body)
    assert found == pytest.approx(level, abs=1e-15)


def test_vibrations_and_their_velocity():
    motion = Motion(
        sinusoids=(
            Sinusoid(axis="y", amplitude="10 cm", frequency="5 Hz", phase="90 deg"),
            Sinusoid(axis="y", amplitude=0.02, frequency=30, phase="0 deg"),
            Sinusoid(axis="pitch", amplitude="2 mrad", frequency="8 Hz", phase=0),
        )
    )
    pose = true_pose(motion, TIME, 150.0, 1)
    y = 0.1 * np.cos(10 * np.pi * TIME) + 0.02 * np.sin(60 * np.pi * TIME)
    assert pose.place[:, 1] == pytest.approx(y) and not pose.place[:, [0, 2]].any()
    assert np.gradient(y, TIME)[1:-1] == pytest.approx(pose.velocity[1:-1, 1], abs=0.03)
    nose = pose.attitude.apply([1.0, 0.0, 0.0])
    assert nose[:, 2] == pytest.approx(np.sin(2e-3 * np.sin(16 * np.pi * TIME)), abs=1e-15)


def processes(time, count=300, rms=2.0, bandwidth=3.0):
    return np.stack(
        [random_process(time, rms, bandwidth, np.random.default_rng(k)) for k in range(count)]
    )


def test_variance_and_correlation_of_a_random_attitude():
    """Within 4 standard errors of the mean over independent members."""
    lag = np.array([0.0, 0.01, 0.05, 0.1, 0.3])
    found = processes(7.3 + lag)
    corner = 2 * np.pi * 3.0 / np.sqrt(np.sqrt(2) - 1)
    expected = 4.0 * (1 + corner * lag) * np.exp(-corner * lag)
    products = found * found[:, :1]
    error = products.std(0, ddof=1) / np.sqrt(len(found))
    assert (np.abs(products.mean(0) - expected) < 4 * error).all()
    # normal: the fourth moment is three times the square of the second
    kurtosis = (found[:, 0] ** 4).mean() / (found[:, 0] ** 2).mean() ** 2
    assert kurtosis == pytest.approx(3, abs=4 * np.sqrt(24 / len(found)))


def test_spectrum_of_a_random_attitude():
    """Half of the power at the bandwidth, the fourth power beyond: periodograms of many members.

    A Hann window of 6.4 s: each of its frequencies sees those 0.2 Hz beside it.
    """
    step, count = 0.025, 256
    time = step * np.arange(count)
    found = processes(time) * np.hanning(count)
    power = np.abs(np.fft.rfft(found)) ** 2 * 2 * step / (np.hanning(count) ** 2).sum()
    frequency = np.fft.rfftfreq(count, step)
    corner = 3.0 / np.sqrt(np.sqrt(2) - 1)
    # one-sided, of variance 4
    expected = 4.0 * 4 / (np.pi * corner) / (1 + (frequency / corner) ** 2) ** 2
    assert np.trapezoid(expected, frequency) == pytest.approx(4, rel=0.04)
    for low, high in ((0.5, 1.5), (2.5, 3.5), (6, 8), (12, 16)):
        band = (frequency >= low) & (frequency <= high)
        ratios = (power[:, band] / expected[band]).mean(1)
        error = ratios.std(ddof=1) / np.sqrt(len(ratios))
        assert abs(ratios.mean() - 1) < 4 * error + 0.01, (low, ratios.mean(), error)


def test_a_random_attitude_is_a_function_of_time():
    motion = Motion(attitude=Attitude(rms="1 mrad", bandwidth="2 Hz"))
    one = true_pose(motion, TIME, 0.0, 5).attitude
    some = true_pose(motion, TIME[::7], 0.0, 5).attitude
    assert one[::7].as_quat() == pytest.approx(some.as_quat(), abs=1e-12)
    other = true_pose(motion, TIME, 0.0, 6).attitude
    assert np.abs(one.as_rotvec() - other.as_rotvec()).max() > 1e-4


def test_axes_are_independent_and_each_has_the_rms():
    motion = Motion(attitude=Attitude(rms="1 mrad", bandwidth="2 Hz"))
    turns = np.array(
        [true_pose(motion, np.zeros(1), 0.0, seed).attitude.as_rotvec()[0] for seed in range(300)]
    )
    assert turns.std(0) == pytest.approx(np.full(3, 1e-3), rel=4 / np.sqrt(2 * 300))
    correlation = np.corrcoef(turns.T)[np.triu_indices(3, 1)]
    assert np.abs(correlation).max() < 4 / np.sqrt(300)


def test_jitter_has_its_rms_on_both_axes_from_beam_to_beam():
    straight = np.broadcast_to([1.0, 0.0, 0.0], (4000, 3))
    found = tilted(straight, 1e-3, np.random.default_rng(2))
    assert np.linalg.norm(found, axis=1) == pytest.approx(1)
    assert found[:, 1:].std(0) == pytest.approx([1e-3, 1e-3], rel=4 / np.sqrt(8000))
    for axis in (1, 2):
        lagged = np.corrcoef(found[:-1, axis], found[1:, axis])[0, 1]
        assert abs(lagged) < 4 / np.sqrt(4000)


def test_a_trajectory_is_a_departure_from_straight_flight():
    time = np.linspace(-1, 1, 21)
    columns = {"t": time, "x": 152 * time, "y": 3 * time, "yaw": 0.2 * time}
    flown = trajectory(columns, 150.0, "flight.csv")
    pose = true_pose(Motion(), TIME, 150.0, 1, flown)
    assert pose.place == pytest.approx(np.outer(TIME, [2, 3, 0]), abs=1e-12)
    assert pose.velocity == pytest.approx(np.tile([2, 3, 0], (len(TIME), 1)), abs=1e-9)
    assert pose.attitude.as_rotvec() == pytest.approx(np.outer(TIME, [0, 0, 0.2]), abs=1e-12)
    # what is missing is straight flight
    still = true_pose(Motion(), TIME, 150.0, 1, trajectory({"t": time}, 150.0, "flight.csv"))
    assert np.abs(still.place).max() < 1e-12 and np.abs(still.velocity).max() < 1e-10


def test_attitudes_between_those_of_a_file_are_on_a_great_circle():
    columns = {"t": np.array([0.0, 1.0]), "roll": np.array([0.1, 0.3]), "yaw": np.array([0.0, 0.5])}
    flown = trajectory(columns, 0.0, "flight.csv")
    found = true_pose(Motion(), np.array([0.25]), 0.0, 1, flown).attitude
    ends = Rotation.from_euler("ZYX", [[0, 0, 0.1], [0.5, 0, 0.3]])
    quarter = Rotation.from_rotvec((ends[0].inv() * ends[1]).as_rotvec() / 4)
    assert (ends[0] * quarter).as_quat() == pytest.approx(found.as_quat()[0], abs=1e-12)


@pytest.mark.parametrize(
    ("time", "message"),
    [
        ([0.0, 0.101], "flight.csv ends at 0.1 s; expected until 0.101 s"),
        ([-0.05, 0.1], "flight.csv begins at 0 s; expected from -0.05 s on"),
    ],
)
def test_a_trajectory_is_not_extrapolated(time, message):
    flown = trajectory({"t": np.array([0.0, 0.1])}, 150.0, "flight.csv")
    with pytest.raises(InputError, match=f"^{re.escape(message)}"):
        flown.at(np.array(time), 150.0)


@pytest.mark.parametrize(
    ("motion", "message"),
    [
        ({"sinusoids": [{"axis": "y", "amplitude": "1 mrad", "frequency": 1}]}, "quantity in m"),
        ({"sinusoids": [{"axis": "yaw", "amplitude": "1 m", "frequency": 1}]}, "an angle, such"),
        ({"sinusoids": [{"axis": "yaw", "amplitude": 0.1, "frequency": 1}]}, "0.1 has no unit"),
        (
            {"sinusoids": [{"axis": "yaw", "amplitude": "2 rad", "frequency": 1}]},
            "amplitude: 2 rad is not allowed; expected at most 1 rad",
        ),
        (
            {"trajectory": "a.csv", "attitude": {"rms": "1 mrad", "bandwidth": 1}},
            "attitude: not allowed with trajectory, which has it",
        ),
    ],
)
def test_a_motion_that_makes_no_sense(motion, message):
    with pytest.raises(ValidationError, match=re.escape(message)):
        Motion(**motion)


def test_amplitudes_are_written_with_the_unit_of_their_axis():
    vibrations = [
        {"axis": "y", "amplitude": "1 cm", "frequency": 1},
        {"axis": "roll", "amplitude": "1 mrad", "frequency": 1},
    ]
    motion = Motion(sinusoids=vibrations)
    written = motion.model_dump(mode="json")
    assert [one["amplitude"] for one in written["sinusoids"]] == ["0.01 m", "0.001 rad"]
    assert Motion(**written) == motion
