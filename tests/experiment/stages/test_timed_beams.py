"""Beams of an experiment's scans: absolute times, files, what is refused, what stays untouched.

Detects: beams where nothing takes time or moves, a second scan at the first one's times or on its
trajectory, a changed trajectory that makes no other experiment, bad input without one clear line.
"""

import re

import numpy as np
import pytest
import xarray as xr

from lidar_mi.errors import InputError
from lidar_mi.experiment.folder.run_folder import made_by, new_record
from lidar_mi.experiment.graph import call
from lidar_mi.experiment.pipeline import stages_of
from lidar_mi.experiment.preflight.check import sections
from lidar_mi.experiment.stages.lines import slab_wind, states_of_wind
from lidar_mi.experiment.stages.rendering import scan_plans
from lidar_mi.experiment.stages.timed_beams import line_beams
from lidar_mi.experiment.truth.extinction import make_truth
from lidar_mi.experiment.truth.flows import flows_of
from lidar_mi.instrument.doppler_scan import scan_wind
from lidar_mi.schema import reading
from tests.support.experiments import small

STILL = {"speed": "150 m/s", "dt": "0.1 s"}


def experiment(timing=None, motion=None, reported=None, **keys):
    data = reading.merged(small(spacing="1 m"), keys)
    data["platform"] = STILL | {"motion": motion, "reported": reported}
    data["scan"] = data.get("scan", {}) | {"timing": timing}
    return reading.check(data, "test")


@pytest.fixture(scope="module")
def truth():
    return make_truth(experiment())


@pytest.mark.parametrize(
    "keys",
    [
        {},
        {"timing": {"duration": 0}},
        {"timing": {"pattern": "raster", "duration": 0, "slow": "columns"}},
        {"motion": {}, "reported": {}},
        {"motion": {"sinusoids": []}, "reported": {"offset": {"x": 0}}},
    ],
)
def test_nothing_that_takes_time_or_moves_has_no_beams(truth, keys):
    assert [plan.beams for plan in call(scan_plans, experiment(**keys), truth=truth)] == [
        None,
        None,
    ]


@pytest.mark.parametrize(
    "keys",
    [
        {"timing": {"duration": "1 us"}},
        {"timing": {"pattern": "lissajous", "cycles": [3, 2], "duration": 0}},
        {"motion": {"scanner_jitter": "1 urad"}},
        {"reported": {"latency": "1 us"}},
    ],
)
def test_anything_else_has_beams(truth, keys):
    for plan in call(scan_plans, experiment(**keys), truth=truth):
        assert len(plan.beams.time) == len(plan.y) * len(plan.z)


def test_without_motion_beams_go_from_straight_flight_to_the_nodes(truth):
    asked = experiment(timing={"duration": "80 ms"}, scan={"follow": "10 m/s"})
    for number, plan in enumerate(call(scan_plans, asked, truth=truth)):
        beams = plan.beams
        assert plan.position == pytest.approx(number * 14.0)
        assert beams.origin[:, 0] == pytest.approx(plan.position + 140 * beams.time)
        assert not beams.origin[:, 1:].any()
        nodes = np.stack(np.meshgrid(plan.z[::-1], plan.y[::-1], indexing="ij")[::-1], -1)
        found = beams.true_places(plan.position + plan.centre)
        assert found == pytest.approx(nodes.reshape(-1, 2), abs=1e-9)
        assert np.array_equal(beams.direction, beams.reported_direction)


def test_both_scans_fly_along_one_trajectory(tmp_path, truth):
    """Second scans see what the platform does dt later: a roll rate, a climb."""
    (tmp_path / "flight.csv").write_text("t,z (m),yaw (mrad)\n-1,-2,-5\n1,2,5\n")
    asked = experiment({"duration": "80 ms"}, {"trajectory": "flight.csv"}, scan={"aim": "angles"})
    for number, plan in enumerate(call(scan_plans, asked, truth=truth, search_path=tmp_path)):
        time = 0.1 * number + plan.beams.time
        assert plan.beams.origin[:, 2] == pytest.approx(2 * time)
        still = plan.directions()
        turn = np.arctan2(plan.beams.direction[:, 1], plan.beams.direction[:, 0])
        assert turn - np.arctan2(still[:, 1], still[:, 0]) == pytest.approx(5e-3 * time)


