"""Rings in any image: what the command `lidar-mi rings` finds, on made and on real images.

Detects: a centre off by its error bar, radii off by 0.1 px, lines taken for orders or orders for
lines, unequal splitting, a tilted camera mistaken for another centre, and images without two
rings that give a number.
"""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from lidar_mi.errors import InputError
from lidar_mi.retrieval.rings.analysis import analyse_rings
from lidar_mi.retrieval.rings.frames import few_levels
from tests.support import ring_reference as reference

LABORATORY = Path(__file__).parents[4] / "shared" / "data" / "fringes"


def split_rings(shape, centre, spacing, fractions, finesse=60.0, ellipticity=0.0, tilt=0.0):
    """Airy rings of several lines, seen by a tilted camera that makes ellipses of circles.

    ``tilt`` is that of a pinhole's image plane, in 1/px: exact, not to first order.
    """
    x = np.arange(shape[1]) - centre[0]
    y = (np.arange(shape[0]) - centre[1])[:, None]
    x, y = x * (1 + ellipticity) / (1 + tilt * x), y * (1 - ellipticity) / (1 + tilt * x)
    order = (x**2 + y**2) / spacing
    return sum(1 / (1 + finesse * np.sin(np.pi * (order - f)) ** 2) for f in fractions)


@pytest.mark.slow
def test_noisy_backscatter_off_centre():
    """2 images of 1.3e7 photons: four coordinates scatter as their error bars say."""
    rng = np.random.default_rng(5)
    mean = reference.ring_image(0.0, 1.3e7, (431.7, 402.2))
    pulls, fractions = [], []
    for _ in range(2):
        found = analyse_rings(reference.noisy(mean, rng, 5.0))
        pulls.append(np.subtract(found.centre, (431.7, 402.2)) / found.centre_std)
        fractions.append(found.fraction[0])
    # 4 sigma of a chi-square with 4 degrees of freedom, the error bars good to a third
    assert np.sum(np.square(pulls)) < 1.7 * (4 + 4 * np.sqrt(8))
    assert np.mean(fractions) == pytest.approx(0.5, abs=0.02)


@pytest.mark.slow
@pytest.mark.parametrize("fractions", [(0.75,), (0.59, 0.89), (0.2, 0.45, 0.7)])
def test_lines_and_orders_are_distinguished(fractions):
    image = split_rings((500, 640), (300.3, 262.8), 20000.0, fractions)
    found = analyse_rings(image)
    np.testing.assert_allclose(found.centre, (300.3, 262.8), atol=0.03)
    assert found.spacing == pytest.approx(20000, rel=3e-3)
    np.testing.assert_allclose(found.fraction, fractions, atol=5e-3)
    assert set(found.line) == set(range(len(fractions)))
    if len(fractions) > 1:
        split = found.splitting / found.spacing
        expected = np.subtract(fractions[1:], fractions[0])
        np.testing.assert_allclose(split[:2], [expected] * 2, atol=5e-3)


@pytest.mark.slow
def test_laboratory_like_image():
    """Split line, 8 bits, tilted camera, ellipses, sloping light: stands in for the real images.

    The same instrument sees the line single and split: one centre, equal splitting in both
    orders, and the pair's mean where the single ring was.
    """
    rng = np.random.default_rng(6)
    size, centre = (512, 640), (297.2, 277.4)
    slope = 1 + 0.2 * np.linspace(-1, 1, size[0])[:, None]
    found = []
    for fractions in ((0.74,), (0.59, 0.89)):
        rings = split_rings(size, centre, 49900.0, fractions, 20.0, 0.008, 4e-5)
        grey = 12 + 60 * rings * slope + rng.normal(0, 1, size)
        found.append(analyse_rings(grey.round().clip(0, 255).astype(np.uint8)))
    single, split = found
    for one in found:
        np.testing.assert_allclose(one.centre, centre, atol=0.6)
        # toward the axis that is stretched, away from it on the other: -x gets e, y gets it back
        assert one.ellipticity[0] == pytest.approx(-0.008, abs=1e-3)
        assert one.tilt[0] == pytest.approx(4e-5, rel=0.3)
    split_r2 = split.splitting[:2, 0]
    assert split_r2[1] == pytest.approx(split_r2[0], rel=0.02)
    means = [np.mean(split.radius[split.order == k] ** 2) for k in range(2)]
    np.testing.assert_allclose(means, single.radius[:2] ** 2, atol=0.01 * single.spacing)


