"""Klett's and Fernald's inversions of profiles in closed form.

Detects: a wrong factor, sign or power in a solution, a reference at the wrong range, an outward
solution that goes on after it has diverged.
"""

import numpy as np
import pytest

from lidar_mi.errors import InputError
from lidar_mi.retrieval.extinction.fernald import MOLECULAR_LIDAR_RATIO, fernald
from lidar_mi.retrieval.extinction.klett import klett

RANGES = np.linspace(100, 400, 3001)
HOMOGENEOUS = np.full_like(RANGES, 0.01)


def smooth(r):
    """Extinction and its integral from 100 m."""
    k = 2 * np.pi / 150
    depth = 0.005 * (r - 100) + 0.003 * (1 - np.cos(k * (r - 100))) / k
    return 0.005 + 0.003 * np.sin(k * (r - 100)), depth


def piecewise(r):
    """Two layers."""
    return np.where(r < 250, 0.002, 0.01), 0.002 * (r - 100) + 0.008 * np.maximum(r - 250, 0)


def equation(backscatter, depth):
    """Signal of single scattering."""
    return 3e5 * backscatter / RANGES**2 * np.exp(-2 * depth)


@pytest.mark.parametrize("reference", [-1, 0, 1500])
@pytest.mark.parametrize("exponent", [1.0, 0.7])
def test_klett_recovers_a_smooth_profile(reference, exponent):
    extinction, depth = smooth(RANGES)
    signal = equation(0.05 * extinction**exponent, depth)
    found = klett(signal, RANGES, extinction[reference], reference, exponent)
    # steps of 0.1 m: the trapezoid's error is of second order
    np.testing.assert_allclose(found, extinction, rtol=2e-5)


def test_klett_recovers_layers():
    extinction, depth = piecewise(RANGES)
    found = klett(equation(0.05 * extinction, depth), RANGES, extinction[-1])
    # half a step of the jump's two extinctions counts for the other layer
    np.testing.assert_allclose(found, extinction, rtol=2e-3)


@pytest.mark.parametrize("wrong", [0.5, 2.0])
def test_wrong_reference_of_klett_decays_with_the_optical_depth(wrong):
    """Homogeneous air: 1 / s = 1 / s_0 + (1 / s_m - 1 / s_0) exp(-2 depth from the far end)."""
    signal = equation(0.05 * HOMOGENEOUS, 0.01 * (RANGES - 100))
    found = klett(signal, RANGES, wrong * 0.01)
    off = (1 / wrong - 1) * np.exp(-0.02 * (400 - RANGES))
    np.testing.assert_allclose(found, 0.01 / (1 + off), rtol=2e-5)


def test_outward_klett_diverges_where_its_denominator_vanishes():
    """1 - 2 s_m int X / X_m = 0: too large a reference at the near end."""
    signal = equation(0.05 * HOMOGENEOUS, 0.01 * (RANGES - 100))
    found = klett(signal, RANGES, 0.02, 0)
    # 1 = 2 (1 - exp(-0.02 d)): d = 34.66 m
    end = 100 + np.log(2) / 0.02
    assert np.isfinite(found[RANGES < end - 0.2]).all()
    assert np.isinf(found[RANGES > end + 0.2]).all()


@pytest.mark.parametrize("reference", [-1, 0, 1000])
@pytest.mark.parametrize("lidar_ratio", [20.0, 50.0])
def test_fernald_separates_particles_from_molecules(reference, lidar_ratio):
    extinction, depth = smooth(RANGES)
    molecular = 1e-4 * np.exp(-RANGES / 300)
    both = depth + MOLECULAR_LIDAR_RATIO * 3e-2 * (np.exp(-100 / 300) - np.exp(-RANGES / 300))
    signal = equation(extinction / lidar_ratio + molecular, both)
    at = extinction[reference] / lidar_ratio
    found = fernald(signal, RANGES, molecular, lidar_ratio, at, reference)
    np.testing.assert_allclose(found, extinction, rtol=5e-5)


def test_fernald_of_molecules_alone_finds_no_particles():
    molecular = 1e-5
    signal = equation(molecular, MOLECULAR_LIDAR_RATIO * molecular * (RANGES - 100))
    found = fernald(signal, RANGES, molecular, 50.0)
    assert np.abs(found).max() < 1e-6 * 50 * molecular


def test_fernald_without_molecules_is_klett():
    extinction, depth = piecewise(RANGES)
    signal = equation(extinction / 30, depth)
    expected = klett(signal, RANGES, 0.012)
    found = fernald(signal, RANGES, 0.0, 30.0, 0.012 / 30)
    np.testing.assert_allclose(found, expected, rtol=1e-12)


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"signal": np.r_[np.ones(3000), 0]}, "signal: 0 is not allowed; expected values above 0"),
        ({"signal": np.ones(7)}, "signal: shape"),
        ({"signal": ["a"]}, r"signal: \['a'\] is not allowed; expected numbers"),
        ({"lidar_ratio": None}, "lidar_ratio: None sr is not allowed"),
        ({"ranges": RANGES[::-1]}, "ranges: not at least two finite, ascending"),
        ({"reference": 3001}, "reference: 3001 is not allowed; expected an index of 3001"),
        ({"molecular_backscatter": -1.0}, "molecular_backscatter: -1 is not allowed"),
        ({"molecular_backscatter": 0.0}, "reference_backscatter: 0.0 m.* above 0"),
        ({"lidar_ratio": np.inf}, "lidar_ratio: inf sr is not allowed"),
    ],
)
def test_bad_input_is_refused(changed, message):
    given = {
        "signal": np.ones_like(RANGES),
        "ranges": RANGES,
        "molecular_backscatter": 1e-6,
        "lidar_ratio": 50.0,
    }
    with pytest.raises(InputError, match=message):
        fernald(**(given | changed))


@pytest.mark.parametrize("name", ["reference_extinction", "exponent"])
def test_klett_needs_numbers_above_0(name):
    given = {"reference_extinction": 0.01, "exponent": 1.0} | {name: 0.0}
    with pytest.raises(InputError, match=f"{name}: 0.0"):
        klett(np.ones_like(RANGES), RANGES, **given)
