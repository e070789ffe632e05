"""Filters and noise identified from input and output.

Detects biased filters, stated errors that are too small or too large, unstable noise models, wrong
autocovariances, gaps that are taken for data.
"""

import numpy as np
import pytest
from scipy.signal import lfilter

from lidar_mi.encounter.control_block.filter_fit import (
    autocovariance,
    burg,
    fit_filter,
    fit_process,
)
from lidar_mi.errors import InputError

GAIN, BEFORE, AFTER, LAG, INNOVATION = 0.9, 0.4, 0.3, 0.6, 0.3
NOISE_VARIANCE = INNOVATION**2 / (1 - LAG**2)


def simulated(random, number=600):
    """Output and input of a known filter."""
    value = lfilter([1], [1, -0.95], random.normal(size=number + 11))
    weights = np.array([AFTER**k for k in (3, 2, 1)] + [BEFORE**k for k in range(9)])
    weights *= GAIN / weights.sum()
    noise = lfilter([INNOVATION], [1, -LAG], random.normal(size=number))
    output = np.full(number + 11, np.nan)
    output[8:-3] = 0.2 + np.convolve(value, weights, "valid") + noise
    return output, value


@pytest.mark.slow
def test_errors_are_as_stated():
    """Of 50 records: the mean of normalised errors within 1, as much as half of their own is bias;
    their variance, with a standard error of 0.2, within 0.3 and 1.9."""
    random, errors = np.random.default_rng(1), []
    true = np.array([0.2, GAIN, BEFORE, AFTER])
    for _ in range(50):
        fit = fit_filter(*simulated(random), 3)
        variance, stderr = fit.noise_variance
        density, density_stderr = fit.noise_spectrum(np.array([0.05]))
        expected = INNOVATION**2 / abs(1 - LAG * np.exp(-0.1j * np.pi)) ** 2
        filters = (fit.parameters - true) / np.sqrt(np.diag(fit.covariance))
        noise = [(variance - NOISE_VARIANCE) / stderr, (density[0] - expected) / density_stderr[0]]
        errors.append([*filters, *noise])
    assert (abs(np.mean(errors, axis=0)) < 1).all()
    assert (np.var(errors, axis=0) > 0.3).all() and (np.var(errors, axis=0) < 1.9).all()


def test_a_response_has_the_error_of_its_gain_at_low_frequency():
    fit = fit_filter(*simulated(np.random.default_rng(2)), 3)
    response, stderr = fit.response(np.array([0.0]))
    assert response[0] == pytest.approx(fit.parameters[1])
    assert stderr[0] == pytest.approx(np.sqrt(fit.covariance[1, 1]), rel=1e-4)


def test_gaps_are_left_out():
    """A tenth of the outputs is missing: the filter is the same within its errors."""
    random = np.random.default_rng(3)
    output, value = simulated(random, 1200)
    whole = fit_filter(output, value, 3)
    output[random.random(len(output)) < 0.1] = np.nan
    some = fit_filter(output, value, 3)
    assert some.count < 0.9 * whole.count
    error = abs(some.parameters - whole.parameters)
    assert (error < 3 * np.sqrt(np.diag(some.covariance))).all()


def test_few_samples_are_refused():
    with pytest.raises(InputError, match=r"26 slabs in succession .* expected 50 or more"):
        fit_filter(*simulated(np.random.default_rng(4), 30), 3)


def test_autocovariance_is_that_of_the_closed_form():
    number = np.arange(6)
    found = autocovariance(np.array([0.6]), 0.09, 6)
    np.testing.assert_allclose(found, 0.09 / (1 - 0.36) * 0.6**number)
    # of two lags: Yule-Walker
    a, b = 0.5, -0.3
    zero, first, second, *_ = autocovariance(np.array([a, b]), 1.0, 4)
    assert zero == pytest.approx((1 - b) / (1 + b) / ((1 - b) ** 2 - a**2))
    assert first == pytest.approx(a * zero / (1 - b))
    assert second == pytest.approx(a * first + b * zero)
    np.testing.assert_allclose(autocovariance(np.zeros(0), 2.0, 3), [2, 0, 0])


def test_burg_finds_the_lags_of_a_process_with_gaps():
    white = np.random.default_rng(5).normal(size=20000)
    values = lfilter([1], [1, -0.5, 0.3], white)
    values[::500] = np.nan
    # standard errors are below 1/sqrt(n)
    np.testing.assert_allclose(burg(values, 2), [0.5, -0.3], atol=4 / np.sqrt(20000))
    lags, variance = fit_process(values)
    assert len(lags) == 2 and variance == pytest.approx(1, abs=4 * np.sqrt(2 / 20000))
