"""Analytic vortices against closed forms: detects 1e-9 relative in the swirl, any sign error,
and 10 % in the circulation of the sample wake."""

import numpy as np
import pytest
from scipy.integrate import quad

from lidar_mi.atmosphere.vortices.vortex import (
    MODELS,
    Vortex,
    descent_speed,
    pair_wake,
    tangential_speed,
    velocity,
    vortex_pair,
)
from lidar_mi.errors import InputError


def test_lamb_oseen_formula():
    r = np.array([0.5, 3.0, 20.0])
    expected = 458 / (2 * np.pi * r) * (1 - np.exp(-1.2564 * r**2 / 9))
    np.testing.assert_allclose(tangential_speed(r, 458, 3.0), expected, rtol=1e-12)


def test_burnham_hallock_formula():
    r = np.array([0.5, 3.0, 20.0])
    expected = 458 / (2 * np.pi) * r / (r**2 + 9)
    np.testing.assert_allclose(
        tangential_speed(r, 458, 3.0, "burnham_hallock"), expected, rtol=1e-12
    )


@pytest.mark.parametrize("model", MODELS)
def test_speed_on_the_axis_is_zero_and_linear_near_it(model):
    r = np.array([0.0, 1e-200, 1e-9, 2e-9])
    speed = tangential_speed(r, 458, 3.0, model)
    assert np.isfinite(speed).all() and speed[0] == 0
    assert speed[3] / speed[2] == pytest.approx(2, rel=1e-12)


@pytest.mark.parametrize("model", MODELS)
def test_velocity_equals_the_biot_savart_integral_of_its_vorticity(model):
    """Circulation through r, 2 pi integral of omega r dr, with omega = the curl of velocity()."""
    vortex = (Vortex(458.0, 3.0, 1.0, -2.0, model),)
    h = 1e-4

    def vorticity(r):
        y, z = 1.0 + r * np.cos(0.7), -2.0 + r * np.sin(0.7)
        dw = velocity(vortex, y + h, z)[1] - velocity(vortex, y - h, z)[1]
        dv = velocity(vortex, y, z + h)[0] - velocity(vortex, y, z - h)[0]
        return (dw - dv) / (2 * h)

    inside = 2 * np.pi * quad(lambda r: vorticity(r) * r, 0, 7.0)[0]
    assert inside == pytest.approx(2 * np.pi * 7 * tangential_speed(7.0, 458, 3.0, model), rel=1e-6)


def test_velocity_is_free_of_divergence():
    y, z = np.meshgrid(np.linspace(-30, 30, 7), np.linspace(-10, 10, 5), indexing="ij")
    pair, h = vortex_pair(458.0), 1e-4
    dv = velocity(pair, y + h, z)[0] - velocity(pair, y - h, z)[0]
    dw = velocity(pair, y, z + h)[1] - velocity(pair, y, z - h)[1]
    assert np.abs((dv + dw) / (2 * h)).max() < 1e-6


def test_port_vortex_turns_from_port_to_up():
    """omega_x > 0: outboard (y > y0) air rises, air above moves to starboard (v < 0)."""
    port, starboard = vortex_pair(458.0)
    assert port.y == 23.55 and starboard.y == -23.55
    assert port.circulation == 458 and starboard.circulation == -458
    assert velocity((port,), port.y + 5, 0.0)[1] > 0
    assert velocity((port,), port.y, 5.0)[0] < 0


def test_pair_drives_itself_down_at_the_descent_speed():
    pair = vortex_pair(458.0)
    w0 = descent_speed(458.0, 47.1)
    assert w0 == pytest.approx(1.548, abs=5e-4)  # published with the sample wake
    for vortex in pair:
        v, w = velocity(pair, vortex.y, vortex.z)
        assert v == pytest.approx(0, abs=1e-12)
        assert w == pytest.approx(-w0, rel=1e-12)
    # Midway both point vortices add up: 2 Gamma/(2 pi b0/2) = 4 w0.
    assert velocity(pair, 0.0, 0.0)[1] == pytest.approx(-4 * w0, rel=1e-12)


def test_pair_wake_has_the_readers_layout():
    y, z = np.linspace(-50, 50, 21), np.linspace(-30, 30, 13)
    pair = vortex_pair(458.0, model="burnham_hallock")
    wake = pair_wake(pair, y, z)
    assert wake.v.dims == ("x", "y", "z") and wake.v.shape == (1, 21, 13)
    assert set(wake.data_vars) == {"u", "v", "w"}
    assert wake.w.attrs["units"] == "m s-1" and wake.y.attrs["units"] == "m"
    assert not wake.u.any()
    v, w = velocity(pair, 10.0, 20.0)
    at = wake.isel(x=0).sel(y=10.0, z=20.0)
    assert (float(at.v), float(at.w)) == pytest.approx((float(v), float(w)), rel=1e-12)


@pytest.mark.parametrize(
    "call, words",
    [
        (lambda: Vortex(1.0, 0.0, 0, 0), "core_radius"),
        (lambda: Vortex(1.0, -1.0, 0, 0), "core_radius"),
        (lambda: Vortex(np.nan, 1.0, 0, 0), "circulation"),
        (lambda: Vortex(1.0, 1.0, 0, 0, "rankine"), "burnham_hallock"),
        (lambda: vortex_pair(458.0, separation=0), "separation"),
        (lambda: vortex_pair(-458.0), "circulation"),
        (lambda: descent_speed(458.0, -1.0), "separation"),
        (lambda: tangential_speed(1.0, 458.0, 0.0), "core_radius"),
        (lambda: pair_wake(vortex_pair(458.0), [1.0, 0.0], [0.0, 1.0]), "wake.y"),
    ],
)
def test_bad_input(call, words):
    with pytest.raises(InputError, match=words):
        call()
