"""Variances of systems that follow a Markov chain.

Detects equations that forget the chain, its memory or its direction, a wrong limit without jumps,
and a finite variance of a system that has none.
"""

import numpy as np
import pytest
import scipy

from lidar_mi.encounter.control_block.jump_linear import jump_covariance, stationary_distribution
from lidar_mi.errors import InputError
from tests.support.markov_chain import chain

STEPS, RECORDS = 2000, 200
TRANSITION = np.array([[0.97, 0.03], [0.3, 0.7]])


def system(random, radius, modes=1):
    """Matrices (modes, ...) of four states, two inputs and two outputs."""
    a = random.standard_normal((modes, 4, 4))
    a *= radius / np.array([abs(np.linalg.eigvals(one)).max() for one in a])[:, None, None]
    shapes = ((4, 2), (2, 4), (2, 2))
    return a, *(random.standard_normal((modes, *shape)) for shape in shapes)


def test_without_jumps_it_is_the_integral_of_the_spectrum():
    """And the Lyapunov equation of one mode; of two equal modes as well."""
    random = np.random.default_rng(1)
    a, b, c, d = system(random, 0.9)
    noise = np.array([[2.0, 0.5], [0.5, 1.0]])
    found = jump_covariance(a, b, c, d, [[1.0]], noise)
    states = scipy.linalg.solve_discrete_lyapunov(a[0], b[0] @ noise @ b[0].T)
    expected = c[0] @ states @ c[0].T + d[0] @ noise @ d[0].T
    np.testing.assert_allclose(found, expected, rtol=1e-6)
    z = np.exp(2j * np.pi * np.arange(4096) / 4096)
    response = c[0] @ np.linalg.solve(z[:, None, None] * np.eye(4) - a[0], b[0]) + d[0]
    density = response @ noise @ np.conj(np.swapaxes(response, 1, 2))
    np.testing.assert_allclose(found, density.mean(axis=0).real, rtol=1e-6)
    twice = (np.concatenate([one, one]) for one in (a, b, c, d))
    np.testing.assert_allclose(jump_covariance(*twice, TRANSITION, noise), expected, rtol=1e-6)


@pytest.mark.parametrize("stay", [0.2, 0.7, 0.95])
def test_variances_are_those_of_a_simulation(stay):
    """Each within 4 standard errors of 200 records, with lost samples in runs of several lengths.

    The second mode is a system of its own, unstable by itself in one case.
    """
    random = np.random.default_rng(2)
    transition = np.array([[0.95, 0.05], [1 - stay, stay]])
    a, b, c, d = system(random, 0.85, modes=2)
    a[1] *= 1.1 / 0.85 if stay == 0.2 else 1.0
    predicted = jump_covariance(a, b, c, d, transition, np.eye(2))
    modes = chain(random, transition, STEPS, RECORDS)
    x, squares = np.zeros((RECORDS, 4)), np.zeros((RECORDS, 2, 2))
    for k, mode in enumerate(modes):
        w = random.standard_normal((RECORDS, 2))
        if k >= STEPS // 10:
            y = np.einsum("rij,rj->ri", c[mode], x) + np.einsum("rij,rj->ri", d[mode], w)
            squares += y[:, :, None] * y[:, None]
        x = np.einsum("rij,rj->ri", a[mode], x) + np.einsum("rij,rj->ri", b[mode], w)
    squares /= STEPS - STEPS // 10
    stderr = squares.std(axis=0, ddof=1) / np.sqrt(RECORDS)
    assert (abs(squares.mean(axis=0) - predicted) < 4 * stderr).all()
    assert (np.diag(stderr) < 0.1 * np.diag(predicted)).all()


def test_a_value_held_through_runs_has_the_closed_form():
    """y = w while received, then its last value: of white w the variance stays that of w.

    The difference from w has the variance 2 sigma^2 where lost: 2 pi sigma^2.
    """
    hold = np.array([[[0.0]], [[1.0]]])
    new = np.array([[[1.0]], [[0.0]]])
    common = dict(a=hold, b=new, transition=TRANSITION, noise=[[4.0]])
    assert jump_covariance(c=hold, d=new, **common) == pytest.approx(4.0)
    assert stationary_distribution(TRANSITION) == pytest.approx([1 / 1.1, 0.1 / 1.1])
    assert jump_covariance(c=hold, d=new - 1, **common) == pytest.approx(8 * 0.1 / 1.1)


def test_what_has_no_variance_is_refused():
    one = np.ones((2, 1, 1))
    for growth, stable in ((1.4, True), (2.0, False)):
        # alternating modes: x is multiplied by growth / 2, then by growth
        a = growth * np.array([[[0.5]], [[1.0]]])
        arguments = (a, one, one, one, [[0.0, 1.0], [1.0, 0.0]], [[1.0]])
        if stable:
            assert np.isfinite(jump_covariance(*arguments)).all()
        else:
            with pytest.raises(InputError, match="not stable in the mean square"):
                jump_covariance(*arguments)
    with pytest.raises(InputError, match=r"jump_linear\.transition: .* whose rows sum to 1"):
        jump_covariance(one, one, one, one, [[0.9, 0.2], [0.5, 0.5]], [[1.0]])
