"""Stated errors of winds on the way of a wing, in turbulence that the estimator does not know.

Every case is judged by the fractions of errors within one and two standard errors, which fail both
if stated errors are too small and if they are too large.
"""

import numpy as np
import pytest

from lidar_mi.retrieval.along_path.smoother import Lattice, basis, observation, smoothed
from lidar_mi.retrieval.along_path.statistics import StatisticsEstimator
from tests.support.slab_winds import STRIDE, WINDOW, Slabs, calm, turbulent

SPEED, KEPT = 75.0, 18
ACROSS = np.linspace(-14.0, 14.0, 7)


def predictions(air, slabs, evolving, count=42):
    """Errors and standard errors at the wing's arrival, a row for each arrival and component."""
    statistics, kept, found = StatisticsEstimator(STRIDE), [], []
    for number, (x, time, vectors) in enumerate(slabs.along_path(count)):
        statistics.add(x, vectors)
        kept = [*kept, (x, time, vectors)][-KEPT:]
        if number < KEPT or number % 6:
            continue
        known = statistics.statistics
        swept = evolving * np.sqrt(np.mean([v.wind**2 for *_, v in kept]))
        lattice = Lattice(22.0, 12.0, WINDOW).through(vectors)
        x, y = np.meshgrid(kept[0][0] + np.array([3.75, 26.0]), ACROSS, indexing="ij")
        at = x.ravel(), y.ravel(), np.zeros(x.size), x.ravel() / SPEED
        truth = air(*at)
        for component in "vw":
            k = "vw".index(component)
            one = basis(component, known.length, known.resolution, known.shape, STRIDE, lattice)
            seen = [observation(one, known, v) for *_, v in kept]
            planes, times, vectors_of = zip(*kept, strict=True)
            winds = [v.wind[k] for v in vectors_of]
            mean, stderr = smoothed(one, known, planes, times, seen, winds, swept).at(*at)
            found.append((mean - truth[k + 1], stderr))
    return np.array(found)


def judged(flights):
    """Percentages within 1 and 1.96 standard errors with their sampling errors.

    Flights are independent, winds of one are not.
    """
    for limit, expected in ((1.0, 68.3), (1.96, 95.0)):
        inside = [100 * (np.abs(rows[:, 0]) < limit * rows[:, 1]).mean() for rows in flights]
        yield np.mean(inside), expected, np.std(inside, ddof=1) / np.sqrt(len(inside))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("sigma", "length", "noise", "resolution", "options"),
    [
        (1.5, 300.0, 0.3, 0.0, {}),
        pytest.param(1.5, 300.0, 0.1, 8.0, {}, marks=pytest.mark.slow),
        (1.0, 100.0, 0.3, 8.0, {"spectrum": "kolmogorov"}),
        pytest.param(0.5, 60.0, 0.2, 0.0, {}, marks=pytest.mark.slow),
        pytest.param(2.3, 500.0, 0.3, 6.0, {"evolution": "sweeping"}, marks=pytest.mark.slow),
        (1.5, 200.0, 0.3, 0.0, {"evolution": "sweeping"}),
    ],
)
def test_errors_are_as_stated(sigma, length, noise, resolution, options):
    """Within 5 points and 2 sampling errors; lengths and intensities are not those of the grid."""
    flights = []
    for seed in range(6):
        air = turbulent(sigma, length, 40 + seed, **options)
        slabs = Slabs(air, noise, resolution, seed=seed)
        flights.append(predictions(air, slabs, "evolution" in options))
    for found, expected, sampling in judged(flights):
        assert sampling < 5
        assert abs(found - expected) < 5 + 2 * sampling


def test_stated_errors_that_are_wrong_are_corrected():
    """By a factor of 2: the vectors themselves show their noise."""
    for stated in (0.5, 2.0):
        estimator = StatisticsEstimator(STRIDE)
        for x, _, vectors in Slabs(turbulent(0.5, 300.0, 5), 0.4, stated=stated).along_path(30):
            estimator.add(x, vectors)
        assert estimator.statistics.scale * stated == pytest.approx(1.0, rel=0.25)


@pytest.mark.parametrize("resolution", [4.4, 8.0, 11.2])
def test_resolution_shows_in_the_vectors(resolution):
    estimator = StatisticsEstimator(STRIDE)
    for x, _, vectors in Slabs(turbulent(1.5, 300.0, 9), 0.1, resolution).along_path(30):
        estimator.add(x, vectors)
    assert 0.7 < estimator.statistics.resolution / resolution < 1.45


def test_calm_air_is_calm():
    rows = predictions(calm, Slabs(calm, 0.3), False)
    off, stderr = np.moveaxis(rows, 1, 0)
    assert np.abs(off).max() < 0.1
    # the mean of all vectors of a slab has 0.03 m/s
    assert 0.0 < stderr.max() < 0.1
    assert (np.abs(off) < 2 * stderr).mean() > 0.9


def test_vectors_without_noise():
    """The wind between the windows' means is what is not known."""
    air = turbulent(1.5, 300.0, 77)
    rows = predictions(air, Slabs(air, 0.0), False)
    off, stderr = np.moveaxis(rows, 1, 0)
    assert 0.6 < np.sqrt(np.mean(off**2) / np.mean(stderr**2)) < 1.15
    assert np.sqrt(np.mean(off**2)) < 0.45
