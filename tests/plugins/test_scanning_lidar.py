"""The scanning lidar's beams, gates, telescope and their errors.

Detects: an axis swapped or mirrored, an angle off by 1e-6 rad, a gate edge off by 1e-6, a
telescope disc that is not filled evenly (Kolmogorov-Smirnov, 0.5 %).
"""

import math

import mitsuba as mi
import numpy as np
import pytest
from scipy.stats import kstest, uniform

pytestmark = pytest.mark.usefixtures("variant")

GATE = (500.0, 502.5)


def directions(sensor):
    return np.array(mi.traverse(sensor)["directions"]).reshape(-1, 3).astype(float)


def beams(number):
    return mi.UInt32(np.arange(number, dtype=np.uint32))


class TestWherePixelsLook:
    def test_angles_are_equidistant_with_both_ends_top_left_first(self, world):
        sensor = mi.load_dict(
            world.lidar(
                (5, 3),
                GATE,
                azimuth_min_deg=-6.2,
                azimuth_max_deg=6.2,
                elevation_min_deg=-1.0,
                elevation_max_deg=3.9,
            )
        )
        found = directions(sensor).reshape(3, 5, 3)
        azimuth = np.degrees(np.arctan2(found[..., 1], found[..., 0]))
        elevation = np.degrees(np.arctan2(found[..., 2], found[..., 0]))
        assert azimuth == pytest.approx(np.tile([6.2, 3.1, 0, -3.1, -6.2], (3, 1)), abs=1e-5)
        expected = np.repeat([[3.9], [1.45], [-1.0]], 5, 1)
        assert elevation == pytest.approx(expected, abs=1e-5)
        assert np.linalg.norm(found, axis=-1) == pytest.approx(1, abs=1e-7)

    def test_single_pixel_points_to_the_middle_of_the_angles(self, world):
        sensor = mi.load_dict(
            world.lidar(
                (1, 1),
                GATE,
                azimuth_min_deg=2.0,
                azimuth_max_deg=4.0,
                elevation_max_deg=-1.0,
                elevation_min_deg=-5.0,
            )
        )
        (x, y, z) = directions(sensor)[0]
        assert math.degrees(math.atan2(y, x)) == pytest.approx(3, abs=1e-5)
        assert math.degrees(math.atan2(z, x)) == pytest.approx(-3, abs=1e-5)

    def test_without_angles_a_single_pixel_points_straight_ahead(self, world):
        assert directions(mi.load_dict(world.lidar((1, 1), GATE)))[0] == pytest.approx([1, 0, 0])

    @pytest.mark.parametrize("row", [0, 2])
    @pytest.mark.parametrize("column", [0, 3])
    def test_a_cloud_is_imaged_by_the_pixel_that_points_at_it(self, world, row, column):
        """Largest elevation in the top row, largest azimuth in the left column, in the image."""
        azimuth = np.radians(np.linspace(4, -4, 4))[column]
        elevation = np.radians(np.linspace(3, -3, 3))[row]
        centre = 501.25 * np.array([1, math.tan(azimuth), math.tan(elevation)])
        scene = world.scene(
            world.lidar(
                (4, 3),
                GATE,
                azimuth_min_deg=-4.0,
                azimuth_max_deg=4.0,
                elevation_min_deg=-3.0,
                elevation_max_deg=3.0,
            ),
            cloud=world.box(centre - 4, centre + 4, world.homogeneous(1e-3)),
        )
        stokes, _ = world.render(scene)
        lit = stokes[0, 0] > 0
        assert lit.sum() == 1 and lit[row, column]

    @pytest.mark.parametrize("kind", ["tensor", "file.npy", "file.txt"])
    def test_direction_table(self, world, optics, tmp_path, kind):
        """Row by row from the top left, normalised."""
        rng = np.random.default_rng(1)
        table = optics.unit_vectors(rng, 6) * rng.uniform(0.1, 10, (6, 1))
        if kind == "tensor":
            source = mi.TensorXf(table)
        elif kind == "file.npy":
            source = str(tmp_path / kind)
            np.save(source, table)
        else:
            source = str(tmp_path / kind)
            np.savetxt(source, table, header="x y z")
        sensor = mi.load_dict(world.lidar((3, 2), GATE, directions=source, gate_kind="spherical"))
        assert np.abs(directions(sensor) - optics.normalized(table)).max() < 1e-6

    def test_sample_ray_is_along_the_beam_of_the_film_position(self, world):
        pose = mi.ScalarTransform4f().translate([10, -2, 3]).rotate([0, 0, 1], 30)
        sensor = mi.load_dict(
            world.lidar(
                (5, 3),
                GATE,
                azimuth_min_deg=-6.2,
                azimuth_max_deg=6.2,
                elevation_min_deg=-3.9,
                elevation_max_deg=3.9,
                to_world=pose,
            )
        )
        row, column = (i.ravel() for i in np.indices((3, 5)))
        # anywhere in the pixel, its corners included
        for dx, dy in [(0.5, 0.5), (0.001, 0.999)]:
            position = mi.Point2f(mi.Float((column + dx) / 5), mi.Float((row + dy) / 3))
            ray, weight = sensor.sample_ray(mi.Float(0), mi.Float(0.5), position, mi.Point2f(0.5))
            matrix = np.array(pose.matrix).astype(float)
            expected = directions(sensor) @ matrix[:3, :3].T
            assert np.abs(np.array(ray.d).T - expected).max() < 1e-6
            assert np.abs(np.array(ray.o).T - [10, -2, 3]).max() < 1e-6
            assert np.array(weight).max() == 1


