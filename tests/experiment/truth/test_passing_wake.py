"""The air that passes a coherent lidar. Physics tier.

Detects: a frame that turns the wrong way, a plane of a simulation that is elsewhere or does not
drift, an echo that does not follow the aerosol, turbulence that stays where the wind goes.
"""

import math

import numpy as np
import pytest

from lidar_mi.experiment.graph import call
from lidar_mi.experiment.stages.coherent_lines import passing_air
from lidar_mi.experiment.truth.passing_wake import echo
from lidar_mi.io.wake_file import read_wake
from tests.support.experiments import check

PLANE = {"file": "wake_slab_40s.nc", "time": "40 s"}


def experiment(wake, **doppler):
    data = {"name": "air", "doppler": {"kind": "coherent"} | doppler}
    return check(data | ({"wake": wake} if wake else {"doppler": data["doppler"] | STARE}))


STARE = {"scan": {"kind": "stare"}}


def test_frames_of_lidar_and_flight():
    """A flight to the south-west; 100 m to its left is south-east of where it begins."""
    given = experiment(
        None,
        passage={"heading": "225 deg"},
        position=["0 m", "0 m", "0 m"],
        air={"wind": ["3 m/s", "1 m/s"]},
    )
    air = call(passing_air, given)
    side = 100 / math.sqrt(2)
    x, y, z = air.places(np.array(side), np.array(-side), np.array(5.0))
    assert (float(x), float(y), float(z)) == pytest.approx((0, 100, 5))
    east, north, up = air.wind(*(np.zeros(1) for _ in range(4)))
    assert float(east[0]) == pytest.approx((-3 + 1) / math.sqrt(2))
    assert float(north[0]) == pytest.approx((-3 - 1) / math.sqrt(2))
    assert float(up[0]) == 0


def test_a_plane_of_a_simulation_drifts_and_sinks():
    given = experiment(PLANE, passage={"height": "110 m"}, air={"wind": ["0 m/s", "2 m/s"]})
    air = call(passing_air, given)
    port, starboard = air.vortices(0.0)
    assert (port.z + starboard.z) / 2 == pytest.approx(110)
    assert (port.y + starboard.y) / 2 == pytest.approx(0, abs=1e-9)
    later = air.vortices(20.0)
    # with the wind, and as the partner carries it: 440 m^2/s at 47 m
    assert later[0].y - port.y == pytest.approx(40, abs=3)
    assert (port.z - later[0].z) / 20 == pytest.approx(440 / (2 * math.pi * 46.7), rel=0.1)
    # the wind of a node of the file is where it has moved to, with the mean wind
    flow = read_wake(air_file(), 40.0, {})
    y, z = float(flow["y"][30]), float(flow["z"][40])
    v, w = (float(flow[name].isel(x=0, y=30, z=40)) for name in "vw")
    origin = np.array(air.wake.origin)
    place = air.wake.centre_at(20.0) + np.array([0, y - origin[1], z - origin[2]])
    found = air.in_frame(*(np.array([one]) for one in place), np.array([20.0]))
    assert float(found[1][0]) == pytest.approx(v + 2, abs=1e-6)
    assert float(found[2][0]) == pytest.approx(w, abs=1e-6)


def air_file():
    from importlib.resources import files

    return files("lidar_mi.scenes") / "wake_slab_40s.nc"


def test_the_echo_is_that_of_the_aerosol():
    """Along a line through the exhaust of a vortex: more than even air nearer, less behind."""
    given = experiment(PLANE, passage={"height": "110 m"}, position=["0 m", "700 m", "0 m"])
    air = call(passing_air, given)
    port = air.vortices(0.0)[0]
    distance = np.linspace(500, 900, 801)[None]
    angle = math.atan2(port.z, 700 - port.y)
    line = distance * math.cos(angle), np.zeros_like(distance), distance * math.sin(angle)
    power = echo(given.doppler, given.wake, air)(*line, np.zeros_like(distance))
    even = check(
        {
            "name": "even",
            "wake": PLANE | {"extinction": {"tracer": None, "aerosol": None}},
            "doppler": given.doppler.model_dump(mode="json"),
        }
    )
    flat = echo(even.doppler, even.wake, call(passing_air, even))(*line, np.zeros_like(distance))
    expected = (700 / distance) ** 2 * np.exp(-2e-4 * (distance - 700))
    np.testing.assert_allclose(flat, expected, rtol=1e-6)
    ratio = (power / flat)[0]
    core = int(np.abs(distance[0] - math.hypot(700 - port.y, port.z)).argmin())
    assert ratio[0] == pytest.approx(1) and ratio[core] > 2 and 0.8 < ratio[-1] < 0.999


def test_turbulence_moves_with_the_mean_wind():
    given = experiment(
        None, air={"wind": ["4 m/s", "-3 m/s"], "turbulence": {"sigma": "1 m/s", "length": "50 m"}}
    )
    air = call(passing_air, given)
    place = np.array([10.0]), np.array([20.0]), np.array([30.0])
    moved = place[0] + 4 * 7, place[1] - 3 * 7, place[2]
    now = np.array(air.in_frame(*place, np.zeros(1)))
    then = np.array(air.in_frame(*moved, np.full(1, 7.0)))
    np.testing.assert_allclose(now, then, atol=1e-4)
    assert abs(now[0, 0] - 4) > 1e-3
