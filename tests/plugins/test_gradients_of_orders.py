"""Gradients of all scattering orders: extinction, albedo, phase functions, flow.

Detects: an order whose gradient is 3 % off, a vertex that is left out of it (zero extinction,
matrices in the middle of a path), components that are exchanged, a forward mode that is not the
transpose of the reverse one, gradients that do not exist and are given nevertheless.
"""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scipy.stats import norm

from validation import gradient_reference as reference
from validation.gradient_reference import MEDIUM, ORDERS, SHAPE

pytestmark = [
    pytest.mark.usefixtures("variant"),
    # few samples: that their errors are known badly is no matter here
    pytest.mark.filterwarnings("ignore:gated_volpath"),
]

DATA = f"{MEDIUM}.sigma_t.data"
VOXELS = [(*place, 0) for place in np.ndindex(SHAPE)]
UNPOLARISED = [
    pytest.param(name, marks=pytest.mark.slow)
    for name in ("llvm_ad_mono", "llvm_ad_rgb", "llvm_ad_spectral_polarized")
]
ANGLES = np.arange(0, 181, 20.0)
COSINE = np.cos(np.radians(ANGLES))
TABLE = np.column_stack(
    [
        ANGLES,
        1 + 0.75 * COSINE**2 + 0.5 * COSINE,
        0.3 + 0.75 * COSINE**2,
        COSINE,
        0.9 * COSINE,
        -0.5 * (1 - COSINE**2),
        0.2 * (1 - COSINE**2),
    ]
)
FLOW = np.random.default_rng(3).uniform(-20, 20, (2, 2, 2, 3))


def mueller():
    return {"type": "mueller", "table": mi.TensorXf(TABLE.astype(np.float32))}


def assert_agree(scores):
    """Normal scores: the largest, and their rms, as a quarter of as many independent ones have."""
    assert np.abs(scores).max() < max(3.5, norm.isf(5e-5 / scores.size)), np.abs(scores).max()
    rms = np.sqrt(np.mean(scores**2))
    assert abs(rms - 1) < 4 / np.sqrt(scores.size / 2), rms


def compared(scene, key, directions, samples=200, seeds=8, of_differences=6):
    expected = reference.by_differences(scene, key, directions, of_differences * samples, 1)
    found = reference.by_replay(scene, key, directions, samples, range(100, 100 + seeds))
    assert_agree(reference.scores(found, expected))
    return found, expected


def voxels(depth, varied, places, **effort):
    values = reference.extinction(depth, varied)[..., None]
    directions = reference.steps(values.shape, [(place, 0.05 * values[place]) for place in places])
    return compared(reference.loaded(values[..., 0]), DATA, directions, **effort)


@pytest.mark.slow
@pytest.mark.parametrize("depth", [0.1, 1.0, 3.0])
def test_extinction_at_all_depths(depth):
    # the third order of thin air is one of rare paths
    found, expected = voxels(depth, True, VOXELS[::3], seeds=16, of_differences=30)
    # most of them are known to a fifth
    lit = found.errors > 0
    errors = np.hypot(found.errors, expected.errors)[lit]
    assert np.median(np.abs(found.values[lit]) / errors) > 5


@pytest.mark.parametrize("variant", UNPOLARISED, indirect=True)
def test_extinction_in_other_variants(variant):
    voxels(1.0, True, VOXELS[1::9])


@pytest.mark.slow
def test_elements_of_a_table():
    places = [(row, column) for row in (0, 2, 5, 9) for column in range(1, 7)]
    steps = reference.steps(TABLE.shape, [(place, 0.05 * TABLE[place[0], 1]) for place in places])
    scene = reference.loaded(reference.extinction(1.0, True), mueller())
    compared(scene, f"{MEDIUM}.phase_function.table", steps, samples=500, seeds=12)


@pytest.mark.slow
def test_asymmetry():
    scene = reference.loaded(reference.extinction(1.0, True), {"type": "hg", "g": 0.6})
    compared(scene, f"{MEDIUM}.phase_function.g", np.array([[0.03]]), samples=500)


@pytest.mark.slow
def test_flow():
    scene = reference.loaded(reference.extinction(1.0, True), flow=FLOW)
    steps = reference.steps(FLOW.shape, [(place, 1.0) for place in np.ndindex(FLOW.shape)])
    compared(scene, f"{MEDIUM}.sigma_t.flow", steps, samples=500, seeds=12)


def case(name):
    """A scene, the parameter that is differentiated, and a direction of its change."""
    values, random = reference.extinction(1.0, True), np.random.default_rng(5)
    if name == "table":
        tangent = random.uniform(-1, 1, TABLE.shape)
        tangent[:, 0] = 0
        return reference.loaded(values, mueller()), f"{MEDIUM}.phase_function.table", tangent
    if name == "flow":
        scene = reference.loaded(values, mueller(), flow=FLOW)
        return scene, f"{MEDIUM}.sigma_t.flow", random.uniform(-1, 1, FLOW.shape)
    if name == "albedo":
        scene = reference.loaded(values, mueller(), albedo=random.uniform(0.5, 1, SHAPE))
        return scene, f"{MEDIUM}.albedo.data", random.uniform(-1, 1, (*SHAPE, 1))
    if name == "blend":
        both = {"type": "blendphase", "weight": 0.3, "one": mueller(), "two": "rayleigh_polarized"}
        both["two"] = {"type": "rayleigh_polarized"}
        scene = reference.loaded(values, both)
        return scene, f"{MEDIUM}.phase_function.weight.value.value", np.ones(1)
    return reference.loaded(values, mueller()), DATA, random.uniform(0, 1, (*SHAPE, 1))


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    [
        "table",
        *(
            pytest.param(n, marks=pytest.mark.slow)
            for n in ("flow", "extinction", "albedo", "blend")
        ),
    ],
)
def test_forward_is_the_transpose_of_backward(name):
    """With the same random numbers, in several passes."""
    scene, key, tangent = case(name)
    scene.integrator().samples_per_pass = 4000
    image = reference.forward(scene, key, tangent, 200, 7).mean(0)
    scale = np.abs(image).max()
    for component, stokes in enumerate(np.eye(4)):
        gate = component % 2
        gradient = reference.backward(scene, key, gate, stokes, 200, 7)
        assert abs(image[gate, component]) > 1e-3 * scale
        assert abs((gradient * tangent).sum() - image[gate, component]) < 1e-4 * scale


