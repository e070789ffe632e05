"""Families of defects: their air, their halves and the statistics of what methods say of them.

Detects: air that does not move as stated, a family that is the same for all seeds or without the
defect of its name, wrong or lost vectors that are not counted.
"""

from dataclasses import replace

import numpy as np
import pytest

from validation.defects import families, measure
from validation.defects.air import IMAGE, VOLUME, drawn
from validation.defects.families import BY_NAME, FAMILIES


@pytest.mark.parametrize("shape, vortices", [(IMAGE, False), (IMAGE, True), (VOLUME, False)])
def test_air_moves_as_it_says(shape, vortices):
    """Over a hundredth of dt the places of the air change by the motion, and textures with them."""
    air = drawn(np.random.default_rng(1), shape, vortices)
    assert np.allclose(air.at(0.0), air.at(1.0, air.back(air.places, -1.0)), atol=2e-4)
    step = 0.01
    moved = (air.places - air.back(air.places, step)) / step
    assert np.abs(moved - air.motion(air.places)).max() < 2 * step


@pytest.mark.parametrize("family", FAMILIES, ids=lambda family: family.name)
def test_drawn_anew_for_every_seed(family):
    small = (48, 64) if len(family.shape) == 2 else (12, 12, 12)
    first, again, other = (replace(family, shape=small).pair(seed)[1] for seed in (1, 1, 2))
    assert [image.shape for image in first] == [small] * 2
    for one, same, unlike in zip(first, again, other, strict=True):
        assert np.isfinite(one).all() and np.array_equal(one, same)
        assert not np.array_equal(one, unlike)


def test_every_kind_of_defect_judges():
    kinds = {f.kind for f in FAMILIES} - {"none", "lost pairs"}
    assert kinds == {f.kind for f in families.chosen("judge")}


def test_defects_are_what_they_say():
    rows = BY_NAME["repeated rows"].pair(3)[1][0]
    assert (np.diff(rows, axis=0) == 0).all(1).mean() >= 0.5
    one, two = BY_NAME["copied blocks"].pair(3)[1]
    assert 0.04 < (one == two).reshape(12, 8, 14, 8).all((1, 3)).mean() < 0.6
    assert (BY_NAME["hot voxels"].pair(3)[1][0] > 3).mean() < 0.011


def test_outcome_counts_wrong_and_lost_vectors(monkeypatch):
    """Of 100 vectors 10 are flagged by the checks, 9 of the others are 5 stated errors off."""
    family = BY_NAME["clean"]

    def errors(_, wind):
        error = np.zeros((2, 100))
        error[0, 10:19] = 5.0
        return error, np.ones((2, 100)), wind["flag"].values == 0

    def retrieved(images, method, checks=True):
        return {"flag": measure.data_array(np.arange(100.0)[:, None] < 10 * checks)[:, 0]}

    monkeypatch.setattr(measure, "errors", errors)
    monkeypatch.setattr(measure, "retrieved", retrieved)
    row = measure.outcome(family, "cc", [1, 2], loss=True)
    assert (row.valid, row.far, row.seeds_far, row.lost) == (0.9, 0.1, 2, 0.1)
    assert row.variance == pytest.approx(9 * 25 / 180)


@pytest.mark.parametrize(("family", "loss"), [("columns", False), ("clean", True)])
def test_valid_vectors_are_within_their_errors_and_clean_ones_kept(family, loss):
    """What is required of the table, by its quickest method."""
    small = replace(BY_NAME[family], shape=(64, 80))
    row = measure.outcome(small, "cc", [1], loss)
    assert row.valid > 0.3 and row.far <= measure.MOST_FAR
    assert not loss or row.lost <= measure.MOST_LOST
