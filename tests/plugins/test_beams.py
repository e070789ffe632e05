"""Beams with places and times of their own.

Detects: an origin that is ignored or counted twice anywhere between laser and telescope (0.2 % in
any single beam), gates that do not lie where the air's planes are (1e-6), a delay that does not
follow the telescope, a table read in another order.
"""

import math

import mitsuba as mi
import numpy as np
import pytest

pytestmark = pytest.mark.usefixtures("variant")

GATE = (500.0, 502.5)
SIZE = (7, 5)
NUMBER = SIZE[0] * SIZE[1]
VARIANTS = [
    "llvm_ad_mono_polarized",
    *(pytest.param(name, marks=pytest.mark.slow) for name in ("llvm_ad_mono", "llvm_ad_rgb")),
]
AREA = math.pi * 0.5**2


def table(seed=1, origin=5.0, angle=0.1):
    """Oblique beams (N, 7) from places some metres apart."""
    rng = np.random.default_rng(seed)
    beams = np.zeros((NUMBER, 7))
    beams[:, :3] = rng.uniform(-origin, origin, (NUMBER, 3))
    beams[:, 3] = 1
    beams[:, 4:6] = rng.uniform(-angle, angle, (NUMBER, 2))
    beams[:, 6] = rng.uniform(-0.05, 0.05, NUMBER)
    return beams


def unit(directions):
    return directions / np.linalg.norm(directions, axis=1, keepdims=True)


def sensor(world, beams, gate=GATE, **parameters):
    return world.lidar(SIZE, gate, beams=mi.TensorXf(beams), **parameters)


def layers(world, lidar, shift=(0.0, 0.0, 0.0), integrator=None, slab=None):
    """A dense slab from 490 m in thin air, all displaced."""
    low, high = np.array([490.0, -120, -120]) + shift, np.array([512.0, 120, 120]) + shift
    slab = slab or world.homogeneous(2e-2)
    return world.scene(
        lidar,
        integrator,
        environment=world.homogeneous(1e-3),
        slab=world.box(low, high, slab, world.ENVIRONMENT),
    )


def signal(low, high, face):
    """Received over emitted energy for gates in the slab, which begins at the range ``face``.

    The integral of A p sigma exp(-2 tau) / R^2 over the ranges ``low`` to ``high``.
    """
    total = 0.0
    for node, weight in zip(*np.polynomial.legendre.leggauss(12), strict=True):
        r = (low + high) / 2 + (high - low) / 2 * node
        depth = 1e-3 * face + 2e-2 * (r - face)
        density = AREA * 3 / (8 * math.pi) * 2e-2 / r**2 * np.exp(-2 * depth)
        total = total + weight * (high - low) / 2 * density
    return total


@pytest.mark.parametrize("variant", VARIANTS, indirect=True)
@pytest.mark.parametrize("estimator", ["gated", "analog"])
def test_beams_from_the_origin_are_those_of_directions(world, variant, estimator):
    """Bit by bit, whatever their times: no air moves here. Analog sums have no fixed order."""
    beams = table(origin=0)
    integrator = {"max_order": 3, "estimator": estimator}
    options = {"environment": world.ENVIRONMENT, "samples": 256}
    scenes = (
        layers(world, sensor(world, beams, **options), integrator=integrator),
        layers(
            world,
            world.lidar(SIZE, GATE, directions=mi.TensorXf(beams[:, 3:6]), **options),
            integrator=integrator,
        ),
    )
    first, second = (np.array(mi.render(scene, seed=3)) for scene in scenes)
    tolerance = 0 if estimator == "gated" else 1e-5 * first.max()
    assert first.any() and np.abs(first - second).max() <= tolerance


@pytest.mark.parametrize("variant", VARIANTS, indirect=True)
@pytest.mark.parametrize("kind", ["planar", "spherical"])
def test_single_scattering_from_displaced_origins(world, statistics, variant, kind):
    """Each beam's own distance to the slab and its own gates, against the lidar equation."""
    beams, samples = table(), 512
    lidar = sensor(world, beams, gate_kind=kind, environment=world.ENVIRONMENT)
    stokes, error = world.render(layers(world, lidar), seed=2, spp=samples)
    cosine, x = unit(beams[:, 3:6])[:, 0], beams[:, 0]
    scale = 1 / cosine if kind == "planar" else np.ones(NUMBER)
    truth = signal(*((end - x) * scale for end in GATE), (490 - x) / cosine)
    found, sigma = (values.reshape(NUMBER) for values in (stokes[0, 0], error[0]))
    if not mi.is_polarized:  # Rayleigh's phase function for natural light is the same backwards
        assert np.abs(stokes[0, 1:]).max() == 0
    statistics.assert_agree(found, sigma, truth, samples, bias=2e-5)


