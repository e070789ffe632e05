"""Geometry of windows. Detects a shift by one pixel and any wrong term in a sum."""

import numpy as np
import pytest
import torch

from lidar_mi.errors import InputError
from lidar_mi.retrieval.images.windows import Windows, averaged, box_sum


@pytest.mark.parametrize("size", range(1, 14))
def test_box_sum_is_the_sum_of_neighbours(size):
    values = torch.rand(3, 17, dtype=torch.float64, generator=torch.Generator().manual_seed(size))
    expected = np.lib.stride_tricks.sliding_window_view(values.numpy(), size, axis=1).sum(-1)
    np.testing.assert_allclose(box_sum(values, size, 1), expected, rtol=1e-14)
    np.testing.assert_allclose(box_sum(values.T, size, 0).T, expected, rtol=1e-14)


def test_box_sum_keeps_a_nan_in_its_windows():
    values = torch.ones(20)
    values[10] = torch.nan
    sums = box_sum(values, 4, 0)
    assert torch.isnan(sums).nonzero()[:, 0].tolist() == [7, 8, 9, 10]


@pytest.mark.parametrize("template, search, stride", [(8, 16, 1), (5, 10, 2), (4, 7, 3), (2, 4, 5)])
def test_regions_lie_inside_and_templates_in_their_middle(template, search, stride):
    windows = Windows((31, 40), template, search, stride)
    for axis, size in enumerate(windows.shape):
        starts = np.asarray(windows.starts(axis))
        assert len(starts) == windows.count[axis]
        before, after = windows.lead, search - template - windows.lead
        assert 0 <= after - before <= 1
        assert starts[0] - before == 0
        assert starts[-1] + template + after <= size < starts[-1] + template + after + stride
        np.testing.assert_array_equal(windows.centres(axis), starts + (template - 1) / 2)


def test_averaged_is_a_gaussian_mean_of_known_values():
    random = torch.Generator().manual_seed(5)
    for shape, least in (
        ((13, 17), 0.3),
        ((13, 17), -1.0),
        ((9, 10, 11), 0.3),
        ((9, 10, 11), -1.0),
    ):
        field = torch.randn(shape, generator=random, dtype=torch.float64)
        known = torch.rand(shape, generator=random) > least
        found = averaged(field, known, 1.5)
        at = torch.stack(torch.meshgrid(*map(torch.arange, shape), indexing="ij")).flatten(1).T
        for place in (0, 40, len(at) - 1):
            off = (at - at[place]).double()
            weight = torch.exp(-off.square().sum(1) / (2 * 1.5**2)) * known.flatten()
            weight *= (off.abs() <= 5).all(1)
            expected = (weight * field.flatten()).sum() / weight.sum()
            torch.testing.assert_close(found.flatten()[place], expected)


def test_windows_of_volumes_divide_the_margin_of_the_stride():
    """Templates lie inside, search regions need not."""
    windows = Windows((10, 12, 17), 8, 16, 4)
    assert windows.count == (1, 2, 3) and windows.reach == 4
    assert [list(windows.starts(axis)) for axis in range(3)] == [[1], [0, 4], [0, 4, 8]]
    assert windows.centres(0).tolist() == [4.5]
    volume = torch.arange(10 * 12 * 17, dtype=torch.float64).reshape(10, 12, 17)
    found = windows.of_templates(volume)
    assert found[0, 1, 2] == volume[1:9, 4:12, 8:16].mean()


def test_unravel_gives_shifts_and_the_rim():
    windows = Windows((20, 20), 4, 9)
    shift_z, shift_y, rim = windows.unravel(torch.arange(36))
    assert shift_z.reshape(6, 6)[:, 0].tolist() == [-2, -1, 0, 1, 2, 3]
    assert shift_y.reshape(6, 6)[0].tolist() == [-2, -1, 0, 1, 2, 3]
    inner = (~rim).reshape(6, 6)
    assert inner[1:-1, 1:-1].all() and inner.sum() == 16


@pytest.mark.parametrize("room", [1, 3, 50, 10**6])
def test_tiles_cover_every_window_once_with_the_pixels_it_needs(room, monkeypatch):
    monkeypatch.setattr("lidar_mi.retrieval.images.windows.TILE_BYTES", room * 100)
    windows = Windows((37, 41), 5, 11, 3)
    observed = np.zeros(windows.count, int)
    for tile in windows.tiles(100):
        observed[tile.vectors] += 1
        assert observed[tile.vectors].size <= room
        pixels = np.empty(windows.shape)[tile.pixels]
        part = Windows(pixels.shape, 5, 11, 3)
        assert part.count == observed[tile.vectors].shape
        assert tile.pixels[0].start == windows.starts(0)[tile.vectors[0].start] - windows.lead
    assert (observed == 1).all()


@pytest.mark.parametrize(
    "options, field",
    [
        ({"template": 1}, "template: 1 "),
        ({"template": 8.0}, "template: 8.0 "),
        ({"template": True}, "template: True "),
        ({"search": 9}, "search: 9 "),
        ({"stride": 0}, "stride: 0 "),
        ({"search": 31}, "search: 31 px does not fit into the image of 30 x 40"),
    ],
)
def test_bad_sizes_are_named(options, field):
    with pytest.raises(InputError) as error:
        Windows((30, 40), **options)
    assert str(error.value).startswith(field) and "\n" not in str(error.value)