class TestGates:
    def test_planar_gates_lie_between_planes(self, world):
        sensor = mi.load_dict(
            world.lidar((7, 1), GATE, azimuth_min_deg=-60.0, azimuth_max_deg=60.0)
        )
        axis = sensor.beam_frame(beams(7)).n
        low, high = (np.array(r).astype(float) for r in sensor.ranges(axis, mi.Point3f(0)))
        x = np.array(axis.x).astype(float)
        assert low * x == pytest.approx(500, rel=1e-6) and high * x == pytest.approx(
            502.5, rel=1e-6
        )
        origins, (near, far) = sensor.origins_and_ranges()
        assert not origins.any()
        assert near.min() == pytest.approx(500, rel=1e-6)
        assert far.max() == pytest.approx(502.5 / math.cos(math.radians(60)), rel=1e-6)

    def test_spherical_gates_have_one_range(self, world):
        sensor = mi.load_dict(
            world.lidar(
                (7, 1), GATE, azimuth_min_deg=-60.0, azimuth_max_deg=60.0, gate_kind="spherical"
            )
        )
        low, high = sensor.ranges(sensor.beam_frame(beams(7)).n, mi.Point3f(0))
        assert (np.array(low) == 500).all() and (np.array(high) == 502.5).all()
        assert (sensor.origins_and_ranges()[1].T == (500, 502.5)).all()


