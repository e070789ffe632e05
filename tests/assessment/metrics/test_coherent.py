"""Errors of vortices and winds from lines of sight, by hand.

Detects: flagged scans that count, errors relative to something else, coverages of another size,
ages in the wrong interval.
"""

import numpy as np
import pytest
import xarray as xr

from lidar_mi.assessment.metrics.coherent import (
    errors_by_age,
    lines_metrics,
    profile_metrics,
    vortex_errors,
    vortex_scan_metrics,
)


def vortices(scans=4):
    """Two vortices; the last scan is flagged, the errors of the others are known."""
    both = ("scan", "vortex")
    ones = np.ones((scans, 2))
    sign = ones * [-1, 1]
    data = {
        "circulation_5_15": 404 * sign,
        "circulation_5_15_stderr": 8 * ones,
        "circulation_5_15_true": 400 * sign,
        "circulation_5_15_rv": 440 * sign,
        "circulation_5_15_rv_true": 400 * sign,
        "y": ones * [500.3, 550.0],
        "y_stderr": 0.2 * ones,
        "y_true": ones * [500.0, 550.0],
        "y_rv": ones * [500.0, np.nan],
        "y_rv_true": ones * [501.0, np.nan],
        "z": ones * [30.4, 30.0],
        "z_stderr": 0.1 * ones,
        "z_true": 30 * ones,
        "z_rv": 30 * ones,
        "z_rv_true": 30 * ones,
    }
    found = xr.Dataset({name: (both, values) for name, values in data.items()})
    found["age"] = "scan", 10.0 * np.arange(scans)
    flag = np.zeros(scans, int)
    flag[-1] = 2
    found["flag"] = "scan", flag
    # far off, but flagged
    found["y"][-1] += 100
    return found.assign_attrs(separation=50.0)


def test_errors_of_vortices():
    errors = vortex_errors(vortices())
    np.testing.assert_allclose(errors["circulation_error"][:3], 0.01)
    np.testing.assert_allclose(errors["y_error"][0], [0.006, 0], atol=1e-12)
    np.testing.assert_allclose(errors["place_error"][0], [0.01, 0], atol=1e-12)
    np.testing.assert_allclose(errors["circulation_normalised"][0], [-0.5, 0.5])
    assert np.isnan(errors["place_error"][3]).all()


def test_metrics_of_vortices():
    found = vortex_scan_metrics(vortices())
    start = "coherent.vortices."
    assert found[f"{start}scans"] == 4 and found[f"{start}valid_fraction"] == 0.75
    assert found[f"{start}circulation_error"] == pytest.approx(0.01)
    assert found[f"{start}circulation_bias"] == pytest.approx(0.01)
    assert found[f"{start}place_error"] == pytest.approx(0.005)
    assert found[f"{start}place_rms"] == pytest.approx(0.01 / np.sqrt(2))
    # y is off by 1.5 standard errors in one vortex of two, z by 4, circulations by 0.5
    assert (found[f"{start}coverage_68_y"], found[f"{start}coverage_95_y"]) == (0.5, 1.0)
    assert (found[f"{start}coverage_68_z"], found[f"{start}coverage_95_z"]) == (0.5, 0.5)
    assert found[f"{start}normalised_error_variance_circulation"] == pytest.approx(0.25)
    assert found["coherent.rv.circulation_error"] == pytest.approx(0.1)
    assert found["coherent.rv.place_error"] == pytest.approx(0.02)
    assert found["coherent.rv.valid_fraction"] == 0


def test_no_valid_scan():
    none = vortices()
    none["flag"][:] = 1
    found = vortex_scan_metrics(none)
    assert found["coherent.vortices.valid_fraction"] == 0
    assert "coherent.vortices.place_error" not in found


def test_errors_by_age():
    first, last = errors_by_age(vortices(), bins=2)
    assert (first["first"], first["last"], first["scans"], first["valid"]) == (0, 10, 2, 2)
    assert (last["first"], last["last"], last["scans"], last["valid"]) == (20, 30, 2, 1)
    assert first["circulation"] == pytest.approx(0.01)
    assert last["place"] == pytest.approx(0.005)


def test_lines_and_winds():
    shape = ("time", "range")
    lines = xr.Dataset(
        {
            "radial_velocity": (shape, [[1.1, 0.9], [1.1, 0.9]]),
            "radial_velocity_true": (shape, np.ones((2, 2))),
            "radial_velocity_stderr": (shape, np.full((2, 2), 0.1)),
            "snr": (shape, np.full((2, 2), 0.1)),
            "flag": (shape, np.zeros((2, 2), int)),
        }
    )
    found = lines_metrics(lines)
    assert found["coherent.lines"] == 2 and found["coherent.cnr"] == pytest.approx(-10)
    assert found["coherent.rmse_v_los"] == pytest.approx(0.1)
    assert found["coherent.bias_v_los"] == pytest.approx(0)
    both = ("time", "height")
    winds = xr.Dataset({"flag": (both, [[0, 0, 4]])})
    for name in "uvw":
        winds[name] = both, [[1.3, 0.7, 50.0]]
        winds[f"{name}_true"] = both, [[1.0, 1.0, 1.0]]
        winds[f"{name}_stderr"] = both, [[0.4, 0.2, 0.1]]
    found = profile_metrics(winds)
    assert found["coherent.winds.valid_fraction"] == pytest.approx(2 / 3)
    assert found["coherent.winds.rmse_u"] == pytest.approx(0.3)
    assert (found["coherent.winds.coverage_68_w"], found["coherent.winds.coverage_95_w"]) == (
        0.5,
        1,
    )


def test_gates_without_a_signal_have_no_part_in_the_noise():
    shape = ("time", "range")
    lines = xr.Dataset(
        {
            "radial_velocity": (shape, [[1.1, 19.0], [0.9, -3.0]]),
            "radial_velocity_true": (shape, np.ones((2, 2))),
            "radial_velocity_stderr": (shape, [[0.1, 11.0], [0.1, 11.0]]),
            "snr": (shape, [[0.1, 1e-9], [0.1, 1e-9]]),
            "flag": (shape, [[0, 1], [0, 1]]),
        }
    )
    found = lines_metrics(lines)
    assert found["coherent.signal_fraction"] == 0.5
    assert found["coherent.rmse_v_los"] == pytest.approx(0.1) == found["coherent.noise"]
    assert lines_metrics(lines.assign(flag=lines["flag"] + 1)) == {
        "coherent.lines": 2,
        "coherent.signal_fraction": 0,
    }
