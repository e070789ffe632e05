"""Error measures of line-of-sight winds.

Detects: a spread that takes a speed's own bias for noise, degrees of freedom or standard errors
that are wrong, a bias weighted by how many images were read, missing readings taken for zero.
"""

import numpy as np
import pytest
import xarray as xr

from lidar_mi.assessment.metrics.velocities import velocity_metrics

DIMS = ("algorithm", "centre", "averaged", "v_los", "image")


def found(error, tried, v_std=None):
    """Winds of one method and case with these errors (speeds, images), about true speeds."""
    error = np.asarray(error, float)
    speeds = 10.0 * np.arange(len(error))
    v = (error + speeds[:, None])[None, None, None]
    std = np.full(v.shape, np.nan) if v_std is None else np.broadcast_to(v_std, v.shape)
    return xr.Dataset(
        {"v": (DIMS, v), "v_std": (DIMS, std), "tried": ("algorithm", [tried])},
        coords={"algorithm": ["ca"], "centre": ["free"], "averaged": [5], "v_los": speeds},
    )


def measures(*args, **options):
    metrics = velocity_metrics(found(*args, **options))
    start = "doppler.ca.centre_free.averaged_5."
    assert all(key.startswith(start) for key in metrics)
    return {key.removeprefix(start): value for key, value in metrics.items()}


def test_measures_by_hand():
    """Speeds with errors (1, 3) and (-5, -3, -4): means 2 and -4, squares 2 + 2, three degrees of
    freedom."""
    got = measures([[1, 3, np.nan], [-5, -3, -4]], 3, v_std=[1, 7, np.nan])
    std = np.sqrt(4 / 3)
    assert got == pytest.approx(
        {
            "retrieved_fraction": 5 / 6,
            "bias": -1.0,
            "bias_lowest": -4.0,
            "bias_highest": 2.0,
            "bias_stderr": std * np.sqrt(1 / 2 + 1 / 3) / 2,
            "std": std,
            "std_stderr": std / np.sqrt(6),
            "expected_std": 5.0,
        }
    )


@pytest.mark.slow
def test_standard_errors_are_those_of_repeated_experiments():
    """500 sets of 3 speeds x 4 normal errors: bias and std scatter as stated."""
    rng = np.random.default_rng(1)
    errors = 0.7 * rng.standard_normal((500, 3, 4)) + np.array([3, -1, 0])[:, None]
    sets = [measures(error, 4) for error in errors]
    column = {name: np.array([s[name] for s in sets]) for name in sets[0]}
    assert np.mean(column["bias"]) == pytest.approx(2 / 3, abs=4 * 0.7 / np.sqrt(12 * 500))
    assert np.sqrt(np.mean(column["std"] ** 2)) == pytest.approx(0.7, rel=0.05)
    # 500 sets know a standard deviation to 3.2 %
    assert np.std(column["bias"]) == pytest.approx(np.mean(column["bias_stderr"]), rel=0.13)
    assert np.std(column["std"]) == pytest.approx(np.mean(column["std_stderr"]), rel=0.13)


def test_undetermined_measures_are_left_out():
    one = measures([[1.0], [2.0]], 1)
    assert "std" not in one and "bias_stderr" not in one and one["bias"] == 1.5
    assert measures([[np.nan, np.nan]], 2) == {"retrieved_fraction": 0.0}
    assert measures([[np.nan, np.nan]], 0) == {}