@pytest.mark.parametrize("estimator", ["gated", "analog"])
def test_displaced_origin_is_a_displaced_scene(world, statistics, estimator):
    """All orders of scattering: the same beams from another place, or the air from there."""
    samples = 4096 if estimator == "gated" else 16384
    moved, resting = table(), table()
    shift = np.array([6.0, -4.0, 3.0])
    moved[:, :3], resting[:, :3] = shift, 0
    integrator = {"max_order": 3, "estimator": estimator}
    results = []
    for seed, (beams, gate, place) in enumerate(
        [(moved, GATE, (0, 0, 0)), (resting, (GATE[0] - 6, GATE[1] - 6), -shift)]
    ):
        lidar = sensor(world, beams, gate, environment=world.ENVIRONMENT)
        scene = layers(world, lidar, place, integrator)
        stokes, error = world.render(scene, seed=seed, spp=samples)
        results.append((stokes[0, 0].ravel(), error[0].ravel()))
    (first, first_error), (second, second_error) = results
    z = (first - second) / np.hypot(first_error, second_error)
    assert abs(z.mean()) < 4 / math.sqrt(NUMBER)
    assert 0.3 < z.var() < 2  # 4 sigma of 35 beams
    assert first_error.max() < 0.05 * first.min() or estimator == "analog"


def test_planar_gates_lie_between_the_same_planes(world):
    beams = table()
    lidar = mi.load_dict(sensor(world, beams))
    index = mi.UInt32(np.arange(NUMBER))
    axis, origin = lidar.beam_frame(index).n, lidar.beam_origin(index)
    for end, reach in zip(GATE, lidar.ranges(axis, origin), strict=True):
        assert np.array(origin.x + axis.x * reach) == pytest.approx(end, rel=1e-6)


def test_spherical_gates_follow_the_air(world):
    """A telescope 3 m ahead opens its gates 3 m earlier."""
    beams = table()
    lidar = mi.load_dict(sensor(world, beams, gate_kind="spherical"))
    origins, ranges = lidar.origins_and_ranges()
    assert origins == pytest.approx(beams[:, :3], abs=1e-6)
    assert ranges == pytest.approx(np.array(GATE)[:, None] - beams[:, 0], rel=1e-6)


def test_pose_moves_all_beams(world):
    """Origins are in the lidar's frame, which ``to_world`` places."""
    beams = table()
    pose = mi.ScalarTransform4f().translate([10, -2, 3]).rotate([0, 0, 1], 30)
    lidar = mi.load_dict(sensor(world, beams, to_world=pose))
    matrix = np.array(pose.matrix).astype(float)
    expected = beams[:, :3] @ matrix[:3, :3].T + matrix[:3, 3]
    assert lidar.origins_and_ranges()[0] == pytest.approx(expected, abs=1e-5)
    row, column = (i.ravel() for i in np.indices(SIZE[::-1]))
    position = mi.Point2f(mi.Float((column + 0.5) / SIZE[0]), mi.Float((row + 0.5) / SIZE[1]))
    ray, _ = lidar.sample_ray(mi.Float(0), mi.Float(0.5), position, mi.Point2f(0.5))
    assert np.array(ray.o).T == pytest.approx(expected, abs=1e-5)
    assert np.array(ray.d).T == pytest.approx(unit(beams[:, 3:6]) @ matrix[:3, :3].T, abs=1e-6)
    assert np.array(ray.time) == pytest.approx(beams[:, 6], abs=1e-8)


@pytest.mark.parametrize("kind", ["tensor", "file.npy", "file.txt", "file.csv"])
def test_table_of_beams(world, tmp_path, kind):
    beams = table()
    source = str(tmp_path / kind)
    if kind == "tensor":
        source = mi.TensorXf(beams)
    elif kind == "file.npy":
        np.save(source, beams)
    else:
        delimiter = "," if kind.endswith("csv") else " "
        np.savetxt(source, beams, delimiter=delimiter, header="x y z dx dy dz t")
    parameters = mi.traverse(mi.load_dict(world.lidar(SIZE, GATE, beams=source)))
    found = {name: np.array(parameters[name]) for name in ("origins", "directions", "times")}
    assert found["origins"].reshape(-1, 3) == pytest.approx(beams[:, :3], abs=1e-6)
    assert found["directions"].reshape(-1, 3) == pytest.approx(unit(beams[:, 3:6]), abs=1e-6)
    assert found["times"] == pytest.approx(beams[:, 6], abs=1e-8)