def test_a_trajectory_is_found_beside_and_its_change_makes_another_experiment(tmp_path):
    flight = tmp_path / "flight.csv"
    asked = experiment(motion={"trajectory": "flight.csv"})
    signatures = []
    for climb in (1, 2):
        flight.write_text(f"t,z\n-1,0\n1,{climb}\n")
        graph = stages_of(asked)
        keys = graph.keys(graph["images"])
        signatures.append(made_by(new_record(asked, tmp_path), keys))
    assert signatures[0] != signatures[1]


@pytest.mark.parametrize(
    ("table", "keys", "message"),
    [
        (
            "t,y\n-1,0\n0.1,0\n",
            {"timing": {"duration": "0.1 s"}, "motion": {"trajectory": "a.csv"}},
            "platform.motion.trajectory: a.csv ends at 0.1 s; expected until 0.149923 s, the end",
        ),
        (
            "t,y\n0,0\n1,0\n",
            {"reported": {"latency": "10 ms"}, "motion": {"trajectory": "a.csv"}},
            "platform.motion.trajectory: a.csv begins at 0 s; expected from -0.01 s on, when",
        ),
        (
            "t,x\n-1,0\n1,0\n",
            {"motion": {"trajectory": "a.csv"}},
            "platform.motion.trajectory: a.csv flies at 0 m/s along x; expected platform.speed = "
            "150 m/s to 5 % and 1 m/s, or no column x",
        ),
        (
            "t,azimuth (deg),elevation (deg)\n0,1,2\n1,2,3\n",
            {"timing": {"pattern": "table", "table": "a.csv"}},
            "scan.timing.table: a.csv has 2 beams; expected 651, as many as the image has",
        ),
        (
            "t,azimuth (deg)\n0,1\n1,2\n",
            {"timing": {"pattern": "table", "table": "a.csv"}},
            "<folder>/a.csv: elevation missing; expected columns t, azimuth, elevation",
        ),
        (
            "",
            {"motion": {"trajectory": "b.csv"}},
            "platform.motion.trajectory: b.csv not found; looked in <folder>",
        ),
        (
            "",
            {"timing": {"duration": "0.2 s"}},
            "scan.timing: a scan of 0.2 s is not allowed; expected at most platform.dt = 0.1 s",
        ),
        (
            "",
            {"timing": {"beam_rate": "1 kHz"}},
            "scan.timing: a scan of 0.651 s is not allowed; expected at most platform.dt",
        ),
        (
            "",
            {"timing": {"duration": "0.1 s", "max_rate": "5 deg/s", "dead_time": "1 ms"}},
            "scan.timing.duration: 0.1 s is not allowed; the scanner would need",
        ),
    ],
)
def test_bad_input_is_one_line(tmp_path, truth, table, keys, message):
    (tmp_path / "a.csv").write_text(table)
    with pytest.raises(InputError) as error:
        call(scan_plans, experiment(**keys), truth=truth, search_path=tmp_path)
    said = str(error.value)
    assert said.startswith(message.replace("<folder>", str(tmp_path))) and "\n" not in said


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"timing": {}}, "scan.timing: duration, beam_rate: neither is given"),
        (
            {"timing": {"duration": 1, "beam_rate": 1}},
            "scan.timing: duration, beam_rate: both are given; expected exactly one",
        ),
        (
            {"timing": {"duration": 1, "cycles": [1, 2]}},
            "scan.timing: cycles: (1, 2) is not allowed with pattern serpentine; expected it with",
        ),
        (
            {"motion": {"sinusoids": [{"axis": "y", "amplitude": "1 deg", "frequency": 1}]}},
            "platform.motion.sinusoids.0.amplitude: '1 deg' is not allowed; expected a quantity in",
        ),
    ],
)
def test_keys_that_make_no_sense_are_one_line(keys, message):
    with pytest.raises(InputError, match=f"^test: {re.escape(message)}"):
        experiment(**keys)


