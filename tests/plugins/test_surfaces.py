"""Lines through shapes that touch, nest, overlap or nearly so, against intervals in numpy.

Detects: a medium lost behind a surface that touches another one or lies a few roundings behind it,
one that is kept where it ends, a result that depends on the kind of shape, on the direction of its
normals, on the order of shapes in the scene or on another shape elsewhere.
"""

import math

import mitsuba as mi
import numpy as np
import pytest

from plugins.bodies import Closed, Cube, Sheet, Sphere
from plugins.bounds import Bounds
from plugins.media import collision, transmittance
from plugins.surfaces import Air
from tests.support.meshes import box_file

pytestmark = pytest.mark.usefixtures("variant")

LINES = 2000
EXTINCTION = {"low": 4e-3, "high": 9e-3, "dense": 3e-2}
# first and last x, and medium, of boxes across the lines; the widths differ as much as these do
ARRANGEMENTS = {
    "one": [(50, 90, "low")],
    "touching": [(50, 90, "low"), (90, 150, "high")],
    "one medium": [(50, 90, "low"), (90, 150, "low")],
    "gap of 1e-6 m": [(50, 90, "low"), (90.000001, 150, "high")],
    "gap of 1e-5 m": [(50, 90, "low"), (90.00001, 150, "high")],
    "gap of 1e-4 m": [(50, 90, "low"), (90.0001, 150, "high")],
    "gap of 1e-3 m": [(50, 90, "low"), (90.001, 150, "high")],
    "overlap of 1e-5 m": [(50, 90.00001, "low"), (90, 150, "high")],
    "three": [(50, 70, "low"), (70, 90, "high"), (90, 150, "dense")],
    "thin between": [(50, 90, "low"), (90, 90.0002, "dense"), (90.0002, 150, "high")],
    "thin alone": [(50, 50.0002, "dense"), (120, 150, "high")],
    "nested": [(50, 150, "low"), (70, 90, "high")],
    "nested, a face shared": [(50, 150, "low"), (90, 150, "high")],
    "nested, both faces shared": [(50, 150, "low"), (50, 150, "high"), (60, 80, "dense")],
    "overlapping": [(50, 95, "low"), (90, 130, "high")],
    "overlapping, one medium": [(50, 95, "low"), (90, 150, "low")],
}
SHRINK = 0.9


def shape(kind, folder, first, last, half_width, medium):
    """A box, or two rectangles that are its faces across the x axis."""
    middle, half = (first + last) / 2, (last - first) / 2
    place = mi.ScalarTransform4f().translate([middle, 0, 0])
    sides = {"bsdf": {"type": "null"}, "interior": medium}
    if kind == "rectangles":
        turn = place.rotate([0, 1, 0], 90).scale([half_width, half_width, 1])
        forward, back = (
            mi.ScalarTransform4f().translate([shift, 0, 0]) @ turn for shift in (half, -half)
        )
        back = back @ mi.ScalarTransform4f().rotate([0, 1, 0], 180)
        return [{"type": "rectangle", "to_world": at, **sides} for at in (forward, back)]
    size = [half, half_width, half_width]
    if kind == "mesh":
        return [
            {"type": "ply", "filename": box_file(folder), "to_world": place.scale(size), **sides}
        ]
    sign = -1 if kind == "mirrored" else 1
    cube = {"type": "cube", "to_world": place.scale([sign * half, *size[1:]]), **sides}
    if kind == "inside out":
        # normals inwards, and the media exchanged: the same air
        return [{**cube, "flip_normals": True, "interior": None, "exterior": medium}]
    return [cube]


def build(boxes, kind, folder, *more, backward=False):
    scene = {"type": "scene"}
    for name, extinction in EXTINCTION.items():
        scene[name] = {"type": "homogeneous", "sigma_t": extinction}
    for number, (first, last, name) in list(enumerate(boxes))[:: -1 if backward else 1]:
        width = 40 * SHRINK**number
        parts = shape(kind, folder, first, last, width, {"type": "ref", "id": name})
        for side, part in enumerate(parts):
            scene[f"box{number}_{side}"] = {k: v for k, v in part.items() if v is not None}
    scene |= {f"more{number}": one for number, one in enumerate(more)}
    return mi.load_dict(scene)


def expected(boxes, origin, direction, distance):
    """Optical depths of lines (n, 3) that stay within the boxes' widths, of the smallest box."""
    cuts = np.array([x for first, last, _ in boxes for x in (first, last)], np.float32)
    at = (cuts.astype(float) - origin[:, :1]) / direction[:, :1]
    stop = np.broadcast_to(distance, len(origin))[:, None]
    ends = np.sort(np.concatenate([np.clip(at, 0, stop), 0 * stop, stop], 1), axis=1)
    middle = origin[:, :1] + direction[:, :1] * (ends[:, 1:] + ends[:, :-1]) / 2
    volumes = [(last - first) * SHRINK ** (2 * k) for k, (first, last, _) in enumerate(boxes)]
    extinction = np.zeros_like(middle)
    for k in np.argsort(volumes)[::-1]:
        first, last, name = boxes[k]
        inside = (middle > np.float32(first)) & (middle < np.float32(last))
        extinction = np.where(inside, EXTINCTION[name], extinction)
    return (extinction * np.diff(ends, axis=1)).sum(1)


