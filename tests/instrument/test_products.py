"""Depolarisation and fraction of multiple scattering, values and errors.

Errors are compared with the spread of 4000 simulated experiments (4 sigma: 5 %) and with the
formula for a ratio of independent channels (rounding).
"""

import math

import numpy as np
import pytest
import xarray as xr

from lidar_mi.errors import InputError
from lidar_mi.instrument.products import (
    depolarization_image,
    depolarization_stderr,
    depolarization_stderr_bound,
    linear_depolarization,
    multiple_scattering_fraction,
    multiple_scattering_image,
    with_products,
)

EXPERIMENTS, PHOTONS = 4000, 400


def photons(kind, seed=1):
    """Weight and cross-polarised part of photons, (experiments, photons)."""
    random = np.random.default_rng(seed)
    shape = (EXPERIMENTS, PHOTONS)
    if kind == "alike":  # single scattering: weights differ, depolarisation hardly
        weight = random.gamma(4, 0.25, shape)
        return weight, weight * random.uniform(0.19, 0.21, shape)
    if kind == "mixed":
        weight = random.gamma(4, 0.25, shape)
        return weight, weight * random.beta(1, 4, shape)
    # one photon in 5 is twice as heavy, and polarised across the rest
    rare = random.uniform(size=shape) < 0.2
    weight = np.where(rare, 2.0, 1.0)
    return weight, np.where(rare == (kind == "rare cross"), weight, 0.0)


def estimates(kind):
    """S0, S1 of every experiment, and their standard errors and correlation over experiments."""
    weight, cross = photons(kind)
    s0, s1 = weight.mean(1), (weight - 2 * cross).mean(1)
    return s0, s1, s0.std(), s1.std(), np.corrcoef(s0, s1)[0, 1]


def assert_spread(values, expected):
    """4 sigma of a standard deviation of nearly normal values."""
    assert values.std() == pytest.approx(expected, rel=4 / math.sqrt(2 * EXPERIMENTS))


# depolarisation


@pytest.mark.parametrize(
    "matrix_ratio, expected", [(1.0, 0.0), (0.0, 1.0), (0.5, 1 / 3), (-1.0, math.nan)]
)
def test_depolarization_of_known_light(matrix_ratio, expected):
    """Spheres keep the polarisation, complete depolarisation leaves halves in both channels."""
    found = linear_depolarization([2e-11], [2e-11 * matrix_ratio])
    np.testing.assert_allclose(found, [expected], rtol=1e-12)


def test_without_signal_there_is_no_depolarization():
    assert np.isnan(linear_depolarization(0.0, 0.0))
    assert np.isnan(depolarization_stderr(0.0, 0.0, 0.0, 0.0, 0.0))
    assert np.isnan(depolarization_stderr_bound(0.0, 0.0, 0.0, 64))


@pytest.mark.parametrize("kind", ["alike", "mixed"])
def test_error_of_depolarization_is_its_spread(kind):
    s0, s1, *errors = estimates(kind)
    found = depolarization_stderr(s0.mean(), s1.mean(), *errors)
    assert_spread(linear_depolarization(s0, s1), found)


def test_error_of_independent_channels():
    """delta = X / P with independent errors: relative variances add. S0 = P + X, S1 = P - X."""
    p, x, dp, dx = 3.0, 0.7, 0.05, 0.02
    spread = math.hypot(dp, dx)
    found = depolarization_stderr(p + x, p - x, spread, spread, (dp**2 - dx**2) / spread**2)
    assert found == pytest.approx(x / p * math.hypot(dp / p, dx / x), rel=1e-12)


def test_identical_samples_have_no_error():
    """S1 = 0.6 S0 photon by photon, in float32 as in an image: 3e-4 of S0's error remain."""
    s0, s1, first = np.float32(8e-11), np.float32(0.6 * 8e-11), np.float32(8e-13)
    assert depolarization_stderr(s0, s1, first, np.float32(0.6) * first, np.float32(1)) < 3e-6


