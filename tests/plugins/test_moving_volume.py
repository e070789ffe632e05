"""Air that changes with time, on its own and before a lidar.

Detects: states or axes in another order, an error of 1e-5 between states or cells, a beam that
meets the air of another time, a pattern displaced by more than the closed form says, gradients that
reach the states of other times, air that a flow carries to another place, or past its bounds.
"""

import math

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scipy.interpolate import RegularGridInterpolator

pytestmark = pytest.mark.usefixtures("variant")

VARIANTS = [
    "llvm_ad_mono_polarized",
    *(pytest.param(name, marks=pytest.mark.slow) for name in ("llvm_ad_mono", "llvm_ad_rgb")),
]
LOW, HIGH = np.array([498.0, -10.0, -8.0]), np.array([505.0, 10.0, 8.0])
SHAPE = (5, 4, 6, 3)  # times, z, y, x
STATES = np.random.default_rng(1).uniform(0.5, 1.5, SHAPE).astype(np.float32)
TIMES = np.linspace(-0.05, 0.05, SHAPE[0])


def transform():
    return mi.ScalarTransform4f().translate(LOW).scale(HIGH - LOW)


def volume(states=STATES, **parameters):
    ends = {"time_start": TIMES[0], "time_stop": TIMES[-1], "to_world": transform()}
    data = mi.TensorXf(np.asarray(states, np.float32))
    return {"type": "moving_volume", "data": data} | ends | parameters


def interactions(place, time):
    it = dr.zeros(mi.Interaction3f, len(place))
    it.p = mi.Point3f(*(mi.Float(axis) for axis in np.asarray(place, np.float32).T))
    it.time = mi.Float(np.asarray(time, np.float32))
    return it


@pytest.mark.parametrize("variant", VARIANTS, indirect=True)
def test_values_are_linear_in_place_and_time(variant):
    rng = np.random.default_rng(2)
    # beyond the ends too: the nearest state and cell
    place = rng.uniform(LOW - 1, HIGH + 1, (5000, 3))
    time = rng.uniform(-0.07, 0.07, 5000)
    loaded = mi.load_dict(volume())
    found = np.array(loaded.eval(interactions(place, time)), float)
    axes = [TIMES]
    for k in (2, 1, 0):
        cells = SHAPE[3 - k]
        axes.append(LOW[k] + (HIGH - LOW)[k] * (np.arange(cells) + 0.5) / cells)
    points = np.column_stack([time, place[:, ::-1]])
    points = np.clip(points, [axis[0] for axis in axes], [axis[-1] for axis in axes])
    expected = RegularGridInterpolator(axes, STATES.astype(float))(points)
    assert np.abs(found - expected).max() < 1e-4
    assert np.array(loaded.eval_1(interactions(place, time))) == pytest.approx(found[0])
    assert loaded.max() == STATES.max()
    assert np.array(loaded.bbox().min) == pytest.approx(LOW)
    assert np.array(loaded.bbox().max) == pytest.approx(HIGH)


@pytest.mark.parametrize("axis", range(4))
def test_an_axis_of_one_node_is_uniform(axis):
    states = STATES.take([1], axis)
    rng = np.random.default_rng(3)
    place, time = rng.uniform(LOW, HIGH, (100, 3)), rng.uniform(-0.05, 0.05, 100)
    thin, thick = (
        mi.load_dict(volume(each)).eval_1(interactions(place, time))
        for each in (states, states.repeat(SHAPE[axis], axis))
    )
    assert np.array(thin) == pytest.approx(np.array(thick), rel=1e-5)