class TestTelescope:
    def test_disc_is_filled_evenly_across_the_beam(self, world):
        number = 200_000
        rng = np.random.default_rng(3)
        sensor = mi.load_dict(
            world.lidar(
                (1, 1), GATE, aperture_radius=0.7, azimuth_min_deg=20.0, azimuth_max_deg=20.0
            )
        )
        frame = sensor.beam_frame(mi.UInt32(0))
        sample = mi.Point2f(mi.Float(rng.random(number)), mi.Float(rng.random(number)))
        point = np.array(sensor.sample_aperture(frame, sample)).astype(float)
        across, up, along = (np.array(v).ravel() @ point for v in (frame.s, frame.t, frame.n))
        assert np.abs(along).max() < 1e-6
        fraction = (across**2 + up**2) / 0.7**2
        assert kstest(fraction, uniform.cdf).pvalue > 1e-3
        assert kstest(np.arctan2(up, across), uniform(-np.pi, 2 * np.pi).cdf).pvalue > 1e-3
        assert np.array(sensor.aperture_area())[0] == pytest.approx(math.pi * 0.49, rel=1e-6)

    @pytest.mark.parametrize("half_mrad", [0.6, 5.0, 1400.0])
    def test_field_of_view_ends_at_its_half_angle(self, world, half_mrad):
        sensor = mi.load_dict(world.lidar((1, 1), GATE, fov_half_mrad=half_mrad))
        frame, tangent = sensor.beam_frame(mi.UInt32(0)), sensor.field_tangent(mi.UInt32(0))
        for fraction, observed in [(0.0, True), (0.999, True), (1.001, False)]:
            angle = fraction * half_mrad * 1e-3
            for azimuth in np.linspace(0, 2 * np.pi, 5):
                source = mi.Vector3f(
                    math.cos(angle),
                    math.sin(angle) * math.cos(azimuth),
                    math.sin(angle) * math.sin(azimuth),
                )
                # of any length
                assert (
                    np.array(sensor.in_field_of_view(frame, source * 500, tangent))[0] == observed
                )
        assert not np.array(sensor.in_field_of_view(frame, mi.Vector3f(-1, 0, 0), tangent))[0]


class TestUpdates:
    def slab(self, world, gate, position=0.0, **parameters):
        return world.scene(
            world.lidar(
                (3, 2),
                gate,
                environment=world.ENVIRONMENT,
                to_world=mi.ScalarTransform4f().translate([position, 0, 0]),
                **parameters,
            ),
            environment=world.homogeneous(1e-3),
            slab=world.box(
                [490, -60, -60], [510, 60, 60], world.homogeneous(5e-3), world.ENVIRONMENT
            ),
        )

    def test_changed_parameters_give_the_image_of_a_new_scene(self, world):
        angles = {"azimuth_min_deg": -4.0, "azimuth_max_deg": 4.0, "elevation_max_deg": 2.0}
        scene = self.slab(world, GATE, **angles)
        before, _ = world.render(scene, seed=1)
        other = {"azimuth_min_deg": -1.0, "azimuth_max_deg": 3.0, "elevation_max_deg": 1.0}
        wide = {"laser": {"type": "laser", "divergence_full_mrad": 20.0}, "fov_half_mrad": 7.0}
        receiver = {"aperture_radius": 0.3, **wide}
        expected_scene = self.slab(world, (485.0, 490.0), 15.0, **receiver, **other)
        expected, error = world.render(expected_scene, seed=1)

        parameters = mi.traverse(scene)
        parameters["sensor.directions"] = mi.traverse(expected_scene)["sensor.directions"]
        parameters["sensor.gate_start"] = 485.0
        parameters["sensor.gate_stop"] = 490.0
        parameters["sensor.aperture_radius"] = 0.3
        parameters["sensor.fov_half_mrad"] = 7.0
        parameters["sensor.laser.divergence_full_mrad"] = 20.0
        parameters["sensor.to_world"] = mi.Transform4f().translate([15, 0, 0])
        parameters.update()
        after, error_after = world.render(scene, seed=1)
        assert (np.abs(after[0, 0] / before[0, 0] - 1) > 0.1).all()
        assert after == pytest.approx(expected, rel=1e-6, abs=0)
        assert error_after == pytest.approx(error, rel=1e-4)

    def test_directions_can_be_changed_again(self, world):
        """Each update reaches the sensor that was traversed once."""
        sensor = mi.load_dict(world.lidar((2, 1), GATE, azimuth_max_deg=1.0))
        parameters = mi.traverse(sensor)
        for slope in (0.1, 0.2, 0.3):
            parameters["directions"] = mi.Float([1, slope, 0, 1, 0, slope])
            parameters.update()
            found = directions(sensor)
            assert found[0, 1] / found[0, 0] == pytest.approx(slope, rel=1e-6)

    def test_new_directions_are_normalised(self, world):
        sensor = mi.load_dict(world.lidar((2, 1), GATE, azimuth_max_deg=1.0))
        parameters = mi.traverse(sensor)
        parameters["directions"] = mi.Float([3, 4, 0, 0.1, 0, 0.1])
        parameters.update()
        assert directions(sensor) == pytest.approx(
            np.array([[0.6, 0.8, 0], [math.sqrt(0.5), 0, math.sqrt(0.5)]]), abs=1e-6
        )

    @pytest.mark.parametrize(
        ("name", "value", "message"),
        [
            ("gate_start", -1.0, "scanning_lidar.gate_start: -1.0 is not allowed; expected"),
            ("gate_stop", 499.0, "scanning_lidar.gate_stop: 499.0 is not allowed; expected"),
            ("fov_half_mrad", 0.0, "scanning_lidar.fov_half_mrad: 0.0 is not allowed; expected an"),
            ("laser.beam_radius", -1.0, "laser.beam_radius: -1.0 is not allowed; expected"),
            ("directions", [1.0, 0, 0], "scanning_lidar.directions: 'shape (1, 3)' is not allowed"),
            ("directions", [1.0] * 7, "scanning_lidar.directions: 'shape (7,)' is not allowed"),
            ("directions", [0.0] * 6, "scanning_lidar.directions: 'a row of zero length or NaN'"),
        ],
    )
    def test_bad_updates_are_named(self, world, name, value, message):
        sensor = mi.load_dict(world.lidar((2, 1), GATE, azimuth_max_deg=1.0))
        parameters = mi.traverse(sensor)
        parameters[name] = mi.Float(value)
        with pytest.raises((RuntimeError, ValueError)) as error:
            parameters.update()
        assert message in str(error.value).splitlines()[-1]


