"""Paths of single scattering that are selected by their contribution.

Detects: a density of gate and pulse wrong by 1e-3 anywhere, a selection with a bias of 0.3 %, a
candidate in another medium than the walk finds there, noise that does not fall.
"""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scipy.special import ndtr

from plugins.gate_sampling import pulse_in_gate

pytestmark = pytest.mark.usefixtures("variant")

VIEW = {
    "azimuth_min_deg": -6.2,
    "azimuth_max_deg": 6.2,
    "elevation_min_deg": -3.9,
    "elevation_max_deg": 3.9,
}


@pytest.mark.parametrize("sigma", [1e-4, 0.02, 0.3, 1.0, 5.0, 300.0])
def test_ranges_have_the_distribution_of_gate_and_pulse(sigma):
    """Weighted fractions below each of 40 places against differences of normal integrals."""
    low, high, many = 999.0, 1001.5, 400_000
    parts = mi.Float((np.arange(many) + 0.5) / many)
    place, weight = (np.array(a, float) for a in pulse_in_gate(parts, low, high, sigma))
    off, width = place - 1000.25, high - low
    edges = np.linspace(-width / 2 - 5 * sigma, width / 2 + 5 * sigma, 41)
    found = np.array([weight[off < edge].sum() for edge in edges]) / many

    def integral(x):
        # of the normal distribution function, by parts
        z = x / sigma
        return x * ndtr(z) + sigma * np.exp(-(z**2) / 2) / np.sqrt(2 * np.pi)

    expected = (integral(edges + width / 2) - integral(edges - width / 2)) / width
    # places near 1000 are known to 6e-5
    allowed = 3e-4 + 6e-5 / (width + sigma)
    np.testing.assert_allclose(found, expected, atol=allowed)
    # a heavier tail, so that no weight explodes
    assert weight.max() < (1.1 if sigma > width / 60 else 2.01)
    assert weight.mean() == pytest.approx(1, abs=3e-4)


def slab_scene(world, candidates, *, pulse, gate=(500.0, 502.5), order=1, extra=None, **lidar):
    """A bright slab whose cells differ, in dim air, and gates that end within and outside."""
    rng = np.random.default_rng(3)
    low, high = (498.0, -65.0, -45.0), (503.0, 65.0, 45.0)
    values = 2e-3 * rng.uniform(0.2, 1.8, (9, 13, 8))
    return world.scene(
        world.lidar(
            (6, 4),
            gate,
            laser={"pulse_duration": pulse * 1e-9},
            environment=world.ENVIRONMENT,
            **VIEW,
            **lidar,
        ),
        {"candidates": candidates, "max_order": order},
        environment=world.homogeneous(1e-4),
        slab=world.box(low, high, world.grid(values, low, high), world.ENVIRONMENT),
        **(extra or {}),
    )


CASES = {
    "no pulse": {"pulse": 0},
    "short pulse": {"pulse": 1},
    "pulse of the gate": {"pulse": 10},
    "pulse of ten gates": {"pulse": 150},
    "gates": {"pulse": 10, "gate": (490.0, 510.0), "gate_count": 5},
    "spherical gates": {
        "pulse": 10,
        "gate": (490.0, 510.0),
        "gate_count": 3,
        "gate_kind": "spherical",
    },
    "field that cuts the beam": {"pulse": 10, "fov_half_mrad": 0.4},
    "from the telescope on": {"pulse": 30, "gate": (0.5, 520.0), "gate_count": 2},
    "orders": {"pulse": 10, "order": 3},
}


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES.values(), ids=CASES)
def test_expectation_is_that_of_one_candidate(world, case):
    spp = 4000
    one, first = world.render(slab_scene(world, 1, **case), seed=1, spp=spp)
    many, second = world.render(slab_scene(world, 12, **case), seed=2, spp=spp)
    spread = np.hypot(first, second)
    z = ((many[:, 0] - one[:, 0]) / spread).ravel()
    assert np.abs(z).max() < 4.5
    assert abs(z.mean()) < 4 / np.sqrt(z.size)
    assert (z**2).mean() == pytest.approx(1, abs=4 * np.sqrt(2 / z.size))


@pytest.mark.slow
def test_second_order_is_that_of_one_candidate(world):
    """In a gate behind the slab, which only the tail of the pulse reaches."""
    found = []
    for candidates in (1, 12):
        scene = slab_scene(world, candidates, pulse=20, gate=(504.0, 511.0), order=2)
        scene.integrator().orders = True
        images = [np.array(mi.render(scene, seed=seed, spp=2000)) for seed in range(8)]
        # S0 to S3, its error, then order by order
        found.append([image[..., 6].sum(dtype=float) for image in images])
    one, many = np.array(found)
    spread = np.hypot(*(np.std(a, ddof=1) / np.sqrt(len(a)) for a in found))
    assert one.mean() > 0 and abs(many.mean() - one.mean()) < 4 * spread


@pytest.mark.parametrize("case", [{"pulse": 10}, {"pulse": 1, "fov_half_mrad": 0.8}], ids=str)
def test_noise_of_pulses_and_of_what_the_field_cuts_off_falls(world, case):
    one, many = (world.render(slab_scene(world, n, **case), seed=1, spp=400)[1] for n in (1, 16))
    assert (many**2).mean() < (one**2).mean() / 8


@pytest.mark.slow
def test_gradients_have_one_candidate(world):
    found = []
    for candidates in (1, 16):
        scene = slab_scene(world, candidates, pulse=10)
        parameters = mi.traverse(scene)
        key = "slab.interior_medium.sigma_t.data"
        dr.enable_grad(parameters[key])
        parameters.update()
        image = mi.render(scene, parameters, seed=4, spp=64)
        dr.backward(image.array)
        found.append(np.array(dr.grad(parameters[key])))
    np.testing.assert_array_equal(*found)
    assert np.abs(found[0]).max() > 0


def test_open_surfaces_have_one_candidate(world):
    """Behind them the medium is known from the one in front alone."""
    at = mi.ScalarTransform4f().translate([499, 0, 0]).rotate([0, 1, 0], -90).scale(200)
    wall = {
        "type": "rectangle",
        "to_world": at,
        "bsdf": {"type": "null"},
        "exterior": world.ENVIRONMENT,
        "interior": world.homogeneous(2e-3),
    }
    images = []
    for candidates in (1, 16):
        scene = world.scene(
            world.lidar((3, 2), (497.0, 502.0), environment=world.ENVIRONMENT, **VIEW),
            {"candidates": candidates},
            environment=world.homogeneous(1e-4),
            wall=wall,
        )
        images.append(world.render(scene, seed=5, spp=64)[0])
    np.testing.assert_array_equal(*images)
    assert (images[0][:, 0] > 0).all()
