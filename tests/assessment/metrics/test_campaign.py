"""Numbers of a campaign: means over members, boundaries of requirements, coverage.

Detects: an interval that is not Student's, a boundary at another place than where the margin is 0,
points at which nothing was delivered and that count as unknown, coverage that counts failed runs.
"""

import numpy as np
import pytest
import xarray as xr
from scipy import stats

from lidar_mi.assessment.metrics.campaign import (
    Interval,
    boundaries,
    chosen,
    coverages,
    judged,
    met,
    metrics_of,
    over_members,
    undecided,
    varies_by_factors,
)
from lidar_mi.errors import InputError


def test_means_have_the_interval_of_student():
    values = xr.DataArray(
        np.random.default_rng(1).normal(size=(3, 5)), dims=("range", "member"), name="x"
    )
    values[1, 2:] = np.nan
    found = over_members(values)
    for k, given in enumerate((values[0], values[1, :2], values[2])):
        expected = stats.ttest_1samp(given, 0).confidence_interval(0.95)
        np.testing.assert_allclose((found.low[k], found.high[k]), expected)
    alone = over_members(values.isel(member=0, drop=True))
    assert np.isnan(alone.low).all() and (alone.mean == values[:, 0]).all()


@pytest.mark.parametrize("logarithmic", [False, True])
def test_boundaries_are_where_the_margin_is_zero(logarithmic):
    # margin linear in the knob's scale, 0 at 3, known to +-0.5 of its slope's unit
    place = np.array([1.0, 2, 4, 8])
    scale = np.log if logarithmic else np.asarray
    mean = xr.DataArray(scale(place) - scale(3.0), {"energy": place}, ("energy",))
    (found,) = boundaries(Interval(mean, mean - 0.5, mean + 0.5), logarithmic)
    inverse = np.exp if logarithmic else np.asarray
    assert found.above
    np.testing.assert_allclose(found.value, 3)
    np.testing.assert_allclose(found.low, inverse(scale(3.0) - 0.5))
    np.testing.assert_allclose(found.high, inverse(scale(3.0) + 0.5))
    (falling,) = boundaries(Interval(-mean, -mean - 0.5, -mean + 0.5), logarithmic)
    assert not falling.above
    np.testing.assert_allclose([falling.low, falling.high], [found.low, found.high])


def test_a_run_that_delivers_nothing_does_not_meet_a_requirement():
    margin = xr.DataArray([0.2, np.nan, np.nan, 0.0], dims="range")
    key = "sensor.flight_control.cruise.error_w.margin"
    data = xr.Dataset({"status": ("range", [0, 0, 1, 0]), key: margin})
    found = met(over_members(judged(data, key)))
    np.testing.assert_array_equal(found, [1, 0, np.nan, 1])
    # nor does one of another phase of flight, but of that nothing was asked
    data["sensor.flight_control.cruise.applies"] = ("range", [1.0, 0, np.nan, 1])
    found = met(over_members(judged(data, key)))
    np.testing.assert_array_equal(found, [1, np.nan, np.nan, 1])


def test_a_limit_in_the_interval_is_undecided():
    mean = xr.DataArray([1.0, -1, 1], dims="range")
    half = xr.DataArray([0.5, 0.5, 2], dims="range")
    np.testing.assert_array_equal(undecided(Interval(mean, mean - half, mean + half)), [0, 0, 1])


def test_coverage_is_the_mean_of_runs_and_its_error_their_spread():
    random = np.random.default_rng(2)
    inner, count = random.normal(0.68, 0.05, 40), 40
    truth, error = np.full(count, 440.0), random.normal(size=count)
    data = xr.Dataset(
        {
            "sensor.coverage_68_v": ("member", inner),
            "sensor.coverage_95_v": ("member", inner + 0.27),
            "vortex.truth.port_y": ("member", truth),
            "vortex.vectors.port_y": ("member", truth + 3 * error),
            "vortex.vectors.port_y_stderr": ("member", np.full(count, 3.0)),
            "status": ("member", np.zeros(count, int)),
        }
    )
    wind, vortex = coverages(metrics_of(data))
    assert wind.count == vortex.count == count
    np.testing.assert_allclose(wind.within_68, inner.mean())
    np.testing.assert_allclose(wind.stderr_68, stats.sem(inner))
    np.testing.assert_allclose(vortex.within_68, np.mean(abs(error) < 1))
    np.testing.assert_allclose(vortex.within_95, np.mean(abs(error) < 1.96))


def test_metrics_are_chosen_by_name():
    data = xr.Dataset({"sensor.rmse_u": ("x", [1.0]), "status": ("x", [0])})
    assert chosen(metrics_of(data), ["sensor.rmse_u"]) == ["sensor.rmse_u"]
    with pytest.raises(InputError, match=r"sensor\.rmse_v.*sensor\.rmse_u"):
        chosen(metrics_of(data), ["sensor.rmse_v"])


def test_errors_that_vary_by_factors():
    assert varies_by_factors(np.array([0.1, np.nan, 1.0]))
    assert not varies_by_factors(np.array([0.1, 0.9])) and not varies_by_factors(np.array([0, 5.0]))
    assert not varies_by_factors(np.array([np.nan]))