ERRORS = [
    (
        {"laser": {"type": "point"}},
        "scanning_lidar.emitter: 0 is not allowed; expected exactly one",
    ),
    ({"second": {"type": "laser"}}, "scanning_lidar.emitter: 2 is not allowed; expected exactly"),
    ({"gate_start": 0.0}, "scanning_lidar.gate_start: 0.0 is not allowed; expected a range above"),
    ({"gate_start": math.nan}, "scanning_lidar.gate_start: nan is not allowed"),
    ({"gate_start": "near"}, "scanning_lidar.gate_start: 'near' is not allowed; expected a number"),
    (
        {"gate_stop": 498.0},
        "scanning_lidar.gate_stop: 498.0 is not allowed; expected a range beyond gate_start",
    ),
    ({"gate_stop": 500.0}, "scanning_lidar.gate_stop: 500.0 is not allowed"),
    ({"gate_stop": math.inf}, "scanning_lidar.gate_stop: inf is not allowed"),
    ({"gate_count": 0}, "scanning_lidar.gate_count: 0 is not allowed; expected a whole number"),
    (
        {"gate_kind": "conical"},
        "scanning_lidar.gate_kind: 'conical' is not allowed; expected one of planar, spherical",
    ),
    ({"aperture_radius": -0.5}, "scanning_lidar.aperture_radius: -0.5 is not allowed"),
    ({"aperture_radius": math.inf}, "scanning_lidar.aperture_radius: inf is not allowed"),
    ({"fov_half_mrad": 0.0}, "scanning_lidar.fov_half_mrad: 0.0 is not allowed"),
    (
        {"fov_half_mrad": 1600.0},
        "scanning_lidar.fov_half_mrad: 1600.0 is not allowed; expected an angle above 0",
    ),
    ({"azimuth_max_deg": 0.0}, "scanning_lidar.azimuth_max_deg: 0.0 is not allowed; expected more"),
    ({"azimuth_max_deg": 90.0}, "scanning_lidar.azimuth_min_deg, azimuth_max_deg: (0.0, 90.0)"),
    ({"azimuth_min_deg": 5.0}, "scanning_lidar.azimuth_min_deg, azimuth_max_deg: (5.0, 1.0)"),
    ({"azimuth_max_deg": "wide"}, "scanning_lidar.azimuth_max_deg: 'wide' is not allowed"),
    ({"elevation_max_deg": math.nan}, "scanning_lidar.elevation_max_deg: nan is not allowed"),
    (
        {"directions": [[1.0, 0, 0]]},
        "scanning_lidar.directions: 'shape (1, 3)' is not allowed; expected (2, 3)",
    ),
    ({"directions": [[1.0, 0], [1, 0]]}, "scanning_lidar.directions: 'shape (2, 2)'"),
    ({"directions": [[1.0, 0, 0], [0, 0, 0]]}, "scanning_lidar.directions: 'a row of zero length"),
    ({"directions": [[1.0, 0, 0], [0, math.nan, 0]]}, "'a row of zero length or NaN'"),
    (
        {"directions": [[1.0, 0, 0], [-1, 0, 0.1]]},
        "scanning_lidar.gate_kind: 'planar' is not allowed; expected 'spherical' when a beam",
    ),
]


