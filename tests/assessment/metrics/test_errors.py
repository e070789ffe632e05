"""Errors of winds. Detects any wrong statistic (constructed errors with known answers), a truth
taken at the template instead of the vector, and NaN where a number is promised."""

import json

import numpy as np
import pytest
import xarray as xr

from lidar_mi.assessment.metrics.errors import (
    commonest_flag,
    deviations,
    error_by_quality,
    error_statistics,
    truth_at_vectors,
    wind_metrics,
)
from lidar_mi.atmosphere.vortices.cores import Core

STATISTICS = {
    f"{statistic}_{name}"
    for statistic in ("rmse", "bias", "p50", "p90")
    for name in ("v", "w", "speed", "direction")
}


def winds(v, w, flag=None, y=None, z=None, texture=None):
    """A retrieval with one row of vectors."""
    v, w = np.atleast_2d(np.asarray(v, float)), np.atleast_2d(np.asarray(w, float))
    rows, columns = v.shape

    def filled(values, other):
        return ("z", "y"), np.broadcast_to(other if values is None else values, v.shape)

    return xr.Dataset(
        {
            "v": (("z", "y"), v),
            "w": (("z", "y"), w),
            "flag": filled(flag, np.uint8(0)),
            "texture": filled(texture, 0.1),
        },
        coords={
            "z": np.arange(rows, dtype=float),
            "y": np.arange(columns, dtype=float),
            "y_vector": filled(y, np.arange(columns, dtype=float)),
            "z_vector": filled(z, 0.0),
        },
    )


def flow(v, w):
    y, z = np.arange(-20, 20.5, 0.5), np.arange(-10, 10.5, 0.5)
    yy, zz = np.meshgrid(y, z)
    return xr.Dataset(
        {"v": (("z", "y"), v(yy, zz)), "w": (("z", "y"), w(yy, zz))}, coords={"y": y, "z": z}
    )


def test_truth_is_exact_for_cubic_flows_at_any_place():
    """A cubic spline with not-a-knot ends holds cubic polynomials."""
    rng = np.random.default_rng(1)
    y, z = rng.uniform(-20, 20, 200), rng.uniform(-10, 10, 200)
    linear = flow(lambda y, z: 2 * y - 3 * z + 1, lambda y, z: 0.5 * y + z)
    found = truth_at_vectors(winds(y * 0, y * 0, y=y, z=z), linear)
    np.testing.assert_allclose(found["v"].values[0], 2 * y - 3 * z + 1, atol=1e-10)
    np.testing.assert_allclose(found["w"].values[0], 0.5 * y + z, atol=1e-10)
    cubic = flow(lambda y, z: y**3 / 400 - y * z, lambda y, z: z**3 / 100 + y**2 * z / 50)
    found = truth_at_vectors(winds(y * 0, y * 0, y=y, z=z), cubic)
    np.testing.assert_allclose(found["v"].values[0], y**3 / 400 - y * z, atol=1e-9)
    np.testing.assert_allclose(found["w"].values[0], z**3 / 100 + y**2 * z / 50, atol=1e-9)


def test_truth_belongs_to_the_vector_not_to_its_template():
    """In solid rotation of 5 s^-1 a displacement of 1 m moves the place by 0.5 m: 2.5 m/s."""
    rotation = flow(lambda y, z: -5 * z, lambda y, z: 5 * y)
    wind = winds([[0.0]], [[10.0]], y=[[2.0]], z=[[0.5]]).assign_coords(y=[2.0], z=[0.0])
    found = truth_at_vectors(wind, rotation)
    assert found["v"].item() == pytest.approx(-2.5, abs=1e-10)
    assert found["w"].item() == pytest.approx(10.0, abs=1e-10)


