"""A vortex pair above the ground. Physics tier.

Detects: images that turn the wrong way, air that passes the ground, a pair that sinks too far or
spreads too little, a drift that is not the wind's, a decay that the motion does not feel.
"""

import numpy as np
import pytest

from lidar_mi.atmosphere.vortices.ground_effect import PairAboveGround
from lidar_mi.atmosphere.vortices.vortex import velocity
from lidar_mi.errors import InputError


def pair(**changes):
    given = {"circulation": 400.0, "separation": 40.0, "core_radius": 2.0, "height": 60.0}
    return PairAboveGround(**given | {"last": 200.0} | changes)


def test_a_pair_follows_lambs_hyperbola():
    """1 / y^2 + 1 / z^2 is constant; cores are small against all distances."""
    (y, other), (z, _) = pair(core_radius=0.5).places(np.linspace(0, 200, 41))
    np.testing.assert_allclose(1 / y**2 + 1 / z**2, 1 / 20**2 + 1 / 60**2, rtol=1e-6)
    np.testing.assert_allclose(other, -y, atol=1e-6)
    assert y[-1] > 200 and z[-1] == pytest.approx(1 / np.sqrt(1 / 20**2 + 1 / 60**2), rel=0.01)


def test_no_air_passes_the_ground():
    wake = pair()
    y = np.linspace(-200, 200, 81)
    v, w = wake.wind(y, np.zeros_like(y), 35.0)
    assert np.abs(w).max() < 1e-12 and np.abs(v).max() > 1


def test_far_from_the_ground_it_is_the_pair_alone():
    wake = pair(height=5000.0, last=20.0)
    speed = 400 / (2 * np.pi * 40)
    _, z = wake.places(20.0)
    assert z[0] == pytest.approx(5000 - 20 * speed, abs=0.01)
    y, height = np.meshgrid(np.linspace(-50, 50, 21), np.linspace(4920, 5020, 21))
    expected = velocity(wake.vortices(20.0), y, height)
    np.testing.assert_allclose(wake.wind(y, height, 20.0), expected, atol=2e-3)
    alone = pair(ground=False, last=20.0)
    assert alone.places(20.0)[1][0] == pytest.approx(60 - 20 * speed, abs=1e-3)


def test_decay_slows_the_descent():
    """Height lost is speed times time constant times (1 - exp(-t / T)), without ground."""
    wake = pair(decay_time=30.0, ground=False, age=10.0)
    speed, passed = 400 / (2 * np.pi * 40), 10 + 25.0
    assert float(wake.circulation_at(25.0)) == pytest.approx(400 * np.exp(-passed / 30))
    lost = speed * 30 * (1 - np.exp(-passed / 30))
    assert wake.places(25.0)[1][0] == pytest.approx(60 - lost, abs=1e-3)
    assert wake.vortices(25.0)[1].circulation == pytest.approx(-400 * np.exp(-passed / 30))


def test_each_vortex_drifts_with_the_wind_at_its_height():
    calm, windy = pair(), pair(crosswind=lambda z: 2.0 + 0 * z)
    np.testing.assert_allclose(windy.places(50.0)[0], calm.places(50.0)[0] + 100, atol=1e-5)
    np.testing.assert_allclose(windy.places(50.0)[1], calm.places(50.0)[1], atol=1e-5)


def test_times_of_any_shape_and_order():
    wake = pair()
    times = np.array([[30.0, 10.0], [10.0, 70.0]])
    y, z = wake.places(times)
    assert y.shape == (2, 2, 2)
    assert y[0, 1, 1] == pytest.approx(wake.vortices(70.0)[0].y)
    assert z[1, 0, 1] == z[1, 1, 0]


@pytest.mark.parametrize("changes", [{"height": 0.0}, {"circulation": -1.0}, {"core_radius": 0.0}])
def test_what_is_no_pair_is_refused(changes):
    with pytest.raises(InputError):
        pair(**changes)
