"""Fisher scoring of many fits: where it ends, how certain that is, what it refuses.

Detects steps that end beside the maximum of the likelihood (scipy's minimiser of the Poisson
likelihood), a prior without effect, deviations other than the closed form's, fits that are said to
have converged when they have not.
"""

import numpy as np
import pytest
import torch
from scipy.optimize import minimize

from lidar_mi.errors import InputError
from lidar_mi.retrieval.likelihood.scoring import (
    Fits,
    Limits,
    fisher_matrix,
    inverse_of,
    scoring,
    standard_deviations,
)

FITS = Fits("counts", 5, ("a level", "steps that end"))
X = torch.linspace(-1.0, 1.0, 40, dtype=torch.float64)
PRIOR = 2.0**-2
"""Inverse variance of the slope about 0."""


def limits(longest=(1.0, 1.0), steps=40):
    return Limits(torch.tensor(longest, dtype=torch.float64), 1e-8, steps)


def counts(number=6):
    random = np.random.default_rng(1)
    x = X.numpy()
    rates = np.exp(random.uniform(1, 3, (number, 1)) + random.uniform(-1, 1, (number, 1)) * x)
    return torch.as_tensor(random.poisson(rates).astype(float))


def of_poisson(data):
    """Counts of mean exp(a + b x), a normal prior of b."""

    def expanded(parameters):
        mean = torch.exp(parameters[:, :1] + parameters[:, 1:] * X)
        jacobian = torch.stack([mean, mean * X], 1)
        prior = torch.diag(torch.tensor([0.0, PRIOR], dtype=torch.float64))
        score = (jacobian @ ((data - mean) / mean)[:, :, None])[:, :, 0]
        return fisher_matrix(jacobian, 1 / mean) + prior, score - parameters @ prior, mean

    return expanded


def advanced(parameters, step):
    return parameters + step, None


def test_it_ends_at_the_maximum_of_likelihood_and_prior():
    data = counts()
    start = torch.ones(len(data), 2, dtype=torch.float64)
    end, fisher, mean = scoring(of_poisson(data), advanced, start, limits(), FITS)
    torch.testing.assert_close(mean, torch.exp(end[:, :1] + end[:, 1:] * X))
    for one, found, matrix in zip(data.numpy(), end.numpy(), fisher.numpy(), strict=True):

        def cost(p, one=one):
            return np.sum(np.exp(p[0] + p[1] * X.numpy()) - one * (p[0] + p[1] * X.numpy())) + (
                PRIOR * p[1] ** 2 / 2
            )

        best = minimize(cost, [1.0, 0.0], options={"gtol": 1e-7})
        np.testing.assert_allclose(found, best.x, atol=1e-5)
        stated = standard_deviations(torch.as_tensor(matrix)[None])[0].numpy()
        np.testing.assert_allclose(stated, np.sqrt(np.diag(np.linalg.inv(matrix))), rtol=1e-10)


def test_deviations_of_units_far_apart_and_of_what_is_not_determined():
    """Of diag(s) C diag(s) they are those of C over s, whatever the powers of ten; else NaN."""
    unit = torch.tensor([[1.0, 0.5], [0.5, 1.0]], dtype=torch.float64)
    scale = torch.tensor([1e-9, 1e7], dtype=torch.float64)
    found = standard_deviations((scale[:, None] * unit * scale)[None])[0]
    torch.testing.assert_close(found * scale, torch.full_like(scale, (4 / 3) ** 0.5))
    inverse = inverse_of(scale[:, None] * unit * scale)
    torch.testing.assert_close(scale[:, None] * inverse * scale, torch.linalg.inv(unit))
    twins = torch.ones(1, 2, 2, dtype=torch.float64)
    assert standard_deviations(twins).isnan().all()


def test_fits_that_end_at_a_bound_have_ended():
    data = counts(2)

    def bounded(parameters, step):
        low = (parameters + step).clamp(max=0.1)
        return low, low[:, 0] == 0.1

    end, _, _ = scoring(of_poisson(data), bounded, torch.zeros_like(data[:, :2]), limits(), FITS)
    assert (end[:, 0] == 0.1).all()


@pytest.mark.parametrize(
    ("steps", "start", "message"),
    [
        (2, 1.0, r"counts\[5\]: the fit does not converge; expected steps that end"),
        (40, np.nan, r"counts\[6\]: the fit fails; expected a level"),
    ],
)
def test_what_does_not_converge_is_refused_by_its_number(steps, start, message):
    data, parameters = counts(3), torch.ones(3, 2, dtype=torch.float64)
    parameters[1] = start
    with pytest.raises(InputError, match=message):
        scoring(of_poisson(data), advanced, parameters, limits(steps=steps), FITS)
