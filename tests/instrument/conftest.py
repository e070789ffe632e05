"""What tests of counted photons hold them against."""

import numpy as np
import pytest
from scipy import stats


def _chi_square_p(counts, distribution):
    """Probability of so bad a fit, bins of at least 50 expected counts."""
    edges = np.unique(distribution.ppf(np.linspace(0, 1, 60)[1:-1]))
    bins = np.concatenate([[-0.5], edges + 0.5, [np.inf]])
    expected = len(counts) * np.diff(np.concatenate([[0], distribution.cdf(edges), [1]]))
    assert expected.min() > 50
    found = np.histogram(counts, bins)[0]
    return stats.chisquare(found, expected * found.sum() / expected.sum()).pvalue


@pytest.fixture
def chi_square_p():
    return _chi_square_p