def both(timing=None, motion=None, reported=None, **sensor):
    data = small(spacing="1 m") | {
        "doppler": {"lidar": {"range": "150 m"}},
        "sensor": {"method": "cc", "crossflow_std": "1 m/s", "timing": timing} | sensor,
        "platform": STILL | {"motion": motion, "reported": reported},
    }
    return reading.check(data, "test")


def test_lines_of_sight_have_times_of_their_own():
    assert call(line_beams, both()) is None
    beams = call(line_beams, both({"pattern": "raster", "duration": "90 ms"}))
    assert len(beams.time) == 63
    # row by row from the top left, each for 90 ms / 63
    assert beams.time == pytest.approx(((np.arange(63) + 0.5) / 63 - 0.5) * 0.09)
    # fixed to the body, they go where the directions are
    assert beams.direction == pytest.approx(both().sensor.directions.directions())
    moved = call(line_beams, both(motion={"scanner_jitter": "1 mrad"}))
    assert not moved.time.any() and np.ptp(moved.direction - moved.reported_direction) > 1e-3


def test_lines_meet_the_state_of_their_own_time(truth):
    """Of a wake with a second state, whose wind grows by (4, -6, 9) m/s in dt."""
    narrow = {"azimuth_half": "3 deg", "elevation_half": "2 deg"}
    asked = both({"pattern": "raster", "duration": "90 ms"}, directions=narrow)
    growth, beams = np.array([4.0, -6.0, 9.0]), call(line_beams, asked)
    first, _ = flows_of(asked)
    first = first if "u" in first else first.assign(u=0 * first["v"])
    later = xr.Dataset({n: first[n] + d for n, d in zip("uvw", growth, strict=True)})
    wind = call(slab_wind, asked, truth=truth)

    def speeds(flows):
        states = call(states_of_wind, asked, slab_wind=wind, flows=flows)
        sensor = asked.sensor.directions, asked.doppler.lidar
        return scan_wind(states, *sensor, 0.0, 1, 150.0, None, beams)["v_los_true"].values

    steady = speeds((first, None))
    # against the direction of the light
    expected = -(beams.direction @ growth) * beams.time / asked.platform.dt
    np.testing.assert_allclose(speeds((first, later)) - steady, expected, atol=1e-5)
    assert np.abs(expected).max() > 1.5


@pytest.mark.parametrize(
    ("timing", "message"),
    [
        (
            {"duration": "0.2 s"},
            "sensor.timing: a scan of 0.2 s is not allowed; expected at most 1",
        ),
        (
            {"duration": "0.1 s", "dead_time": "0.02 s"},
            "sensor.timing.dead_time: 0.02 s is not allowed; 6 turns take 0.12 s",
        ),
    ],
)
def test_lines_that_take_too_long(timing, message):
    with pytest.raises(InputError, match=f"^{re.escape(message)}"):
        call(line_beams, both(timing))
    with pytest.raises(InputError, match=r"timing.pulses_per_beam: 2 is not allowed with sensor"):
        both(timing | {"pulses_per_beam": 2})


def test_check_says_what_a_scan_asks_of_laser_and_scanner():
    """31 x 21 beams in 80 ms with 20 turns of 1 ms; a turn reverses 31 steps of 1 m at 501.25 m."""
    asked = experiment({"duration": "80 ms", "dead_time": "1 ms"})
    rows = dict(dict(sections(asked))["scan of the backscatter lidar"])
    rate = 31 * 21 / 0.06
    assert rows["duration"] == "0.08 s" and rows["distance flown"] == "12 m"
    assert float(rows["beams per second between turns"]) == pytest.approx(rate, rel=1e-3)
    turning = np.degrees(np.arctan(1 / 501.25)) * rate
    assert float(rows["angular rate"].split()[0]) == pytest.approx(turning, rel=2e-3)
    reversal = 2 * turning / 1e-3
    assert float(rows["angular acceleration"].split()[0]) == pytest.approx(reversal, rel=2e-3)
