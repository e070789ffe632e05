"""Stated errors of profiles over families of profiles, without the renderer.

Detects: an error that is too small or too large, a reference or an error of the calibration that
does not count, a strength of the prior that follows noise.
"""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d

from lidar_mi.inversion.layers import Layers
from lidar_mi.inversion.scoring import Known, fit

GATES, PARTS, FINE, FACTOR = 24, 3, 12, 0.85
EDGES = np.linspace(100, 220, GATES + 1)


def middles(count):
    faces = np.linspace(100, 220, count + 1)
    return (faces[1:] + faces[:-1]) / 2


X = middles(FINE * GATES)
AIR, MODEL = (Layers(x, EDGES, np.ones(1)) for x in (X, middles(PARTS * GATES)))


def plumes(random):
    field = np.full(X.size, 0.5)
    for at, width in zip(random.uniform(100, 220, 2), random.uniform(6, 15, 2), strict=True):
        field += random.uniform(0.5, 2) * np.exp(-(((X - at) / width) ** 2))
    return field


def layers(random):
    return np.repeat(np.exp(random.normal(0, 0.5, 6)), X.size // 6)


def noise(random):
    field = gaussian_filter1d(random.normal(size=X.size), 18)
    return np.exp(0.5 * field / field.std())


def retrieved(profile, depth, brightest, calibration, seed):
    """Normalised errors of the layers' means."""
    random = np.random.default_rng(seed)
    truth = profile(random)
    truth *= depth / truth.sum() / (X[1] - X[0])
    signal, _ = AIR.signal(truth, FACTOR)
    per_signal = brightest / signal.max()
    counts = random.poisson(per_signal * signal + 1.0).astype(float)
    per_signal *= np.exp(calibration * random.normal())
    true = truth.reshape(GATES, -1).mean(1)
    row = np.zeros(PARTS * GATES)
    row[-PARTS:] = 1 / PARTS
    known = Known(1.0, calibration, row, np.log(true[-1]) + 0.1 * random.normal(), 0.1)
    gain, start = np.full(signal.shape, per_signal), np.full(row.size, depth / 120)
    found = fit(counts, gain, 0 * signal, MODEL, FACTOR, known, start)
    mean = found.extinction.reshape(GATES, -1).mean(1)
    slopes = np.kron(np.eye(GATES), np.ones(PARTS) / PARTS) * found.extinction / mean[:, None]
    error = np.sqrt(np.diag(slopes @ found.covariance @ slopes.T))
    return np.log(mean / true) / error


@pytest.mark.parametrize("profile", [plumes, layers, noise])
@pytest.mark.parametrize(
    ("depth", "brightest", "calibration"),
    [(0.3, 3e3, 0), (1, 1e5, 0.05), (3, 3e3, 0), (3, 1e5, 0.05)],
)
def test_stated_errors_hold(profile, depth, brightest, calibration):
    """Families of profiles that the prior does not describe, 20 of each."""
    normalised = np.array(
        [retrieved(profile, depth, brightest, calibration, seed) for seed in range(20)]
    )
    # errors of a profile have two to ten independent parts, few where the calibration's dominates:
    # 20 of them 40 to 200. One walk for layers and for the steps between them states too large
    # errors within layers
    assert 0.55 < (normalised**2).mean() < 1.4
    assert 0.55 < (np.abs(normalised) < 1).mean() < 0.87
    assert 0.92 < (np.abs(normalised) < 1.96).mean()


def test_reference_alone_decides_where_no_light_returns():
    """Counts of the background: the last layer is the reference, with its error."""
    row = np.zeros(12)
    row[-3:] = 1 / 3
    layers_ = Layers(middles(12), EDGES, np.ones(1))
    known = Known(5.0, 0.0, row, np.log(0.02), 0.2)
    dim = np.full((GATES, 1), 1e-6)
    found = fit(np.full((GATES, 1), 5.0), dim, 0 * dim, layers_, 1.0, known, np.full(12, 0.01))
    assert np.exp(row @ np.log(found.extinction)) == pytest.approx(0.02, rel=1e-3)
    assert np.sqrt(row @ found.covariance @ row) == pytest.approx(0.2, rel=1e-3)


def test_an_uncertain_calibration_is_the_error_of_thin_air():
    """Signal in proportion to extinction: its relative error is the calibration's."""
    layers_ = Layers(middles(GATES), EDGES, np.ones(1))
    thin = np.full(GATES, 1e-6)
    gain = np.full((GATES, 1), 1e6 / layers_.signal(thin, 1.0)[0].max())
    counts = gain * layers_.signal(thin, 1.0)[0]
    row = np.ones(GATES) / GATES
    known = Known(0.0, 0.07, row, 0.0, np.inf)
    found = fit(counts, gain, 0 * gain, layers_, 1.0, known, thin)
    np.testing.assert_allclose(np.sqrt(np.diag(found.covariance)), 0.07, rtol=0.01)
