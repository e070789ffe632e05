"""Random numbers common to beams, gates and images.

Detects: an expectation that differs from that of independent numbers (4 sigma in 200 seeds, of
every pixel and of their sum), beams that are sampled differently, passes that change the numbers, a
realisation of the error whose variance or correlation is not that of the image's error, gradients
of other numbers than the image.
"""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

pytestmark = pytest.mark.usefixtures("variant")

LOW, HIGH = np.array([95.0, -20.0, -15.0]), np.array([115.0, 20.0, 15.0])
TIMES = (-0.05, 0.05)
ROWS, COLUMNS, GATES = 3, 4, 2


def beams():
    """A bent scan from a telescope that moves: origin, direction and time of every beam."""
    time = np.linspace(*TIMES, ROWS * COLUMNS)
    azimuth, elevation = np.meshgrid(
        np.linspace(0.1, -0.1, COLUMNS), np.linspace(0.06, -0.06, ROWS)
    )
    direction = np.stack([np.ones_like(azimuth), azimuth, elevation], -1).reshape(-1, 3)
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    origin = np.outer(time, [70.0, 3.0, -2.0])
    return np.column_stack([origin, direction, time])


def air(extinction, varies):
    """Air that differs with place and time by a factor of up to 1 + varies."""
    off = np.random.default_rng(1).uniform(-varies, varies, (3, 5, 6, 4))
    states = extinction * (1 + off)
    place = mi.ScalarTransform4f().translate(LOW).scale(HIGH - LOW)
    return {
        "type": "moving_volume",
        "data": mi.TensorXf(states.astype(np.float32)),
        "time_start": TIMES[0],
        "time_stop": TIMES[1],
        "to_world": place,
    }


def scan(world, numbers, order=4, extinction=0.04, varies=0.8, **integrator):
    settings = {"max_order": order, "random_numbers": numbers, "shares": True, **integrator}
    lidar = world.lidar(
        (COLUMNS, ROWS),
        (100.0, 108.0),
        laser={"pulse_duration": 5e-9},
        environment=world.ENVIRONMENT,
        gate_count=GATES,
        beams=mi.TensorXf(beams().astype(np.float32)),
    )
    return world.scene(
        lidar,
        settings,
        environment=world.homogeneous(1e-3),
        slab=world.box(LOW, HIGH, world.homogeneous(air(extinction, varies)), world.ENVIRONMENT),
    )


def channels(scene, seed=1, samples=16):
    """The image's quantities by name, (rows, columns, gates)."""
    image = np.array(mi.render(scene, seed=seed, spp=samples)).astype(float)
    names = scene.integrator().quantities()
    image = image.reshape(*image.shape[:2], GATES, len(names))
    return {name: image[..., k] for k, name in enumerate(names)}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("order", "seeds"), [(1, 60), pytest.param(4, 200, marks=pytest.mark.slow)]
)
def test_expectation_and_errors_are_those_of_independent_numbers(world, order, seeds):
    scene = scan(world, "common", order)
    images = [channels(scene, seed) for seed in range(seeds)]
    names = "S0", "S0_mc_error", "S0_stderr"
    s0, drawn, stderr = (np.stack([image[name] for image in images]) for name in names)
    true = channels(scan(world, "independent", order), samples=16 * 4 * seeds)
    error = np.hypot(s0.std(0, ddof=1) / np.sqrt(seeds), true["S0_stderr"])
    z = (s0.mean(0) - true["S0"]) / error
    assert np.abs(z).max() < 4
    total = s0.sum((1, 2, 3))
    spread = np.hypot(total.std(ddof=1) / np.sqrt(seeds), np.sqrt((true["S0_stderr"] ** 2).sum()))
    assert abs(total.mean() - true["S0"].sum()) < 4 * spread
    # of every pixel, and of their sum, whose error would be a fifth with independent numbers
    for name, values in (("stated", stderr**2), ("drawn", drawn**2)):
        ratio = (values.mean(0) / s0.var(0, ddof=1)).mean()
        assert ratio == pytest.approx(1, abs=0.3), name
    shared = total.var(ddof=1) / s0.var(0, ddof=1).sum()
    assert drawn.sum((1, 2, 3)).var() / total.var(ddof=1) == pytest.approx(1, abs=0.5)
    assert shared > 3 and np.abs(drawn.mean(0) / (drawn.std(0) / np.sqrt(seeds))).max() < 4


