"""Scenes that nature does not have are refused: when they are loaded, rendered or updated.

Detects: a coefficient, albedo, weight, transform or instrument out of its range that renders to
NaN, negative or merely wrong light; a check that is left out after an update, or made again
without one.
"""

import math

import mitsuba as mi
import numpy as np
import pytest

pytestmark = pytest.mark.usefixtures("variant")

NAN = math.nan
LOW, HIGH = (498.0, -65.0, -45.0), (506.0, 65.0, 45.0)


def scene(world, environment=None, values=1e-3, place=None, **sensor):
    """Four beams into a slab in an environment."""
    air = world.homogeneous(1e-4) | (environment or {})
    grid = world.grid(np.broadcast_to(values, (3, 4, 5)), LOW, HIGH)
    if place is not None:
        grid["sigma_t"]["to_world"] = mi.ScalarTransform4f(place)
    return world.scene(
        world.lidar((1, 1), (500.0, 502.5), environment=world.ENVIRONMENT, samples=8, **sensor),
        environment=air,
        slab=world.box(LOW, HIGH, grid, world.ENVIRONMENT),
    )


def refusal(function, *arguments):
    """The line by which a scene is refused, however deep Mitsuba buries it."""
    with pytest.raises((RuntimeError, ValueError)) as error:
        function(*arguments)
    causes = [error.value, error.value.__cause__]
    lines = [line for cause in causes if cause for line in str(cause).splitlines()]
    (line,) = {line.split("ValueError: ")[-1] for line in lines if "is not allowed" in line}
    return line


def cell(value):
    values = np.full((3, 4, 5), 1e-3)
    values[1, 2, 3] = value
    return values


@pytest.mark.parametrize("variant", ["llvm_ad_mono_polarized", "llvm_ad_rgb"], indirect=True)
@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"environment": {"sigma_t": -1.0}}, "environment.sigma_t.value.value: -1.0 is not"),
        ({"environment": {"sigma_t": NAN}}, "environment.sigma_t.value.value: nan is not allowed"),
        ({"environment": {"albedo": -1.0}}, "environment.albedo.value.value: -1.0 is not allowed"),
        ({"environment": {"albedo": 2.0}}, "expected 0 to 1"),
        ({"environment": {"scale": -1.0}}, "environment.scale: -1.0 is not allowed; expected fin"),
        ({"values": cell(NAN)}, "slab.interior_medium.sigma_t.data: nan is not allowed"),
        ({"values": cell(-2.0)}, "slab.interior_medium.sigma_t.data: -2.0 is not allowed"),
        ({"place": np.diag([NAN, 1, 1, 1])}, "slab.interior_medium.sigma_t.data: 'Boun"),
    ],
)
def test_unphysical_air_is_refused(world, variant, changes, says):
    loaded = scene(world, **changes)
    line = refusal(mi.render, loaded)
    assert line.startswith("gated_volpath.") and says in line and "; expected " in line


def test_blend_beyond_its_parts_is_refused(world):
    part = {"type": "rayleigh_polarized"}
    blend = {"type": "blendphase", "weight": 2.0, "one": part, "other": part}
    line = refusal(mi.render, scene(world, {"phase": blend}))
    assert "environment.phase_function.weight.value.value: 2.0 is not allowed; expected 0" in line


@pytest.mark.parametrize(
    ("name", "value", "says"),
    [
        ("environment.sigma_t.value.value", -1.0, "gated_volpath.environment.sigma_t"),
        ("slab.interior_medium.albedo.value.value", 2.0, "gated_volpath.slab.interior_medium.alb"),
        ("slab.interior_medium.sigma_t.data", cell(NAN)[..., None], "interior_medium.sigma_t.data"),
        ("slab.vertex_positions", np.full(72, NAN), "gated_volpath.slab: "),
        ("sensor.aperture_radius", NAN, "scanning_lidar.aperture_radius: nan is not allowed"),
        ("sensor.aperture_radius", -0.5, "scanning_lidar.aperture_radius: -0.5 is not allowed"),
        ("sensor.gate_start", NAN, "scanning_lidar.gate_start: nan is not allowed"),
        ("sensor.to_world", [NAN, 0, 0], "scanning_lidar.to_world: "),
    ],
)
def test_updates_are_checked(world, name, value, says):
    """A scene that has rendered well, and then is given something else."""
    loaded = scene(world)
    assert np.isfinite(np.array(mi.render(loaded))).all()
    parameters = mi.traverse(loaded)
    if name.endswith("to_world"):
        parameters[name] = mi.Transform4f().translate(value)
    elif np.ndim(value) > 1:
        parameters[name] = mi.TensorXf(np.asarray(value, np.float32))
    else:
        parameters[name] = mi.Float(np.asarray(value, np.float32))

    def update():
        parameters.update()
        mi.render(loaded)

    assert says in refusal(update)


