"""Straight lines through nested cubes: transmittance against clipping in numpy.

Detects: a length in a medium wrong by 1 mm of some 300 m, a medium mixed up at a surface, a line
that misses or invents a cube, in closed form and by ray queries alike.
"""

import mitsuba as mi
import numpy as np
import pytest

from plugins.bodies import Closed, Cube
from plugins.bounds import Bounds
from plugins.media import transmittance
from plugins.surfaces import Air
from tests.support.meshes import box_file

pytestmark = pytest.mark.usefixtures("variant")

LINES = 20_000
ENVIRONMENT, SLAB = 2e-3, 3e-2


def nested(shape, *surfaces):
    """A slab, turned and stretched, in an environment: the same shape twice."""
    transform = mi.ScalarTransform4f()
    slab = transform.translate([40, 5, -10]).rotate([0.6, 0.0, 0.8], 35).scale([30, 12, 20])
    around = transform.translate([20, 0, 0]).scale([100, 80, 60])
    environment = {"type": "homogeneous", "id": "environment", "sigma_t": ENVIRONMENT}
    cube = {**shape, "bsdf": {"type": "null"}}
    scene = {
        "type": "scene",
        "around": {**cube, "to_world": around, "interior": environment},
        "slab": {
            **cube,
            "to_world": slab,
            "interior": {"type": "homogeneous", "sigma_t": SLAB},
            "exterior": {"type": "ref", "id": "environment"},
        },
    }
    scene |= {f"surface{number}": surface for number, surface in enumerate(surfaces)}
    return mi.load_dict(scene), (np.array(around.matrix), np.array(slab.matrix))


def inside(matrix, origin, direction, distance):
    """Lengths of the lines' parts inside a cube, in double precision."""
    local = np.linalg.inv(matrix)
    start, step = origin @ local[:3, :3].T + local[:3, 3], direction @ local[:3, :3].T
    ends = np.sort([(-1 - start) / step, (1 - start) / step], axis=0)
    first, last = ends[0].max(1).clip(0), np.minimum(ends[1].min(1), distance)
    return (last - first).clip(0)


def lines():
    rng = np.random.default_rng(3)
    direction = rng.standard_normal((LINES, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    # outside all, so that every line begins in a vacuum, and many end inside
    origin = np.array([20.0, 0, 0]) - 300 * direction + rng.uniform(-50, 50, (LINES, 3))
    return origin.astype(np.float32), direction.astype(np.float32), rng.uniform(150, 450, LINES)


def walk(air, origin, direction, distance, bounds):
    points = [
        type_(np.ascontiguousarray(a.T))
        for type_, a in ((mi.Point3f, origin), (mi.Vector3f, direction))
    ]
    rng = mi.PCG32(size=LINES)
    value, _ = transmittance(
        air,
        bounds,
        mi.MediumPtr(None),
        *points,
        mi.Float(distance),
        0,
        mi.Color0f(),
        mi.Float(0),
        rng,
        True,
    )
    return np.array(value, float)


@pytest.mark.slow
@pytest.mark.parametrize("surfaces", ["cubes", "meshes"])
def test_transmittance_through_nested_cubes(surfaces, tmp_path):
    shape = {"type": "cube"}
    if surfaces == "meshes":
        shape = {"type": "ply", "filename": box_file(tmp_path)}
    scene, (around, slab) = nested(shape)
    kind = {"cubes": Cube, "meshes": Closed}[surfaces]
    air = Air(scene)
    assert [type(body) for body in air.bodies] == [kind, kind]
    origin, direction, distance = lines()
    dense = inside(slab, origin.astype(float), direction.astype(float), distance)
    thin = inside(around, origin.astype(float), direction.astype(float), distance) - dense
    assert (dense > 0).mean() > 0.1
    expected = np.exp(-ENVIRONMENT * thin - SLAB * dense)
    bounds = Bounds()
    bounds.update([shape.interior_medium() for shape in scene.shapes()], 0)
    found = walk(air, origin, direction, distance, bounds)
    np.testing.assert_allclose(np.log(found), np.log(expected), rtol=0, atol=1e-3 * SLAB)


def test_a_cube_without_media_changes_nothing():
    scene, _ = nested({"type": "cube"}, {"type": "cube", "bsdf": {"type": "null"}})
    assert len(Air(scene).bodies) == 2


def test_a_cube_bent_by_hand_is_traced():
    scene, _ = nested({"type": "cube"})
    shape = next(s for s in scene.shapes() if s.class_name() == "Cube")
    params = mi.traverse(shape)
    corners = np.array(params["vertex_positions"])
    corners[: 3 * 24] += 0.1 * (corners == corners.max())
    params["vertex_positions"] = mi.Float(corners)
    params.update()
    assert {type(body) for body in Air(scene).bodies} == {Cube, Closed}
