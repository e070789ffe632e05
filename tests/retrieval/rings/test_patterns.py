"""Lines and orders in frames of split, faint and moving lines, with noise of a camera.

Detects: an order that is two or three orders (aliasing), a line that is not found at 5 % of its
neighbour, one that is not there, standard errors 12 % too small, a frame of a series on its own
spacing.
"""

import numpy as np
import pytest

from lidar_mi.errors import InputError
from lidar_mi.retrieval.rings.analysis import analyse_rings
from lidar_mi.retrieval.rings.series import analyse_series
from tests.support.ring_frames import Frame

SMALL = {"shape": (220, 260), "centre": (128.3, 112.7), "spacing": 5000.0, "finesse": 12.0}
SPLITTINGS = np.arange(0, 1.21, 0.04)
KINDS = {
    "two": ((-0.5, 0.5), (1.0, 1.0)),
    "two, unequal": ((-0.5, 0.5), (1.0, 0.6)),
    "three": ((-1.0, 0.0, 1.0), (1.0, 1.0, 1.0)),
    "three, unequal": ((-1.0, 0.0, 1.0), (0.5, 1.0, 0.5)),
}


def zeeman(kind, splitting, seed=1, **more):
    """A frame of a line that the field splits, and the fractional orders of its components."""
    parts, heights = KINDS[kind]
    fraction = tuple(0.62 + splitting * part for part in parts)
    frame = Frame(**SMALL | more, fraction=fraction, height=heights, vignetting=0.3)
    return frame.exposure(np.random.default_rng(seed)), np.array(fraction) % 1


def distance(found, fraction):
    """From each true component to the nearest that is found, orders."""
    off = np.abs((found[:, None] - fraction + 0.5) % 1 - 0.5)
    return off.min(0)


def check_frame(rings, fraction, splitting):
    """Spacing to 0.5 %, every component found, or a blend that it is part of."""
    assert rings.spacing == pytest.approx(SMALL["spacing"], rel=5e-3), splitting
    apart = np.abs((fraction[:, None] - fraction + 0.5) % 1 - 0.5)
    alone = (apart + np.eye(len(fraction)) > 1.5 / SMALL["finesse"]).all(1)
    off = distance(rings.fraction, fraction)
    assert (off[alone] < 5e-3).all(), (splitting, rings.fraction, fraction)
    assert (off < 1.5 / SMALL["finesse"]).all(), (splitting, rings.fraction, fraction)
    # and none that is not there
    assert (distance(fraction, rings.fraction) < 1 / SMALL["finesse"]).all(), splitting


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "splitting"), [("two", 0.44), ("three, unequal", 0.32)])
def test_components_that_cross_the_next_order(kind, splitting):
    image, fraction = zeeman(kind, splitting)
    check_frame(analyse_rings(image), fraction, splitting)


@pytest.mark.parametrize("seed", [11, 13])
def test_components_a_width_apart(seed):
    """One wide line between two that do not exist explains the frame ten times worse."""
    image, fraction = zeeman("three, unequal", 0.08, seed)
    rings = analyse_rings(image)
    np.testing.assert_allclose(np.sort(rings.fraction), np.sort(fraction), atol=5e-3)


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_zeeman_series(kind):
    """31 frames from 0 to 1.2 orders: none is wrong by an order."""
    made = [zeeman(kind, splitting, seed) for seed, splitting in enumerate(SPLITTINGS)]
    series = analyse_series(image for image, _ in made)
    for splitting, rings, (_, fraction) in zip(SPLITTINGS, series.rings, made, strict=True):
        assert rings is not None, splitting
        check_frame(rings, fraction, splitting)


@pytest.mark.slow
def test_the_shorter_spacing_wins():
    """Two lines of one height half an order apart are one line of half the spacing; a known
    spacing says which."""
    image, fraction = zeeman("two", 0.5)
    assert analyse_rings(image).spacing == pytest.approx(2500, rel=1e-3)
    known = analyse_rings(image, spacing=5000.0)
    assert known.spacing == pytest.approx(5000, rel=1e-3)
    assert distance(known.fraction, fraction).max() < 2e-3


