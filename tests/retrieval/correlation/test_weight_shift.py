"""Weight shift against a direct evaluation and against a compact blob.

Detects a wrong sign or axis, an error of 0.01 px in the centre of mass, and a match that does
not use both weight and centre.
"""

import numpy as np
import pytest
import torch
from scipy.ndimage import center_of_mass

from lidar_mi.errors import InputError
from lidar_mi.flags import Flag
from lidar_mi.retrieval.correlation.weight_shift import mass, weight_shift
from lidar_mi.retrieval.images.windows import Windows
from tests.support.flows import plane_waves, texture


def direct(image1, image2, template, search, stride):
    """Best match and displacement, one window after the other, with scipy's centre of mass."""
    lead, shifts = (search - template) // 2, search - template + 1
    rows, columns = ((size - search) // stride + 1 for size in image1.shape)
    dz, dy, score = np.full((3, rows, columns), np.nan)
    for i in range(rows):
        for j in range(columns):
            z, y = i * stride, j * stride
            box = image1[z + lead : z + lead + template, y + lead : y + lead + template]
            weight, centre = box.sum(), np.array(center_of_mass(box))
            weights, centres = [], []
            for p in range(shifts):
                for q in range(shifts):
                    box = image2[z + p : z + p + template, y + q : y + q + template]
                    weights.append(box.sum())
                    centres.append(center_of_mass(box))
            weights, centres = np.array(weights), np.array(centres)
            misfit = (weights - weight) ** 2 / weights.var()
            misfit += ((centres - centre) ** 2).sum(1) / centres.var(0).sum()
            best = misfit.argmin()
            p, q = divmod(best, shifts)
            score[i, j] = np.sqrt(misfit[best])
            if 0 < p < shifts - 1 and 0 < q < shifts - 1:
                dz[i, j], dy[i, j] = centres[best] - centre + (p - lead, q - lead)
    return dz, dy, score


@pytest.mark.parametrize("template, search, stride", [(8, 16, 3), (5, 10, 2), (4, 7, 1)])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_equals_the_definition(template, search, stride, dtype):
    rng = np.random.default_rng(template)
    first, second = (torch.as_tensor(1e-3 * (1 + rng.random((22, 25)))).to(dtype) for _ in "12")
    expected = direct(first.double().numpy(), second.double().numpy(), template, search, stride)
    found = weight_shift(first, second, template, search, stride)
    for value, reference in zip((*found.d, found.score), expected, strict=True):
        np.testing.assert_allclose(value, reference, atol=1e-9)


def test_tiles_change_nothing(monkeypatch):
    rng = np.random.default_rng(1)
    first, second = (torch.as_tensor(1 + rng.random((40, 43))) for _ in "12")
    whole = weight_shift(first, second, stride=2)
    monkeypatch.setattr("lidar_mi.retrieval.images.windows.TILE_BYTES", 60_000)
    for one, other in zip(weight_shift(first, second, stride=2), whole, strict=True):
        torch.testing.assert_close(one, other, equal_nan=True)


def test_mass_of_a_point():
    image = torch.zeros(9, 9, dtype=torch.float64)
    image[3, 6] = 2
    weight, centre_z, centre_y = mass(image, 4)
    assert weight[2, 4] == 2
    assert centre_z[2, 4] == pytest.approx(3 - (2 + 1.5))
    assert centre_y[2, 4] == pytest.approx(6 - (4 + 1.5))
    assert weight[5, 5] == 0 and torch.isnan(centre_z[5, 5])


@pytest.mark.parametrize("dy, dz", [(2.0, 1.0), (0.4, -0.3), (-1.7, 2.2)])
def test_compact_blob_on_nothing(dy, dz):
    """Wherever a template holds the whole blob, so does the match: s + C_s - C is exact.

    0.01 px: a Gaussian of 0.8 px loses 2e-4 of its weight at 3 px from the middle.
    """
    y, z = np.meshgrid(np.arange(30.0), np.arange(28.0))

    def blob(cy, cz):
        return torch.as_tensor(np.exp(-((y - cy) ** 2 + (z - cz) ** 2) / (2 * 0.8**2)))

    found = weight_shift(blob(14.5, 13.5), blob(14.5 + dy, 13.5 + dz))
    windows = Windows((28, 30))
    i, j = windows.starts(0).index(10), windows.starts(1).index(11)  # centres 13.5 and 14.5
    assert abs(float(found.dy[i, j]) - dy) < 0.01
    assert abs(float(found.dz[i, j]) - dz) < 0.01
    assert found.flag[i, j] == 0


def test_zero_weight_is_no_match():
    for value in (0.0, 0.1, -1.0):
        flat = torch.full((30, 30), value)
        found = weight_shift(flat, flat)
        assert (found.flag & Flag.NO_MATCH.value > 0).all()
        assert torch.isnan(found.dy).all() and torch.isnan(found.dz).all()


def test_rim_and_nan_are_flagged():
    y, z = np.meshgrid(np.arange(50.0), np.arange(40.0))
    first = torch.as_tensor(texture(plane_waves(4, 12.0), y, z))
    second = torch.as_tensor(texture(plane_waves(4, 12.0), y - 5, z))
    second[20, 30] = torch.inf
    found = weight_shift(first, second)
    rim = (found.flag & Flag.PEAK_ON_RIM.value) > 0
    bad = (found.flag & Flag.NON_FINITE_INPUT.value) > 0
    assert rim.double().mean() > 0.5 and torch.isnan(found.dy[rim]).all()
    assert bad.sum() == 16 * 16  # regions that hold the pixel
    assert torch.isnan(found.dy[bad]).all()


def test_bad_input_is_named():
    with pytest.raises(InputError, match=r"^image2: sizes 30 x 30 and 30 x 29 px"):
        weight_shift(torch.ones(30, 30), torch.ones(30, 29))
