"""Light of order two in narrow fields of view against a quadrature in double precision.

Detects: 1 % of it lost or added, at any field of view, telescope and range; the same of its
polarisation and its gradients; single precision that cancels in a connection.
"""

import warnings

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from plugins.closed_paths import OpenPath, closing_distance
from validation.second_order import Bistatic, second_order

pytestmark = pytest.mark.usefixtures("variant")

FAR = {"slab": (2000.0, 2200.0), "gate": (2050.0, 2060.0)}
CASES = [
    Bistatic(fov_half=0.05e-3, aperture=0.02),
    Bistatic(fov_half=0.25e-3, aperture=0.2),
    Bistatic(fov_half=0.5e-3, aperture=0.2, asymmetry=None),
    Bistatic(fov_half=5e-3, aperture=0.5, asymmetry=0.85),
    Bistatic(fov_half=0.05e-3, aperture=0.1, **FAR),
]


def pencil(world, case, place=None, **integrator):
    """One thin, collimated beam, and one gate of order two in a slab."""
    phase = {"type": "hg", "g": case.asymmetry}
    phase = "rayleigh_polarized" if case.asymmetry is None else phase
    air = world.homogeneous(case.extinction, phase, case.albedo)
    (near, far), wide = case.slab, 1000.0
    slab = world.box((near, -wide, -wide), (far, wide, wide), air)
    place = mi.ScalarTransform4f() if place is None else place
    return world.scene(
        world.lidar(
            (1, 1),
            case.gate,
            laser={"beam_radius": 1e-6, "divergence_full_mrad": 0.0},
            gate_kind="spherical",
            aperture_radius=case.aperture,
            fov_half_mrad=1e3 * case.fov_half,
            to_world=place,
        ),
        {"max_order": 2, "orders": True, **integrator},
        slab=slab | {"to_world": place @ slab["to_world"]},
    )


@pytest.mark.parametrize("case", CASES)
def test_no_light_is_lost_in_a_narrow_field(world, case):
    loaded = pencil(world, case)
    found = np.stack([np.array(mi.render(loaded, spp=20_000, seed=k))[0, 0] for k in range(20)])
    # S1 of single scattering is that of the laser, or 0
    first = found[:, 5] if case.asymmetry is None else 0
    found = np.stack([found[:, 6], found[:, 1] - first], -1).astype(float)
    expected = second_order(case, 16)[:2]
    error = found.std(0, ddof=1) / np.sqrt(len(found))
    assert error[0] < 0.01 * expected[0]
    np.testing.assert_array_less(abs(found.mean(0) - expected), 4 * error + 1e-3 * expected[0])
    assert loaded.integrator().rejected < 1e-4 * 20_000


def test_samples_lost_to_rounding_are_counted_and_said_once(world):
    """Coordinates of 20 km are rounded to millimetres, as wide as a field of 0.05 mrad is here."""
    case, place = CASES[0], mi.ScalarTransform4f().translate([0.0, 20_000.0, 20_000.0])
    loaded = pencil(world, case, place)
    with pytest.warns(UserWarning, match="samples left the field of view by rounding"):
        found = np.array(mi.render(loaded, spp=400_000, seed=1))[0, 0]
    rejected = loaded.integrator().rejected / 400_000
    lost = 1 - found[6] / second_order(case, 16)[0]
    assert 0.5 * lost < rejected < 2 * lost and lost > 0.03
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        mi.render(loaded, spp=1000, seed=2)


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES[:2])
def test_nor_its_derivative_by_extinction(world, case):
    loaded = pencil(world, case)
    integrator, params = loaded.integrator(), mi.traverse(loaded)
    integrator.lowest_order = 2
    key = next(k for k in params.keys() if k.endswith("sigma_t.value.value"))
    dr.enable_grad(params[key])
    slopes = []
    for seed in range(10):
        dr.set_grad(params[key], 1.0)
        params.update()
        image = integrator.render_forward(loaded, params, seed=seed, spp=20_000)
        slopes.append(float(np.array(image)[0, 0, 0]))
    expected, _, slope = second_order(case, 16)
    error = np.std(slopes, ddof=1) / np.sqrt(len(slopes))
    assert error < 0.02 * expected * slope / case.extinction
    assert abs(np.mean(slopes) - expected * slope / case.extinction) < 4 * error


@pytest.mark.slow
@pytest.mark.parametrize("angle", [1e-5, 1e-4, 1e-3, 1e-2])
@pytest.mark.parametrize("excess", [1e-4, 1e-2, 1.0])
def test_paths_close_along_the_direction_from_the_telescope(angle, excess):
    """Within 1e-5 of the exact place, for any excess length and angle to the vertex."""
    distance, turn = 140.0, np.linspace(0, 2 * np.pi, 64)
    inward = np.stack([np.sin(angle) * np.cos(turn), np.sin(angle) * np.sin(turn), 0 * turn])
    inward[2] = np.sqrt(1 - (inward[:2] ** 2).sum(0))
    inward = np.float32(inward).astype(float)
    inward /= np.linalg.norm(inward, axis=0)
    one = 1 - inward[2]
    length = excess * (distance + excess / 2) / (excess + distance * one)
    exact = length * inward - [[0], [0], [distance]]
    open_path = OpenPath(
        mi.Vector3f(0, 0, 1), mi.Float(distance), mi.Float(excess), mi.Float(1e-3), mi.Float(1e9)
    )
    onward = np.array(open_path.from_telescope(mi.Vector3f(*map(mi.Float, inward))), float)
    # the direction itself is rounded: 1e-7 of its components
    slack = 1e-6 * np.linalg.norm(length * inward) / np.linalg.norm(exact, axis=0)
    off = np.linalg.norm(onward - exact / np.linalg.norm(exact, axis=0), axis=0)
    assert (off < 1e-5 + slack).all()
    path = np.float32(distance + excess)
    found = closing_distance(
        mi.Vector3f(0, 0, -distance), mi.Vector3f(*map(mi.Float, inward)), mi.Float(path)
    )
    excess = float(path) - distance
    length = excess * (distance + excess / 2) / (excess + distance * one)
    np.testing.assert_allclose(np.array(found, float), length, rtol=2e-3 if angle < 1e-4 else 1e-4)
