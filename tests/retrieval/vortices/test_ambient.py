"""The ambient wind of a fit against generalised least squares with dense matrices. Detects a
covariance, a gradient or a turbulence that is not the one stated, and a second pair that passes."""

import numpy as np
import pytest
import torch
import xarray as xr

from lidar_mi.atmosphere.air.turbulence import turbulence
from lidar_mi.atmosphere.vortices.vortex import velocity, vortex_pair
from lidar_mi.retrieval.along_path.von_karman import covariance as von_karman
from lidar_mi.retrieval.vortices import ambient
from lidar_mi.retrieval.vortices.robust_fit import Misfit, Solution
from lidar_mi.retrieval.vortices.vector_fit import fit_vortices_to_wind

RMS, LENGTH = 0.7, 60.0
PAIR = np.array([350.0, np.log(3.0), 13.5, 1.5, -350.0, np.log(3.0), -12.0, -2.0, 1.0, 0.0])


def solution(random, y, z, noise):
    """Ten smooth columns and residuals of vectors (2, z, y) that any linear fit could have."""
    vertical, lateral = np.meshgrid(z, y, indexing="ij")
    phases = random.uniform(0, 2 * np.pi, (10, 2, 2, 1, 1))
    columns = np.sin(phases[:, :, 0] + lateral / 9) * np.cos(phases[:, :, 1] + vertical / 7)
    columns[8:] = np.eye(2)[:, :, None, None]
    residual = noise * random.standard_normal((2, *vertical.shape))
    weight = torch.full(residual.shape, noise**-2, dtype=torch.float64)
    jacobian, residual = torch.as_tensor(-columns), torch.as_tensor(residual)
    slope = -torch.eye(2, dtype=torch.float64)[:, :, None, None].expand(2, 2, *vertical.shape)
    one = torch.ones_like(residual)
    misfit = Misfit(residual, jacobian, slope, one > 0, noise**2 * one, noise**2 * one)
    flat = jacobian.flatten(1)
    normal = (flat * weight.flatten()) @ flat.T
    return Solution(torch.as_tensor(PAIR), misfit, weight, normal, 1.0, True)


def gradient_and_eddies(y, z):
    """Covariances of all vectors by the gradient and by turbulence of 1 m/s."""
    vertical, lateral = (a.ravel() for a in np.meshgrid(z, y, indexing="ij"))
    dy, dz = lateral[:, None] - lateral, vertical[:, None] - vertical
    square = np.where(dy**2 + dz**2 > 0, dy**2 + dz**2, 1.0)
    vv, ww = (von_karman(name, 0, dy, dz, LENGTH) for name in "vw")
    # isotropy: vw = (f - g) dy dz / r^2, of which ww - vv has (dz^2 - dy^2) / r^2
    across = von_karman("w", 0, np.sqrt(square), 0, LENGTH)
    along = von_karman("v", 0, np.sqrt(square), 0, LENGTH)
    vw = (along - across) * dy * dz / square
    middle = PAIR[[2, 3]] / 2 + PAIR[[6, 7]] / 2
    away = np.stack([lateral - middle[0], vertical - middle[1]])
    linear = np.zeros((4, 2, away.shape[1]))
    linear[:2, 0], linear[2:, 1] = away, away
    linear = linear.reshape(4, -1)
    return ambient.GRADIENT**2 * linear.T @ linear, np.block([[vv, vw], [vw, ww]])


def dense(y, z, found, noise):
    """Parameters' step and covariance by the covariance of all vectors, of known turbulence."""
    gradient, eddies = gradient_and_eddies(y, z)
    total = noise**2 * np.eye(len(eddies)) + RMS**2 * eddies + gradient
    columns = -found.misfit.jacobian.flatten(1).numpy()
    inverse = np.linalg.inv(total)
    covariance = np.linalg.inv(columns @ inverse @ columns.T)
    return covariance @ columns @ inverse @ found.misfit.residual.flatten().numpy(), covariance


def exact(monkeypatch, spreads):
    """One vector a block, and one length."""
    monkeypatch.setattr(ambient, "_SPREADS", np.array(spreads))
    monkeypatch.setattr(ambient, "LENGTHS", (LENGTH,))
    monkeypatch.setattr(ambient, "_APART", (0.0, 0.0, 0.0))
    monkeypatch.setattr(ambient, "_scale", lambda found: 1.0)
    ambient._covariances.cache_clear()