@pytest.mark.parametrize("kind", ["alike", "mixed", "rare cross", "rare parallel"])
def test_bound_is_never_below_the_spread(kind):
    s0, s1, first, *_ = estimates(kind)
    spread = linear_depolarization(s0, s1).std()
    assert depolarization_stderr_bound(s0.mean(), s1.mean(), first, PHOTONS) > spread


def test_bound_is_reached_by_samples_of_a_single_order():
    """Half of equal photons cross-polarised: delta = 1, and its error is 2 / sqrt(n)."""
    random = np.random.default_rng(2)
    n = 10_000
    cross = random.binomial(n, 0.5, EXPERIMENTS) / n
    delta = linear_depolarization(1.0, 1 - 2 * cross)
    assert depolarization_stderr_bound(1.0, 0.0, 0.0, n) == pytest.approx(2 / math.sqrt(n))
    assert_spread(delta, depolarization_stderr_bound(1.0, 0.0, 0.0, n))


def a_scan(**attrs):
    shape = (2, 3, 4)
    values = {"S0": 8e-11, "S1": 4.8e-11, "S2": 0, "S3": 0, "S0_stderr": 8e-13}
    return xr.Dataset(
        {name: (("gate", "z", "y"), np.full(shape, v, np.float32)) for name, v in values.items()},
        coords={"gate": [0, 1], "z": np.arange(3.0), "y": np.arange(4.0)},
        attrs={
            "stokes_emitted": [1.0, 1.0, 0.0, 0.0],
            "polarized": 1,
            "samples_per_beam": 128,
            "gate_count": 2,
            "estimator": "gated",
        }
        | attrs,
    )


def test_image_with_the_bound():
    """0.25, and at most 1.25 sqrt(0.01^2 + 1 / 64): the beam's photons share two gates."""
    found = depolarization_image(a_scan())
    assert found["depolarization"].dims == ("gate", "z", "y")
    np.testing.assert_allclose(found["depolarization"], 0.25, rtol=1e-6)
    expected = 1.25 * math.sqrt(1e-4 + 1 / 64)
    np.testing.assert_allclose(found["depolarization_stderr"], expected, rtol=1e-6)
    assert found["depolarization_stderr"].attrs["stderr_is_bound"] == 1
    analog = depolarization_image(a_scan(estimator="analog"))["depolarization_stderr"]
    np.testing.assert_allclose(analog, 1.25 * math.sqrt(1e-4 + 1 / 128), rtol=1e-6)
    np.testing.assert_array_equal(found["y"], np.arange(4.0))


def test_image_with_the_error():
    scan = a_scan()
    scan["S1_stderr"] = 0.6 * scan["S0_stderr"]
    scan["S0_S1_correlation"] = xr.zeros_like(scan["S0"]) + 0.9
    found = depolarization_image(scan)["depolarization_stderr"]
    # (S0 + S1)^2 / 2 = 2.56 / 2 S0^2, both terms 0.6 x 0.01 S0^2, difference 2 (1 - 0.9)
    expected = 0.6 * 0.01 * math.sqrt(2 * 0.1) / 1.28
    np.testing.assert_allclose(found, expected, rtol=1e-6)
    assert found.attrs["stderr_is_bound"] == 0


@pytest.mark.parametrize(
    "attrs, message",
    [
        ({"stokes_emitted": [1.0, 0.0, 0.0, 0.0]}, r"stokes_emitted: \[1.0, 0.0, 0.0, 0.0\]"),
        ({"stokes_emitted": None}, "stokes_emitted: None"),
        ({"polarized": 0}, "polarized: 0"),
    ],
)
def test_light_without_the_papers_polarization_is_refused(attrs, message):
    with pytest.raises(InputError, match=message):
        depolarization_image(a_scan(**attrs))


@pytest.mark.parametrize("name", ["samples_per_beam", "estimator", "gate_count"])
def test_bound_needs_the_number_of_samples(name):
    scan = a_scan()
    del scan.attrs[name]
    with pytest.raises(InputError, match=f"attribute {name} is missing"):
        depolarization_image(scan)


