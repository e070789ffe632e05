"""Illumination that changes between images: found where it changes, and nowhere else.

Detects a gain that is wrong by 3 standard errors, false alarms of moving air, and winds of an
unevenly lit image that are worse than without.
"""

from functools import partial

import numpy as np
import pytest
import torch

from lidar_mi.retrieval.defects.illumination import described, illumination
from lidar_mi.retrieval.wind.options import WindowSizes
from lidar_mi.retrieval.wind.pair import retrieve_wind
from tests.support.crosswind import DT, crosswind_pair
from tests.support.flows import axes, data_array
from validation.coverage import CASES

COLUMNS, ROWS = 160, 128
pair = partial(crosswind_pair, size=(COLUMNS, ROWS), mean=(-9.0, 5.0))


def lit(image, along_z, along_y):
    """Brightness that changes so much from edge to edge."""
    z, y = np.meshgrid(np.linspace(-0.5, 0.5, ROWS), np.linspace(-0.5, 0.5, COLUMNS), indexing="ij")
    return image * (1 + along_z * z + along_y * y)


def found(image1, image2, **options):
    return illumination(torch.as_tensor(image1), torch.as_tensor(image2), **options)


@pytest.mark.parametrize("seed", [81, *(pytest.param(s, marks=pytest.mark.slow) for s in (82, 83))])
def test_moving_air_is_lit_evenly(seed):
    for length in (1.5, 3.0, 6.0):
        (image1, image2), _ = pair(seed, length, 0.02)
        assert described(found(image1, image2)) == ""


@pytest.mark.parametrize("case", ["advected, texture 0 %", "stored state at t2, texture 5 %"])
def test_turning_smoke_is_lit_evenly(case):
    image1, image2, _, _ = CASES[case](5)
    assert described(found(image1.values, image2.values)) == ""


def test_gain_that_grows_from_edge_to_edge_is_found():
    """From the scatter of both slopes over seeds, 3 standard errors of the mean; each to 1 %."""
    off = []
    for seed in range(84, 88):
        (image1, image2), _ = pair(seed, 2.0, 0.02)
        gain = found(image1, lit(image2, 0.03, -0.06)).numpy()
        off.append([gain[-1, 0] - gain[0, 0] - 0.03, gain[0, -1] - gain[0, 0] + 0.06])
    off = np.array(off)
    assert (np.abs(off.mean(0)) < 3 * off.std() / np.sqrt(len(off))).all()
    assert np.abs(off).max() < 0.01


def test_false_alarms_are_as_rare_as_asked_for():
    """Of blocks that are independent: 400 images, binomial with 3 sigma."""
    random = np.random.default_rng(90)
    alarms = sum(
        described(found(*(10 + random.standard_normal((2, 96, 96))), false_alarm=0.1)) != ""
        for _ in range(400)
    )
    # fewer, as a plane must also explain 0.3 of the variance
    assert alarms <= 400 * 0.1 + 3 * np.sqrt(400 * 0.1 * 0.9)


@pytest.mark.slow
def test_winds_are_as_if_lit_evenly():
    """Stated standard errors were twice as large."""
    (image1, image2), _ = pair(91, 2.0, 0.01)
    y, z = axes(COLUMNS, ROWS)

    def wind(second):
        images = (data_array(i, y, z) for i in (image1, second))
        return retrieve_wind(*images, DT, "variational", windows=WindowSizes(stride=4), noise=0.01)

    even, uneven = wind(image2), wind(lit(image2, 0.0, 0.05))
    assert "illumination" in uneven.attrs and "illumination" not in even.attrs
    assert float((uneven.v_stderr / even.v_stderr).mean()) == pytest.approx(1, abs=0.1)
    assert float(np.abs((uneven.v - even.v) / even.v_stderr).mean()) < 0.3