@pytest.mark.slow
def test_light_of_an_order_is_proportional_to_a_power_of_the_albedo():
    """Euler's relation of a uniform albedo: a dS/da = k S of the order k."""
    values = reference.extinction(1.0, True)
    scene = reference.loaded(values, albedo=np.full(SHAPE, 0.9))
    image = np.array(mi.render(scene, spp=20_000, seed=3), float).reshape(36, 2, -1)
    parameters, integrator = mi.traverse(scene), scene.integrator()
    for order in range(1, ORDERS + 1):
        integrator.lowest_order = integrator.max_order = order
        found = [
            0.9 * reference.backward(scene, f"{MEDIUM}.albedo.data", 1, (1, 0, 0, 0), 2000, seed)
            for seed in range(8)
        ]
        found = np.sum(found, axis=(1, 2, 3, 4))
        light = image[:, 1, 4 + order]
        sigma = np.hypot(found.std(ddof=1) / 8**0.5, order * light.std(ddof=1) / 6)
        assert sigma < 0.02 * order * light.mean()
        assert abs(found.mean() - order * light.mean()) < 4 * sigma
    assert f"{MEDIUM}.albedo.data" in parameters


def test_a_table_has_no_gradient_along_itself():
    """It is scaled: what multiplies all of its elements changes nothing."""
    scene, key, _ = case("table")
    gradient = reference.backward(scene, key, 0, (1, 0, 0, 0), 300, 1)
    products = gradient[:, 1:] * TABLE[:, 1:]
    assert abs(products.sum()) < 1e-4 * np.abs(products).sum()
    assert not gradient[:, 0].any()


@pytest.mark.slow
def test_air_that_does_not_scatter_has_a_gradient():
    """One-sided differences where the extinction is 0."""
    values = reference.extinction(1.0, True)
    values[:, :, 3:5] = 0
    scene = reference.loaded(values)
    parameters = mi.traverse(scene)
    tangent = np.zeros((*SHAPE, 1))
    tangent[:, :, 3:5] = 1
    step = 2e-3
    with reference._same_paths(scene):
        images = []
        for length in (0, 1, 2):
            parameters[DATA] = mi.TensorXf(values[..., None] + length * step * tangent)
            parameters.update()
            image = np.array(mi.render(scene, spp=20_000, seed=3), float)
            images.append(image.reshape(36, 2, -1)[..., 5:])
        # of second order
        slope = (4 * images[1] - 3 * images[0] - images[2]) / (2 * step)
        parameters[DATA] = mi.TensorXf(values[..., None])
        parameters.update()
    integrator = scene.integrator()
    for order in (2, 3):
        integrator.lowest_order = integrator.max_order = order
        found = [reference.forward(scene, DATA, tangent, 2000, seed) for seed in range(3)]
        found = np.concatenate(found)[..., 0]
        for gate in (0, 1):
            one, other = found[:, gate], slope[:, gate, order - 1]
            sigma = np.hypot(one.std(ddof=1) / len(one) ** 0.5, other.std(ddof=1) / 6)
            assert abs(one.mean() - other.mean()) < 4 * sigma
            assert sigma < 0.1 * abs(other.mean())


class TestRefused:
    def refused(self, scene, *keys):
        parameters = mi.traverse(scene)
        for key in keys:
            dr.enable_grad(parameters[key])
        parameters.update()
        with pytest.raises(ValueError, match=r"^gated_volpath\.gradients: ") as error:
            scene.integrator().render_forward(scene, parameters)
        (line,) = str(error.value).splitlines()
        return line

    @pytest.mark.slow
    def test_what_has_no_gradient(self):
        scene = reference.loaded(reference.extinction(1.0, False))
        line = self.refused(scene, DATA, "sensor.fov_half_mrad")
        assert "'sensor.fov_half_mrad' is not allowed; expected extinction coefficients" in line

    @pytest.mark.slow
    def test_phase_functions_without_parameters_that_have_one(self):
        scene = reference.loaded(reference.extinction(1.0, False))
        phase = f"{MEDIUM}.phase_function.depolarization"
        assert f"'{phase}' is not allowed" in self.refused(scene, phase)

    @pytest.mark.slow
    def test_tables_of_mitsuba(self):
        scene = reference.loaded(
            reference.extinction(1.0, False), {"type": "tabphase", "values": "1, 2, 3"}
        )
        assert "values' is not allowed" in self.refused(scene, f"{MEDIUM}.phase_function.values")

    @pytest.mark.slow
    def test_no_parameter(self):
        scene = reference.loaded(reference.extinction(1.0, False))
        assert "'no parameter' is not allowed; expected dr.enable_grad of" in self.refused(scene)

    def test_analog_samples(self):
        scene = reference.loaded(reference.extinction(1.0, False))
        scene.integrator().estimator = "analog"
        assert "'analog' is not allowed; expected the gated estimator" in self.refused(scene, DATA)
