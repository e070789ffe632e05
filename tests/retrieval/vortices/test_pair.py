"""Derived quantities of a pair: physics tests against closed forms and drawn parameters. Detect a
standard error off by 25 %, and a pair that drifts the wrong way."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from lidar_mi.atmosphere.vortices.vortex import vortex_pair
from lidar_mi.errors import InputError
from lidar_mi.retrieval.vortices.model import wind
from lidar_mi.retrieval.vortices.pair import VortexPairFit, circulation_5_15
from tests.support.vortex_pairs import uneven, vector


def some_fit(covariance=None, profile="lamb_oseen"):
    pair = uneven(profile)
    covariance = np.zeros((10, 10)) if covariance is None else covariance
    return VortexPairFit(vector(*pair), covariance, profile, 1.0, 1.0, 0.0, 0.0)


def test_quantities_in_closed_form():
    found = {name: q.value for name, q in some_fit().quantities.items()}
    b = np.hypot(25.0, 3.0)
    assert found["separation"] == pytest.approx(b)
    assert found["descent_speed"] == pytest.approx(280 / (2 * np.pi * b))
    assert found["time_scale"] == pytest.approx(2 * np.pi * b**2 / 280)
    assert (found["centre_y"], found["centre_z"]) == pytest.approx((0.5, -0.5))
    assert found["starboard_core_radius"] == pytest.approx(3.5)
    # the mean of r^2 / (r^2 + c^2) from 5 to 15 m
    c = 4.0
    mean = 1 - c / 10 * (np.arctan(15 / c) - np.arctan(5 / c))
    assert float(circulation_5_15(400.0, c, "burnham_hallock")) == pytest.approx(
        400 * mean, rel=1e-4
    )
    assert float(circulation_5_15(400.0, 0.01)) == pytest.approx(400.0)


@pytest.mark.slow
def test_errors_of_quantities_and_wind_against_drawn_parameters():
    """First order against 1500 draws from the covariance: these scatter by 2 %, 80 by 8 %."""
    random = np.random.default_rng(3)
    root = (
        random.standard_normal((10, 10)) * np.array([3, 0.01, 0.1, 0.1] * 2 + [0.05] * 2)[:, None]
    )
    covariance = root @ root.T
    fit = some_fit(covariance)
    drawn = random.multivariate_normal(fit.parameters, covariance, 1500)
    y, z = np.array([10.0, 14.0, -3.0]), np.array([0.0, 3.0, 5.0])
    fits = [VortexPairFit(p, covariance, "lamb_oseen", 1.0, 1.0, 0.0, 0.0) for p in drawn[:80]]
    winds = np.array(
        [
            wind(torch.as_tensor(p), torch.as_tensor(y), torch.as_tensor(z), "lamb_oseen").numpy()
            for p in drawn
        ]
    )
    stated = fit.wind(y, z)
    np.testing.assert_allclose(stated["v_stderr"], winds[:, 0].std(0), rtol=0.08)
    np.testing.assert_allclose(stated["w_stderr"], winds[:, 1].std(0), rtol=0.08)
    together = [np.corrcoef(winds[:, 0, k], winds[:, 1, k])[0, 1] for k in range(3)]
    np.testing.assert_allclose(stated["vw_correlation"], together, atol=0.08)
    quantities = [one.quantities for one in fits]
    for name in ("separation", "descent_speed", "port_core_radius", "starboard_circulation_5_15"):
        values = [one[name].value for one in quantities]
        assert fit.quantities[name].stderr == pytest.approx(np.std(values), rel=0.32), name


@pytest.mark.slow
def test_the_pair_drifts_on_and_its_errors_grow():
    """Alike vortices sink by Gamma t/(2 pi b) and go with the mean wind; errors as drawn ones."""
    pair = vortex_pair(400.0, 40.0, 3.0)
    covariance = np.diag([4.0, 1e-4, 0.01, 0.01] * 2 + [0.04] * 2)
    now = VortexPairFit(
        vector(*pair, mean=(2.0, 0.5)), covariance, "lamb_oseen", 1.0, 1.0, 0.1, 3.0
    )
    later = now.after(2.0)
    sunk = 2.0 * (0.5 - 400 / (2 * np.pi * 40))
    np.testing.assert_allclose(
        later.parameters - now.parameters, [0, 0, 4, sunk, 0, 0, 4, sunk, 0, 0], atol=1e-9
    )
    assert now.quantities["drift_w"].value == pytest.approx(sunk / 2)
    # the wind goes along
    here, there = now.wind([5.0], [3.0]), later.wind([9.0], [3.0 + sunk])
    np.testing.assert_allclose(here["w"], there["w"])
    drawn = np.random.default_rng(5).multivariate_normal(now.parameters, covariance, 150)
    moved = np.array(
        [
            VortexPairFit(p, covariance, "lamb_oseen", 1.0, 1.0, 0.1, 3.0).after(2.0).parameters
            for p in drawn
        ]
    )
    # the spread of 150 scatters by 6 %
    np.testing.assert_allclose(moved.std(0), np.sqrt(np.diag(later.covariance)), rtol=0.24)


def test_slopes_against_drawn_ones():
    """Of 20000 slopes and fractions from 0 to 1, mean and covariance of the parameters to 4 %."""
    random = np.random.default_rng(5)
    fit = replace(some_fit(), inclined=random.standard_normal((10, 2)))
    slopes, covariance = np.array([0.4, -0.1]), np.array([[0.02, 0.005], [0.005, 0.01]])
    found = fit.with_slopes(slopes, covariance)
    drawn = random.multivariate_normal(slopes, covariance, 20000) * random.random((20000, 1))
    true = fit.parameters - drawn @ fit.inclined.T
    np.testing.assert_allclose(found.parameters, true.mean(0), atol=0.02)
    np.testing.assert_allclose(found.covariance, np.cov(true.T), atol=0.04 * np.cov(true.T).max())
    assert (found.slopes == slopes).all()
    with pytest.raises(InputError, match="give a telescope"):
        some_fit().with_slopes(slopes, covariance)