def test_no_truth_outside_the_flow_or_without_a_place():
    still = flow(lambda y, z: 0 * y, lambda y, z: 0 * y)
    wind = winds([0.0] * 4, [0.0] * 4, y=[0.0, 20.1, np.nan, 0.0], z=[0.0, 0.0, 0.0, -10.1])
    found = truth_at_vectors(wind, still)
    assert np.isfinite(found["v"].values[0]).tolist() == [True, False, False, False]
    assert found["v"].dims == wind["v"].dims


def test_directions_wrap_at_pi():
    """179 and -179 degrees are 2 degrees apart."""
    angles = np.radians([[179.0, -179.0, 10.0, 170.0]])
    truth = np.radians([[-179.0, 179.0, -10.0, -170.0]])
    error = deviations(
        winds(3 * np.cos(angles), 3 * np.sin(angles)), winds(np.cos(truth), np.sin(truth))
    )
    np.testing.assert_allclose(np.degrees(error["direction"].values[0]), [-2, 2, 20, -20])
    np.testing.assert_allclose(error["speed"].values, 2.0)


def test_statistics_of_known_errors():
    """|errors| of v are 1 ... 100 with alternating sign, of w always +0.5; the truth blows along
    +y so fast that the speed's error is v's."""
    errors = np.arange(1, 101) * np.tile([1.0, -1.0], 50)
    truth = winds(np.full(100, 1e6), np.zeros(100))
    metrics = wind_metrics(winds(1e6 + errors, np.full(100, 0.5)), truth, [])
    assert metrics["rmse_v"] == pytest.approx(np.sqrt(101 * 201 / 6))  # sum of squares 1 ... n
    assert metrics["bias_v"] == pytest.approx(-0.5)
    assert metrics["p50_v"] == pytest.approx(50.5)
    assert metrics["p90_v"] == pytest.approx(90.1)
    assert metrics["rmse_w"] == metrics["bias_w"] == metrics["p50_w"] == metrics["p90_w"] == 0.5
    assert metrics["rmse_speed"] == pytest.approx(metrics["rmse_v"], rel=1e-6)
    assert metrics["bias_direction"] == pytest.approx(0.5e-6, rel=1e-3)
    assert metrics["valid_fraction"] == metrics["retrieved_fraction"] == 1
    assert set(metrics) == {"valid_fraction", "retrieved_fraction", *STATISTICS} | {
        f"all.{key}" for key in STATISTICS
    }


def test_flagged_vectors_are_included_only_in_all():
    wind = winds([1.0, 1.0, 7.0, np.nan], [0.0, 0.0, 7.0, np.nan], flag=[0, 0, 4, 0])
    metrics = wind_metrics(wind, winds(np.zeros(4), np.zeros(4)), [])
    assert metrics["rmse_v"] == 1
    assert metrics["all.rmse_v"] == pytest.approx(np.sqrt(51 / 3))
    assert metrics["valid_fraction"] == 0.5
    assert metrics["retrieved_fraction"] == 0.75


def test_a_vector_without_a_truth_is_not_known():
    metrics = wind_metrics(winds([1.0, 5.0], [0.0, 0.0]), winds([0.0, np.nan], [0.0, 0.0]), [])
    assert metrics["rmse_v"] == metrics["all.rmse_v"] == 1
    assert metrics["retrieved_fraction"] == 0.5


def test_outside_two_core_radii():
    """By the vector's place: core of 2 m at (0, 0); vectors within 4 m are off by 100 m/s."""
    y = np.array([0.0, 3.9, 4.1, 8.0])
    wind = winds([100.0, 100.0, 1.0, 1.0], np.zeros(4), y=y)
    metrics = wind_metrics(wind, winds(np.zeros(4), np.zeros(4)), [Core(0.0, 0.0, 2.0, 100.0)])
    assert metrics["outside_cores.rmse_v"] == 1
    assert metrics["rmse_v"] == pytest.approx(np.sqrt((2e4 + 2) / 4))


