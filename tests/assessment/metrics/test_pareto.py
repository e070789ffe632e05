"""The Pareto front. Unit tier: against every pair of points.

Detects a dominated point on the front, an undominated one that is missing, a wrong direction, a
point without a value that takes part.
"""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from lidar_mi.assessment.metrics.pareto import pareto_front
from lidar_mi.errors import InputError


def by_pairs(values):
    def beaten(i):
        return any(
            np.all(values[j] <= values[i]) and np.any(values[j] < values[i])
            for j in range(len(values))
        )

    return np.array([not np.isnan(values[i]).any() and not beaten(i) for i in range(len(values))])


@given(
    arrays.arrays(
        float,
        st.tuples(st.integers(0, 25), st.integers(1, 4)),
        elements=st.sampled_from([0.0, 1.0, 2.0, 3.5, np.nan]),
    )
)
def test_against_every_pair(values):
    np.testing.assert_array_equal(pareto_front(values), by_pairs(values))


def test_larger_is_better_where_it_is_said():
    # error against range: the third is worse in both than the second
    points = [[0.1, 100.0], [0.2, 300.0], [0.3, 200.0], [np.nan, 900.0]]
    assert pareto_front(points, [False, True]).tolist() == [True, True, False, False]


def test_a_direction_for_each_objective():
    with pytest.raises(InputError, match="maximised: 1 values are not allowed"):
        pareto_front([[0.0, 1.0]], [True])
