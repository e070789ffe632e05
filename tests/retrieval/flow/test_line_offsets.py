"""Offsets of lines: detects those that the flow takes for motion, and errors without theirs."""

from functools import cache

import numpy as np
import pytest
import torch

from lidar_mi.retrieval.flow.line_offsets import LineOffsets, most_probable
from validation.defects.families import BY_NAME
from validation.defects.measure import errors, retrieved


def test_offsets_of_balanced_groups():
    """REML of the one-way layout: v = (MSB - MSE) / n, shrunk means (Searle et al. 1992, ch. 3).

    The variance is one of a grid in steps of 2^(1/2).
    """
    random, groups, n, variance = np.random.default_rng(1), 400, 20, 0.5
    values = variance**0.5 * random.standard_normal(groups)
    data = values[:, None] + random.standard_normal((groups, n))
    information = n * torch.eye(groups, dtype=torch.float64)
    ratio, found, root = most_probable(information, torch.as_tensor(data.sum(1)))
    fitted = data.mean(1).var() - 1 / n
    shrunk = fitted / (fitted + 1 / n) * data.mean(1)
    assert ratio > 100
    assert found.numpy() == pytest.approx(shrunk, rel=0.03)
    expected = torch.full((groups,), 1 / (n + 1 / fitted), dtype=torch.float64)
    assert (root @ root.T).diagonal().numpy() == pytest.approx(expected.numpy(), rel=0.03)
    # a chi-square of the groups lies within 4 sigma of 1
    error = (found.numpy() - values) / expected.sqrt().numpy()
    assert np.mean(error**2) == pytest.approx(1, abs=4 * (2 / groups) ** 0.5)


def test_without_offsets_the_ratio_is_that_of_chance():
    """Half a chi-square of one degree of freedom exceeds 10.8 once in a thousand times."""
    random = torch.Generator().manual_seed(2)
    information = 5.0 * torch.eye(100, dtype=torch.float64)
    for _ in range(20):
        gradient = 5**0.5 * torch.randn(100, generator=random, dtype=torch.float64)
        assert most_probable(information, gradient)[0] < 10.8


@pytest.mark.parametrize(
    ("fits", "change", "suspected", "settled", "explain"),
    [
        (1, 2.0, True, False, False),
        (3, 0.05, False, True, True),
        (3, 0.05, True, True, False),
        (6, 0.7, True, True, True),
        (6, 20.0, False, True, False),
    ],
)
def test_offsets_are_kept_if_they_explain_the_images(fits, change, suspected, settled, explain):
    """What is not offsets of lines remains after they are removed, or grows from fit to fit."""
    none = torch.zeros(1)
    found = LineOffsets((0,), none, none, [none], fits, change, suspected)
    assert (found.settled, found.explain) == (settled, explain)


@cache
def family(name, seed):
    air, images = BY_NAME[name].pair(seed)
    wind = retrieved(images, "variational")
    return wind, *errors(air, wind)


@pytest.mark.slow
def test_clean_images_have_none():
    assert "noise_of_lines" not in family("clean", 1)[0].attrs


@pytest.mark.slow
@pytest.mark.parametrize("name", ["columns", "rows"])
@pytest.mark.parametrize("seed", [1, 2])
def test_wind_is_that_of_images_without_them(name, seed):
    """Without the offsets' model errors were 0.3 m/s."""
    wind, error, stated, valid = family(name, seed)
    assert "noise_of_lines" in wind.attrs
    assert valid.mean() > 0.9
    score = (error / stated)[:, valid]
    assert (np.abs(score) > 4).any(0).mean() <= 0.01
    assert np.sqrt(np.mean(error[:, valid] ** 2)) < 0.25


@pytest.mark.slow
def test_bands_of_light_are_offsets_or_their_vectors_are_flagged():
    """Without the offsets' model errors were 1 m/s. They are found in one pair at least."""
    number = 0
    for seed in (1, 2):
        wind, error, stated, valid = family("flicker", seed)
        assert not valid.any() or (np.abs(error / stated)[:, valid] > 4).any(0).mean() <= 0.01
        if "noise_of_lines" in wind.attrs:
            number += 1
            assert np.sqrt(np.mean(error[:, valid] ** 2)) < 0.25
    assert number >= 1


@pytest.mark.slow
@pytest.mark.xfail(reason="a corner of one of two pairs has no skill: 83 % are valid, not 90 %")
def test_few_vectors_are_lost_under_bands_of_light_that_are_offsets():
    pairs = [family("flicker", seed) for seed in (1, 2)]
    fractions = [valid.mean() for wind, *_, valid in pairs if "noise_of_lines" in wind.attrs]
    assert fractions and min(fractions) > 0.9
