"""The singlet: paraxial optics in closed form, Fermat's principle, places to 0.01 pixels.

Detects: 1e-4 of the refractive index, 1e-5 of the focal length, a surface bent the wrong way, a
tenth of a wavelength of spherical aberration, 0.01 pixels (74 nm) of distortion.
"""

import numpy as np
import pytest
from scipy.optimize import minimize

from lidar_mi.errors import InputError
from lidar_mi.instrument.lens import fused_silica_index, singlet, trace

PIXEL = 7.4e-6
FIELD = np.arctan(620 * PIXEL / 0.3)


@pytest.fixture(scope="module")
def lens():
    return singlet(0.3, 354.7e-9, 5e-3, FIELD)


@pytest.mark.parametrize(
    ("wavelength", "index"), [(587.6e-9, 1.45846), (404.7e-9, 1.46962), (365.0e-9, 1.47454)]
)
def test_index_is_that_of_the_catalogue(wavelength, index):
    """d, h and i lines of fused silica (manufacturers' tables, 20 C)."""
    assert fused_silica_index(wavelength) == pytest.approx(index, abs=2e-5)


def test_focal_length_is_the_lensmaker_s(lens):
    """Thick lens: power of both surfaces, and the back focal distance."""
    (front, back), thickness, index = 1 / lens[1:, 0], lens[1, 2], lens[1, 3]
    bend = thickness * (index - 1) / index
    power = (index - 1) * (front - back + bend * front * back)
    assert 1 / power == pytest.approx(0.3, rel=3e-5)
    distance = (1 - bend * front) / power
    assert lens[2, 2] == pytest.approx(distance, rel=3e-5)
    assert lens[0, 2] > 0 and thickness > 0


def test_paths_to_the_focus_are_equally_long(lens):
    """Fermat: of all ways through both surfaces light takes the shortest, and on the axis all
    shortest ways are alike to 1 % of a wavelength."""

    def sag(height, radius, conic):
        return height**2 / radius / (1 + np.sqrt(1 - (1 + conic) * height**2 / radius**2))

    edge = lens[1:, 2].sum()  # the CCD, from the vertex of the front

    def length(heights, start):
        """Micrometres, from a plane in front, at a height on the stop."""
        first, second = np.asarray(heights) * 1e-3
        x1 = sag(first, *lens[1, :2])
        x2 = lens[1, 2] + sag(second, *lens[2, :2])
        way = np.hypot(x1 + 1e-3, first - start)
        way += lens[1, 3] * np.hypot(x2 - x1, second - first)
        return 1e6 * (way + np.hypot(edge - x2, second))

    found = []
    for start in np.array([0.0, 1.5e-3, 3e-3, 5e-3]):
        heights = [1e3 * start, 0.98e3 * start]
        # parallel light enters at its height; the second surface is where the way is shortest
        best = minimize(
            lambda h, s=start: length([1e3 * s, h[0]], s),
            heights[1:],
            method="Nelder-Mead",
            options={"xatol": 1e-7, "fatol": 1e-10},
        )
        found.append(best.fun)
    assert np.ptp(found) < 0.01 * 0.3547


def test_light_falls_where_an_ideal_lens_puts_it(lens):
    """Middle of the light within 0.01 px of f tan(angle) over the field; blur as documented."""
    rng = np.random.default_rng(1)
    radius, turn = 5e-3 * np.sqrt(rng.random(20_000)), 2 * np.pi * rng.random(20_000)
    # opposite points of the stop together: no noise of the mean at first order
    across = np.append(radius * np.cos(turn), -radius * np.cos(turn))
    along = np.append(radius * np.sin(turn), -radius * np.sin(turn))
    for pixels in (0, 100, 250, 400, 550, 618):
        angle = np.arctan(pixels * PIXEL / 0.3)
        x, y = (values / PIXEL for values in trace(lens, across, along, angle))
        assert x.mean() == pytest.approx(pixels, abs=0.003)
        assert abs(y.mean()) < 0.003
        spread = (pixels / 618) ** 2
        assert x.std() == pytest.approx(0.143 * spread, rel=0.05, abs=1e-4)
        assert y.std() == pytest.approx(0.066 * spread, rel=0.05, abs=1e-4)


def test_lens_scales_with_its_focal_length(lens):
    """Everything is proportional, at one ratio of stop and focal length."""
    twice = singlet(0.6, 354.7e-9, 10e-3, FIELD)
    np.testing.assert_allclose(twice[:, [0, 2]], 2 * lens[:, [0, 2]], rtol=1e-6)
    np.testing.assert_allclose(twice[:, [1, 3]], lens[:, [1, 3]], rtol=1e-6)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((0.0, 354.7e-9, 5e-3, 0.01), "focal_length: 0 is not allowed"),
        ((0.3, 354.7e-9, 0.05, 0.01), "stop_radius: 0.05 is not allowed; .* up to 0.03"),
        ((0.3, 354.7e-9, 5e-3, 0.1), "field: 0.1 is not allowed; expected above 0, up to 0.05"),
        ((0.3, 100e-9, 5e-3, 0.01), "wavelength: 1e-07 m is not allowed; expected 0.21 to 3.71 um"),
    ],
)
def test_wrong_numbers_are_named(arguments, message):
    with pytest.raises(InputError, match=message):
        singlet(*arguments)