def lines():
    """Both ways, to behind all boxes, into them, and to the face at 90 m: origins, directions, m"""
    rng = np.random.default_rng(4)
    way = np.where(np.arange(LINES) % 2, 1, -1)[:, None]
    direction = np.column_stack([np.ones(LINES), rng.uniform(-0.1, 0.1, (LINES, 2))]) * way
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    middle = np.column_stack([np.full(LINES, 100), rng.uniform(-8, 8, (LINES, 2))])
    distance = np.where(way[:, 0] > 0, *np.resize([[200, 93.7, 90], [200, 103, 110]], (2, LINES)))
    return (middle - direction * 100).astype(np.float32), direction.astype(np.float32), distance


def bounds_of(scene):
    bounds = Bounds()
    sides = [(shape.interior_medium(), shape.exterior_medium()) for shape in scene.shapes()]
    bounds.update({medium: None for pair in sides for medium in pair if medium is not None}, 0)
    return bounds


def walk(along, scene, origin, direction, distance):
    """What `transmittance` or `collision` finds along lines from outside of all media."""
    points = (
        type_(*(np.ascontiguousarray(axis) for axis in a.T))
        for type_, a in ((mi.Point3f, origin), (mi.Vector3f, direction))
    )
    return along(
        Air(scene),
        bounds_of(scene),
        mi.MediumPtr(None),
        *points,
        mi.Float(distance),
        0,
        mi.Color0f(),
        mi.Float(0),
        mi.PCG32(size=len(origin)),
        mi.Bool(True),
    )


def depth(scene, origin, direction, distance):
    value, _ = walk(transmittance, scene, origin, direction, distance)
    return -np.log(np.array(value, float))


def check(scene, boxes, tolerance=2e-4):
    """``tolerance`` in m: some roundings of a coordinate, for every surface."""
    origin, direction, distance = lines()
    found = depth(scene, origin, direction, distance)
    truth = expected(boxes, origin.astype(float), direction.astype(float), distance)
    allowed = tolerance * max(EXTINCTION.values()) + 1e-6
    np.testing.assert_allclose(found, truth, rtol=0, atol=allowed)


@pytest.mark.parametrize("kind", ["cube", "mirrored", "inside out", "mesh"])
@pytest.mark.parametrize("name", ARRANGEMENTS)
def test_boxes(name, kind, tmp_path):
    boxes = ARRANGEMENTS[name]
    check(build(boxes, kind, tmp_path), boxes)


@pytest.mark.parametrize("kind", ["cube", "mesh"])
@pytest.mark.parametrize("name", ["touching", "gap of 1e-5 m", "nested, a face shared"])
def test_free_flights(name, kind, tmp_path):
    """As many collisions as optical depths say, and their mean distance, within 4 sigma."""
    boxes = ARRANGEMENTS[name]
    origin, direction, distance = (np.tile(a, (30, *[1] * (a.ndim - 1))) for a in lines())
    scene = build(boxes, kind, tmp_path)
    flight, medium, found = walk(collision, scene, origin, direction, distance)
    flight, found = np.array(flight, float), np.array(found)
    chance = -np.expm1(-expected(boxes, origin.astype(float), direction.astype(float), distance))
    sigma = np.sqrt((chance * (1 - chance)).sum())
    assert abs(found.sum() - chance.sum()) < 4 * sigma
    # of those, uniform on the scale of optical depth
    passed = -np.expm1(-expected(boxes, origin.astype(float), direction.astype(float), flight))
    part = (passed / chance)[found]
    assert abs(part.mean() - 0.5) < 4 / math.sqrt(12 * found.sum())
    where = origin[:, 0] + direction[:, 0] * flight
    nowhere = np.array(medium == mi.MediumPtr(None)) & found
    assert not nowhere.any() and ((where > 50) & (where < 150))[found].all()


@pytest.mark.parametrize("name", ARRANGEMENTS)
def test_the_order_in_the_scene_does_not_matter(name, tmp_path):
    boxes = ARRANGEMENTS[name]
    found = [
        depth(build(boxes, "cube", tmp_path, backward=backward), *lines())
        for backward in (False, True)
    ]
    np.testing.assert_allclose(*found, rtol=0, atol=1e-6)


# rectangles have no inside: where they overlap or share a place, light may be in either medium
OPEN = [name for name in ARRANGEMENTS if not name.startswith(("nested", "overlap"))]


@pytest.mark.parametrize("name", OPEN)
def test_rectangles(name, tmp_path):
    boxes = ARRANGEMENTS[name]
    scene = build(boxes, "rectangles", tmp_path)
    assert {type(sheet) for sheet in Air(scene).sheets} == {Sheet}
    check(scene, boxes, 1e-3)


