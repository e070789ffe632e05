"""Flights again by recorded estimates. System tier.

Detects: an estimate that is delivered of another scan, with another covariance or after another
latency, a replay that flies otherwise than the recorded flight, one of another experiment, images
or errors of winds that are lost.
"""

import numpy as np
import pytest
import xarray as xr

import lidar_mi as lm
from lidar_mi.aircraft.state import Commands
from lidar_mi.encounter.ahead.preview import WakeTracker
from lidar_mi.encounter.replay import NOT_RECORDED, recorded_flight, recorded_lidar
from lidar_mi.errors import InputError
from lidar_mi.experiment.log import silent
from lidar_mi.experiment.truth.wake_along_path import wake_along_path
from lidar_mi.schema.reading import check
from tests.support.command_line import in_process
from tests.support.synthetic_lidar import STDERR, SyntheticLidar, encounter_keys


def experiment(**changes):
    return check(encounter_keys(**changes), "test")


@pytest.fixture(scope="module")
def flown(tmp_path_factory):
    """A flight whose lidar is blind at the fifth scan, and its folder."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("lidar_mi.encounter.report.draw_all", lambda *_: [])
        patch.setattr("lidar_mi.assessment.figures.encounter_film.RATE", 2)
        folder = tmp_path_factory.mktemp("flight") / "flown"
        lidar = SyntheticLidar(wake_along_path(experiment()), latency=0.12, blind=lambda n: n == 5)
        return lm.fly(experiment(), folder, lidar=lidar, notice=silent), folder


@pytest.mark.slow
def test_the_same_controller_flies_the_same_flight(flown):
    first, folder = flown
    again = lm.fly(experiment(), replay=folder, notice=silent)
    xr.testing.assert_allclose(again.series, first.series, rtol=1e-9, atol=1e-9)
    for name in ("x", "time", "delivered", "usable", "port_y", "estimate_covariance"):
        np.testing.assert_allclose(again.track[name], first.track[name], rtol=1e-9, err_msg=name)
    assert again.metrics == pytest.approx(first.metrics, rel=1e-6)


def test_estimates_are_those_of_the_flight(flown):
    first, folder = flown
    one = experiment()
    lidar = recorded_lidar(recorded_flight(folder, one), one)
    assert lidar.latency is None  # by default as recorded
    found = lidar.step(0.4)
    number = int(np.abs(first.track["time"].values - 0.35).argmin())
    assert (found.time, found.delivered) == pytest.approx((0.35, 0.52))
    assert found.x == float(first.track["x"][number]) and found.pair.success
    np.testing.assert_allclose(found.pair.covariance, np.diag(STDERR**2), rtol=1e-12)
    estimate = float(first.track["port_circulation"].sel(source="estimate")[number])
    assert found.pair.parameters[0] == pytest.approx(estimate)
    assert lidar.step(0.5).pair is None  # blind
    late = lidar.step(9.0)
    assert late.flags == (NOT_RECORDED,) and late.x == pytest.approx(75 + 9 * 75 - 7.5)
    assert WakeTracker(lidar, 0.1, 7.5).lidar is lidar


def test_another_controller_has_the_same_estimates(flown):
    first, folder = flown

    def idle(aircraft):
        return lambda preview, state: Commands()

    found = lm.fly(experiment(), replay=folder, controller=idle, notice=silent)
    steered, left = (one.metrics["encounter.feedforward.largest_roll"] for one in (first, found))
    assert left > 2 * steered
    np.testing.assert_allclose(
        found.track["port_y"].sel(source="estimate"), first.track["port_y"].sel(source="estimate")
    )


@pytest.mark.slow
def test_aircraft_and_latency_may_change(flown):
    _, folder = flown
    one = experiment(aircraft={"aileron_rate": "5 deg/s"}, control={"latency": "0.3 s"})
    found = lm.fly(one, replay=folder, notice=silent)
    late = found.track["delivered"] - found.track["time"]
    np.testing.assert_allclose(late, 0.05 + 0.3)
    moved = np.abs(np.diff(found.series["aileron_deflection"].sel(flight="feedforward"))).max()
    assert moved <= np.radians(5) * 0.0101


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"path": {"speed": "80 m/s"}},
            r"encounter\.path\.speed: 80.* is not the 75.* of the flight in .*flown; a replay may",
        ),
        ({"rate": "5 Hz"}, r"encounter\.rate: 5.* is not the 10"),
        ({"control": {"mode": "perfect"}}, r"encounter\.control\.mode: perfect is not allowed"),
        ({"air": {"turbulence": {}}}, r"encounter\.air: "),
    ],
)
def test_what_a_replay_may_not_change(flown, changes, message):
    with pytest.raises(InputError, match=message):
        lm.fly(experiment(**changes), replay=flown[1], notice=silent)


def test_what_is_no_flight(flown, tmp_path):
    _, folder = flown
    with pytest.raises(InputError, match=r"no experiment\.yaml in it"):
        lm.fly(experiment(), replay=tmp_path, notice=silent)
    with pytest.raises(InputError, match="is the flight to be replayed"):
        lm.fly(experiment(), folder, replay=folder, notice=silent)
    with pytest.raises(InputError, match="lidar: not allowed with replay"):
        lidar = SyntheticLidar(wake_along_path(experiment()))
        lm.fly(experiment(), replay=folder, lidar=lidar, notice=silent)
    short = {"start": "60 m", "beyond": "20 m"}
    blind = experiment(control={"mode": "off"}, path=short)
    lm.fly(blind, tmp_path / "off", notice=silent)
    with pytest.raises(InputError, match="holds no finished flight with the lidar"):
        lm.fly(experiment(path=short), replay=tmp_path / "off", notice=silent)


@pytest.mark.slow
def test_the_command(flown, tmp_path):
    _, folder = flown
    sets = ("--set", "encounter.control.latency=0.2 s")
    done = in_process("fly", "--replay", folder, *sets, "-o", tmp_path / "again")
    assert done.returncode == 0, done.stderr
    assert (
        "Beyond the autopilot, the lidar removes" in done.stdout
        and (tmp_path / "again" / "track.nc").is_file()
    )
    done = in_process("fly")
    assert done.returncode == 2 and "EXPERIMENT: missing; expected an experiment" in done.stderr