@pytest.mark.skipif(not LABORATORY.is_dir(), reason="the laboratory pictures are not here")
def test_laboratory_images():
    """Real images of one line, single and split: what any right analysis must find."""
    single, split = (
        analyse_rings(np.array(Image.open(LABORATORY / f"fabry_perot_{name}.jpg")))
        for name in ("single", "split")
    )
    assert np.hypot(*np.subtract(single.centre, split.centre)) < 1.0
    assert set(split.line) == {0, 1} and set(single.line) == {0}
    assert split.spacing == pytest.approx(single.spacing, rel=0.01)
    splitting = split.splitting[:, 0]
    assert len(splitting) >= 2
    np.testing.assert_allclose(splitting, splitting[0], rtol=0.01)
    for order in range(2):
        pair = split.radius[split.order == order] ** 2
        assert abs(pair.mean() - single.radius[order] ** 2) < 0.01 * single.spacing
    assert split.misfit < 0.01 and not single.misfit > 0.01


def test_given_centre_stays():
    image = split_rings((500, 640), (300.3, 262.8), 20000.0, (0.5,))
    found = analyse_rings(image, (300.3, 262.8))
    assert found.centre == (300.3, 262.8) and found.centre_std == (0.0, 0.0)
    assert found.fraction[0] == pytest.approx(0.5, abs=5e-3)
    pattern = found.tables()[0]
    assert pattern.title == "pattern"
    assert dict(pattern.rows)["centre x, y"] == "300.3, 262.8 px (given)"
    assert "300.3, 262.8 px (given)" in repr(found)


# --- bad input ------------------------------------------------------------------------------


def images():
    rng = np.random.default_rng(9)
    y, x = np.mgrid[:300, :400]
    r = np.hypot(x - 190, y - 160)
    good = split_rings((300, 400), (190.0, 160.0), 8000.0, (0.5,))
    spoiled = good.copy()
    spoiled[5, 6] = np.nan
    return {
        "noise": (rng.normal(100, 5, (300, 400)), "rings: |centre: |no common centre"),
        "even": (np.full((300, 400), 3.0), "no common centre"),
        "ramp": (x + 0.0, "no common centre"),
        "blob": (np.exp(-(r**2) / 5000), "rings: 0 detected|none detected"),
        "one ring": (np.exp(-(((r - 90) / 12) ** 2)), "rings: 1 detected; expected at least 2"),
        "unequal": (
            sum(np.exp(-(((r - a) / 3) ** 2)) for a in (60, 75, 100, 110, 140)),
            "equal steps",
        ),
        "nan": (spoiled, r"1 pixel\(s\) of NaN"),
        "saturated": (good.clip(max=0.5), "saturated"),
        "outside": (split_rings((300, 400), (-40.0, 160.0), 8000.0, (0.5,)), "centre: "),
    }


@pytest.mark.slow
@pytest.mark.parametrize(
    "kind", [pytest.param(k, marks=[pytest.mark.slow] * (k == "unequal")) for k in images()]
)
def test_refused(kind):
    image, message = images()[kind]
    with pytest.raises(InputError, match=message) as stop:
        analyse_rings(image)
    assert "\n" not in str(stop.value)


def test_arguments():
    with pytest.raises(InputError, match="2 images are not allowed"):
        analyse_rings(np.zeros((2, 30, 30)))
    with pytest.raises(InputError, match=r"centre: .900.0, 3.0. px"):
        analyse_rings(split_rings((300, 400), (190.0, 160.0), 8000.0, (0.5,)), (900.0, 3.0))


@pytest.mark.slow
def test_few_grey_levels_are_doubted():
    """Thresholded and posterised pictures, whose flat crests look like split lines; not counts."""
    y, x = np.mgrid[:240, :320].astype(float)
    order = ((x - 163.3) ** 2 + (y - 118.6) ** 2) / 6500
    light = 1 / (1 + 60 * np.sin(np.pi * (order - 0.37)) ** 2)
    for seed in range(2):
        frame = np.random.default_rng(seed).poisson(400 * light + 20).astype(float)
        for coarse in (frame > 150, np.round(frame / 120)):
            assert "grey levels" in analyse_rings(coarse.astype(float)).doubt
        for fine in (frame, np.round(frame / 20)):
            found = analyse_rings(fine)
            assert found.doubt == ""
            off = (found.fraction[0] - 0.37) / found.fraction_std[0]
            assert len(found.fraction) == 1 and abs(off) < 4
        # single photons have few levels, and the variance of counts
        assert few_levels(np.random.default_rng(seed).poisson(2 * light + 0.1)) == ""
