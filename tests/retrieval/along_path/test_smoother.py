"""The recursive filter and smoother against the Gaussian process of all slabs at once.

Detects an error of the filter, of the smoother, of predictions between and beyond slabs or of their
standard errors, a slab that is not missed, vectors that count although they are rejected.
"""

from dataclasses import replace

import numpy as np
import pytest

from lidar_mi.retrieval.along_path.smoother import Lattice, basis, observation, smoothed
from lidar_mi.retrieval.along_path.statistics import Statistics, error_correlation
from lidar_mi.retrieval.along_path.von_karman import covariance
from tests.support.slab_winds import STRIDE, Slabs, turbulent

STATISTICS = Statistics(1.4, 60.0, 4.0, 1.3)
LATTICE = Lattice(12.0, 8.0, 8.0)


def seen(count=6, missing=(), rejected=0):
    slabs = Slabs(turbulent(1.2, 80.0, 3), 0.3, nz=4, ny=5)
    found = [one for n, one in enumerate(slabs.along_path(count)) if n not in missing]
    random = np.random.default_rng(2)
    for number, (x, time, vectors) in enumerate(found):
        wind = vectors.wind.copy()
        bad = random.permutation(wind[0].size)[:rejected]
        wind.reshape(2, -1)[:, bad] = np.nan
        found[number] = x, time, replace(vectors, wind=wind, common=np.array([0.1, 0.2]))
    return found


def field(slabs, component="w", statistics=STATISTICS, swept=0.0):
    x, time, vectors = zip(*slabs, strict=True)
    lattice = LATTICE.through(vectors[0])
    one = basis(component, statistics.length, statistics.resolution, "gaussian", STRIDE, lattice)
    number = "vw".index(component)
    return smoothed(
        one,
        statistics,
        x,
        time,
        [observation(one, statistics, v) for v in vectors],
        [v.wind[number] for v in vectors],
        swept,
    )


def dense(slabs, component, x, y, z):
    """Mean and standard error at places by one solution for all vectors of all slabs."""
    found = field(slabs, component)
    one, s = found.basis, STATISTICS
    rows, errors, values, planes = [], [], [], []
    number = "vw".index(component)
    whole = float(covariance(component, 0, 0, 0, s.length, s.mean(2)))
    for plane, _, vectors in slabs:
        used = observation(one, s, vectors).used
        at_y, at_z = (a[used] for a in np.meshgrid(vectors.y, vectors.z))
        places = np.stack([at_y, at_z], -1)
        row = one.mean(places)
        stderr = s.scale * vectors.stderr[number][used]
        own = s.sigma**2 * (whole - row**2 @ one.variance)
        error = np.outer(stderr, stderr) * error_correlation(places, s.mean(2))
        error += vectors.common[number] ** 2
        errors.append(error + np.diag(own))
        rows.append(row)
        values.append(vectors.wind[number][used])
        planes.append(np.full(len(row), plane))
    rows, values, planes = np.concatenate(rows), np.concatenate(values), np.concatenate(planes)

    def prior(a, plane_a, b, plane_b):
        decay = np.exp(-np.abs(plane_a[:, None, None] - plane_b[:, None]) / one.reach)
        return s.sigma**2 * np.einsum("nm,km,nkm,m->nk", a, b, decay, one.variance)

    noise = np.zeros((len(rows), len(rows)))
    start = 0
    for error in errors:
        part = slice(start, start + len(error))
        noise[part, part] = error
        start += len(error)
    point = one.point(np.stack([y, z], -1), 0.0)
    across = prior(point, x, rows, planes)
    gain = np.linalg.solve(prior(rows, planes, rows, planes) + noise, across.T).T
    variance = s.sigma**2 - (gain * across).sum(1)
    return gain @ values, np.sqrt(variance)


@pytest.mark.parametrize("component", ["v", "w"])
@pytest.mark.parametrize(("missing", "rejected"), [((), 0), ((2, 3), 0), ((1,), 6)])
def test_recursion_is_the_solution_at_once(component, missing, rejected):
    slabs = seen(missing=missing, rejected=rejected)
    planes = np.array([s[0] for s in slabs])
    # on slabs, between them, before the first and beyond the last one
    x = np.array([planes[0] - 30, planes[0], planes[1] + 2.0, planes[2], planes[-1] + 11.0])
    y, z = np.array([0.0, 3.0, -7.0, 9.0, 1.0]), np.array([0.0, -2.0, 4.0, 1.0, 0.0])
    found = field(slabs, component)
    # the statistics are not those of the air: its innovations may show it
    found = replace(found, inflation=np.ones(len(slabs)))
    mean, stderr = found.at(x, y, z, np.zeros(5))
    expected, error = dense(slabs, component, x, y, z)
    np.testing.assert_allclose(mean, expected, atol=1e-6)
    np.testing.assert_allclose(stderr, error, rtol=1e-5)


def test_slabs_without_vectors_say_nothing():
    slabs = seen()
    blind = [(x, t, replace(v, wind=np.full_like(v.wind, np.nan))) for x, t, v in slabs]
    places = np.array([160.0]), np.zeros(1), np.zeros(1), np.zeros(1)
    mean, stderr = field(blind).at(*places)
    assert mean[0] == 0 and stderr[0] == pytest.approx(STATISTICS.sigma)
    # one that is rejected is no slab at all
    some = [slabs[0], blind[1], *slabs[2:]]
    left = [slabs[0], *slabs[2:]]
    for one, other in zip(field(some).at(*places), field(left).at(*places), strict=True):
        # the other field has one bridge in place of two
        assert one[0] == pytest.approx(other[0], rel=1e-6)


def test_eddies_that_are_swept_are_known_less():
    found = field(seen(), swept=2.0)
    places = [np.array([a]) for a in (157.5, 0.0, 0.0)]
    errors = [found.at(*places, np.array([t]))[1][0] for t in (0.1, 1.1, 3.1)]
    assert errors[0] < errors[1] < errors[2] < STATISTICS.sigma


def test_what_is_no_turbulence_has_larger_errors():
    """A vortex of 15 m/s in two slabs of turbulence of 1.4 m/s; in turbulence alone errors stay."""
    slabs = seen(12)
    assert field(slabs, statistics=replace(STATISTICS, length=80.0)).inflation.max() == 1.0
    for number in (6, 7):
        x, time, vectors = slabs[number]
        y = vectors.y - 4.0
        swirl = 15.0 * y / np.maximum(np.abs(y), 3.0) ** 2 * 3.0
        slabs[number] = x, time, replace(vectors, wind=vectors.wind + swirl)
    found = field(slabs)
    assert found.inflation[6:8].min() > 2 and found.inflation[[0, 1, 10, 11]].max() == 1.0
    places = [np.array([s[0] for s in slabs]), *np.zeros((3, 12))]
    errors = found.at(*places)[1]
    assert errors[6] > 1.4 * errors[1]
