"""Flights through a wake: three of the same wake, steered by nothing, by the lidar, by the truth.

Detects flights that do not meet the same wake, a track that is not used or used before it was
delivered, a wing that is steered the wrong way, a track that is forgotten when the lidar no longer
sees the vortices, scans of slabs that nobody meets, an upset that is an error.
"""

import numpy as np
import pytest

from lidar_mi.aircraft.models import aircraft_of
from lidar_mi.aircraft.state import Commands
from lidar_mi.assessment.metrics.encounter import MET, encounter_metrics
from lidar_mi.assessment.report.encounter import encounter_answer
from lidar_mi.encounter.flight import simulate_flights
from lidar_mi.experiment.log import silent
from lidar_mi.experiment.truth.wake_along_path import wake_along_path
from lidar_mi.schema.reading import check
from tests.support.synthetic_lidar import SyntheticLidar, encounter_keys


@pytest.fixture(scope="module")
def experiment():
    return check(encounter_keys(), "test")


@pytest.fixture(scope="module")
def lidar(experiment):
    return SyntheticLidar(wake_along_path(experiment))


@pytest.fixture(scope="module")
def flights(experiment, lidar):
    return simulate_flights(experiment, silent, lidar=lidar)


@pytest.mark.slow
def test_all_meet_the_same_wake(flights, experiment):
    """On the nominal path the rolling moment is that of the wings level, whatever steers."""
    assert list(flights.series["flight"].values) == ["off", "autopilot", "feedforward", "perfect"]
    off, perfect = (flights.series.sel(flight=mode) for mode in ("off", "perfect"))
    assert np.array_equal(off["x"], perfect["x"])
    # banked wings meet the wind of other places: by the square of 30 degrees
    strongest = float(np.abs(off["roll_moment"]).max())
    assert np.abs(off["roll_moment"] - perfect["roll_moment"]).max() < 0.15 * strongest
    assert float(off["time"][-1]) == pytest.approx(225 / 75, abs=0.051)


def test_help_lessens_the_roll(flights):
    found = encounter_metrics(flights.series, flights.track)
    off, blind, ours, perfect = (
        found[f"encounter.{mode}.largest_roll"] for mode in flights.series["flight"].values
    )
    assert perfect < blind < off
    assert perfect < 0.7 * off
    assert found["encounter.removed_beyond_autopilot.largest_roll"] > 0.9
    assert found["encounter.prediction_error"] < 0.1
    assert ours < 0.7 * off


def test_track_is_used_when_it_is_delivered(flights, lidar):
    one, track = flights.series.sel(flight="feedforward"), flights.track
    first = track["delivered"].values[np.flatnonzero(track["usable"].values)[0]]
    known = np.isfinite(one["predicted_roll_moment"].values)
    assert one["time"].values[known][0] == pytest.approx(first, abs=0.0101)
    # the second scan's time and the latency
    assert np.allclose(track["delivered"], track["time"] + 0.05 + 0.02)
    # no scan of slabs behind the end of the flight
    assert lidar.steps[-1] * 75 + 75 <= 225 + 7.5


def test_commands_keep_the_limits(flights, experiment):
    limits = aircraft_of(experiment.encounter).limits
    deflection = flights.series["aileron_deflection"]
    step = float(flights.series["time"][1] - flights.series["time"][0])
    assert np.abs(deflection).max() <= limits.deflection[0] * (1 + 1e-9)
    assert np.abs(deflection.diff("time")).max() <= limits.rate[0] * step * (1 + 1e-9)
    # the moment is that of the deflection
    power = aircraft_of(experiment.encounter).control_moments[0, 0]
    assert np.allclose(flights.series["control_roll_moment"], power * deflection)


@pytest.mark.slow
def test_what_was_seen_is_not_forgotten(experiment):
    """A lidar that goes blind after the tenth slab: those slabs are still ahead, and steered by."""
    blind = SyntheticLidar(wake_along_path(experiment), blind=lambda number: number > 10)
    flights = simulate_flights(experiment, silent, lidar=blind)
    one = flights.series.sel(flight="feedforward")
    known = np.isfinite(one["predicted_roll_moment"].values)
    assert flights.track["usable"][-1] == 0
    # ten slabs up to 75 + 9 x 7.5 m, four that the track may miss, five beyond
    assert 75 + 9 * 7.5 < float(one["x"].values[known].max()) < 75 + 18 * 7.5 + 1
    assert not known[-1]