def test_changed_origins_give_the_image_of_a_new_scene(world):
    options = {"environment": world.ENVIRONMENT}
    before, after = table(1), table(2)
    scene = layers(world, sensor(world, before, **options))
    old, _ = world.render(scene, seed=1)
    new_scene = layers(world, sensor(world, after, **options))
    expected, _ = world.render(new_scene, seed=1)
    parameters, new = mi.traverse(scene), mi.traverse(new_scene)
    for name in ("origins", "directions", "times"):
        parameters[f"sensor.{name}"] = new[f"sensor.{name}"]
    parameters.update()
    found, _ = world.render(scene, seed=1)
    assert (found == expected).all() and not (found == old).all()


def _with(row, column, value):
    beams = table()
    beams[row, column] = value
    return beams


@pytest.mark.parametrize(
    ("beams", "message"),
    [
        (table()[:, :6], "scanning_lidar.beams: 'shape (35, 6)' is not allowed; expected (35, 7)"),
        (table()[1:], "scanning_lidar.beams: 'shape (34, 7)' is not allowed"),
        (_with(4, 6, math.nan), "scanning_lidar.beams[4]: "),
        (_with(7, 1, math.inf), "scanning_lidar.beams[7]: "),
        (_with(9, slice(3, 6), 0), "scanning_lidar.beams[9]: "),
        (_with(2, 3, -1), "scanning_lidar.gate_kind: 'planar' is not allowed"),
        (_with(2, 0, 500), "scanning_lidar.origins: 'x = 500 m' is not allowed; expected before"),
    ],
)
def test_bad_tables_are_named(world, beams, message):
    with pytest.raises(RuntimeError) as error:
        mi.load_dict(sensor(world, beams))
    assert message in str(error.value).splitlines()[-1]


def test_beams_and_directions_exclude_each_other(world):
    directions = mi.TensorXf(table()[:, 3:6])
    with pytest.raises(RuntimeError, match=r"scanning_lidar\.beams: 'with directions'"):
        mi.load_dict(sensor(world, table(), directions=directions))


@pytest.mark.parametrize("content", [b"a,b\n", b"", b"\xff\xfe\n", b"1,2,3\n1,2\n"])
def test_bad_files_are_named(world, tmp_path, content):
    path = tmp_path / "beams.csv"
    path.write_bytes(content)
    with pytest.raises(RuntimeError) as error:
        mi.load_dict(world.lidar(SIZE, GATE, beams=str(path)))
    assert "scanning_lidar.beams: " in str(error.value).splitlines()[-1]


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("origins", [0.0] * 3, "scanning_lidar.origins: '3 numbers, 0 of them NaN' is not allowed"),
        ("origins", [math.nan] * 105, "scanning_lidar.origins: '105 numbers, 105 of them NaN'"),
        ("times", [0.0] * 36, "scanning_lidar.times: '36 numbers, 0 of them NaN' is not allowed"),
    ],
)
def test_bad_updates_are_named(world, name, value, message):
    parameters = mi.traverse(mi.load_dict(sensor(world, table())))
    parameters[name] = mi.Float(value)
    with pytest.raises((RuntimeError, ValueError)) as error:
        parameters.update()
    assert message in str(error.value).splitlines()[-1]


def test_gates_that_miss_the_air_from_all_origins(world):
    """The slab begins 490 m from the lidar's origin; these beams look from behind or beside it."""
    beams = table(origin=0)
    beams[:, 0] = -400.0  # the planar gates stay in the slab
    cloud = world.box([490, -120, -120], [512, 120, 120], world.homogeneous(1e-3))
    stokes, _ = world.render(world.scene(sensor(world, beams), cloud=cloud))
    assert (stokes[0, 0] > 0).all()
    beams[:, :3] = 0, 5000.0, 0
    scene = world.scene(sensor(world, beams), cloud=cloud)
    with pytest.raises(ValueError, match=r"gated_volpath\.gates: .* is not allowed"):
        scene.integrator().render(scene)