@pytest.mark.parametrize(("parameters", "message"), ERRORS)
def test_bad_values_are_named(world, parameters, message):
    sensor = world.lidar((2, 1), GATE, **({"azimuth_max_deg": 1.0} | parameters))
    if "laser" in parameters:
        sensor["laser"] = parameters["laser"]
    if "directions" in parameters:
        sensor["directions"] = mi.TensorXf(np.array(parameters["directions"]))
    with pytest.raises(RuntimeError) as error:
        mi.load_dict(sensor)
    assert message in str(error.value).splitlines()[-1]


@pytest.mark.parametrize("field", ["gate_start", "gate_stop"])
def test_missing_gate_is_named(world, field):
    sensor = world.lidar((1, 1), GATE)
    del sensor[field]
    with pytest.raises(RuntimeError, match=rf"scanning_lidar\.{field}: 'nothing' is not allowed"):
        mi.load_dict(sensor)


def test_missing_laser_is_named(world):
    sensor = world.lidar((1, 1), GATE)
    del sensor["laser"]
    with pytest.raises(RuntimeError, match="exactly one nested emitter of type 'laser'"):
        mi.load_dict(sensor)


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("absent.txt", None),
        ("words.txt", b"a b c\n"),
        ("ragged.txt", b"1 0 0\n1 0\n"),
        ("e.npy", b""),
    ],
)
def test_bad_direction_files_are_named(world, tmp_path, name, content):
    path = tmp_path / name
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(RuntimeError) as error:
        mi.load_dict(world.lidar((2, 1), GATE, directions=str(path)))
    assert "scanning_lidar.directions: " in str(error.value).splitlines()[-1]
    assert name in str(error.value).splitlines()[-1]


@pytest.mark.parametrize("kind", ["spherical", "planar"])
def test_a_backward_beam_needs_spherical_gates(world, kind):
    parameters = {"directions": mi.TensorXf([[-1.0, 0, 0]]), "gate_kind": kind}
    if kind == "spherical":
        assert directions(mi.load_dict(world.lidar((1, 1), GATE, **parameters)))[0, 0] == -1
    else:
        with pytest.raises(RuntimeError, match="does not point forward"):
            mi.load_dict(world.lidar((1, 1), GATE, **parameters))


def test_other_integrators_say_that_the_laser_is_left_out(world):
    """A wall in front of the lidar is dark under `path`: silence would let it pass for a result."""
    scene = mi.load_dict(
        {
            "type": "scene",
            "sensor": world.lidar((1, 1), GATE),
            "wall": {"type": "sphere", "center": [501.0, 0, 0], "radius": 0.5},
        }
    )
    with pytest.warns(UserWarning, match="without its laser and its gates"):
        image = mi.render(scene, integrator=mi.load_dict({"type": "path"}), spp=4)
    assert not np.array(image).any()
