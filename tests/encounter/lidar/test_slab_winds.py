"""Winds of successive slabs, in this process and in one of its own.

Detects winds that differ between both, structure learnt once that stays behind as a pair drifts,
a wind that waits for vortices it does not have, and flags that the slab's estimate does not tell.
"""

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from benchmarks.cases import DT, drifting_pair_images
from benchmarks.realtime import UNFORESEEN
from lidar_mi.encounter.lidar.slab_winds import FirstImage, InOwnProcess, InThisProcess
from lidar_mi.retrieval.method_names import ImageMethod
from lidar_mi.retrieval.vortices.image_fit import fit_vortices
from lidar_mi.retrieval.wind.options import WindowSizes
from tests.support.vortex_pairs import uneven

NOISE = 0.03
WINDOWS = {"windows": WindowSizes(8, 16, 1)}


def slab(number, step=0.4):
    """Images of slabs in which the pair is so much (m) further, with other texture."""
    vortices = [replace(v, y=v.y + step * number, z=v.z - step * number) for v in uneven()]
    return drifting_pair_images(vortices, (0.5, 0.0), NOISE, number, columns=130, rows=90)


@pytest.fixture(scope="module")
def drifting():
    """Slabs, and the pair found in each."""
    slabs = [slab(number) for number in range(5)]
    return slabs, [fit_vortices(s.first, s.second, DT, NOISE) for s in slabs]


def wind_of(winds, images, expected=None, before=None, complete=None):
    """A slab's wind, prepared with its first image."""
    first = FirstImage(images.first, DT, NOISE, expected=expected)
    assert winds.prepare(first, before).result() > 0
    return winds.retrieve(images.second, complete).result()


def winds_of(winds, drifting, complete=None):
    """One slab after the other, the pair expected where the last one was."""
    found, before = [], None
    for images, pair in zip(*drifting, strict=True):
        expected = before and replace(before, covariance=before.covariance + np.diag(UNFORESEEN**2))
        found.append(wind_of(winds, images, expected, before, complete))
        before = pair
    return found


@pytest.fixture(scope="module")
def here(drifting):
    return winds_of(InThisProcess(ImageMethod.VARIATIONAL, WINDOWS), drifting)


@pytest.mark.slow
def test_a_process_of_its_own_finds_the_same(here, drifting):
    winds = InOwnProcess(ImageMethod.VARIATIONAL, WINDOWS)
    for (one, *_), (other, _, seconds) in zip(here, winds_of(winds, drifting), strict=True):
        # but for rounding in single precision
        for name in ("v", "w"):
            off = (one[name] - other[name]) / one[f"{name}_stderr"]
            assert float(abs(off).max()) < 0.01
        assert bool((one["flag"] == other["flag"]).mean() > 0.99)
        assert one.attrs["from_start"] == other.attrs["from_start"]
        assert seconds["wind"] > 0


def doubled(wind):
    """A completion of a wind."""
    return wind.assign(v=2 * wind["v"]), ("doubled",)


@pytest.mark.slow
def test_a_wind_is_completed_where_it_is_found_and_the_next_starts_without(here, drifting):
    """In a process of its own; the next slab starts from the images' wind."""
    winds = InOwnProcess(ImageMethod.VARIATIONAL, WINDOWS)
    found = winds_of(winds, [part[:2] for part in drifting], doubled)
    for (wind, flags, seconds), alone in zip(found, here, strict=False):
        assert flags == ("doubled",) and set(seconds) == {"wind", "combination"}
        off = (wind["v"] / 2 - alone.wind["v"]) / alone.wind["v_stderr"]
        assert float(abs(off).max()) < 0.01


def failing(wind):
    raise ValueError("a completion that fails")


@pytest.mark.slow
@pytest.mark.parametrize("form", [InThisProcess, InOwnProcess])
def test_a_fault_surfaces_with_the_result(drifting, form):
    """Not as the wind is asked for: the vortices are fitted meanwhile."""
    winds = form(ImageMethod.CC, WINDOWS)
    images = drifting[0][0]
    winds.prepare(FirstImage(images.first, DT, NOISE), None).result()
    future = winds.retrieve(images.second, failing)
    with pytest.raises(ValueError, match="a completion that fails"):
        future.result()


@pytest.mark.slow
def test_what_limits_the_wind_of_most_vectors_is_said(drifting):
    """A pattern at rest as strong as the texture, and unrelated images."""
    images, random = drifting[0][0], np.random.default_rng(5)
    fixed = gaussian_filter(random.standard_normal(images.first.shape), 1.5)
    fixed = 1 + float(images.first.std()) * fixed / fixed.std()
    other = images.first.copy(data=1 + 0.05 * random.standard_normal(images.first.shape))
    pairs = {
        "wind: at rest": (fixed * images.first, fixed * images.second),
        "wind: unrelated": (images.first, other),
    }
    for reason, pair in pairs.items():
        winds = InThisProcess(ImageMethod.VARIATIONAL, WINDOWS)
        seen = replace(images, first=pair[0], second=pair[1])
        assert reason in wind_of(winds, seen).flags


def test_other_methods_start_from_nothing(drifting):
    images = drifting[0][0]
    assert wind_of(InThisProcess(ImageMethod.CC, WINDOWS), images).wind.attrs["method"] == "cc"