def test_without_valid_vectors_keys_are_absent_not_nan():
    flagged = winds([1.0, 2.0], [0.0, 0.0], flag=[1, 1])
    still = winds([0.0, 0.0], [0.0, 0.0])
    metrics = wind_metrics(flagged, still, [Core(0.0, 0.0, 2.0, 100.0)])
    assert set(metrics) == {
        "valid_fraction",
        "retrieved_fraction",
        *(f"all.{k}" for k in STATISTICS),
    }
    nothing = winds([np.nan, np.nan], [np.nan, np.nan])
    metrics = wind_metrics(nothing, still, [])
    assert metrics == {"valid_fraction": 0, "retrieved_fraction": 0}
    json.dumps(metrics, allow_nan=False)


def test_error_by_quality_groups():
    """The error is the texture itself: every group's rmse follows from its 100 members."""
    rng = np.random.default_rng(2)
    texture = rng.permutation(np.arange(1, 1201)) / 1000
    flag = (texture <= 0.25).astype(np.uint8)
    wind = winds(texture, -texture, flag=flag, texture=texture)
    groups = error_by_quality(wind, winds(0 * texture, 0 * texture), "texture", bins=12)
    members = (np.arange(1, 1201) / 1000).reshape(12, 100)
    np.testing.assert_allclose(groups["rmse"], np.sqrt((members**2).mean(1)))
    np.testing.assert_allclose(groups["texture"], np.median(members, 1))
    np.testing.assert_allclose(groups["valid"], [0, 0, 0.5] + 9 * [1])


def test_error_by_quality_leaves_out_unknown_values():
    wind = winds([1.0, np.nan, 3.0], [1.0, 2.0, 3.0], texture=[0.1, 0.2, np.nan])
    groups = error_by_quality(wind, winds(np.zeros(3), np.zeros(3)), "texture")
    assert groups.sizes["group"] == 1
    assert groups["rmse"].item() == 1 and groups["texture"].item() == 0.1
    none = winds([np.nan], [np.nan])
    assert error_by_quality(none, none, "texture").sizes["group"] == 0


def test_the_commonest_flag_is_named():
    attributes = {
        "flag_masks": np.array([1, 2, 4], np.uint8),
        "flag_meanings": "edge no_texture far",
    }
    flag = xr.DataArray(np.array([[1, 3], [2, 6]], np.uint8), dims=("z", "y"), attrs=attributes)
    assert commonest_flag(flag) == "75 % have the flag no_texture"


def test_statistics_of_gaussian_errors_are_the_closed_forms():
    """100 000 errors of 0.3 m/s about a bias of 0.2: rms 0.36 and, over stated errors of their rms,
    68.3 % and 95 % coverage about 0. Within 4 sigma: of a mean 1 / sqrt(n), of a mean square
    sqrt(2 / n), of a fraction p sqrt(p (1 - p) / n)."""
    n = 100_000
    random = np.random.default_rng(5)
    noise = 0.3 * random.standard_normal(n)
    found = error_statistics(0.2 + noise)
    assert set(found) == {"rmse", "bias"}
    assert found["bias"] == pytest.approx(0.2, abs=4 * 0.3 / np.sqrt(n))
    # variance of the mean square: 2 s^4 + 4 b^2 s^2
    spread = np.sqrt((2 * 0.3**4 + 4 * 0.2**2 * 0.3**2) / n)
    assert found["rmse"] ** 2 == pytest.approx(0.3**2 + 0.2**2, abs=4 * spread)

    stated = random.uniform(0.1, 2.0, n)
    found = error_statistics(stated * noise / 0.3, stated)
    assert found["stderr"] == pytest.approx(np.sqrt(np.mean(stated**2)))
    assert found["normalised_error_variance"] == pytest.approx(1, abs=4 * np.sqrt(2 / n))
    for key, fraction in (("coverage_68", 0.6827), ("coverage_95", 0.9500)):
        assert found[key] == pytest.approx(
            fraction, abs=4 * np.sqrt(fraction * (1 - fraction) / n)
        ), key
