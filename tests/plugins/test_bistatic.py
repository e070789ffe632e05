"""A laser beside its telescope, and several fields of view in one rendering.

Detects: an offset, a tilt or a turn of the laser that changes nothing or goes the other way, an
overlap wrong by 1 %, a field of view that is another beam's.
"""

import math

import mitsuba as mi
import numpy as np
import pytest

from validation.second_order import Bistatic, second_order

pytestmark = pytest.mark.usefixtures("variant")

EXTINCTION = 0.01
GATES = np.linspace(100.0, 140.0, 21)


def pose(offset=(0.0, 0.0), tilt=0.0, turn=0.0):
    """Of a laser at (e_h, e_v), m, tilted towards e_h and turned about its axis, degrees."""
    place = mi.ScalarTransform4f().translate([*offset, 0.0])
    return place.rotate([0, 1, 0], tilt).rotate([0, 0, 1], turn)


def slab(world, to_world, gates, size=(1, 1), orders=1, phase="rayleigh_polarized", **lidar):
    """A thin beam and a slab from 100 to 150 m of range."""
    air = world.homogeneous(lidar.pop("extinction", EXTINCTION), phase)
    return world.scene(
        world.lidar(
            size,
            (gates[0], gates[-1]),
            laser={"beam_radius": 1e-6, "divergence_full_mrad": 0.0, "to_world": to_world},
            gate_kind="spherical",
            gate_count=len(gates) - 1,
            **lidar,
        ),
        {"max_order": orders, "orders": True},
        slab=world.box((100.0, -1000.0, -1000.0), (150.0, 1000.0, 1000.0), air),
    )


def test_a_beam_that_crosses_the_field_of_view(world):
    """A laser 10 m beside the telescope meets its axis at 115 m: the lidar equation along it."""
    g, base, fov, aperture = 0.5, 10.0, 10e-3, 0.01
    angle = math.atan(base / 115.0)
    to_world = pose((base, 0.0), -math.degrees(angle))
    phase = {"type": "hg", "g": g}
    loaded = slab(
        world, to_world, GATES, phase=phase, aperture_radius=aperture, fov_half_mrad=1e3 * fov
    )
    image = np.array(mi.render(loaded, spp=4_000_000, seed=1), float).reshape(len(GATES) - 1, -1)
    along = np.linspace(100.0, 150.0, 2_000_001) / math.cos(angle)
    beam = np.array([math.cos(angle), -math.sin(angle)])
    place = np.array([[0.0], [base]]) + along * beam[:, None]
    back = np.linalg.norm(place, axis=0)
    cosine = -(beam @ place) / back
    value = (1 - g * g) / (4 * np.pi * (1 + g * g - 2 * g * cosine) ** 1.5)
    depth = EXTINCTION * (along - 100.0 / math.cos(angle) + back * (1 - 100.0 / place[0]))
    value *= EXTINCTION * np.exp(-depth) * np.pi * aperture**2 * place[0] / back**3
    value *= np.abs(place[1] / place[0]) < math.tan(fov)
    path = (along + back) / 2
    expected, _ = np.histogram(path, GATES, weights=value * np.gradient(along))
    seen = expected > 0
    assert seen.sum() == 15
    found, error = image[:, 0], image[:, 4]
    # the aperture, 1 % of the field's radius, blurs its rim
    slack = 2e-3 * expected + np.where(seen, 0, 1e-3 * expected.max())
    assert (np.abs(found - expected) < 4 * error + slack).all()
    assert (error[seen] < 0.02 * expected.max()).all()


def test_a_turned_laser_emits_turned_polarisation(world):
    """Backscattering by molecules keeps linear polarisation, about an axis turned by 30 degrees."""
    loaded = slab(world, pose(turn=30.0), [110.0, 120.0])
    s0, s1, s2, *_ = np.array(mi.render(loaded, spp=1000, seed=1), float)[0, 0]
    # U changes its sign: it refers to the returning light
    assert s1 / s0 == pytest.approx(math.cos(math.pi / 3), abs=2e-3)
    assert abs(s2 / s0) == pytest.approx(math.sin(math.pi / 3), abs=2e-3)
    parameters = mi.traverse(loaded)
    parameters["sensor.laser.to_world"] = mi.Transform4f().rotate([0, 0, 1], 60.0)
    parameters.update()
    s0, s1, *_ = np.array(mi.render(loaded, spp=1000, seed=1), float)[0, 0]
    assert s1 / s0 == pytest.approx(math.cos(2 * math.pi / 3), abs=2e-3)


@pytest.mark.slow
def test_fields_of_view_of_one_telescope(world):
    """A pixel for each, in one rendering: each is what it is alone."""
    fields = (0.25e-3, 1e-3, 5e-3)
    loaded = slab(
        world,
        pose(),
        (110.0, 120.0),
        size=(3, 1),
        orders=2,
        phase="isotropic",
        extinction=0.03,
        aperture_radius=0.2,
        directions=mi.TensorXf(np.tile([[1.0, 0.0, 0.0]], (3, 1))),
        fov_half_mrad=", ".join(f"{1e3 * field}" for field in fields),
    )
    found = np.stack([np.array(mi.render(loaded, spp=20_000, seed=k))[0, :, 6] for k in range(20)])
    expected = [second_order(Bistatic(fov_half=field, aperture=0.2), 16)[0] for field in fields]
    error = found.std(0, ddof=1) / math.sqrt(20)
    assert (error < 0.02 * np.array(expected)).all()
    np.testing.assert_array_less(abs(found.mean(0) - expected), 4 * error)


def test_what_is_refused(world):
    with pytest.raises(RuntimeError, match="'2 numbers' is not allowed; expected one, or 1"):
        slab(world, pose(), (110.0, 120.0), fov_half_mrad="1, 2")
    loaded = slab(world, pose((0.0, 5.0)), (110.0, 120.0))
    mi.render(loaded, spp=4)
    air = world.homogeneous(1e-3, "rayleigh_polarized")
    around = world.scene(
        world.lidar((1, 1), (110.0, 120.0), laser={"to_world": pose((0.0, 5.0))}, medium=air),
        room=world.box((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0), air),
    )
    with pytest.raises(RuntimeError) as caught:
        mi.render(around, spp=4)
    assert "expected a place on the telescope's side of room" in str(caught.value.__cause__)