def test_rectangles_of_one_medium_at_one_place(tmp_path, monkeypatch):
    """Of one size, so that Mitsuba merges what faces each other."""
    monkeypatch.setattr(f"{__name__}.SHRINK", 1.0)
    boxes = ARRANGEMENTS["one medium"]
    scene = build(boxes, "rectangles", tmp_path)
    assert len(scene.shapes()) == 1 and len(Air(scene).sheets) == 4
    check(scene, boxes, 1e-3)


@pytest.mark.parametrize("surface", ["null", "diffuse"])
@pytest.mark.parametrize("kind", ["sphere", "rectangle", "cylinder", "disk", "cube"])
def test_a_shape_elsewhere_changes_nothing(kind, surface, tmp_path):
    place = mi.ScalarTransform4f().translate([0, 500, 0])
    other = {"type": kind, "to_world": place, "bsdf": {"type": surface}}
    if surface == "null":
        other["interior"] = {"type": "ref", "id": "dense"}
    boxes = ARRANGEMENTS["three"]
    check(build(boxes, "cube", tmp_path, other), boxes)


def test_spheres_nest_and_touch():
    """Of radius 40 and 20 about 100 m, the second one mirrored; a third touches from outside."""
    scene = {"type": "scene"}
    for name, extinction in EXTINCTION.items():
        scene[name] = {"type": "homogeneous", "sigma_t": extinction}
    null = {"type": "sphere", "bsdf": {"type": "null"}}
    at = mi.ScalarTransform4f().translate
    for number, (x, size, name) in enumerate(
        [(100, [40] * 3, "low"), (100, [-20, 20, 20], "high"), (150, [10] * 3, "dense")]
    ):
        place = at([x, 0, 0]).scale(size)
        scene[f"sphere{number}"] = {
            **null,
            "to_world": place,
            "interior": {"type": "ref", "id": name},
        }
    scene = mi.load_dict(scene)
    assert {type(body) for body in Air(scene).bodies} == {Sphere}
    origin, direction, _ = lines()

    def chord(x, radius):
        offset = np.array([x, 0, 0]) - origin.astype(float)
        middle = (offset * direction).sum(1)
        return 2 * np.sqrt(
            np.maximum(radius**2 - ((offset - middle[:, None] * direction) ** 2).sum(1), 0)
        )

    outer, inner, third = chord(100, 40), chord(100, 20), chord(150, 10)
    truth = EXTINCTION["low"] * (outer - inner) + EXTINCTION["high"] * inner
    truth += EXTINCTION["dense"] * third
    found = depth(scene, origin, direction, 400.0)
    np.testing.assert_allclose(found, truth, rtol=0, atol=1e-4)


def test_an_opaque_surface_ends_all_light(tmp_path):
    boxes = ARRANGEMENTS["touching"]
    wall = {
        "type": "rectangle",
        "to_world": mi.ScalarTransform4f().translate([90, 0, 0]).rotate([0, 1, 0], 90).scale(1e3),
        "bsdf": {"type": "diffuse"},
    }
    scene = build(boxes, "cube", tmp_path, wall)
    origin, direction, _ = lines()
    value = np.exp(-depth(scene, origin, direction, 85.0))
    truth = expected(boxes, origin.astype(float), direction.astype(float), 85.0)
    np.testing.assert_allclose(value[1::2], np.exp(-truth[1::2]), rtol=1e-5)
    with np.errstate(divide="ignore"):
        assert np.isinf(depth(scene, origin, direction, 120.0)).all()


@pytest.mark.parametrize("outside", [None, "high"])
def test_a_mesh_with_a_cavity(outside, tmp_path):
    """In which is the exterior medium, or none."""
    scene = {
        "type": "scene",
        **{k: {"type": "homogeneous", "sigma_t": v} for k, v in EXTINCTION.items()},
        "shell": {
            "type": "ply",
            "filename": box_file(tmp_path, 0.5),
            "to_world": mi.ScalarTransform4f().translate([100, 0, 0]).scale(40),
            "bsdf": {"type": "null"},
            "interior": {"type": "ref", "id": "low"},
            **({"exterior": {"type": "ref", "id": outside}} if outside else {}),
        },
    }
    boxes = [(60, 80, "low"), (120, 140, "low")]
    boxes += [(80, 120, outside)] if outside else []
    check(mi.load_dict(scene), boxes)


def test_shapes_with_one_medium_on_both_sides_change_nothing(tmp_path):
    boxes = [(50, 150, "low")]
    inner = {
        "type": "cube",
        "to_world": mi.ScalarTransform4f().translate([100, 0, 0]).scale(10),
        "bsdf": {"type": "null"},
        "interior": {"type": "ref", "id": "low"},
        "exterior": {"type": "ref", "id": "low"},
    }
    check(build(boxes, "cube", tmp_path, inner), boxes)


def test_kinds_of_shapes(tmp_path):
    boxes = ARRANGEMENTS["one"]
    for kind, body in (("cube", Cube), ("mirrored", Cube), ("mesh", Closed)):
        air = Air(build(boxes, kind, tmp_path))
        assert [type(b) for b in air.bodies] == [body]
        assert air.bodies[0].volume == pytest.approx(40 * 80 * 80, rel=1e-5)