def test_a_scene_that_is_mended_renders_again(world):
    loaded = scene(world)
    first = np.array(mi.render(loaded, seed=1))
    parameters = mi.traverse(loaded)
    for extinction in (-1.0, 1e-4):
        parameters["environment.sigma_t.value.value"] = extinction
        parameters.update()
        if extinction < 0:
            refusal(mi.render, loaded)
    np.testing.assert_array_equal(np.array(mi.render(loaded, seed=1)), first)


def test_passed_arrays_are_not_checked_again(world, monkeypatch):
    """Every array once; then that which is replaced, also where its values stay the same."""
    loaded = scene(world)
    physical = loaded.integrator().physical
    looked, check_values = [], physical.check_values
    monkeypatch.setattr(
        physical,
        "check_values",
        lambda name, *more: (looked.append(name), check_values(name, *more)),
    )
    mi.render(loaded)
    assert "slab.interior_medium.sigma_t.data" in looked and "environment.scale" in looked
    for replaced in (False, True, False):
        looked.clear()
        if replaced:
            parameters = mi.traverse(loaded)
            parameters["slab.interior_medium.sigma_t.data"] = mi.TensorXf(
                np.full((3, 4, 5, 1), 1e-3, np.float32)
            )
            parameters.update()
        mi.render(loaded)
        assert looked == ["slab.interior_medium.sigma_t.data"] * replaced


def shifted(*way):
    matrix = np.eye(4)
    matrix[:3, 3] = way
    return matrix


@pytest.mark.parametrize("kind", ["scanning_lidar", "laser", "plane_waves", "ccd"])
@pytest.mark.parametrize(
    "place",
    [
        shifted(NAN, 0, 0),
        shifted(0, math.inf, 0),
        np.diag([2.0, 2, 2, 1]),
        np.diag([1.0, 1, -1, 1]),
        np.diag([1.0, 1e-6, 1, 1]),
    ],
    ids=["NaN", "infinite", "stretched", "mirrored", "flat"],
)
def test_poses_are_rotations_and_translations_only(kind, place):
    film = {"type": "hdrfilm", "width": 1, "height": 1, "rfilter": {"type": "box"}}
    own = {
        "scanning_lidar": {"gate_start": 5.0, "gate_stop": 6.0, "laser": {"type": "laser"}},
        "plane_waves": {"line": {"type": "spectral_line"}},
    }.get(kind, {})
    film = {"film": film} if kind in ("scanning_lidar", "ccd") else {}
    turned = mi.ScalarTransform4f().rotate([0, 0, 1], 30).translate([1, 2, 3])
    assert mi.load_dict({"type": kind, "to_world": turned, **own, **film}) is not None
    bad = mi.ScalarTransform4f(place)
    line = refusal(mi.load_dict, {"type": kind, "to_world": bad, **own, **film})
    assert line.startswith(f"{kind}.to_world: ") and "expected a rotation and a trans" in line


@pytest.mark.parametrize(
    ("plugin", "changes"),
    [
        ("laser", {"beam_radius": 1e-60}),
        ("laser", {"beam_radius": 1e60}),
        ("laser", {"beam_cut": NAN}),
        ("laser", {"divergence_full_mrad": 1e60}),
        ("laser", {"wavelength": 1e-60}),
        ("laser", {"pulse_duration": NAN}),
        ("ccd", {"focal_length": 1e-60}),
        ("ccd", {"centre_x": 1e60}),
        ("spectral_line", {"wavelength": 1e60}),
        ("spectral_line", {"v_los": 1e60}),
        ("etalon", {"gap": 1e60, "line": {"type": "spectral_line"}}),
        ("etalon", {"bow": NAN, "line": {"type": "spectral_line"}}),
        ("etalon", {"reflectivity": NAN, "line": {"type": "spectral_line"}}),
        ("plane_waves", {"field_half_mrad": NAN, "line": {"type": "spectral_line"}}),
        ("rayleigh_polarized", {"depolarization": NAN}),
        ("gated_volpath", {"samples_per_pass": 2**31}),
        ("gated_volpath", {"max_order": 2**31}),
        ("fringes", {"samples_per_pass": 2**31}),
    ],
    ids=str,
)
def test_numbers_that_single_precision_loses_are_refused(plugin, changes):
    """1e-60 would be 0 in a kernel, 1e60 infinite, and their squares are the smaller ranges."""
    field = next(iter(changes))
    film = {"type": "hdrfilm", "width": 1, "height": 1, "rfilter": {"type": "box"}}
    film = {"film": film} if plugin == "ccd" else {}
    line = refusal(mi.load_dict, {"type": plugin, **changes, **film})
    assert line.startswith(f"{plugin}.{field}: ") and "; expected " in line


def test_images_beyond_32_bits_are_refused(world):
    """2^32 values and more wrapped around, or ended the process."""
    film = {"type": "hdrfilm", "width": 300, "height": 300, "rfilter": {"type": "box"}}
    loaded = scene(world, gate_count=10_000, film=film, azimuth_max_deg=1.0, elevation_max_deg=1.0)
    line = refusal(mi.render, loaded)
    assert "gated_volpath.gate_count: 10000 is not allowed; expected at most 9544 with" in line
