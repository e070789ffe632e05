"""What a method states of its own errors: detects a source without skill that is not called so."""

import numpy as np
import pytest
import xarray as xr

from lidar_mi.assessment.metrics.names import Source, has_no_skill
from lidar_mi.assessment.metrics.winds import cross_flow_metrics
from lidar_mi.flags import Flag


def winds(stderr, flag=0):
    """A wind of 3 and 4 m/s, retrieved exactly, with a standard error and a flag for all."""
    shape = {"source": 1, "algorithm": 1, "z": 4, "y": 5}
    one = xr.DataArray(np.ones(tuple(shape.values())), dims=tuple(shape))
    fields = {"v": 3 * one, "v_true": 3 * one, "w": 4 * one, "w_true": 4 * one}
    fields |= {"v_bound": one, "w_bound": one, "v_stderr": stderr * one, "w_stderr": stderr * one}
    axes = {"source": [str(Source.BACKSCATTER)], "algorithm": ["variational"]}
    axes |= {"z": np.arange(4.0), "y": np.arange(5.0)}
    found = xr.Dataset(fields | {"flag": (one * flag).astype(int)}, axes)
    z, y = xr.broadcast(found["z"], found["y"])
    return found.assign(y_vector=one * y, z_vector=one * z)


@pytest.mark.parametrize(
    ("stderr", "flag", "fraction", "none"),
    [
        (0.5, 0, 0.0, False),
        (3.6, 0, 1.0, True),  # sqrt(2) 3.6 > 5
        (3.5, 0, 0.0, False),
        (0.5, Flag.NO_SKILL.value, 1.0, True),
    ],
)
def test_standard_errors_as_large_as_the_wind_have_no_skill(stderr, flag, fraction, none):
    metrics = cross_flow_metrics(winds(stderr, flag), [])
    assert metrics["backscatter.variational.stderr_v"] == pytest.approx(stderr)
    assert metrics["backscatter.variational.no_skill_fraction"] == fraction
    assert has_no_skill(metrics, Source.BACKSCATTER, "variational") == none


def test_a_method_without_standard_errors_has_no_such_verdict():
    metrics = cross_flow_metrics(winds(np.nan), [])
    assert not any("stderr" in key or "skill" in key for key in metrics)
    assert not has_no_skill(metrics, Source.BACKSCATTER, "variational")


def test_coverage_counts_valid_vectors():
    """Four of twenty errors of v are 1.5 standard errors, two are 3, one of which is flagged."""
    found = winds(0.5)
    off = np.zeros((1, 1, 4, 5))
    off[..., 0, :4], off[..., 1, :2] = 1.5 * 0.5, 3 * 0.5
    flag = np.zeros(off.shape, int)
    flag[..., 1, 0] = Flag.NO_SKILL.value
    metrics = cross_flow_metrics(found.assign(v=found["v"] + off, flag=found["flag"] + flag), [])
    head = "backscatter.variational.coverage"
    assert metrics[f"{head}_68_v"] == pytest.approx(14 / 19)
    assert metrics[f"{head}_95_v"] == pytest.approx(18 / 19)
    assert metrics[f"{head}_95_w"] == 1.0
    assert not any("coverage" in key for key in cross_flow_metrics(winds(np.nan), []))
