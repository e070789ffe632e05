"""The wake of a turbine against the conservation laws and the published formulas.

Detects: a deficit that does not carry the thrust (0.1 %), a swirl that does not carry the torque,
turns the wrong way or is not that of its circulation, and turbulence with divergence, of the wrong
strength or spectrum (4 sigma).
"""

import math

import numpy as np
import pytest
from numpy.testing import assert_allclose

from lidar_mi.atmosphere.turbine import (
    TurbineWake,
    added_turbulence,
    isotropic_turbulence,
    turbine_flow,
)
from lidar_mi.errors import InputError

CASE = {
    "diameter": 50.0,
    "thrust": 0.75,
    "tip_speed_ratio": 7.0,
    "wind_speed": 8.0,
    "growth": 0.035,
    "downstream": 150.0,
    "hub_core": 3.0,
}


def wake(**changes):
    return TurbineWake(**CASE | changes)


def plane(one, half=200.0, step=0.5):
    axis = np.arange(-half, half + step / 2, step)
    return turbine_flow(one, 0.0, axis, axis).isel(x=0), step**2


@pytest.mark.parametrize("changes", [{}, {"thrust": 0.4, "downstream": 120}, {"growth": 0.06}])
def test_the_wind_lost_is_the_thrust(changes):
    """Momentum: the integral of u (U - u) is C_T pi D^2 U^2 / 8 (brute force on a grid)."""
    one = wake(**changes)
    flow, cell = plane(one)
    lost = float((flow.u * (one.wind_speed - flow.u)).sum()) * cell
    assert lost * 8 / (math.pi * 50**2 * one.wind_speed**2) == pytest.approx(one.thrust, rel=1e-3)


@pytest.mark.parametrize("changes", [{}, {"tip_speed_ratio": -5.0, "hub_core": 5.0}])
def test_the_swirl_carries_the_torque(changes):
    """Angular momentum: the integral of u (y w - z v) is the ideal rotor's C_P / lambda."""
    one = wake(**changes)
    flow, cell = plane(one)
    turned = float((flow.u * (flow.y * flow.w - flow.z * flow.v)).sum()) * cell
    coefficient = turned / (one.wind_speed**2 * math.pi * 25**3 / 2)
    induction = (1 - math.sqrt(1 - one.thrust)) / 2
    power = 4 * induction * (1 - induction) ** 2  # of the ideal rotor, momentum theory
    assert coefficient == pytest.approx(power / one.tip_speed_ratio, rel=1e-3)


def test_published_deficits():
    """Bastankhah and Porte-Agel 2014: eq. 23 by hand, for C_T = 0.42, k* = 0.03; mass at the disc.

    beta = (1 + 0.7616) / (2 x 0.7616) = 1.1565, epsilon = 0.2151; at 5 D sigma/D = 0.3651, so
    1 - sqrt(1 - 0.42 / (8 x 0.3651^2)) = 1 - sqrt(0.6061) = 0.2214.
    """
    one = wake(thrust=0.42, growth=0.03, downstream=250.0)
    assert one.width / 50 == pytest.approx(0.3651, abs=1e-4)
    assert one.axial_deficit == pytest.approx(0.2214, abs=2e-4)
    assert float(one.axial_speed(0.0)) == pytest.approx(8 * (1 - 0.2214), rel=1e-3)
    at_width = 1 - float(one.axial_speed(one.width)) / 8
    assert at_width == pytest.approx(one.axial_deficit * math.exp(-0.5))


@pytest.mark.parametrize("x", [0.0, np.arange(3.0)])
def test_nothing_changes_along_x_without_turbulence(x):
    flow = turbine_flow(wake(), x, np.arange(-5, 6.0), np.arange(-4, 5.0))
    assert flow.u.dims == ("x", "y", "z") and flow.u.sizes["x"] == np.size(x)
    assert float(abs(flow - flow.isel(x=0)).to_array().max()) == 0
    assert flow.u.attrs["units"] == "m s-1"


def test_turbulence_has_no_divergence_and_unit_strength():
    axes = [np.arange(n) * h for n, h in ((24, 1.0), (40, 0.5), (30, 0.8))]
    gusts = isotropic_turbulence(*axes, 10.0, 3)
    assert gusts.shape == (3, 24, 40, 30)
    steps = (1.0, 0.5, 0.8)
    inner = (slice(2, -2),) * 3
    parts = [
        np.gradient(g, h, axis=k)[inner] for k, (g, h) in enumerate(zip(gusts, steps, strict=True))
    ]
    assert abs(sum(parts)).max() < 1e-9 * max(abs(part).max() for part in parts)
    assert (gusts**2).mean() == pytest.approx(1)
    assert_allclose(gusts.mean((1, 2, 3)), 0, atol=1e-12)


