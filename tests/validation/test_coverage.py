"""The table of coverage. Unit tier.

Detects: a standard error of a fraction that takes neighbours for independent, a case that does not
change what it says, and a table that leaves a case out.
"""

import numpy as np
import pytest

from validation import coverage
from validation.normalised import BLOCK


def test_standard_error_of_independent_values():
    values = np.random.default_rng(1).normal(size=(2, 60, 80))
    mean, error = coverage._mean_and_error(values)
    assert mean == pytest.approx(values.mean())
    # of 48 blocks, known to a tenth
    assert error == pytest.approx(1 / np.sqrt(values.size), rel=0.4)


def test_standard_error_of_uniform_blocks():
    blocks = np.random.default_rng(2).normal(size=(1, 12, 16))
    size = BLOCK
    values = np.tile(np.kron(blocks, np.ones((1, size, size))), (2, 1, 1))
    assert coverage._mean_and_error(values)[1] == pytest.approx(1 / np.sqrt(blocks.size), rel=0.3)


@pytest.mark.parametrize(("alike", "expected"), [(0.0, 12.0), (1.0, 1.0), (0.5, 12 / 6.5)])
def test_pairs_with_a_common_error_are_few(alike, expected):
    """Correlation between any two pairs; 4800 places leave 2 % of uncertainty."""
    random = np.random.default_rng(3)
    common = np.tile(random.normal(size=(1, 2, 60, 80)), (12, 1, 1, 1))
    error = np.sqrt(alike) * common + np.sqrt(1 - alike) * random.normal(size=common.shape)
    error[:, :, :5] = np.nan
    found = coverage.independent_pairs(error.reshape(24, 60, 80))
    assert found == pytest.approx(expected, rel=0.08)


def test_errors_that_are_alike_in_all_pairs_are_not_averaged_out():
    one = np.random.default_rng(4).normal(size=(2, 60, 80))
    error = coverage._mean_and_error(one)[1]
    assert coverage._mean_and_error(np.tile(one, (12, 1, 1)))[1] == pytest.approx(error)


def test_values_that_are_not_known_do_not_count():
    values = np.full((2, 20, 20), np.nan)
    assert np.isnan(coverage._mean_and_error(values)).all()
    values[:, :10] = 3.0
    assert coverage._mean_and_error(values) == (3.0, 0.0)


@pytest.mark.parametrize("fraction", [pytest.param(0.05, marks=pytest.mark.slow), 0.3])
def test_replaced_fraction_is_the_uncorrelated_variance(fraction):
    moved = coverage.replaced_texture(0.0, 1, noise=0.0)
    changed = coverage.replaced_texture(fraction, 1, noise=0.0)
    np.testing.assert_array_equal(changed[0], moved[0])
    correlation = np.corrcoef(moved[1].values.ravel(), changed[1].values.ravel())[0, 1]
    # a cell of the texture covers pi l^2 / 2 = 14 px: 2150 of them
    error = 2 * correlation * (1 - correlation**2) / np.sqrt(2150)
    assert 1 - correlation**2 == pytest.approx(fraction, abs=4 * error)


@pytest.mark.slow
def test_gain_gradient_and_pattern():
    plain = coverage.replaced_texture(0.0, 1, noise=0.0)
    gain = coverage.instrument("gain", 1, noise=0.0)
    np.testing.assert_allclose(gain[1], 1.05 * plain[1], rtol=1e-12)
    ratio = (coverage.instrument("gradient", 1, noise=0.0)[1] / plain[1]).isel(z=0).values
    assert ratio[0] == pytest.approx(0.95) and ratio[-1] == pytest.approx(1.05)
    pattern = coverage.instrument("pattern", 1, noise=0.0)
    np.testing.assert_allclose(pattern[0] / plain[0], pattern[1] / plain[1], rtol=1e-9)
    assert float((pattern[0] / plain[0]).std()) == pytest.approx(0.05, rel=0.1)


def test_true_second_state_is_another_one():
    advected = coverage.shipped_wake("advect", 0.1, 1)
    true = coverage.shipped_wake("40.1 s", 0.1, 1)
    # the winds of both states differ by what a wake does in 0.05 s
    change = np.abs(advected[2]["w"] - true[2]["w"]).max()
    assert 0 < change < 1.0
    assert float(np.abs(advected[1] - true[1]).max()) > 0


@pytest.mark.slow
def test_a_row_of_the_table():
    found = coverage.measured("gain of 5 %", "variational", [1])
    assert 0.02 < found.rmse < 0.1 and 2 < found.wind < 4 and found.valid > 0.95
    assert 0.4 < found.coverage_68[0] < found.coverage_95[0] <= 1
    assert "gain of 5 %" in coverage._line(found)


def row(covered, wide, variance, valid=1.0):
    return coverage.Coverage("air", "cc", 0.1, 0.1, 3.0, covered, wide, variance, valid)


def test_rows_that_miss_are_bold():
    """Only by more than their own errors."""
    held = row((0.65, 0.03), (0.94, 0.01), (1.28, 0.05))
    assert "**" not in coverage._line(held)
    missed = row((0.60, 0.02), (0.85, 0.02), (1.60, 0.20))
    assert "| **60 ± 2** | **85 ± 2** | **1.60 ± 0.20** |" in coverage._line(missed)
    assert coverage._line(row(*[(np.nan, np.nan)] * 3, valid=0.0)).endswith("| all flagged |")
