"""Fits from an expected pair against fits from nothing, of the same images, and known truth.

Detects a result off by 0.2 standard errors, and wrong starts that are not found out.
`validation.pairs_in_air` has the standard errors.
"""

from dataclasses import replace

import numpy as np
import pytest
import torch

from benchmarks.cases import DT, drifting_pair_images
from lidar_mi.errors import InputError
from lidar_mi.retrieval.vortices.image_fit import fit_vortices, started_fit
from lidar_mi.retrieval.vortices.images import SAME_BRIGHTNESS, Builder
from lidar_mi.retrieval.vortices.robust_fit import residual_after
from tests.support.vortex_pairs import uneven, vector

SMALL = {"columns": 130, "rows": 90}
EXPECTED = np.array([12.0, 0.05, 0.3, 0.3, 12.0, 0.05, 0.3, 0.3, 0.1, 0.1])
"""Standard errors of an expected pair, as of a track over a few slabs."""


def expected(like, parameters):
    return replace(like, parameters=parameters, covariance=np.diag(EXPECTED**2))


@pytest.fixture(scope="module")
def images():
    return drifting_pair_images(uneven(), (1.0, -0.5), 0.03, seed=3, **SMALL)


@pytest.fixture(scope="module")
def cold(images):
    return fit_vortices(images.first, images.second, DT, 0.03)


@pytest.mark.parametrize("sigma", [0.0, 1.0, 2.5])
def test_the_same_fit_as_by_a_search(images, cold, sigma):
    off = np.random.default_rng(2).choice([-1.0, 1.0], 10) * sigma * EXPECTED
    truth = vector(*images.vortices, mean=(1.0, -0.5))
    found = fit_vortices(images.first, images.second, DT, 0.03, start=expected(cold, truth + off))
    assert found.success and found.from_start and not cold.from_start
    stderr = np.sqrt(np.diag(cold.covariance))
    assert (np.abs(found.parameters - cold.parameters) < 0.2 * stderr).all()
    # the strength of the turbulence, of none here, is estimated from other steps
    np.testing.assert_allclose(np.sqrt(np.diag(found.covariance)), stderr, rtol=0.1)
    assert found.chi2 == pytest.approx(cold.chi2, rel=0.02)
    assert found.correlation == pytest.approx(cold.correlation, abs=0.005)
    assert (np.abs(found.parameters - truth) < 4 * stderr).all()


@pytest.mark.parametrize("metres", [3.0, 8.0])
def test_a_wrong_start_is_found_out(images, cold, metres):
    wrong = cold.parameters + metres * np.array([0, 0, 1, 0, 0, 0, 1, 0, 0, 0])
    found = fit_vortices(images.first, images.second, DT, 0.03, start=expected(cold, wrong))
    assert not found.from_start
    # sums in single precision depend on where in memory the images lie
    np.testing.assert_allclose(found.parameters, cold.parameters, rtol=1e-5)


def test_a_fit_that_is_started_with_the_first_image(images, cold):
    """The same as with both at once; pixels of the second image alone may be unknown."""
    start, noise = expected(cold, cold.parameters + 0.3 * EXPECTED), 0 * images.first + 0.03
    second = images.second.copy()
    second[30:36, 50:58] = np.nan
    for other in (images.second, second):
        at_once = fit_vortices(images.first, other, DT, noise, start=start)
        found = started_fit(images.first, DT, noise, start=start)(other)
        assert found.from_start
        np.testing.assert_allclose(found.parameters, at_once.parameters, rtol=1e-5, atol=1e-6)
    stderr = np.sqrt(np.diag(cold.covariance))
    assert (np.abs(found.parameters - cold.parameters) < stderr).all()
    wrong = expected(cold, cold.parameters + 8.0 * np.eye(10)[2])
    searched = started_fit(images.first, DT, 0.03, start=wrong)(images.second)
    assert searched.success and not searched.from_start
    with pytest.raises(InputError, match=r"^image2: sizes"):
        started_fit(images.first, DT, 0.03, start=start)(images.second[1:])


def test_what_a_step_bends_near_the_cores(images, cold):
    """The residual after a step is the linear one and this, but for a seventh of it."""
    z, y = (images.first[axis].values.astype(float) for axis in "zy")
    pair = torch.stack([torch.as_tensor(image.values) for image in (images.first, images.second)])
    bad = torch.zeros(pair.shape[1:], dtype=bool)
    make = Builder(pair, bad, z, y, DT, 0.03, None, 1.0, "lamb_oseen", False)
    model = make(0.0, 1)
    model = replace(model, whole=model.spline)
    start = torch.tensor([*cold.parameters, *SAME_BRIGHTNESS])
    end = start + torch.cat([torch.as_tensor(0.5 * EXPECTED), torch.zeros(6)])
    views = model.views(start)
    misfit, then = model.misfit(start, views), model(end)
    found = model.curved(misfit, views, start, end)
    left = (then.residual - residual_after(misfit, end - start)) * misfit.valid * then.valid
    assert float((left - found).square().sum()) < 0.15**2 * float(left.square().sum())


def test_an_uncertain_start_is_refined_on_blurred_images(images, cold):
    wrong = cold.parameters + np.array([60.0, 0.2, 1.5, 1.0, -40.0, -0.2, -1.0, 1.5, 1.0, -1.0])
    wide = replace(cold, parameters=wrong, covariance=25 * np.diag(EXPECTED**2))
    found = fit_vortices(images.first, images.second, DT, 0.03, start=wide)
    assert found.from_start
    stderr = np.sqrt(np.diag(cold.covariance))
    assert (np.abs(found.parameters - cold.parameters) < 0.2 * stderr).all()


def test_a_start_of_another_profile_is_refused(images, cold):
    other = replace(cold, profile="burnham_hallock")
    with pytest.raises(InputError, match=r"^start\.profile: 'burnham_hallock' is not"):
        fit_vortices(images.first, images.second, DT, start=other)


def test_an_ambient_wind_of_another_image():
    """Where the scan follows the pair, the next image has other blocks at other places."""
    images = drifting_pair_images(uneven(), (1.0, 0.5), 0.01, 3, **SMALL)
    whole = fit_vortices(images.first, images.second, DT, 0.01)
    part = {"y": slice(9, None), "z": slice(4, -3)}
    first, second = (image.isel(part) for image in (images.first, images.second))
    start = expected(whole, whole.parameters)
    found = fit_vortices(first, second, DT, 0.01, start=start)
    assert found.from_start
    assert found.ambient.eddies.shape != whole.ambient.eddies.shape
    off = np.abs(found.parameters - whole.parameters)
    assert (off < 2 * np.sqrt(np.diagonal(whole.covariance))).all()