# multiple scattering


def test_fraction():
    found, error = multiple_scattering_fraction([3.0, 0.0, 2.0], [1.0, 0.0, 0.0])
    np.testing.assert_array_equal(found, [0.25, math.nan, 0.0])
    np.testing.assert_array_equal(error, [0.0, math.nan, 0.0])


@pytest.mark.parametrize("correlation", [-0.9, 0.0, 0.7])
def test_error_of_the_fraction_is_its_spread(correlation):
    random = np.random.default_rng(8)
    errors = np.array([0.03, 0.02])
    covariance = np.outer(errors, errors) * np.array([[1, correlation], [correlation, 1]])
    single, multiple = random.multivariate_normal([3.0, 1.0], covariance, EXPERIMENTS).T
    fraction, _ = multiple_scattering_fraction(single, multiple)
    _, found = multiple_scattering_fraction(3.0, 1.0, *errors, correlation)
    assert_spread(fraction, float(found))
    _, largest = multiple_scattering_fraction(3.0, 1.0, *errors, -1)
    assert found <= largest


def with_orders(scan, share=0.2):
    """The scan with its light split into three orders."""
    parts = {"order1.S0": 1 - share, "order2.S0": 0.9 * share, "order3.S0": 0.1 * share}
    return scan.assign({name: scan["S0"] * part for name, part in parts.items()})


def test_image_of_the_fraction():
    """0.2, and at most 0.8 of the light's relative error of 0.01."""
    found = multiple_scattering_image(with_orders(a_scan()))
    assert found["multiple_scattering_fraction"].dims == ("gate", "z", "y")
    np.testing.assert_allclose(found["multiple_scattering_fraction"], 0.2, rtol=1e-6)
    np.testing.assert_allclose(found["multiple_scattering_fraction_stderr"], 0.008, rtol=1e-6)
    assert found["multiple_scattering_fraction_stderr"].attrs["stderr_is_bound"] == 1
    np.testing.assert_array_equal(found["y"], np.arange(4.0))


@pytest.mark.parametrize("share", [0.02, 0.3, 0.9])
def test_bound_of_the_fraction_is_never_below_its_spread(share):
    """Orders of a photon that know nothing of each other, the higher ones skewed."""
    random = np.random.default_rng(5)
    shape = (EXPERIMENTS, PHOTONS)
    single = (1 - share) * random.gamma(25, 1 / 25, shape).mean(1)
    multiple = share * random.gamma(0.3, 1 / 0.3, shape).mean(1)
    scan = with_orders(a_scan(), share)
    scan["S0_stderr"] = scan["S0"] * (single + multiple).std()
    bound = multiple_scattering_image(scan)["multiple_scattering_fraction_stderr"].values
    assert (
        bound > (multiple / (single + multiple)).std() * (1 - 4 / math.sqrt(2 * EXPERIMENTS))
    ).all()


def test_fraction_needs_orders():
    with pytest.raises(InputError, match="orders: none is not allowed"):
        multiple_scattering_image(a_scan())


def test_products_are_those_the_scan_was_rendered_for():
    def added(scan):
        return {name.removesuffix("_stderr") for name in set(with_products(scan)) - set(scan)}

    unpolarized, circular = a_scan(polarized=0), a_scan(stokes_emitted=[1.0, 0.0, 0.0, 1.0])
    assert added(a_scan()) == {"depolarization"}
    assert added(unpolarized) == added(circular) == set()
    assert added(with_orders(unpolarized)) == {"multiple_scattering_fraction"}
    scan = with_orders(a_scan())
    found = with_products(scan)
    assert added(scan) == {"depolarization", "multiple_scattering_fraction"}
    assert found["depolarization"].dtype == np.float32
    assert found.attrs["depolarization_stderr_is_bound"] == 1
    assert "depolarization_stderr_is_bound" not in scan.attrs