@pytest.mark.parametrize("d", [0.25, 0.5])
def test_a_carried_sinusoid_has_the_phase_and_amplitude_of_the_closed_form(d):
    """Of (1 - f) + f exp(i k d) between states; d in cells, four cells a wave (the shortest).

    In a quarter of a cell from state to state it is displaced by 6e-4 of a cell at most.
    """
    wave, cells, states = 4.0, 32, 5
    k, cell = 2 * np.pi / wave, (HIGH - LOW)[1] / cells
    y = LOW[1] + cell * (np.arange(cells) + 0.5)
    carried = np.cos(k * (np.arange(cells) - d * np.arange(states)[:, None]))
    loaded = mi.load_dict(volume(2 + carried[:, None, :, None]))
    worst = 0.0
    for step in np.linspace(0, states - 1, 41):
        time = TIMES[0] + step / (states - 1) * (TIMES[-1] - TIMES[0])
        place = np.column_stack([np.full(cells, 500.0), y, np.zeros(cells)])
        values = np.array(loaded.eval_1(interactions(place, np.full(cells, time))), float)
        found = 2 / cells * (values * np.exp(1j * k * np.arange(cells))).sum()
        whole = min(int(step), states - 2)
        f = step - whole
        expected = np.exp(1j * k * d * whole) * (1 - f + f * np.exp(1j * k * d))
        assert abs(found - expected) < 1e-4
        worst = max(worst, abs(np.angle(found * np.exp(-1j * k * d * step))) / k)
        assert abs(found) > 1 - 5 * (d / wave) ** 2
    assert worst == pytest.approx(0.63 * d**3 / wave**2, rel=0.15)
    assert worst < {0.25: 7e-4, 0.5: 6e-3}[d]


@pytest.mark.parametrize("variant", VARIANTS, indirect=True)
@pytest.mark.parametrize(
    ("estimator", "order"),
    [
        ("gated", 1),
        pytest.param("gated", 2, marks=pytest.mark.slow),
        pytest.param("analog", 2, marks=pytest.mark.slow),
    ],
)
def test_every_beam_meets_the_air_of_its_time(world, variant, estimator, order):
    """Beams at the times of states, against the static air of that state."""
    samples, beams = 2048 if estimator == "gated" else 100_000, 20
    rng = np.random.default_rng(4)
    states = 0.03 * rng.uniform(0.1, 1, SHAPE)
    table = np.zeros((beams, 7))
    table[:, 3] = 1
    table[:, 4], table[:, 5] = rng.uniform(-0.015, 0.015, (2, beams))
    state = np.arange(beams) % SHAPE[0]
    table[:, 6] = TIMES[state]

    def image(sigma_t, seed):
        medium = world.homogeneous(0.0) | {"type": "heterogeneous", "sigma_t": sigma_t}
        scene = world.scene(
            world.lidar((beams, 1), (500.0, 502.5), beams=mi.TensorXf(table), aperture_radius=2.0),
            {"max_order": order, "estimator": estimator},
            slab=world.box(LOW, HIGH, medium),
        )
        stokes, error = world.render(scene, seed=seed, spp=samples)
        return stokes[0, 0, 0], error[0, 0]

    moving, moving_error = image(volume(states), 0)
    still = [image(volume(states[k : k + 1]), 1 + k) for k in range(SHAPE[0])]
    at_time, at_time_error = (
        np.array([each[state[i]] for i, each in enumerate(np.transpose(part))])
        for part in zip(*still, strict=True)
    )
    z = (moving - at_time) / np.hypot(moving_error, at_time_error)
    assert abs(z.mean()) < 4 / math.sqrt(beams) and np.abs(z).max() < 5
    # the air of other times would have been noticed
    other = np.array([still[(state[i] + 1) % SHAPE[0]][0][i] for i in range(beams)])
    assert np.abs((moving - other) / np.hypot(moving_error, at_time_error)).max() > 10


def test_gradients_belong_to_the_states_around_a_beams_time(world):
    """A quarter of the way between two equal states: 3/4 and 1/4 of the static air's gradient."""
    base = 0.05 * np.random.default_rng(1).uniform(0.5, 1.5, SHAPE[1:])
    table = np.zeros((2, 7))
    table[:, 3], table[:, 4], table[:, 6] = 1, (-0.005, 0.005), TIMES[1] + 0.25 * 0.025

    def gradient(states):
        medium = world.homogeneous(0.0) | {"type": "heterogeneous", "sigma_t": volume(states)}
        scene = world.scene(
            world.lidar((2, 1), (500.0, 503.0), beams=mi.TensorXf(table)),
            slab=world.box(LOW, HIGH, medium),
        )
        parameters = mi.traverse(scene)
        key = "slab.interior_medium.sigma_t.data"
        dr.enable_grad(parameters[key])
        parameters.update()
        image = mi.render(scene, parameters, spp=2000, seed=1)
        dr.backward(dr.sum(image * 1e7))
        return np.array(dr.grad(parameters[key]), float)[..., 0]

    still = gradient(base[None])[0]
    moving = gradient(np.broadcast_to(base, SHAPE))
    assert np.abs(still).max() > 0
    expected = np.array([0, 0.75, 0.25, 0, 0])[:, None, None, None] * still
    assert np.abs(moving - expected).max() < 1e-4 * np.abs(still).max()


