"""Returns of diffuse surfaces: ground, walls, calibration targets.

Detects: a reflectance, cosine, distance or transmittance that enters wrongly by 0.1 %, a return in
another gate, light from a face that is turned away, hidden or out of view, polarised light, a
derivative that is missing.
"""

import math

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scipy.stats import norm

pytestmark = pytest.mark.usefixtures("variant")

RANGE, EXTINCTION, APERTURE, RHO = 200.0, 1e-3, 0.1, 0.3


def wall(tilt=0.0, distance=RANGE, bsdf=None, half=20.0):
    """A square across the x axis, turned about z by degrees, that faces the lidar at 0."""
    place = mi.ScalarTransform4f().translate([distance, 0.0, 0.0]).rotate([0, 0, 1], tilt)
    place = place.rotate([0, 1, 0], -90.0).scale(half)
    bsdf = bsdf or {"type": "diffuse", "reflectance": RHO}
    return {"type": "rectangle", "to_world": place, "bsdf": bsdf}


def target(world, gate=(190.0, 210.0), gates=4, air=None, laser=None, integrator=None, **shapes):
    laser = {"beam_radius": 1e-6, "divergence_full_mrad": 0.0, **(laser or {})}
    media = {"environment": air} if air else {}
    sensor = world.lidar(
        (1, 1),
        gate,
        laser=laser,
        environment=world.ENVIRONMENT if air else None,
        gate_count=gates,
        gate_kind="spherical",
        aperture_radius=APERTURE,
        fov_half_mrad=2.0,
    )
    return world.scene(sensor, {"orders": True, **(integrator or {})}, **media, **shapes)


def rendered(scene, samples=4000, seed=1):
    return np.array(mi.render(scene, spp=samples, seed=seed), float).reshape(
        scene.sensors()[0].gate_count, -1
    )


def expected(tilt=0.0, extinction=EXTINCTION):
    """rho / pi cos A / R^2 T^2, of a telescope much smaller than the range."""
    lambertian = RHO / math.pi * math.cos(math.radians(tilt))
    return lambertian * math.pi * (APERTURE / RANGE) ** 2 * math.exp(-2 * extinction * RANGE)


def test_a_pulse_spreads_it_over_gates(world):
    duration = 3e-8
    scene = target(world, gates=10, laser={"pulse_duration": duration}, wall=wall())
    found = rendered(scene, 2_000_000)
    sigma = duration * 299792458.0 / 2 / (2 * math.sqrt(2 * math.log(2)))
    parts = np.diff(norm.cdf(np.linspace(190.0, 210.0, 11), RANGE, sigma)) * expected(0.0, 0.0)
    assert (np.abs(found[:, 0] - parts) < 4.5 * found[:, 4] + 1e-3 * parts.max()).all()


@pytest.mark.slow
def test_gated_and_analog_agree_with_air_before_and_behind(world):
    """Scattering air of structure, three orders, a small oblique wall in the beam."""
    values = 0.01 * np.random.default_rng(1).uniform(0.3, 1.7, (3, 3, 8))
    low, high = (150.0, -60.0, -60.0), (220.0, 60.0, 60.0)
    shapes = {
        "slab": world.box(low, high, world.grid(values, low, high), world.ENVIRONMENT),
        "wall": wall(30.0, 205.0, half=0.2),
    }
    images = []
    for estimator, samples in (("gated", 60_000), ("analog", 500_000)):
        scene = target(
            world,
            air=world.homogeneous(1e-4),
            gate=(180.0, 220.0),
            laser={"beam_radius": 0.3, "beam_cut": 0.4},
            integrator={"estimator": estimator, "max_order": 3},
            **shapes,
        )
        images.append(rendered(scene, samples))
    gated, analog = images
    z = (gated[:, 0] - analog[:, 0]) / np.hypot(gated[:, 4], analog[:, 4])
    assert (np.abs(z) < 4).all()
    # the wall is most of its gate
    assert gated[2, 5] > 3 * gated[1, 5] and analog[2, 4] < 0.1 * analog[2, 0]


def test_faces_that_are_dark(world):
    away = wall(180.0)
    facing = wall(180.0, bsdf={"type": "twosided", "bsdf": wall()["bsdf"]})
    assert rendered(target(world, wall=away))[:, 0].sum() == 0
    assert rendered(target(world, wall=facing))[2, 0] == pytest.approx(expected(0, 0), rel=1e-3)
    metal = wall(distance=195.0, bsdf={"type": "conductor"})
    for estimator in ("gated", "analog"):
        hidden = target(world, wall=wall(), metal=metal, integrator={"estimator": estimator})
        assert rendered(hidden)[:, 0].sum() == 0
    turned = {"to_world": mi.ScalarTransform4f().rotate([0, 1, 0], 0.2)}
    assert rendered(target(world, laser=turned, wall=wall()))[:, 0].sum() == 0


def test_derivative_by_the_extinction_before_it(world):
    """d ln S / d extinction = -2 R."""
    air = world.homogeneous(EXTINCTION, "isotropic", 0.0)
    scene = target(world, air=air, wall=wall(), gates=1)
    params = mi.traverse(scene)
    (key,) = (k for k in params.keys() if k.endswith("sigma_t.value.value"))
    dr.enable_grad(params[key])
    dr.set_grad(params[key], 1.0)
    params.update()
    image = scene.integrator().render_forward(scene, params, seed=1, spp=1000)
    slope = float(np.array(image)[0, 0, 0])
    # the mean over gate and telescope: 0.1 % of the range
    assert slope == pytest.approx(-2 * RANGE * expected(), rel=2e-3)