@pytest.mark.parametrize("noise", [0.02, 0.3])
def test_restricted_likelihood(monkeypatch, noise):
    """Posterior mean of the strength by determinants of the covariance of all vectors.

    Turbulence of the likelihood's kind and a wake's departure from a pair, of another one: with few
    patterns in place of all, winds that these do not have make the strength too large.
    """
    spreads = np.geomspace(0.05, 5, 40)
    exact(monkeypatch, spreads)
    y, z = np.arange(-30.0, 31, 5), np.arange(-20.0, 21, 5)
    found = solution(np.random.default_rng(5), y, z, noise)
    gradient, eddies = gradient_and_eddies(y, z)
    random = np.random.default_rng(6)
    winds = np.linalg.cholesky(eddies + 1e-9 * np.eye(len(eddies))) @ random.normal(
        size=len(eddies)
    )
    off = found.misfit.residual.flatten().numpy() + 0.1 * winds
    off += 0.2 * random.standard_normal(len(off))
    shaped = torch.as_tensor(off).view(found.misfit.residual.shape)
    found = found._replace(misfit=found.misfit._replace(residual=shaped))
    lateral, vertical = (torch.as_tensor(a) for a in np.meshgrid(y, z))
    got = ambient.in_ambient_wind(found, lateral, vertical, 1.0)
    columns, likelihoods = found.misfit.jacobian.flatten(1).numpy(), []
    for spread in spreads:
        total = noise**2 * np.eye(len(off)) + gradient + spread**2 * eddies
        inverse = np.linalg.inv(total)
        normal = columns @ inverse @ columns.T
        remains = off - columns.T @ np.linalg.solve(normal, columns @ inverse @ off)
        logs = sum(np.linalg.slogdet(part)[1] for part in (total, normal))
        likelihoods.append(-(remains @ inverse @ remains + logs) / 2)
    probability = spreads * np.exp(np.array(likelihoods) - max(likelihoods))
    expected = (probability * spreads**2).sum() / probability.sum()
    assert got.rms == pytest.approx(expected**0.5, rel=5e-3)
    ambient._covariances.cache_clear()


def test_generalised_least_squares(monkeypatch):
    """A grid of one vector a block and known turbulence; von Karman's covariance by other code.

    The mean wind differs: it is that of the air at the pair.
    """
    exact(monkeypatch, [RMS])
    y, z, noise = np.arange(-30.0, 31, 5), np.arange(-20.0, 21, 5), 0.3
    found = solution(np.random.default_rng(3), y, z, noise)
    lateral, vertical = (torch.as_tensor(a) for a in np.meshgrid(y, z))
    got = ambient.in_ambient_wind(found, lateral, vertical, 1.0)
    step, covariance = dense(y, z, found, noise)
    changed = (got.solution.parameters[:10] - found.parameters).numpy()
    stderr = np.sqrt(np.diag(covariance))
    np.testing.assert_allclose(changed[:8], step[:8], atol=2e-3 * stderr[:8].max())
    inverse = torch.linalg.inv(got.solution.fisher)
    np.testing.assert_allclose(inverse[:8, :8], covariance[:8, :8], rtol=5e-3, atol=1e-5)
    # noise and turbulence together are all of it
    flat = got.solution.misfit.jacobian.flatten(1)
    noise_alone = inverse @ ((flat * got.solution.weight.flatten()) @ flat.T) @ inverse
    both = noise_alone[:10, :10] + ambient.ambient_errors(got).covariance
    np.testing.assert_allclose(both, inverse[:10, :10], rtol=1e-3, atol=1e-5)
    ambient._covariances.cache_clear()


def vectors(seed, gradient=(0.0, 0.0, 0.0), rms=0.0, length=60.0, inner=0.0, noise=0.3):
    """Of a pair of 350 m^2/s, 30 m apart, in a mean wind of 1 m/s, every 2.5 m."""
    y, z = np.arange(-45.0, 46, 2.5), np.arange(-30.0, 31, 2.5)
    random = np.random.default_rng(seed)
    pairs = [*vortex_pair(350.0, separation=30.0, core_radius=3.0)]
    pairs += [*vortex_pair(inner, separation=12.0, core_radius=2.0)] if inner else []
    v, w = velocity(pairs, y, z[:, None])
    _, *eddies = turbulence(rms, length, seed, shortest=3.0).velocity(0.0, y, z[:, None], 0.0)
    v_y, v_z, w_y = gradient
    v = v + eddies[0] + 1.0 + v_y * y + v_z * z[:, None]
    w = w + eddies[1] + w_y * y - v_y * z[:, None]
    fields = {
        name: part + noise * random.standard_normal(v.shape) for name, part in (("v", v), ("w", w))
    }
    fields |= {f"{name}_stderr": np.full(v.shape, noise) for name in "vw"}
    return xr.Dataset({k: (("z", "y"), a) for k, a in fields.items()}, {"z": z, "y": y})


TRUE = np.array([350.0, np.log(3.0), 15.0, 0.0, -350.0, np.log(3.0), -15.0, 0.0])


@pytest.mark.slow
@pytest.mark.parametrize("gradient", [(0, 0.08, 0), (-0.03, 0.02, 0.06)])
def test_a_gradient_is_no_circulation(gradient):
    found = fit_vortices_to_wind(vectors(1, gradient))
    error = (found.parameters[:8] - TRUE) / np.sqrt(np.diag(found.covariance)[:8])
    assert found.success and np.square(error).mean() < 3
    v_y, v_z, w_y = gradient
    np.testing.assert_allclose(found.ambient.gradient, [v_y, v_z, w_y, -v_y], atol=0.01)
    assert found.covariance[0, 0] ** 0.5 < 15


def test_a_pair_within_the_pair_is_refused():
    found = fit_vortices_to_wind(vectors(2, inner=120.0))
    assert any("more than two vortices" in reason for reason in found.reasons)
    assert not any("more than" in r for r in fit_vortices_to_wind(vectors(2, rms=1.0)).reasons)