@pytest.mark.slow
def test_beams_of_the_same_air_have_the_same_error(world):
    """Spread over the beams of relative errors, over their standard error: 1 if independent."""
    thin = {"order": 1, "extinction": 1e-3, "varies": 0}
    true = channels(scan(world, "independent", **thin), samples=1 << 17)["S0"]
    found = {}
    for numbers in ("common", "independent"):
        image = channels(scan(world, numbers, **thin), samples=512)
        spread = (image["S0"] / true).std((0, 1), ddof=1)
        found[numbers] = (spread / (image["S0_stderr"] / image["S0"]).mean((0, 1))).mean()
    assert found["independent"] == pytest.approx(1, abs=0.5)
    assert found["common"] < 0.5 * found["independent"]


@pytest.mark.slow
@pytest.mark.parametrize("numbers", ["common", "independent"])
def test_passes_do_not_change_the_numbers(world, numbers):
    """Passes of a few beams, and of a few samples of a beam."""
    whole = channels(scan(world, numbers, 1), samples=32)
    for most in (96, 16):
        parts = channels(scan(world, numbers, 1, samples_per_pass=most), samples=32)
        for name in ("S0", "S0_stderr"):
            np.testing.assert_allclose(parts[name], whole[name], rtol=1e-4)


@pytest.mark.slow
def test_finite_differences_of_common_numbers_are_the_gradient(world):
    """Of one seed, in air so thin that the random estimate of the transmittance does not count."""
    scene = scan(world, "common", 1, extinction=1e-4)
    parameters = mi.traverse(scene)
    key = "slab.interior_medium.sigma_t.data"
    base = np.array(parameters[key])
    step = 0.02 * base * np.random.default_rng(2).uniform(0.5, 1.5, base.shape)

    def put(values):
        parameters[key] = mi.TensorXf(values.astype(np.float32))

    sides = []
    for sign in (1, -1):
        put(base + sign * step)
        parameters.update()
        sides.append(channels(scene)["S0"])
    put(base)
    dr.enable_grad(parameters[key])
    parameters.update()
    weights = np.zeros((ROWS, COLUMNS, GATES, len(scene.integrator().quantities())))
    weights[..., 0] = np.random.default_rng(3).uniform(0.5, 1.5, weights.shape[:-1])
    image = mi.render(scene, parameters, seed=2, seed_grad=1, spp=16)
    dr.backward(dr.sum(image.array * mi.Float(weights.ravel().astype(np.float32))) * 1e8)
    slope = (np.array(dr.grad(parameters[key])) * step).sum() * 2
    expected = ((sides[0] - sides[1]) * weights[..., 0]).sum() * 1e8
    assert slope == pytest.approx(expected, rel=2e-3)


def test_free_flights_have_independent_numbers(world):
    with pytest.raises(Exception, match=r"random_numbers.*independent"):
        scan(world, "common", estimator="analog")


@pytest.mark.slow
def test_beams_of_other_directions_have_the_same_error(world):
    """Uniform air that scatters again and again, spherical gates: all beams have the same signal.

    Across the horizontal plane, where beams of 2 mrad lie on both sides of it, and to the side.
    """
    elevation, azimuth = np.meshgrid([-6e-3, -2e-3, 2e-3, 6e-3], [0.0, 0.1, 0.2], indexing="ij")
    aim = np.stack([np.cos(azimuth), np.sin(azimuth), elevation], -1).reshape(-1, 3)
    aim /= np.linalg.norm(aim, axis=1, keepdims=True)
    rays = np.column_stack([np.zeros_like(aim), aim, np.zeros(len(aim))])
    lidar = world.lidar(
        (3, 4),
        (100.0, 108.0),
        environment=world.ENVIRONMENT,
        gate_count=GATES,
        gate_kind="spherical",
        fov_half_mrad=50.0,
        beams=mi.TensorXf(rays.astype(np.float32)),
    )
    settings = {"max_order": 4, "random_numbers": "common"}
    scene = world.scene(lidar, settings, environment=world.homogeneous(0.04))
    image = channels(scene, samples=256)
    off = np.abs(image["S0"] - image["S0"].mean((0, 1))).max((0, 1))
    assert (off < 0.1 * image["S0_stderr"].mean((0, 1))).all()
