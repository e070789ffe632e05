"""Sobol' indices from a sample. Physics tier: functions whose indices are known in closed form.

Detects indices off by more than their interval, noise that counts as an effect of a knob, knobs of
a logarithmic scale taken as linear, and intervals that hold the truth too rarely.
"""

import numpy as np
import pytest
from scipy import stats

from lidar_mi.assessment.metrics.sensitivity import sobol_indices, unit_cube
from lidar_mi.errors import InputError

G_3, G_5, G_6 = (0.0, 1.0, 4.5), (0.0, 1.0, 4.5, 9.0, 99.0), (1.0, 2.0, 4.0, 8.0, 16.0, 32.0)
G_8 = (0.0, 1.0, 4.5, 9.0, 99.0, 99.0, 99.0, 99.0)


def ishigami(cube):
    """Ishigami & Homma (1990), a = 7, b = 0.1, and its indices."""
    x, a, b = (2 * np.pi * cube - np.pi).T, 7.0, 0.1
    parts = (1 + b * np.pi**4 / 5) ** 2 / 2, a**2 / 8, b**2 * np.pi**8 * (1 / 18 - 1 / 50)
    first, total = np.array([parts[0], parts[1], 0]), np.array([parts[0] + parts[2], *parts[1:]])
    return np.sin(x[0]) + a * np.sin(x[1]) ** 2 + b * x[2] ** 4 * np.sin(x[0]), first, total


def sobol_g(a):
    """Sobol' (1993)."""

    def function(cube):
        each = 1 / (3 * (1 + np.array(a)) ** 2)
        total = each * np.prod(1 + each) / (1 + each)
        return np.prod((np.abs(4 * cube - 2) + a) / (1 + np.array(a)), axis=1), each, total

    return function


def sample(function, knobs, seed, noise=0.0, points=256, design=stats.qmc.Sobol):
    """A sample, its values with noise of a fraction of their spread, and the true indices."""
    cube = design(knobs, seed=seed).random(points)
    values, first, total = function(cube)
    # either part of the decomposition sums to the variance in its own way: known in closed form
    variance = (
        first.sum() + (total - first).sum() / 2 if function is ishigami else np.prod(1 + first) - 1
    )
    rng = np.random.default_rng(seed + 1)
    values = values + noise * np.sqrt(variance) * rng.standard_normal(points)
    names = {f"knob_{k}": cube[:, k] for k in range(knobs)}
    return names, values, np.stack([first, total]) / variance


def inside(found, true):
    intervals = np.stack([found.first_interval, found.total_interval])
    return (intervals[..., 0] <= true) & (true <= intervals[..., 1])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("function", "knobs"),
    [(ishigami, 3), pytest.param(sobol_g(G_5), 5, marks=pytest.mark.slow)],
    ids=["ishigami", "g5"],
)
def test_known_indices_lie_in_their_intervals(function, knobs):
    names, values, true = sample(function, knobs, seed=7001)
    found = sobol_indices(names, values)
    assert found.determined and found.explained > 0.9 and found.points == 256
    assert inside(found, true).all()
    widths = np.ptp(np.stack([found.first_interval, found.total_interval]), axis=-1)
    assert widths.max() < 0.25
    assert np.abs(np.stack([found.first, found.total]) - true).max() < 0.05


@pytest.mark.slow
@pytest.mark.parametrize(
    ("function", "knobs"),
    [(ishigami, 3), (sobol_g(G_3), 3), (sobol_g(G_5), 5), (sobol_g(G_6), 6), (sobol_g(G_8), 8)],
    ids=["ishigami", "g3", "g5", "g6", "g8"],
)
@pytest.mark.parametrize("noise", [0.0, 0.3])
def test_intervals_hold_as_often_as_they_say(function, knobs, noise):
    hits = []
    for seed in range(7100, 7105):
        design = stats.qmc.LatinHypercube if seed % 2 else stats.qmc.Sobol
        names, values, true = sample(function, knobs, seed, noise, design=design)
        found = sobol_indices(names, values, seed=seed)
        assert found.determined
        hits.append(inside(found, true))
    # one of the correlated indices of a sample may be out in 5 %
    assert np.mean(hits) >= 0.95 - 2 * np.sqrt(0.05 * 0.95 / len(hits) / 2)


@pytest.mark.parametrize("seed", [21, *(pytest.param(k, marks=pytest.mark.slow) for k in (22, 23))])
def test_pure_noise_is_undetermined(seed):
    names, _, _ = sample(ishigami, 3, seed)
    noise = np.random.default_rng(seed).standard_normal(256)
    found = sobol_indices(names, noise)
    assert not found.determined and found.explained < 0.2
    assert "of the variance of a point" in found.reason and np.isnan(found.first).all()


def test_members_tell_luck_from_the_knobs():
    names, values, _ = sample(sobol_g(G_3), 3, seed=31, points=128)
    rng = np.random.default_rng(32)
    members = values[:, None] + values.std() * rng.standard_normal((128, 8))
    members[5] = np.nan
    members[6, 1:] = np.nan
    found = sobol_indices(names, members)
    # equal variances; each of 127 points estimates one with 7 degrees of freedom
    assert found.between_members == pytest.approx(0.5, abs=4 * 0.5 * np.sqrt(2 / 7 / 127 + 2 / 127))
    assert found.points == 127


def test_a_logarithmic_knob_is_uniform_in_its_logarithm():
    """The sum of a knob and the logarithm of another: half the variance each, nothing together."""
    first, second = stats.qmc.Sobol(2, seed=41).random(64).T
    names = {"a": first, "b": 1e-4 * 1000**second}
    found = sobol_indices(names, names["a"] + np.log10(names["b"]) / 3, ["b"])
    assert inside(found, 0.5).all() and found.explained > 0.99
    assert np.ptp(found.total_interval, axis=1).max() < 0.2
    cube = unit_cube(names, ["b"])
    assert cube.min() == 0 and cube.max() == 1
    assert np.corrcoef(cube[:, 1], second)[0, 1] == pytest.approx(1)


@pytest.mark.parametrize(
    ("values", "reason"),
    [(np.full(40, 0.3), "does not vary"), (np.where(np.arange(40) < 10, 1.0, np.nan), "10 points")],
)
def test_what_has_no_indices(values, reason):
    knobs = dict(zip("ab", np.random.default_rng(1).uniform(size=(2, 40)), strict=True))
    found = sobol_indices(knobs, values)
    assert not found.determined and reason in found.reason and np.isnan(found.total).all()


@pytest.mark.parametrize(
    ("knobs", "logarithmic", "message"),
    [
        ({"a": [0.0, 1.0]}, ["a"], "a: 0.0 is not allowed"),
        ({"a": [1.0, 1.0]}, [], "a: not allowed"),
        ({"a": [1.0, 2.0], "b": [1.0, 2.0, 3.0]}, [], "same number of points"),
        ({"a": [1.0, 2.0, 3.0]}, [], "values: 2 are not allowed"),
    ],
)
def test_bad_samples_are_refused(knobs, logarithmic, message):
    with pytest.raises(InputError, match=message):
        sobol_indices(knobs, [1.0, 2.0], logarithmic)
