"""Smooth terms of light and background, against r^n cos(m phi) in numpy.

Detects: a term of another order or direction, terms that depend on each other, a light that has the
fall-off twice.
"""

import numpy as np
import pytest
import torch

from lidar_mi.errors import InputError
from lidar_mi.retrieval.rings.smooth import MOST_DEGREE, term_names, term_values

RNG = np.random.default_rng(3)
PLACES = RNG.uniform(-0.7, 0.7, (2, 500))


def values(names):
    return term_values(names, *map(torch.from_numpy, PLACES)).numpy()


def test_terms_are_polar_polynomials():
    names = term_names("background", MOST_DEGREE)
    r, phi = np.hypot(*PLACES), np.arctan2(PLACES[1], PLACES[0])
    for name, column in zip(names, values(names).T, strict=True):
        n, m = map(int, name.split("_")[1:])
        angular = np.sin(-m * phi) if m < 0 else np.cos(m * phi)
        np.testing.assert_allclose(column, r**n * angular, atol=1e-12, err_msg=name)


@pytest.mark.parametrize("degree", [1, 4, MOST_DEGREE])
def test_they_are_all_polynomials_of_a_degree(degree):
    """With the constant, as many independent columns as x^i y^j with i + j <= degree."""
    table = np.column_stack([np.ones(500), values(term_names("background", degree))])
    assert table.shape[1] == (degree + 1) * (degree + 2) // 2
    assert np.linalg.matrix_rank(table, tol=1e-9) == table.shape[1]


def test_the_fall_off_of_light_is_no_term():
    assert set(term_names("background", 4)) >= {"background_2_0"}
    assert "light_2_0" not in term_names("light", 4) and "light_4_0" in term_names("light", 4)
    assert term_names("light", 0) == () and values(()).shape == (500, 0)


@pytest.mark.parametrize("degree", [-1, MOST_DEGREE + 1, 1.5])
def test_degrees_that_cannot_be(degree):
    with pytest.raises(InputError, match=f"light degree: {degree} is not allowed; expected 0 to 8"):
        term_names("light", degree)
