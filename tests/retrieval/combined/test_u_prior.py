"""Evidence of statistics of u."""

import numpy as np
from scipy import stats

from lidar_mi.retrieval.combined.u_prior import evidence_of


def test_evidence_is_the_density_of_the_lines_velocities():
    rng = np.random.default_rng(3)
    fixed, *shapes = (root @ root.T for root in rng.standard_normal((4, 12, 12)))
    shapes[2] = np.zeros((12, 12))  # lines that see nothing of u
    residual, stds = rng.standard_normal(12), np.array([0.05, 1.0, 10.0])
    evidence, square = evidence_of(fixed, residual, np.array(shapes), stds)
    for k, shape in enumerate(shapes):
        for number, std in enumerate(stds):
            covariance = fixed + std**2 * shape
            density = stats.multivariate_normal(cov=covariance).logpdf(residual)
            without = stats.multivariate_normal(cov=fixed).logpdf(np.zeros(12))
            np.testing.assert_allclose(evidence[k, number], density - without, rtol=1e-9)
            np.testing.assert_allclose(
                square[k, number], residual @ np.linalg.solve(covariance, residual), rtol=1e-9
            )
