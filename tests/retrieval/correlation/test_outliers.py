"""The median test against its formula, and what takes the place of outliers.

Detects a wrong median of an even number, a wrong threshold, an outlier at the rim that its own
extrapolation hides.
"""

import numpy as np
import pytest
import torch

from lidar_mi.errors import InputError
from lidar_mi.retrieval.correlation.outliers import median_outliers, validated


def westerweel(dz, dy, reach, spacing, epsilon):
    """The normalised residual, one vector after the other."""
    rows, columns = dz.shape
    out = np.zeros((rows, columns))
    steps = [s * spacing for s in range(-reach, reach + 1)]
    for i in range(rows):
        for j in range(columns):
            for u in (dz, dy):
                around = [
                    u[i + a, j + b]
                    for a in steps
                    for b in steps
                    if (a, b) != (0, 0) and 0 <= i + a < rows and 0 <= j + b < columns
                ]
                if np.isfinite(around).sum() < 3:
                    continue  # too few to judge
                middle = np.nanmedian(around)
                spread = np.nanmedian(np.abs(np.array(around) - middle))
                out[i, j] += ((u[i, j] - middle) / (spread + epsilon)) ** 2
    return np.sqrt(out)


@pytest.mark.parametrize("size, spacing", [(3, 1), (5, 1), (3, 4)])
@pytest.mark.parametrize("room", [1, 2**27])
def test_median_test_is_the_published_formula(size, spacing, room, monkeypatch):
    monkeypatch.setattr("lidar_mi.retrieval.images.windows.TILE_BYTES", room)
    rng = np.random.default_rng(3)
    dz, dy = rng.standard_normal((2, 14, 17))
    dz[5, 6] = dy[5, 6] = np.nan
    residual = westerweel(dz, dy, size // 2, spacing, 0.1)
    found = median_outliers(torch.as_tensor(np.stack([dz, dy])), size, spacing)
    assert 0.05 < found.double().mean() < 0.95
    np.testing.assert_array_equal(found, residual > 2)


def test_median_test_detects_the_one_wrong_vector():
    y, z = np.meshgrid(np.arange(20.0), np.arange(20.0))
    dz, dy = torch.as_tensor(0.1 * y), torch.as_tensor(-0.1 * z)  # solid rotation
    dy[8, 9] += 1.0
    found = median_outliers(torch.stack([dz, dy]))
    assert found[8, 9]
    inner = found[1:-1, 1:-1]
    assert inner.sum() == 1


def test_lonely_vectors_are_not_judged():
    dz = torch.full((9, 9), torch.nan, dtype=torch.float64)
    dz[4, 4], dz[4, 5], dz[5, 4] = 0.0, 5.0, 5.0
    assert not median_outliers(torch.stack([dz, dz])).any()


@pytest.mark.parametrize("place", [(0, 0, 0), (0, 3, 3), (4, 2, 5), (2, 2, 2)])
def test_outliers_in_volumes_are_detected_at_faces_and_corners(place):
    """A shear of 0.4 px a neighbour is none; one vector 3 px off is, and its neighbours are not."""
    x, z, y = torch.meshgrid(torch.arange(5.0), torch.arange(6.0), torch.arange(6.0), indexing="ij")
    d = torch.stack([0.2 * z, 0.4 * y, -0.1 * x])
    assert not median_outliers(d, continued=True).any()
    d[1, *place] += 3.0
    found = median_outliers(d, continued=True)
    assert bool(found[place]) and int(found.sum()) == 1
    assert validated(d, 1, continued=True)[1].sum() == 1


def test_outliers_and_gaps_take_their_neighbours_median():
    z, y = torch.meshgrid(torch.arange(9.0), torch.arange(12.0), indexing="ij")
    true = torch.stack([0.02 * z, 0.03 * y])
    d = true.clone()
    d[:, 4, 5] = torch.tensor([6.0, -3.0])
    d[:, 0:2, 0:3] = torch.nan
    found, wrong = validated(d, 1)
    assert wrong.sum() == 7 and wrong[4, 5] and wrong[:2, :3].all()
    assert torch.equal(found[:, ~wrong], true[:, ~wrong])
    torch.testing.assert_close(found[:, 4, 5], true[:, 4, 5])
    assert (found - true).abs().max() < 0.1
    nothing, wrong = validated(torch.full((2, 3, 3), torch.nan), 1)
    assert wrong.all() and (nothing == 0).all()


@pytest.mark.parametrize(
    ("change", "start"),
    [
        ({"size": 4}, "median_size: 4"),
        ({"threshold": 0}, "median_threshold: 0"),
        ({"epsilon": float("nan")}, "median_epsilon: nan"),
        ({"spacing": 0}, "spacing: 0"),
    ],
)
def test_bad_input_is_named(change, start):
    with pytest.raises(InputError) as error:
        median_outliers(torch.zeros(2, 5, 5), **change)
    assert str(error.value).startswith(start) and "\n" not in str(error.value)