@pytest.mark.slow
def test_a_track_that_is_lost_in_the_wake():
    """Blind before the wake is crossed: no jump of the aileron, no more bank than the autopilot's.

    The command changes in a step by no more than the actuator moves when the track is lost.
    """
    pair = {"circulation": 350, "separation": 47, "core_radius": 3, "width": 120, "height": 80}
    keys = encounter_keys(path={"start": "300 m", "beyond": "250 m", "crossing_angle": "10 deg"})
    keys["wake"]["vortex_pair"] = pair
    one = check(keys, "test")
    limits = aircraft_of(one.encounter).limits
    for last in (20, 24, 28):
        blind = SyntheticLidar(wake_along_path(one), blind=lambda number, last=last: number > last)
        series = simulate_flights(one, silent, lidar=blind).series
        ours, autopilot = (series.sel(flight=mode) for mode in ("feedforward", "autopilot"))
        lost = np.flatnonzero(np.isfinite(ours["predicted_roll_moment"].values))[-1]
        moment = np.abs(ours["roll_moment"].values)
        assert moment[lost:].max() > 0.5 * moment.max()
        step = float(series["time"][1])
        change = np.abs(np.diff(ours["aileron"].values[lost : lost + 10])).max()
        assert change < limits.rate[0] * step
        banks = [float(np.abs(flight["roll"]).max()) for flight in (ours, autopilot)]
        assert banks[0] <= banks[1]


@pytest.mark.parametrize(
    ("how", "first"),
    [
        ("blind", "The lidar never had a preview: 0 fits"),
        ("late", "The lidar's first preview came too late by"),
        ("no wake", "The lidar never had a preview: 0 fits"),
    ],
)
def test_the_work_of_the_autopilot_is_not_the_lidars(experiment, how, first):
    """A lidar that sees nothing, one that sees the wake when it is past, air without a wake."""
    if how == "no wake":
        turbulence = {"level": "moderate", "seed": 3}
        experiment = check(encounter_keys(air={"wake": False, "turbulence": turbulence}), "test")
    # the late one has a track after 2.8 of 3 s, when the largest roll is past
    lidar = SyntheticLidar(
        wake_along_path(experiment), blind=lambda n: how != "late" or n < 14, latency=1.2
    )
    flights = simulate_flights(experiment, silent, lidar=lidar)
    found = encounter_metrics(flights.series, flights.track)
    rolls = [found[f"encounter.{mode}.largest_roll"] for mode in ("feedforward", "autopilot")]
    assert rolls[0] == pytest.approx(rolls[1], rel=1e-9)
    met = flights.series.attrs.get(MET, "wake")
    verdict, *_ = encounter_answer(found, met=met)
    assert verdict.startswith(first) and "it meets" not in verdict


def test_only_what_a_mode_needs_is_flown(experiment):
    class Unused:
        def step(self, *_):
            raise AssertionError

    for mode, expected in (("off", ["off"]), ("perfect", ["off", "autopilot", "perfect"])):
        one = check(encounter_keys(control={"mode": mode}), "test")
        flights = simulate_flights(one, silent, lidar=Unused())
        assert list(flights.series["flight"].values) == expected and flights.track is None


def test_an_upset_is_a_result():
    """Ailerons that help the wake."""

    def wrong(aircraft):
        return lambda preview, state: Commands(aileron=np.sign(state.roll or 1.0))

    quick = {"aileron_power": 1.0, "roll_inertia": 1e5}
    control = {"mode": "perfect", "levelling_time": None}
    one = check(encounter_keys(control=control, aircraft=quick), "test")
    flights = simulate_flights(one, silent, controller=wrong)
    perfect = flights.series.sel(flight="perfect")
    found = encounter_metrics(flights.series, None)
    assert found["encounter.perfect.departed"] == 1 == found["encounter.perfect.hazardous"]
    assert perfect["departed"][-1] == 1 and np.isfinite(perfect["roll"]).all()
    assert perfect.sizes["time"] == flights.series.sizes["time"]


@pytest.mark.slow
def test_an_aircraft_that_rises_in_a_gust():
    """With the true wind its load factor changes by half as much; rolling is as without a gust."""
    gust = {"gradient": "50 m", "start": "150 m", "speed": "8 m/s"}
    path = {"start": "200 m", "beyond": "125 m", "climb_angle": 0}
    keys = encounter_keys(
        control={"mode": "perfect"},
        aircraft={"model": "heave"},
        air={"wake": False, "gusts": [gust]},
        path=path,
    )
    series = simulate_flights(check(keys, "test"), silent).series
    found = encounter_metrics(series, None)
    off, ours = (found[f"encounter.{mode}.largest_load_increment"] for mode in ("off", "perfect"))
    assert off > 0.25 and ours < 0.5 * off
    assert np.abs(series["roll"]).max() < 1e-9
    assert series["elevator_deflection"].sel(flight="perfect").max() > 0.05
    assert found["encounter.off.largest_bending_increment"] > 1e5