def test_turbulence_has_von_karmans_spectrum():
    """Longitudinal line spectrum: that of E(k) = k^4 / (k^2 + k0^2)^(17/6), summed over the others.

    Phi_11 = E / (4 pi k^2) (k2^2 + k3^2) / k^2 (isotropic, solenoidal) over the waves the grid
    holds, each derivative k as central differences see it, sin(k h) / h. From 2 k0 to half of the
    grid's largest wavenumber, slope of the spectrum over it: 0 within 0.15 (9 components of 3
    fields, 6400 lines each; 4 sigma of the slope 0.1).
    """
    n, h, outer = 80, 0.5, 20.0
    axis = np.arange(n) * h
    window = np.hanning(n)
    power = 0
    for seed in range(3):
        gusts = isotropic_turbulence(axis, axis, axis, outer, seed)
        for k in range(3):
            lines = np.moveaxis(gusts[k], k, 0).reshape(n, -1) * window[:, None]
            power = power + (abs(np.fft.rfft(lines, axis=0)) ** 2).mean(1)
    k = 2 * math.pi * np.fft.rfftfreq(n, h)
    other = 2 * math.pi * np.fft.fftfreq(2 * n, h)
    k2, k3 = np.meshgrid(other, other)
    observed = (np.sin(k2 * h) ** 2 + np.sin(k3 * h) ** 2) / h**2
    k0 = 2 * math.pi / outer
    law = np.array([(observed * (one**2 + k2**2 + k3**2 + k0**2) ** (-17 / 6)).sum() for one in k])
    use = (k > 2 * k0) & (k < math.pi / h / 2)
    slope = np.polyfit(np.log(k[use]), np.log(power[use] / law[use]), 1)[0]
    assert slope == pytest.approx(0, abs=0.15)


def test_added_turbulence_is_the_published():
    """Crespo and Hernandez 1996: a = 0.25, I = 0.1, x/D = 7 gives 0.114 by hand."""
    by_hand = 0.73 * 0.25**0.8325 * 0.1**0.0325 * 7**-0.32
    assert added_turbulence(0.75, 0.1, 350, 50) == pytest.approx(by_hand)
    assert by_hand == pytest.approx(0.1145, abs=5e-4)


def test_turbulence_in_the_wake_has_its_intensity():
    """Rms in the middle and far outside, from many fields' nodes there (4 sigma about 15 %)."""
    one, ambient = wake(), 0.06
    middle = np.hypot(ambient, added_turbulence(0.75, ambient, 150, 50))
    squares = []
    for seed in range(30):
        wide = np.arange(-120, 120.5, 4.0)
        gusts = turbine_flow(one, np.arange(4) * 4.0, wide, wide, ambient, 8.0, seed)
        gusts = gusts.u - one.axial_speed(np.hypot(gusts.y, gusts.z))
        squares.append(
            [
                float((gusts.sel(y=0, z=0) ** 2).mean()),
                float((gusts.sel(y=slice(90, 120)) ** 2).mean()),
            ]
        )
    rms = np.sqrt(np.mean(squares, 0)) / one.wind_speed
    assert rms[0] == pytest.approx(middle, rel=4 / math.sqrt(2 * 30 * 2))
    assert rms[1] == pytest.approx(ambient, rel=0.05)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"thrust": 1.0}, "turbine.thrust: 1.0 is not allowed"),
        ({"diameter": 0.0}, "turbine.diameter: 0.0 m is not allowed"),
        ({"tip_speed_ratio": 0.0}, "turbine.tip_speed_ratio"),
        ({"downstream": 40.0}, "turbine.downstream: 40 m is not allowed; expected the far wake"),
    ],
)
def test_bad_numbers_are_named(changes, message):
    with pytest.raises(InputError) as error:
        wake(**changes)
    assert message in str(error.value) and "\n" not in str(error.value)


def test_the_nearest_allowed_place_is_allowed():
    with pytest.raises(InputError) as error:
        wake(downstream=40.0)
    nearest = float(str(error.value).split("beyond ")[1].split(" m")[0])
    assert wake(downstream=nearest * 1.001).axial_deficit == pytest.approx(1, abs=0.1)
