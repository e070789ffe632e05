"""Sums over sectors of annuli: unit tests against the same sums pixel by pixel. Detect a pixel in
the wrong cell, a cell that forgets where its pixels lie, a sum that loses light."""

import math

import numpy as np
import pytest
import torch

from lidar_mi.errors import InputError
from lidar_mi.retrieval.rings.cells import annular_sectors, pixels


@pytest.mark.parametrize("centre", [(31.4, 22.8), (-12.0, 60.5)])
@pytest.mark.parametrize("sectors", [1, 5, 16])
def test_a_cell_is_an_annulus_between_two_directions(centre, sectors):
    """Two pixels share a cell if and only if their step of r^2 and their part of the turn agree."""
    shape, step = (50, 70), 90.0
    index = annular_sectors(shape, centre, step, sectors).index.tolist()
    cell_of, places = {}, [(x, y) for y in range(shape[0]) for x in range(shape[1])]
    for cell, (x, y) in zip(index, places, strict=True):
        dx, dy = x - centre[0], y - centre[1]
        annulus = math.floor((dx**2 + dy**2) / step)
        turn = math.floor((math.atan2(dy, dx) / (2 * math.pi) + 0.5) * sectors)
        assert cell_of.setdefault((annulus, min(turn, sectors - 1)), cell) == cell
    assert sorted(cell_of.values()) == list(range(len(cell_of)))


def test_means_keep_the_light_of_every_image():
    rng = np.random.default_rng(4)
    images = torch.as_tensor(rng.random((2, 3, 40, 30)))
    cells = annular_sectors((40, 30), (11.0, 25.0), 60.0, 6)
    means = cells.means(images)
    assert means.shape == (2, 3, len(cells.count)) and means.dtype == torch.float64
    np.testing.assert_allclose((means * cells.count).sum(-1), images.sum((-2, -1)), rtol=1e-12)
    for image, mean in zip(images.flatten(0, 1), means.flatten(0, 1), strict=True):
        inside = image.flatten()[cells.index == 7]
        assert float(mean[7]) == pytest.approx(float(inside.mean()), rel=1e-12)


def test_every_pixel_may_be_a_cell():
    image = torch.rand(4, 6, generator=torch.Generator().manual_seed(1))
    cells = pixels((4, 6), (2.5, -1.0))
    assert torch.equal(cells.means(image), image.double().flatten())
    assert (cells.count == 1).all() and cells.spread is None
    assert (float(cells.x[7]), float(cells.y[7]), float(cells.r2[7])) == (-1.5, 2.0, 6.25)


def test_cells_know_their_pixels_about_any_centre():
    shape, centre, other = (50, 70), (31.4, 22.8), (33.1, 21.5)
    cells = annular_sectors(shape, centre, 90.0, 12)
    y, x = np.mgrid[: shape[0], : shape[1]]
    index = cells.index.numpy()
    r2 = ((x - other[0]) ** 2 + (y - other[1]) ** 2).ravel()
    dx, dy = (o - c for o, c in zip(other, centre, strict=True))
    mean = cells.r2 - 2 * (cells.x * dx + cells.y * dy) + dx**2 + dy**2
    by = torch.tensor([-2 * dx, -2 * dy, 1.0], dtype=torch.float64)
    spread = torch.einsum("i,cij,j->c", by, cells.spread, by)
    for cell in range(0, len(cells.count), 7):
        inside = r2[index == cell]
        assert len(inside) == cells.count[cell]
        assert float(mean[cell]) == pytest.approx(inside.mean(), rel=1e-12)
        assert float(spread[cell]) == pytest.approx(inside.var(), abs=1e-8 * inside.mean())


@pytest.mark.parametrize(
    ("step", "sectors", "message"),
    [(0.0, 16, "step: 0.0 px"), (math.nan, 16, "step: nan px"), (9.0, 0, "sectors: 0 is not")],
)
def test_cells_that_cannot_be(step, sectors, message):
    with pytest.raises(InputError, match=message):
        annular_sectors((20, 20), (9.5, 9.5), step, sectors)
