"""Gradients of the image with respect to the extinction grid.

Detects: 2 % in a directional derivative against central differences (k sigma over seeds), a
gradient that reaches cells no beam crosses.
"""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

pytestmark = pytest.mark.usefixtures("variant")

LOW, HIGH = (498.0, -10.0, -10.0), (505.0, 10.0, 10.0)
KEY = "slab.interior_medium.sigma_t.data"
SHAPE = (5, 6, 4)
# optical depth 0.35: attenuation, and its derivative, matter
BASE = 0.05 * np.random.default_rng(1).uniform(0.5, 1.5, SHAPE)
# spherical gate inside the slab, 3 x 2 beams
VIEW = {
    "azimuth_min_deg": -0.15,
    "azimuth_max_deg": 0.15,
    "elevation_min_deg": -0.1,
    "elevation_max_deg": 0.1,
}
WEIGHTS = np.random.default_rng(2).uniform(0.5, 1.5, (2, 3))
DIRECTION = 0.2 * BASE * np.random.default_rng(3).uniform(-0.5, 1.5, SHAPE)


@pytest.fixture
def slab(variant, world):
    scene = world.scene(
        world.lidar((3, 2), (500.0, 503.0), environment=world.ENVIRONMENT, samples=64, **VIEW),
        environment=world.homogeneous(1e-3),
        slab=world.box(LOW, HIGH, world.grid(BASE, LOW, HIGH), world.ENVIRONMENT),
    )
    return scene, mi.traverse(scene)


def put(parameters, values, gradient=False):
    parameters[KEY] = mi.TensorXf(values[..., None].astype(np.float32))
    if gradient:
        dr.enable_grad(parameters[KEY])
    parameters.update()


def image_sum(image):
    """A weighted sum of the beams' S0, of order one."""
    return (np.array(image).astype(float)[..., 0] * WEIGHTS).sum() * 1e7


def by_differences(scene, parameters, seeds, spp):
    values = []
    for seed in seeds:
        ends = []
        for step in (0.5, -0.5):
            put(parameters, BASE + step * DIRECTION)
            ends.append(image_sum(mi.render(scene, spp=spp, seed=seed)))
        values.append(ends[0] - ends[1])
    return np.mean(values), np.std(values, ddof=1) / np.sqrt(len(values))


def backward(scene, parameters, seed, spp):
    put(parameters, BASE, gradient=True)
    image = mi.render(scene, parameters, spp=spp, seed=seed)
    weights = np.zeros(image.shape, np.float32)
    weights[..., 0] = WEIGHTS * 1e7
    dr.backward(dr.sum(image * mi.TensorXf(weights)))
    return np.array(dr.grad(parameters[KEY]))[..., 0].astype(float)


@pytest.mark.parametrize(
    "samples_per_pass", [pytest.param(1 << 22, marks=pytest.mark.slow), 60_000]
)
def test_backward_agrees_with_differences(slab, samples_per_pass):
    scene, parameters = slab
    scene.integrator().samples_per_pass = samples_per_pass
    seeds = range(6)
    expected, error = by_differences(scene, parameters, seeds, 50_000)
    found = [(backward(scene, parameters, 50 + s, 50_000) * DIRECTION).sum() for s in seeds]
    spread = np.hypot(error, np.std(found, ddof=1) / np.sqrt(len(found)))
    assert spread < 0.02 * abs(expected)
    # differences over 30 % of the extinction: their own error is of third order, below 0.5 %
    assert abs(np.mean(found) - expected) < 4 * spread + 0.005 * abs(expected)


def test_forward_is_the_transpose_of_backward(slab):
    scene, parameters = slab
    expected = (backward(scene, parameters, 4, 20_000) * DIRECTION).sum()
    put(parameters, BASE, gradient=True)
    dr.set_grad(parameters[KEY], mi.TensorXf(DIRECTION[..., None].astype(np.float32)))
    parameters.update()
    image = mi.render(scene, parameters, spp=20_000, seed=4)
    assert image_sum(dr.forward_to(image)) == pytest.approx(expected, rel=1e-3)


def test_cells_outside_every_beam_have_no_gradient(slab):
    gradient = backward(*slab, 1, 5_000)
    # beams stay within 3 m of the axis; cells are 4 m high and see one cell further
    assert (gradient[0] == 0).all() and (gradient[-1] == 0).all()
    assert np.abs(gradient[2]).max() > 0


def test_gradient_of_the_albedo_is_the_image_over_the_albedo(variant, world):
    """Single scattering is proportional to the albedo where the vertex is: Euler's relation."""
    medium = world.homogeneous(2e-3, albedo=0.8)
    scene = world.scene(
        world.lidar((3, 2), (500.0, 503.0), **VIEW), slab=world.box(LOW, HIGH, medium)
    )
    parameters = mi.traverse(scene)
    (key,) = [k for k in parameters.keys() if "albedo" in k]
    dr.enable_grad(parameters[key])
    parameters.update()
    image = mi.render(scene, parameters, spp=64, seed=4)
    dr.backward(dr.sum(image[..., 0]) * 1e7)
    gradient = float(np.ravel(np.array(dr.grad(parameters[key])))[0])
    signal, error = (np.array(image)[..., k].astype(float) for k in (0, 4))
    # the gradient's photons are others than the image's
    sigma = 1e7 * np.sqrt(2 * (error**2).sum()) / 0.8
    assert sigma < 1e-2 * gradient
    assert abs(gradient - 1e7 * signal.sum() / 0.8) < 4 * sigma
