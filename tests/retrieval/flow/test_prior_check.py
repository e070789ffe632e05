"""The check of a flow's prior on flows drawn from another one, whose bias is known.

Detects a ratio that is not that of the biases, variances attributed to noise that are of the prior,
and standard errors that remain wrong by the factor by which the prior is.
"""

from functools import partial

import numpy as np
import pytest
import torch

from lidar_mi.retrieval.flow import direct, iterative, strips
from lidar_mi.retrieval.flow.flow_spline import Axis, Mesh, halves
from lidar_mi.retrieval.flow.likelihood import Linear
from lidar_mi.retrieval.flow.prior import KINDS, Prior
from lidar_mi.retrieval.flow.prior_check import prior_check
from lidar_mi.retrieval.flow.settings import IterativeSettings, StripSettings, VariationalSettings

SETTINGS = VariationalSettings(
    ridge=1e-3,
    strips=StripSettings(solved_core=5, solved_overlap=3, core=5, overlap=3),
    # one step from rest: that of a retrieval starts near its end
    solver=IterativeSettings(tolerance=1e-4),
)
CASES = {
    "direct": (direct.solved, (44, 52), 4.0),
    "strips": (strips.solved, (44, 52), 4.0),
    "iterative": (iterative.solved, (16, 20, 22), 5.0),
}
SOLVERS = ["direct", "strips", pytest.param("iterative", marks=pytest.mark.slow)]
DRAWS = {"direct": 0.0, "strips": 0.0, "iterative": 0.1}
"""Accuracy of the posterior covariance."""


class Model:
    """Slopes, a prior and dense matrices of both: the posterior covariance by brute force."""

    def __init__(self, solver):
        self.solve, shape, knots = CASES[solver]
        random = torch.Generator().manual_seed(2)
        normal = partial(torch.randn, generator=random, dtype=torch.float64)
        axes = [Axis(n, knots) for n in shape]
        self.mesh = Mesh(axes, [torch.arange(n, dtype=torch.float64) for n in shape])
        self.slope, self.weight = normal(len(shape), *shape), 0.2 * normal(*shape).square() + 0.01
        nodes = halves(axes, self.weight)
        self.prior = Prior(
            torch.ones(len(KINDS[len(shape)]), *nodes.shape).double(),
            nodes,
            5.0,
            (1.0,) * len(shape),
        )
        self.shape = len(shape), *(axis.knots for axis in axes)
        size = int(np.prod(self.shape))
        units = torch.eye(size, dtype=torch.float64).reshape(size, *self.shape)
        self.along = (self.mesh.field(units) * self.slope).sum(1).flatten(1).T
        rates = self.prior.rates(units).flatten(1)
        self.stiff = (rates * self.prior.weights.flatten()) @ rates.T
        self.stiff += SETTINGS.ridge * torch.eye(size, dtype=torch.float64)
        self.data = self.along.T @ (self.weight.flatten()[:, None] * self.along)

    def fit(self, truth, noise):
        """The posterior of a flow (size,) in noise of unit variance, and its likelihood."""
        weight = self.weight.flatten()
        residual = self.along @ truth + noise / weight.sqrt()
        gradient = self.slope * (weight * residual).reshape(self.weight.shape)
        linear = Linear(
            self.slope, gradient, self.weight, 1.0, self.slope, self.slope,
            self.weight > 0, torch.ones_like(self.weight),
        )  # fmt: skip
        zero = torch.zeros(self.shape, dtype=torch.float64)
        return self.solve(linear, self.mesh, zero, self.prior, SETTINGS, 0), linear


@pytest.mark.slow
@pytest.mark.parametrize("wrong", [0.25, 1.0, 4.0])
@pytest.mark.parametrize("solver", SOLVERS)
def test_ratio_is_that_of_the_true_bias_to_the_expected_one(solver, wrong):
    model = Model(solver)
    root = torch.linalg.inv(torch.linalg.cholesky(model.stiff)).T
    random = torch.Generator().manual_seed(5)
    ratios, squares = [], []
    for _ in range(12):
        truth, noise = (
            torch.randn(n, generator=random, dtype=torch.float64)
            for n in (len(root), model.weight.numel())
        )
        # of a variance that is `wrong` times that of the prior
        truth = wrong**0.5 * (root @ truth)
        posterior, linear = model.fit(truth, noise)
        check = prior_check(posterior, linear, model.mesh)
        ratios.append(check.ratio)
        # at the rim a flow is known much worse than within
        nodes = model.prior.mesh
        error = nodes.field(posterior.coefficients - truth.reshape(model.shape))
        covariance = check.factor(nodes.places) * posterior.covariance(nodes.places)[0]
        stated = covariance.diagonal().movedim(-1, 0)
        # covariances of draws are means over the prior's width
        squares.append(float(error.square().mean() / stated.mean()))
    for values, expected, method in ((ratios, wrong, 0.05), (squares, 1.0, 0.05 + DRAWS[solver])):
        scatter = np.std(values, ddof=1) / len(values) ** 0.5
        # the draws of the check know mean squares to some percent
        assert abs(np.mean(values) - expected) < 4 * scatter + method * expected


@pytest.mark.parametrize("solver", SOLVERS)
def test_fraction_is_that_of_the_posterior_covariance(solver):
    model = Model(solver)
    noise = torch.zeros(model.weight.numel(), dtype=torch.float64)
    posterior, linear = model.fit(torch.ones(len(model.stiff)).double(), noise)
    found = prior_check(posterior, linear, model.mesh).fraction
    inverse = torch.linalg.inv(model.data + model.stiff)
    parts = []
    for covariance in (inverse @ model.stiff @ inverse, inverse):
        root = torch.linalg.cholesky(covariance).T.reshape(-1, *model.shape)
        parts.append(model.prior.smooth(model.prior.mesh.field(root).square().sum((0, 1))))
    # of four draws each part is known to some ten percent about a place
    torch.testing.assert_close(
        found.mean(), (parts[0] / parts[1]).mean(), rtol=0.05 + DRAWS[solver], atol=0
    )
    torch.testing.assert_close(found, parts[0] / parts[1], rtol=0.4, atol=0.05)