def carried(flow, **parameters):
    """One state, carried by a flow for half a second or less."""
    tensor = mi.TensorXf(np.asarray(flow, np.float32))
    times = {"time_start": -0.05, "time_stop": -0.05}
    return mi.load_dict(volume(STATES[:1], flow=tensor, **(times | parameters)))


def test_a_uniform_flow_displaces_the_state():
    """Frozen air: what is there now was flow x time upwind, also beyond the ends."""
    random = np.random.default_rng(4)
    place, time = random.uniform(LOW - 1, HIGH + 1, (2000, 3)), random.uniform(-0.05, 0.5, 2000)
    wind = np.array([2.0, -9.0, 6.0])
    found = np.array(carried(np.broadcast_to(wind, (2, 3, 2, 3))).eval_1(interactions(place, time)))
    upwind = place - wind * (time[:, None] + 0.05)
    still = mi.load_dict(volume(STATES[:1]))
    assert np.abs(found - np.array(still.eval_1(interactions(upwind, time)))).max() < 1e-4


def test_a_rotation_is_followed_to_second_order():
    """Solid rotation by an angle a: a step of the midpoint rule ends a^3 / 6 r beside the arc."""
    cells = np.stack(np.meshgrid(*(np.arange(40) + 0.5,) * 2, indexing="ij"), -1) / 40
    z, y = np.moveaxis(LOW[[2, 1]] + cells * (HIGH - LOW)[[2, 1]], -1, 0)
    rate = 0.8
    wind = np.stack([0 * y, -rate * z, rate * y], -1)[:, :, None]
    # a field that is linear in y: values are places
    values = np.broadcast_to(y[None, :, :, None], (1, 40, 40, 1)) + 10
    random = np.random.default_rng(5)
    place = np.column_stack([np.full(500, 501.0), *random.uniform(-4, 4, (2, 500))])
    for age in (0.25, 0.5):
        loaded = mi.load_dict(
            volume(values, flow=mi.TensorXf(wind.astype(np.float32)), time_start=0, time_stop=0)
        )
        found = np.array(loaded.eval_1(interactions(place, np.full(500, age)))) - 10
        angle = rate * age
        origin = place[:, 1] * np.cos(angle) + place[:, 2] * np.sin(angle)
        radius = np.hypot(place[:, 1], place[:, 2])
        off = np.abs(found - origin)
        assert (off < angle**3 / 6 * radius + 1e-4).all()


def test_carried_air_before_a_lidar(world):
    """Signals are those of the displaced state, whose bounds are others."""
    values = 0.05 * STATES[:1]
    values[..., 2] *= 8
    table = np.zeros((1, 7))
    table[:, 3], table[:, 6] = 1, 0.2
    wind = np.broadcast_to([8.0, 0.0, 0.0], (1, 1, 1, 3)).astype(np.float32)

    def signal(description, seed):
        medium = world.homogeneous(0.0) | {"type": "heterogeneous", "sigma_t": description}
        scene = world.scene(
            world.lidar((1, 1), (500.0, 503.0), beams=mi.TensorXf(table)),
            slab=world.box(LOW, HIGH, medium),
        )
        image = np.array(mi.render(scene, spp=20_000, seed=seed), float).ravel()
        return image[0], image[4]

    flowing = volume(values, flow=mi.TensorXf(wind), time_start=-0.05, time_stop=-0.05)
    # the same as states on a grid four times finer: cells' centres and those between
    fine = mi.load_dict(flowing)
    x = LOW[0] + (np.arange(240) + 0.5) / 240 * (HIGH - LOW)[0]
    axes = [LOW[k] + (np.arange(n) + 0.5) / n * (HIGH - LOW)[k] for k, n in ((2, 4), (1, 6))]
    places = np.stack(np.meshgrid(*axes, x, indexing="ij"), -1)[..., ::-1].reshape(-1, 3)
    sampled = np.array(fine.eval_1(interactions(places, np.full(len(places), 0.2))))
    still = volume(sampled.reshape(1, 4, 6, 240))
    (one, error), (other, other_error) = signal(flowing, 1), signal(still, 2)
    assert abs(one - other) < 4 * math.hypot(error, other_error) + 1e-3 * other
    before, _ = signal(volume(values), 2)
    assert abs(one - before) > 20 * error


