"""Structure that moves otherwise than the air in the plane.

Detects a displacement of smoke that the flow absorbs and nobody states, one that is seen in air
that is carried exactly or in noise, and standard errors that do not hold in such smoke.
"""

import numpy as np
import pytest
import torch

from lidar_mi.retrieval.flow import direct
from lidar_mi.retrieval.flow.coherent_change import mean_square_displacement, residual_operator
from lidar_mi.retrieval.flow.flow_spline import Axis, Mesh
from lidar_mi.retrieval.flow.likelihood import linearised, prepared
from lidar_mi.retrieval.flow.prior import first_prior
from lidar_mi.retrieval.flow.settings import VariationalSettings
from tests.support.smoke import SHAPE, Y, Z, pair, smoke
from validation.coverage import measured


def estimated(images, noise=None):
    """Rms displacement of structure, px, about the flow after one step from rest."""
    settings = VariationalSettings()
    axes = [Axis(n, 5.0) for n in SHAPE]
    mesh = Mesh(axes, [torch.arange(n, dtype=torch.float64) for n in SHAPE])
    prior = first_prior(
        axes, mesh.fitted(torch.full((2, *SHAPE), 0.0).double()), 4.0, (1, 1), settings
    )
    of_images = prepared(images, noise, 0.0, settings)
    coefficients = torch.zeros(2, *(axis.knots for axis in axes), dtype=torch.float64)
    for _ in range(2):
        linear = linearised(of_images, mesh, coefficients, settings)
        posterior = direct.solved(linear, mesh, coefficients, prior, settings, 0)
        coefficients = posterior.coefficients
    linear = linearised(of_images, mesh, coefficients, settings)
    left = residual_operator(linear, mesh, posterior.response)
    return np.sqrt(mean_square_displacement(of_images, linear, left))


def test_the_displacement_of_smoke_is_found():
    """Of six random ones of 0.15 px, of which a rim shows the component across it.

    They vary over more than twice the distance that the estimate assumes, and the flow follows them
    better: the mean may be too small by 30 %.
    """
    rms = 0.15
    found = np.array([estimated(pair(seed, rms)) for seed in range(11, 17)])
    across = rms / np.sqrt(2)
    scatter = 3 * found.std(ddof=1) / np.sqrt(len(found))
    assert 0.7 * across - scatter < found.mean() < across + scatter
    assert (found > 0.4 * across).all() and (found < 1.6 * across).all()


@pytest.mark.parametrize(("noise", "told"), [(0.0, None), (0.05, None), (0.05, 0.05)])
def test_air_that_is_carried_has_none(noise, told):
    found = [estimated(pair(seed, 0.0, noise=noise), told) for seed in range(21, 25)]
    assert found == [0.0] * 4


def test_noise_that_varies_as_the_slopes_do_hides_no_displacement():
    """As that of Monte Carlo samples on bright rims: it was taken for noise larger than given."""
    steep = np.hypot(*np.gradient(smoke(Z, Y)))
    noise = 0.01 + 0.15 * steep / steep.max()
    rms = 0.15
    found, none = (
        np.array([estimated(pair(s, moved, noise=noise), torch.as_tensor(noise)) for s in seeds])
        for moved, seeds in ((rms, range(31, 37)), (0.0, range(31, 34)))
    )
    across = rms / np.sqrt(2)
    scatter = 3 * found.std(ddof=1) / np.sqrt(len(found))
    assert 0.7 * across - scatter < found.mean() < across + scatter
    assert (none == 0.0).all()


@pytest.mark.parametrize(
    "case",
    [
        "advected, texture 10 %",
        "true second state, texture 5 %",
        pytest.param("advected, texture 5 %", marks=pytest.mark.slow),
        pytest.param("true second state, texture 10 %", marks=pytest.mark.slow),
    ],
)
def test_standard_errors_hold_in_smoke_whose_noise_is_not_given(case):
    """Seed 51, none of those that numbers were chosen on.

    They were 1.3 times too large in the first case, as fine texture looks like noise (variance
    0.56 +- 0.07), and 1.4 times too small in the second (1.9 +- 0.3, 87 % within 1.96).
    """
    found = measured(case, "variational", (51,))
    variance, error = found.variance
    assert 0.8 < variance + 2 * error and variance - 2 * error < 1.25
    assert found.coverage_95[0] > 0.89
    assert found.valid > 0.98
