"""Wakes as old as they are met, from the keys of an encounter. Unit tier.

Detects: a key that does not reach the wake, growth or decay from another time, a wake of another
aircraft, keys that contradict each other and are accepted.
"""

import math

import pytest

from lidar_mi.atmosphere.vortices.filament_path import FilamentsAlongPath
from lidar_mi.encounter.fly import fly
from lidar_mi.errors import InputError
from lidar_mi.experiment.log import silent
from lidar_mi.experiment.truth.wake_along_path import (
    described_wake,
    vortices_in_plane,
    wake_along_path,
)
from tests.support.encounters import small_encounter

MET = 190 / 75
"""When the aircraft meets the wake, s."""


def aged(**wake):
    return small_encounter(encounter={"path": {"start": "190 m"}, "wake": wake})


def test_age_and_decay():
    wake = wake_along_path(aged(age="30 s", decay_time="40 s"))
    assert float(wake.circulation_at(5.0)) == pytest.approx(300 * math.exp(-35 / 40))
    # descent is the integral of its speed
    after, before = (float(wake.centre_at(t)[2]) for t in (6.0, 4.0))
    speed = 300 * math.exp(-35 / 40) / (2 * math.pi * 24)
    assert before - after == pytest.approx(2 * speed * math.cos(math.radians(3)), rel=2e-3)


def test_waves_grow_with_age_until_they_link():
    crow = {"model": "filaments", "amplitude": "1 m", "wavelength": "200 m", "phase": "90 deg"}
    wake = wake_along_path(aged(age="20 s", crow=crow))
    assert isinstance(wake, FilamentsAlongPath) and not wake.rings
    scale = 2 * math.pi * 24**2 / 300
    assert wake.amplitude == pytest.approx(math.exp(0.83 * (20 + MET) / scale))
    assert wake.wavelength == 200 and wake.pair.crow_phase == pytest.approx(math.pi / 2)
    assert wake_along_path(aged(age="60 s", crow=crow)).rings
    # check, flight and lidar share one table
    assert wake_along_path(aged(age="20 s", crow=crow)) is wake


def test_description():
    crow = {"model": "filaments", "amplitude": "1 m"}
    rows = dict(described_wake(aged(age="20 s", decay_time="100 s", crow=crow)))
    assert rows["vortices when met"].startswith(f"{300 * math.exp(-(20 + MET) / 100):.4g} m^2/s")
    assert rows["decay of the vortices"] == "to 1/e in 100 s"
    assert rows["Crow instability"].startswith("waves of 4.71 m, linking in 19.4 s, 206 m long")
    rings = dict(described_wake(aged(age="80 s", crow=crow)))
    assert rings["Crow instability"].startswith("rings since")


def test_the_wake_of_an_aircraft_reaches_the_path():
    pair = {"aircraft": "A388", "circulation": None, "separation": None, "core_radius": None}
    keys = {key: value for key, value in pair.items() if value}
    experiment = small_encounter(wake={"vortex_pair": keys | {"width": "60 m", "height": "40 m"}})
    wake = wake_along_path(experiment)
    assert wake.separation == pytest.approx(math.pi / 4 * 79.75)
    assert dict(described_wake(experiment))["vortices when met"].startswith("of an A388, ")


@pytest.mark.slow
def test_flights_through_filaments():
    """Without waves the roll is that in the straight pair; through rings the flight has no truth
    of vortices where a plane cuts none, and goes on."""
    rolls = []
    for crow in ({}, {"model": "filaments"}, {"model": "filaments", "amplitude": "9 m"}):
        path = {"start": "150 m", "beyond": "60 m", "crossing_angle": "15 deg"}
        wake = {"age": "30 s", "crow": crow}
        flown = small_encounter(encounter={"path": path, "wake": wake, "control": {"mode": "off"}})
        rolls.append(fly(flown, notice=silent).metrics["encounter.off.largest_roll"])
    assert rolls[1] == pytest.approx(rolls[0], rel=0.01)
    assert wake_along_path(flown).rings
    seen = [vortices_in_plane(wake_along_path(flown), x, 2.0) for x in range(0, 210, 7)]
    assert None in seen and any(seen)
    assert abs(rolls[2] / rolls[0] - 1) > 0.05


@pytest.mark.parametrize(
    ("wake", "message"),
    [
        ({"decay_time": "40 s", "dissipation_rate": "1e-4 m^2/s^3"}, "one of decay_time and diss"),
        ({"crow": {"model": "filaments", "amplitude": "12 m"}}, "12 m at age 0 is not allowed"),
        ({"crow": {"amplitude": "13 m"}}, "crow_amplitude: 13.0 m is not allowed"),
    ],
)
def test_what_cannot_be_is_refused(wake, message):
    with pytest.raises(InputError, match=message):
        wake_along_path(aged(**wake))