@pytest.mark.slow
def test_a_series_has_one_spacing():
    """A frame between its neighbours takes their spacing; noise is refused."""
    frames = [zeeman("two", splitting)[0] for splitting in (0.46, 0.5, 0.54)]
    frames.append(np.random.default_rng(1).normal(100, 5, SMALL["shape"]))
    series = analyse_series(frames)
    assert [r and round(r.spacing, -2) for r in series.rings] == [5000, 5000, 5000, None]
    assert "rings: " in series.refused[3] or "centre" in series.refused[3]
    columns = series.columns()
    assert {len(column) for column in columns.values()} == {4}
    assert np.isnan(columns["spacing"][3]) and columns["fraction_1"][1] > 0
    assert "fractional orders" in repr(series)


@pytest.mark.slow
@pytest.mark.parametrize("height", [0.05, pytest.param(0.1, marks=pytest.mark.slow)])
def test_faint_line(height):
    """Down to 5 % of the other line, crests of 400 photons: found, with its standard error."""
    frame = Frame(**SMALL, fraction=(0.3, 0.62), height=(height, 1.0))
    found = analyse_rings(frame.exposure(np.random.default_rng(4), photons=400.0))
    assert len(found.fraction) == 2
    assert found.height == pytest.approx([height, 1.0], rel=0.15)
    assert (np.abs(found.fraction - frame.fraction) < 4 * found.fraction_std).all()
    assert found.fraction_std.max() < 0.01


@pytest.mark.slow
@pytest.mark.parametrize(
    "frame",
    [Frame(**SMALL), pytest.param(Frame(**SMALL, plates=0.03, patch=25.0), marks=pytest.mark.slow)],
)
def test_one_line_stays_one(frame):
    """Neither noise nor uneven plates, which widen the line, make a second one."""
    for seed in range(2):
        found = analyse_rings(frame.exposure(np.random.default_rng(seed)))
        assert len(found.fraction) == 1
        assert abs(found.spacing - 5000) < 4 * found.spacing_std


CAMERAS = {
    "plain": ({}, {}),
    "counts": ({}, {"gain": 7.3, "photons": 60.0}),
    "light": ({"vignetting": 0.6, "slope": (0.5, 0.3), "background": 0.4}, {}),
    "pair": ({"fraction": (0.3, 0.62), "height": (1.0, 0.4)}, {}),
    "off centre": ({"centre": (70.2, 50.1)}, {}),
}


@pytest.mark.slow
@pytest.mark.parametrize("camera", CAMERAS)
def test_standard_errors_hold(camera):
    """60 frames: centre, spacing, fractions and three radii are off as their standard errors say.

    The variance of the normalised errors of each is 1 within 4 of its standard deviations, their
    mean over all, whose errors are correlated at most in threes, within 0.8 to 1.25 and these.
    """
    number = 60
    changes, exposure = CAMERAS[camera]
    frame = Frame(**SMALL | {"finesse": 10.0} | changes)
    errors = []
    for seed in range(number):
        found = analyse_rings(frame.exposure(np.random.default_rng([seed, 7]), **exposure))
        fraction = np.array(frame.fraction)
        radius = np.sqrt((found.order + fraction[found.line]) * frame.spacing)
        off = (found.radius - radius) / found.radius_std
        errors.append(
            [
                *np.subtract(found.centre, frame.centre) / found.centre_std,
                (found.spacing - frame.spacing) / found.spacing_std,
                *(found.fraction - fraction) / found.fraction_std,
                *off[[0, len(off) // 2, -1]],
            ]
        )
    squares = np.square(errors)
    assert (squares.mean(0) < 1 + 4 * np.sqrt(2 / number)).all(), squares.mean(0)
    assert (squares.mean(0) > 1 - 4 * np.sqrt(2 / number)).all(), squares.mean(0)
    scatter = 2 * np.sqrt(2 / (number * len(errors[0]) / 3))
    assert 0.8 - scatter < squares.mean() < 1.25 + scatter
    for limit, expected in ((1.0, 0.683), (1.96, 0.95)):
        share = np.sqrt(expected * (1 - expected) / (number * len(errors[0]) / 3))
        assert (squares < limit**2).mean() == pytest.approx(expected, abs=0.02 + 3 * share)


def test_spacing_that_is_not_there():
    with pytest.raises(InputError, match="expected squares that rise by equal steps"):
        analyse_rings(zeeman("two", 0.3)[0], spacing=3700.0)
