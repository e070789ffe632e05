"""Centres of rings: unit tests on images in closed form. Detect x taken for y, half a pixel lost in
binning, and images without a centre that yield one; `test_peaks` has them on rings of an etalon."""

import numpy as np
import pytest

from lidar_mi.errors import InputError
from lidar_mi.retrieval.rings.centre import (
    circular_average,
    circular_centre,
    gradient_centre,
    midpoint_line_centre,
    midpoint_points,
)


def distance(shape, centre):
    y, x = np.mgrid[: shape[0], : shape[1]]
    return np.hypot(x - centre[0], y - centre[1])


def gaussian_ring(shape, centre, radius, width=3.0):
    return np.exp(-(((distance(shape, centre) - radius) / width) ** 2) / 2)


@pytest.mark.parametrize("shape", [(90, 120), (400, 500)], ids=["as it is", "binned by 2"])
@pytest.mark.parametrize("centre", [(61.3, 40.8), (130.2, -33.0)])
def test_gradients_of_a_bowl_meet_in_its_middle(shape, centre):
    """Gradients of r^2 are exactly radial, and stay so when binned; smoothing mirrors what lies
    beyond the image's edge, which costs 0.1 px."""
    found = gradient_centre(distance(shape, centre) ** 2)
    assert found == pytest.approx(centre, abs=0.1)


@pytest.mark.parametrize("image", [np.ones((60, 80)), np.mgrid[:60, :80][1] * 2.0])
def test_gradients_along_one_direction_have_no_centre(image):
    with pytest.raises(InputError, match="no common centre"):
        gradient_centre(image)


def test_circular_average_of_a_cone():
    """r averaged at r is r, to the second order of linear weights: 1 / 6 of a pixel over r."""
    y, x = np.mgrid[:80, :90]
    r, mean, weight = circular_average(np.hypot(x - 30.3, y - 41.6), (30.3, 41.6))
    np.testing.assert_allclose(mean[5:60], r[5:60], atol=0.05)
    assert weight.sum() == pytest.approx(80 * 90)


def test_contrast_is_highest_about_the_centre():
    """A smooth ring, symmetric about its centre: to 0.02 px from 2 px beside it."""
    image = gaussian_ring((90, 120), (58.7, 44.4), 30.0, 5.0)
    assert circular_centre(image, (57.0, 45.5)) == pytest.approx((58.7, 44.4), abs=0.02)


def test_even_light_has_no_best_centre():
    with pytest.raises(InputError, match="no best centre"):
        circular_centre(np.full((50, 50), 7.0), (20.0, 25.0))


def test_crests_lie_on_the_ring():
    """(x_c -+ sqrt(R^2 - (y - y_c)^2), y) for lines along x, likewise along y.

    A line crosses the ring at up to 30 degrees, where its cut is 1.15 times as wide on one side:
    0.1 px of a width of 3 px.
    """
    centre, radius = (70.3, 58.9), 42.0
    points = midpoint_points(gaussian_ring((120, 140), centre, radius), centre, radius, 10.0)
    assert np.isfinite(points).all()
    np.testing.assert_allclose(
        np.hypot(points[..., 0] - centre[0], points[..., 1] - centre[1]), radius, atol=0.1
    )
    for direction in range(2):
        before, behind = points[direction, ..., direction]
        assert (before < centre[direction]).all() and (behind > centre[direction]).all()
        np.testing.assert_allclose((before + behind) / 2, centre[direction], atol=0.02)
    # half of the ring out of the image: no chord along x, those along y are left
    cut = midpoint_points(gaussian_ring((120, 90), centre, radius), centre, radius, 10.0)
    assert np.isnan(cut[0, 1]).all() and np.isfinite(cut[0, 0]).all()


def test_chords_of_a_ring_meet_in_its_centre():
    image = gaussian_ring((120, 140), (70.3, 58.9), 42.0)
    found = midpoint_line_centre(image, (72.0, 57.5), 42.0, 10.0)
    assert found == pytest.approx((70.3, 58.9), abs=0.02)
    with pytest.raises(InputError, match="no chord of a ring of 200 px"):
        midpoint_line_centre(image, (70.0, 59.0), 200.0, 10.0)
