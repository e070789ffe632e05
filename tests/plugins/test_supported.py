"""What Mitsuba's scene interface offers beside the lidar, row by row: honoured or refused.

Detects: a film, sampler, source of light, surface or shape that is ignored without a word; a
parameter of a medium, volume or shape that does not do what Mitsuba says; an update through
``mi.traverse`` that leaves another image than the scene made anew.
"""

import re
from typing import NamedTuple

import mitsuba as mi
import numpy as np
import pytest

from tests.support.meshes import box_file

pytestmark = pytest.mark.usefixtures("variant")

AIR = {"type": "ref", "id": "air"}
NULL = {"type": "null"}


class Place(NamedTuple):
    """Of a box: its middle and half of its length along x."""

    x: float = 60.0
    half: float = 20.0

    def transform(self):
        return mi.ScalarTransform4f().translate([self.x, 0, 0]).scale([self.half, 30, 30])


class Facing(NamedTuple):
    """Of a rectangle whose normal points to the telescope: its place."""

    x: float

    def transform(self):
        return mi.ScalarTransform4f().translate([self.x, 0, 0]).rotate([0, 1, 0], -90).scale(25)


def made(description):
    """With transforms and tensors, which need a variant, in place of what stands for them."""
    if isinstance(description, dict):
        return {key: made(value) for key, value in description.items()}
    if isinstance(description, Place | Facing):
        return description.transform()
    return mi.TensorXf(np.array(description)) if isinstance(description, list) else description


def air(**parameters):
    phase = {"type": "rayleigh_polarized"}
    return {"type": "homogeneous", "sigma_t": 5e-3, "albedo": 1.0, "phase": phase, **parameters}


def slab(**parameters):
    return {"type": "cube", "to_world": Place(), "bsdf": NULL, "interior": AIR, **parameters}


def lidar(film=None, **parameters):
    return {
        "type": "scanning_lidar",
        "gate_start": 45.0,
        "gate_stop": 75.0,
        "gate_count": 2,
        "aperture_radius": 0.2,
        "laser": {"type": "laser", "beam_cut": 0.02, "beam_radius": 0.02},
        "film": {
            "type": "hdrfilm",
            "width": 1,
            "height": 1,
            "rfilter": {"type": "box"},
            **(film or {}),
        },
        **parameters,
    }


def scene(medium=None, sensor=None, **shapes):
    return {
        "type": "scene",
        "integrator": {"type": "gated_volpath"},
        "air": medium or air(),
        "lidar": sensor or lidar(),
        **(shapes or {"slab": slab()}),
    }


def image(description, **options):
    loaded = mi.load_dict(made(description)) if isinstance(description, dict) else description
    return np.array(mi.render(loaded, **{"spp": 400, **options}), float).reshape(-1, 5)


def assert_same(one, other):
    """Of the same random numbers: equal but for rounding."""
    assert (one[:, 0] > 0).all()
    np.testing.assert_allclose(one, other, rtol=2e-3, atol=2e-3 * np.abs(other).max())


def assert_within_errors(one, other):
    error = np.hypot(one[:, 4], other[:, 4])
    assert (one[:, 4] > 0).all() and (np.abs(one[:, 0] - other[:, 0]) < 5 * error).all()


# --- refused ---------------------------------------------------------------------------------

