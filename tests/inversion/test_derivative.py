"""The derivative that the inversion takes against differences of the rendered signal.

Detects: stated errors that are too small because the derivative is simplified, or a simplification
that wastes information.
"""

import numpy as np
import pytest
import xarray as xr

from lidar_mi.instrument.lidar import BackscatterLidar
from lidar_mi.instrument.scan import ScanPlan
from lidar_mi.inversion.layers import Layers
from lidar_mi.inversion.smoothness import precision
from lidar_mi.rendering.backscatter import ScanRenderer
from lidar_mi.rendering.phase import ScatteringAir
from lidar_mi.rendering.settings import RenderSettings

pytestmark = [
    pytest.mark.usefixtures("variant"),
    pytest.mark.parametrize("variant", ["llvm_ad_mono"], indirect=True),
]

LAYERS, STEP = 6, 0.2
LIDAR = BackscatterLidar(
    beam_radius=0.02,
    beam_cut=0.05,
    divergence_full="1 mrad",
    aperture_radius=0.1,
    fov_half="10 mrad",
)
PLAN = ScanPlan(np.zeros(1), np.zeros(1), 100.0, 220.0, "spherical", LAYERS, 0.0)
FACES = np.linspace(100, 220, LAYERS + 1)
X = (FACES[1:] + FACES[:-1]) / 2
# optical depth 1
PROFILE = np.array([0.5, 1.5, 2.0, 0.8, 0.5, 0.7])
PROFILE = PROFILE / PROFILE.sum() / 20


@pytest.mark.slow
def test_simplified_derivative_costs_little_and_states_no_smaller_errors(variant):
    """Covariance of the estimating function's root: the sandwich, with the derivative D of all
    orders by central differences with common random numbers."""
    settings = RenderSettings(variant=variant, samples_per_beam=40_000 * LAYERS, max_order=4)
    sides = np.array([-120.0, 120.0])

    def field(profile):
        values = np.broadcast_to(profile[:, None, None], (LAYERS, 2, 2)).copy()
        return xr.DataArray(values, dims=("x", "y", "z"), coords={"x": X, "y": sides, "z": sides})

    fog = {"type": "hg", "g": 0.85}
    renderer = ScanRenderer(field(PROFILE), PLAN, LIDAR, ScatteringAir(1e-6, fog, 1.0), settings)

    def signal(profile):
        scan = renderer.render(field(profile), PLAN, 3)
        return (scan[name].values.astype(float).ravel() for name in ("S0", "order1.S0"))

    every, single = signal(PROFILE)
    layers = Layers(X, FACES, np.ones(1))
    depth = layers.depth(PROFILE).ravel()
    factor = 1 - 0.5 * (np.log(every / single) * depth).sum() / (depth**2).sum()
    assert 0.75 < factor < 0.95
    mean = 1e5 * every / every.max()
    value, slopes = layers.signal(PROFILE, factor)
    simple = mean[:, None] * (slopes / value[..., None])[:, 0]
    full = np.empty((LAYERS, LAYERS))
    for layer in range(LAYERS):
        change = STEP / 2 * (np.arange(LAYERS) == layer)
        more, less = (next(signal(PROFILE * np.exp(sign * change))) for sign in (1, -1))
        full[:, layer] = mean * np.log(more / less) / STEP
    prior = precision(LAYERS, 0.1)
    prior[-1, -1] += 100  # a reference known to 10 %
    weighted = simple.T / mean
    stated = weighted @ simple + prior
    inverse = np.linalg.inv(weighted @ full + prior)
    actual = inverse @ stated @ inverse.T
    best = np.linalg.inv(full.T / mean @ full + prior)
    stated, actual, best = (np.sqrt(np.diag(one)) for one in (np.linalg.inv(stated), actual, best))
    # the differences' Monte Carlo error changes these ratios by 2 %
    assert 0.8 < (actual / stated).mean() < 1.03
    assert (best / actual).mean() > 0.95