def test_new_states_compile_nothing(world):
    """Data, times and the number of states change from scan to scan."""
    states = 0.05 * STATES
    medium = world.homogeneous(0.0) | {"type": "heterogeneous", "sigma_t": volume(states)}
    scene = world.scene(world.lidar((1, 1), (500.0, 503.0)), slab=world.box(LOW, HIGH, medium))
    parameters = mi.traverse(scene)
    key = "slab.interior_medium.sigma_t"
    before = np.array(mi.render(scene, seed=1))
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
        dr.kernel_history_clear()
        parameters[f"{key}.data"] = mi.TensorXf(2 * np.concatenate([states, states])[..., None])
        parameters[f"{key}.time_stop"] = 0.07
        parameters.update()
        after = np.array(mi.render(scene, seed=1))
        history = dr.kernel_history((dr.KernelType.JIT,))
    assert (after != before).any()
    assert history and all(kernel["cache_hit"] for kernel in history)


@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        ({"data": None}, "moving_volume.data: 'nothing' is not allowed"),
        ({"time_stop": None}, "moving_volume.time_stop: 'nothing' is not allowed"),
        ({"time_stop": -0.05}, "moving_volume.time_stop: -0.05"),
        (
            {"time_stop": -1.0},
            "moving_volume.time_stop: -1.0 is not allowed; expected a time after",
        ),
        ({"time_start": math.nan}, "moving_volume.time_start: nan is not allowed"),
        ({"data": np.ones((2, 3, 4))}, "moving_volume.data: 'shape (2, 3, 4)' is not allowed"),
        ({"data": np.full(SHAPE, np.nan)}, "moving_volume.data: '360 values that are none'"),
        (
            {"data": "absent.npy"},
            "moving_volume.data: 'absent.npy' is not allowed; expected a readable",
        ),
        ({"to_world": (0, 1, 1)}, "moving_volume.to_world: "),
        ({"flow": np.ones((2, 3, 3))}, "moving_volume.flow: 'shape (2, 3, 3)' is not allowed"),
        ({"flow": np.ones((2, 3, 3, 3))}, "moving_volume.flow: 'a wind of 5 states' is not"),
        (
            {"data": STATES[:1], "flow": np.full((1, 1, 1, 3), np.nan)},
            "moving_volume.flow: 'numbers that are none' is not allowed; expected finite ones",
        ),
    ],
)
def test_bad_values_are_named(parameters, message):
    description = volume()
    for name, value in parameters.items():
        if name == "to_world":
            value = mi.ScalarTransform4f(np.diag([*value, 1.0]))
        if isinstance(value, np.ndarray):
            value = mi.TensorXf(value.astype(np.float32))
        description[name] = value
        if value is None:
            del description[name]
    with pytest.raises(RuntimeError) as error:
        mi.load_dict(description)
    assert message in str(error.value).splitlines()[-1]


def test_negative_extinction_is_refused(world):
    """By the integrator, as in any other volume."""
    medium = world.homogeneous(0.0) | {"type": "heterogeneous", "sigma_t": volume(-STATES)}
    scene = world.scene(world.lidar((1, 1), (500.0, 503.0)), slab=world.box(LOW, HIGH, medium))
    with pytest.raises(ValueError, match=r"sigma_t\.data: -.* is not allowed; expected finite, at"):
        scene.integrator().render(scene)


def test_states_from_a_file_in_xml(tmp_path):
    np.save(tmp_path / "puff.npy", STATES)
    loaded = mi.load_string(
        f"""<volume version="3.0.0" type="moving_volume">
              <string name="data" value="{tmp_path / "puff.npy"}"/>
              <float name="time_start" value="-0.05"/> <float name="time_stop" value="0.05"/>
            </volume>"""
    )
    place = np.array([[0.5 / 3, 0.5 / 6, 0.5 / 4]])
    values = [float(loaded.eval_1(interactions(place, [time]))[0]) for time in TIMES]
    assert values == pytest.approx(STATES[:, 0, 0, 0].tolist(), rel=1e-5)