DIFFUSE = {"type": "diffuse"}
REFUSED = {
    "crop": (
        scene(sensor=lidar({"width": 2, "crop_width": 1, "crop_offset_x": 1}, azimuth_max_deg=1.0)),
        "film.crop",
    ),
    "border": (scene(sensor=lidar({"sample_border": True})), "film.sample_border"),
    "filter": (scene(sensor=lidar({"rfilter": {"type": "tent"}})), "film.rfilter"),
    "wide filter": (
        scene(sensor=lidar({"rfilter": {"type": "gaussian", "stddev": 2.0}})),
        "film.rfilter",
    ),
    **{
        kind: (scene(sensor=lidar(sampler={"type": kind, "sample_count": 16})), "sampler")
        for kind in ("stratified", "multijitter", "orthogonal", "ldsampler")
    },
    "sampler's seed": (scene(sensor=lidar(sampler={"type": "independent", "seed": 3})), "seed"),
    "shutter": (scene(sensor=lidar(shutter_close=0.1)), "shutter"),
    "constant light": (scene(slab=slab(), sky={"type": "constant"}), "emitter"),
    "point": (scene(slab=slab(), lamp={"type": "point"}), "emitter"),
    "laser": (scene(slab=slab(), lamp={"type": "laser"}), "emitter"),
    "area light": (
        scene(slab=slab(), lamp={"type": "rectangle", "light": {"type": "area"}}),
        "emitter",
    ),
    **{
        f"bsdf {bsdf['type']}": (scene(slab=slab(bsdf=bsdf)), "bsdf")
        for bsdf in (
            {"type": "mask", "opacity": 0.5, "of": DIFFUSE},
            {"type": "mask", "opacity": {"type": "checkerboard"}, "of": DIFFUSE},
            {"type": "blendbsdf", "weight": 0.5, "a": NULL, "b": DIFFUSE},
            {"type": "thindielectric"},
            {"type": "dielectric"},
            {"type": "roughdielectric"},
            {"type": "diffuse"},
        )
    },
    "instance": (
        scene(
            group={"type": "shapegroup", "of": slab()},
            one={"type": "instance", "of": {"type": "ref", "id": "group"}},
        ),
        "instance",
    ),
    "ellipsoids": (
        scene(
            slab=slab(),
            one={
                "type": "ellipsoids",
                "centers": [[60.0, 0.0, 0.0]],
                "scales": [[10.0, 10.0, 10.0]],
                "quaternions": [[0.0, 0.0, 0.0, 1.0]],
                "bsdf": NULL,
                "interior": AIR,
            },
        ),
        "Ellipsoids",
    ),
    "another medium around the telescope": (
        scene(sensor=lidar(medium=air(sigma_t=1e-3)), slab=slab(to_world=Place(40, 60))),
        r"scanning_lidar\.medium",
    ),
    "another medium around a shape": (scene(slab=slab(exterior=air(sigma_t=1e-3))), "exterior"),
    "flipped normals": (scene(slab=slab(flip_normals=True)), "exterior"),
    "a rectangle that is turned": (
        scene(one={"type": "rectangle", "to_world": Facing(60.0), "bsdf": NULL, "exterior": AIR}),
        "one.exterior",
    ),
    "hg too sharp": (scene(air(phase={"type": "hg", "g": 0.999})), r"phase_function\.g"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_refused(name):
    description, says = REFUSED[name]
    with pytest.raises(RuntimeError) as error:
        image(description)
    last = str(error.value.__cause__ or error.value).strip().splitlines()[-1]
    assert re.search(rf"{says}.* is not allowed; expected ", last), last


@pytest.mark.parametrize("name", ["near_clip", "far_clip", "fov", "focus_distance"])
def test_parameters_of_cameras_are_unknown(name):
    with pytest.raises(RuntimeError, match=name):
        mi.load_dict(made(lidar(**{name: 1.0})))


# --- honoured: film, sampler, mi.render --------------------------------------------------------


def test_samples_and_seeds_are_those_of_sampler_or_call():
    given = scene(sensor=lidar(sampler={"type": "independent", "sample_count": 400}))
    np.testing.assert_array_equal(image(given, spp=0), image(scene(), spp=400))
    assert (image(scene(), seed=1) != image(scene(), seed=2))[:, 0].all()


def test_formats_of_the_film_do_not_change_the_tensor():
    other = lidar({"pixel_format": "rgb", "component_format": "float16", "file_format": "pfm"})
    np.testing.assert_array_equal(image(scene(sensor=other)), image(scene()))


def test_one_of_several_sensors_and_another_integrator():
    wide = lidar(aperture_radius=0.4)
    both = mi.load_dict(made(scene(slab=slab(), second=wide)))
    alone = image(scene(sensor=wide))
    assert_same(image(both, sensor=1), alone)
    assert_same(image(both, sensor=both.sensors()[1]), alone)
    twice = mi.load_dict({"type": "gated_volpath", "max_order": 2, "orders": True})
    channels = np.array(mi.render(both, integrator=twice, spp=16)).size
    assert channels == 2 * 7


# --- honoured: media, shapes -------------------------------------------------------------------

# scenes that are to give the same image, from the same random numbers
PAIRS = {
    "scale": (scene(air(sigma_t=2.5e-3, scale=2.0)), scene()),
    "sample_emitters": (scene(air(sample_emitters=False)), scene()),
    "constvolume": (scene(air(sigma_t={"type": "constvolume", "value": 5e-3})), scene()),
    "mirrored": (scene(slab=slab(to_world=Place(60, -20))), scene()),
    "inside out": (
        scene(
            slab={k: v for k, v in slab(flip_normals=True, exterior=AIR).items() if k != "interior"}
        ),
        scene(),
    ),
    "one medium on both sides": (
        scene(
            lidar=lidar(medium=AIR), around=slab(to_world=Place(0, 200)), slab=slab(exterior=AIR)
        ),
        scene(around=slab(to_world=Place(0, 200))),
    ),
    "telescope in a shape, no medium stated": (
        scene(around=slab(to_world=Place(40, 60))),
        scene(sensor=lidar(medium=AIR), around=slab(to_world=Place(40, 60))),
    ),
    "touching": (
        scene(front=slab(to_world=Place(50, 10)), back=slab(to_world=Place(70, 10))),
        scene(),
    ),
    "touching, medium stated twice": (
        scene(
            front=slab(to_world=Place(50, 10), exterior=AIR),
            back=slab(to_world=Place(70, 10), exterior=AIR),
        ),
        scene(),
    ),
    "a hole that a smaller shape fills": (
        scene(slab=slab(), hole=slab(to_world=Place(60, 5))),
        scene(),
    ),
    "black wall": (scene(slab=slab(), wall={"type": "cube", "to_world": Place(500)}), scene()),
    "merge": (
        scene(
            merged={
                "type": "merge",
                "front": slab(to_world=Place(50, 10)),
                "back": slab(to_world=Place(70, 10)),
            }
        ),
        scene(),
    ),
    "ends at the gate's end": (scene(slab=slab(to_world=Place(57.5, 17.5))), scene()),
}


@pytest.mark.parametrize("name", PAIRS)
def test_same_image(name):
    one, other = PAIRS[name]
    assert_same(image(one), image(other))


def test_mesh_and_rectangles_are_the_cube(tmp_path):
    mesh = {"type": "ply", "filename": box_file(tmp_path), "bsdf": NULL, "interior": AIR}
    assert_same(image(scene(mesh={**mesh, "to_world": Place()})), image(scene()))
    turned = mi.ScalarTransform4f().rotate([0, 1, 0], 90).scale(30)
    move = mi.ScalarTransform4f().translate
    faces = {
        "far": move([80, 0, 0]) @ turned,
        "near": move([40, 0, 0]) @ turned @ mi.ScalarTransform4f().rotate([0, 1, 0], 180),
    }
    faces = {
        name: {"type": "rectangle", "to_world": at, "bsdf": NULL, "interior": AIR}
        for name, at in faces.items()
    }
    assert_same(image(scene(**faces)), image(scene()))


@pytest.mark.parametrize("variant", ["llvm_ad_rgb", "llvm_ad_spectral_polarized"], indirect=True)
def test_chromatic_media_have_the_value_at_the_laser_line(variant):
    """Green of 532 nm; in spectral variants a spectrum linear between 400 and 700 nm."""
    if variant == "llvm_ad_rgb":
        colours = {"type": "rgb", "value": [1e-3, 5e-3, 9e-3]}
    else:
        slope = 5e-3 / 532
        colours = {"type": "spectrum", "value": [(nm, slope * nm) for nm in (400, 700)]}
    chromatic = scene(air(sigma_t=colours, albedo={"type": "uniform", "value": 1.0}))
    chromatic["air"]["sigma_t"] = colours
    assert_same(image_of_colours(chromatic), image(scene()))


def image_of_colours(description):
    """Lists of colours stay lists."""
    colours = description["air"].pop("sigma_t")
    built = made(description)
    built["air"]["sigma_t"] = colours
    return np.array(mi.render(mi.load_dict(built), spp=400), float).reshape(-1, 5)


# --- honoured: volumes ---------------------------------------------------------------------------


def grid(cells, low=40.0, high=80.0, **parameters):
    """Extinction in equal cells along x."""
    data = np.array(cells, np.float32).reshape(1, 1, -1, 1)
    at = mi.ScalarTransform4f().translate([low, -30, -30]).scale([high - low, 60, 60])
    volume = {"type": "gridvolume", "data": mi.TensorXf(data), "to_world": at, **parameters}
    return {**air(), "type": "heterogeneous", "sigma_t": volume}


def layers(*extinctions):
    """The same as homogeneous boxes that touch."""
    width = 40 / len(extinctions)
    shapes = {}
    for number, extinction in enumerate(extinctions):
        at = Place(40 + width * (number + 0.5), width / 2)
        shapes[f"layer{number}"] = slab(to_world=at, interior=air(sigma_t=extinction))
    return scene(**shapes)


@pytest.mark.parametrize(
    ("volume", "extinctions"),
    [
        ((([1e-3, 9e-3]), {"filter_type": "nearest"}), (1e-3, 9e-3)),
        (
            (([1e-3, 9e-3], 40, 60), {"filter_type": "nearest", "wrap_mode": "clamp"}),
            (1e-3, 9e-3, 9e-3, 9e-3),
        ),
        (
            (([1e-3, 9e-3], 40, 60), {"filter_type": "nearest", "wrap_mode": "repeat"}),
            (1e-3, 9e-3, 1e-3, 9e-3),
        ),
        (
            (([1e-3, 9e-3], 40, 60), {"filter_type": "nearest", "wrap_mode": "mirror"}),
            (1e-3, 9e-3, 9e-3, 1e-3),
        ),
    ],
    ids=["nearest", "clamp", "repeat", "mirror"],
)
def test_grids_are_layers(volume, extinctions):
    arguments, parameters = volume
    arguments = arguments if isinstance(arguments, tuple) else (arguments,)
    found = image(scene(grid(*arguments, **parameters)), spp=4000)
    assert_within_errors(found, image(layers(*extinctions), spp=4000))


def test_albedo_of_a_grid():
    albedo = mi.TensorXf(np.full((1, 1, 2, 1), 0.4, np.float32))
    at = mi.ScalarTransform4f().translate([40, -30, -30]).scale([40, 60, 60])
    volume = {"type": "gridvolume", "data": albedo, "to_world": at}
    one = image(scene({**grid([5e-3, 5e-3]), "albedo": volume}))
    assert_within_errors(one, image(scene(air(albedo=0.4))))


# --- honoured: mi.traverse -----------------------------------------------------------------------

UPDATES = {
    "sigma_t": (air(), "air.sigma_t.value.value", 8e-3, air(sigma_t=8e-3)),
    "scale": (air(), "air.scale", 2.0, air(scale=2.0)),
    "albedo": (air(), "air.albedo.value.value", 0.5, air(albedo=0.5)),
    "depolarization": (
        air(),
        "air.phase_function.depolarization",
        0.1,
        air(phase={"type": "rayleigh_polarized", "depolarization": 0.1}),
    ),
}


@pytest.mark.parametrize("name", UPDATES)
def test_updates_of_media(name):
    before, key, value, after = UPDATES[name]
    loaded = mi.load_dict(made(scene(before)))
    image(loaded)
    parameters = mi.traverse(loaded)
    parameters[key] = value
    parameters.update()
    assert_same(image(loaded), image(scene(after)))


@pytest.mark.parametrize("cells", [[4e-3, 8e-3], [2e-3, 9e-3, 1e-3]])
def test_updates_of_grids(cells):
    loaded = mi.load_dict(made(scene(grid([1e-3, 1e-3]))))
    image(loaded)
    parameters = mi.traverse(loaded)
    data = np.array(cells, np.float32).reshape(1, 1, -1, 1)
    parameters["air.sigma_t.data"] = mi.TensorXf(data)
    parameters.update()
    assert_same(image(loaded), image(scene(grid(cells))))


def test_a_shape_that_moves():
    loaded = mi.load_dict(made(scene()))
    image(loaded)
    parameters = mi.traverse(loaded)
    corners = np.array(parameters["slab.vertex_positions"]).reshape(-1, 3)
    corners[:, 0] += 10
    parameters["slab.vertex_positions"] = mi.Float(corners.ravel())
    parameters.update()
    assert_same(image(loaded), image(scene(slab=slab(to_world=Place(70)))))


@pytest.mark.parametrize("kind", ["sphere", "rectangle", "ply"])
def test_other_shapes_that_move(kind, tmp_path):
    """Made at 60 m and moved to 70 m, or made there; behind the rectangle is air."""
    more = {"filename": box_file(tmp_path)} if kind == "ply" else {}

    def at(x):
        turned = mi.ScalarTransform4f().translate([x, 0, 0])
        turned = turned.rotate([0, 1, 0], -90 if kind == "rectangle" else 0).scale(25)
        sides = {"bsdf": NULL, "interior": AIR}
        return scene(one={"type": kind, "to_world": turned, **sides, **more})

    loaded = mi.load_dict(made(at(60)))
    image(loaded)
    parameters = mi.traverse(loaded)
    if kind == "ply":
        corners = np.array(parameters["one.vertex_positions"]).reshape(-1, 3)
        corners[:, 0] += 10
        parameters["one.vertex_positions"] = mi.Float(corners.ravel())
    else:
        moved = mi.ScalarTransform4f().translate([10, 0, 0]) @ at(60)["one"]["to_world"]
        parameters["one.to_world"] = mi.Transform4f(np.array(moved.matrix, np.float32))
    parameters.update()
    one, other = image(loaded), image(at(70))
    np.testing.assert_allclose(one, other, rtol=2e-3, atol=2e-3 * other.max())
    assert other.any()


@pytest.mark.parametrize("kind", ["cube", "ply"])
def test_moving_a_shape_compiles_nothing(kind, tmp_path):
    import drjit as dr

    more = {"filename": box_file(tmp_path)} if kind == "ply" else {}
    loaded = mi.load_dict(made(scene(slab=slab(type=kind, **more))))
    parameters = mi.traverse(loaded)
    compiled = []
    for shift in (0, 5, 7):
        corners = np.array(parameters["slab.vertex_positions"]).reshape(-1, 3)
        corners[:, 0] += shift
        parameters["slab.vertex_positions"] = mi.Float(corners.ravel())
        parameters.update()
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
            image(loaded)
            history = dr.kernel_history([dr.KernelType.JIT])
        compiled.append(sum(not kernel["cache_hit"] for kernel in history))
    assert compiled[-1] == 0
