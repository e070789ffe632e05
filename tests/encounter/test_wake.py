"""The wake of an encounter from its keys. Unit tier.

Detects: a key that does not reach the wake, an unsuitable wake that is accepted.
"""

import math

import pytest

import lidar_mi as lm
from lidar_mi.encounter.wake import wake_along_path
from lidar_mi.errors import InputError
from tests.support.encounters import small_encounter


def test_the_keys_reach_the_wake():
    experiment = small_encounter(
        path={
            "speed": "80 m/s",
            "start": "400 m",
            "crossing_angle": "20 deg",
            "climb_angle": "-2 deg",
            "miss": {"y": "3 m", "z": "-4 m"},
        }
    )
    wake = wake_along_path(experiment)
    port, starboard = wake.vortices(400.0, 5.0)
    assert (port.y + starboard.y) / 2 == pytest.approx(3.0)
    assert (port.z + starboard.z) / 2 == pytest.approx(-4.0)
    assert port.circulation == -starboard.circulation == 300
    assert math.hypot(port.y - starboard.y, 0) == pytest.approx(24 / math.cos(0.349), rel=2e-3)


def test_decay_and_deformation_reach_the_wake():
    experiment = small_encounter(
        encounter={
            "path": {"start": "300 m"},
            "wake": {"decay_time": "10 s", "crow": {"amplitude": "2 m", "wavelength": "200 m"}},
        }
    )
    wake = wake_along_path(experiment)
    assert wake.vortices(300.0, 10.0)[0].circulation == pytest.approx(300 / math.e)
    assert wake.crow_amplitude == 2 and wake.crow_wavelength == 200


def test_what_is_not_known_along_the_axis_is_refused():
    with pytest.raises(InputError, match=r"wake: wake_slab_40s\.nc is not allowed"):
        wake_along_path(lm.load_experiment("wake_sensor", encounter={}))
    with pytest.raises(InputError, match="encounter: missing in wake_sensor"):
        wake_along_path(lm.load_experiment("wake_sensor"))
