"""Factors of variances against a general minimiser, and their scatter against Fisher's information.

Detects factors that are not the likeliest ones by 1 %, limits that are passed, and steps that go
round in circles between variances of nearly nothing.
"""

import numpy as np
import pytest
from scipy.optimize import minimize

from lidar_mi.retrieval.likelihood.reml import most_likely

UNLIMITED = np.array([np.inf, np.inf])


def drawn(seed, factors, half=4.0, places=400):
    """Mean squares of 2 `half` normal numbers, whose variance is a white and a steep term."""
    random = np.random.default_rng(seed)
    terms = np.stack([np.ones(places), np.linspace(0.01, 3, places) ** 4])
    variance = factors @ terms
    return variance * random.chisquare(2 * half, places) / (2 * half), terms


@pytest.mark.parametrize("factors", [(1.0, 0.3), (0.02, 1.0), (1.0, 0.0)])
def test_factors_are_the_likeliest(factors):
    """scipy's L-BFGS-B of the gamma distribution's likelihood finds the same."""
    squares, terms = drawn(1, np.array(factors))

    def misfit(logs):
        ratio = squares / (np.exp(logs) @ terms)
        return (4.0 * (ratio - 1 - np.log(ratio))).sum()

    other = minimize(misfit, [-1.0, -1.0], method="L-BFGS-B", bounds=[(-20, 5)] * 2)
    found, mine = most_likely(squares, terms, UNLIMITED, 4.0)
    assert found < other.fun + 0.01
    assert mine == pytest.approx(np.exp(other.x), rel=0.01, abs=0.002)


def test_factors_scatter_as_fishers_information_says():
    """sum of n / 2 x x^T / s^2; the mean of 200 within 4 sigma, their spread within 20 %."""
    true = np.array([1.0, 0.3])
    _, terms = drawn(0, true)
    found = np.array([most_likely(*drawn(seed, true), UNLIMITED, 4.0)[1] for seed in range(200)])
    information = 4.0 * (terms / (true @ terms) ** 2) @ terms.T
    stderr = np.sqrt(np.diag(np.linalg.inv(information)))
    assert (np.abs(found.mean(0) - true) < 4 * stderr / 200**0.5).all()
    assert found.std(0) == pytest.approx(stderr, rel=0.2)


def test_limits_and_what_is_held():
    squares, terms = drawn(2, np.array([1.0, 0.3]))
    _, limited = most_likely(squares, terms, np.array([0.5, np.inf]), 4.0)
    assert limited[0] == pytest.approx(0.5) and limited[1] > 0.3
    _, rest = most_likely(squares, terms[1:], UNLIMITED[1:], 4.0, fixed=terms[0])
    assert rest == pytest.approx([0.3], rel=0.05)


def test_steps_do_not_go_round_in_circles():
    """Squares of a steep term alone: whole steps came to no variance at all, and back."""
    squares, terms = drawn(3, np.array([0.0, 1.0]))
    misfit, factors = most_likely(squares, terms, np.array([np.inf, 20.0]), 4.0)
    assert factors == pytest.approx([0.0, 1.0], abs=0.06)
    # half of chi-square with as many degrees of freedom as squares, each a little above 1
    assert misfit < 0.6 * len(squares)
