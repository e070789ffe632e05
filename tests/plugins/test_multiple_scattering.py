"""Orders above one: both estimators against an independent simulation, order by order.

Detects: 1 % of the signal in any gate of a dense slab (3 sigma of 0.3 % statistics), 1 % in the
degree of polarisation, an order counted twice or left out.
"""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from validation.transport_reference import Case, simulate

pytestmark = pytest.mark.usefixtures("variant")

RAYLEIGH = Case()
FORWARD = Case(asymmetry=0.7, albedo=0.95, fov_half=20e-3)
ORDERS = 6


def dense(world, case, estimator="gated", max_order=ORDERS, samples=64, slab=None, **integrator):
    """One beam into a dense slab in a vacuum, gates of 10 m range (spherical)."""
    phase = "rayleigh_polarized" if case.asymmetry is None else {"type": "hg", "g": case.asymmetry}
    medium = world.homogeneous(case.extinction, phase, case.albedo)
    low, high = (case.slab[0], -1000.0, -1000.0), (case.slab[1], 1000.0, 1000.0)
    return world.scene(
        world.lidar(
            (1, 1),
            (case.gates[0], case.gates[-1]),
            laser={"beam_radius": case.beam_radius, "beam_cut": 100.0},
            samples=samples,
            gate_count=len(case.gates) - 1,
            gate_kind="spherical",
            fov_half_mrad=case.fov_half * 1e3,
        ),
        {"estimator": estimator, "max_order": max_order, "orders": True, **integrator},
        slab=world.box(low, high, slab or medium),
    )


def gates(scene, **options):
    """(gates, channels): S0 ... S3, S0_stderr, then S0 order by order."""
    image = np.array(mi.render(scene, **options)).astype(float)
    return image.reshape(scene.sensors()[0].gate_count, -1)


@pytest.fixture(scope="module")
def truth():
    return {case: simulate(case, 300_000, ORDERS, seed=12) for case in (RAYLEIGH, FORWARD)}


def agree(found, mean, error, sigmas=3.5):
    """Ten gates within the errors of both: 3.5 sigma each, and their mean square near one."""
    z = (found[:, 0] - mean[..., 0].sum(1)) / np.hypot(found[:, 4], error[:, 0])
    assert np.abs(z).max() < sigmas, z
    assert (z**2).mean() < 1 + 3 * np.sqrt(2 / len(z)), z


@pytest.mark.slow
@pytest.mark.parametrize("case", [RAYLEIGH, FORWARD], ids=["rayleigh", "forward"])
@pytest.mark.parametrize("estimator", ["gated", "analog"])
def test_dense_slab_agrees_with_an_independent_simulation(world, truth, case, estimator):
    mean, error = truth[case]
    found = gates(dense(world, case, estimator), spp=1_000_000, seed=5)
    agree(found, mean, error)
    # in both cases multiple scattering exceeds single scattering in the end: nothing can hide
    assert found[-1, 0] > 1.5 * found[-1, 5]
    # every order by itself, summed over gates; high orders are rare in both simulations
    orders, reference = found[:, 5:].sum(0), mean[..., 0].sum(0)
    low, high = (0.03, 0.15) if case is RAYLEIGH else (0.1, 0.4)
    np.testing.assert_allclose(orders[:3], reference[:3], rtol=low)
    np.testing.assert_allclose(orders[3:], reference[3:], rtol=high)


def test_depolarisation_by_multiple_scattering(world, truth):
    mean, error = truth[RAYLEIGH]
    found = gates(dense(world, RAYLEIGH), spp=1_000_000, seed=6)
    total = mean.sum(1)
    degree, reference = found[:, 1] / found[:, 0], total[:, 1] / total[:, 0]
    # both errors of Q over I, taken as uncorrelated: an upper bound
    spread = np.hypot(error[:, 1] / total[:, 0], error[:, 0] * reference / total[:, 0])
    spread = np.hypot(spread, 1.5 * found[:, 4] / found[:, 0])
    assert (np.abs(degree - reference) < 3 * spread).all()
    assert degree[0] > 0.95 and degree[-1] < 0.75


@pytest.mark.slow
@pytest.mark.parametrize("peak", [1e-4, 2.0])
@pytest.mark.parametrize("case", [RAYLEIGH, FORWARD], ids=["rayleigh", "forward"])
def test_a_wrong_forward_peak_guides_without_bias(world, truth, monkeypatch, case, peak):
    """Flights are drawn for a phase function that is not the medium's."""

    def wrong(*_):
        return dr.opaque(mi.Float, peak)

    monkeypatch.setattr("lidar_mi.plugins.path_sampling.narrowest_peak", wrong)
    agree(gates(dense(world, case), spp=400_000, seed=8), *truth[case])


def test_orders_sum_to_the_total_and_the_first_is_single_scattering(world):
    found = gates(dense(world, RAYLEIGH), spp=20_000, seed=1)
    np.testing.assert_allclose(found[:, 5:].sum(1), found[:, 0], rtol=1e-5)
    single = gates(dense(world, RAYLEIGH, max_order=1), spp=20_000, seed=1)
    np.testing.assert_allclose(found[:, 5], single[:, 0], rtol=1e-5)


def test_orders_of_millions_of_samples_keep_their_digits(world):
    """In one gate: a running sum of so many terms is off by 4e-6, or more with longer runs."""
    case = Case(gates=(500.0, 510.0))
    found = gates(dense(world, case, max_order=2), spp=4_000_000, seed=1)
    np.testing.assert_allclose(found[:, 5:].sum(1), found[:, 0], rtol=2e-6)


@pytest.mark.parametrize("factor", [1, 4, 20])
def test_any_majorant_gives_the_same(world, truth, factor):
    """A grid equals the homogeneous slab, and one bright voxel far away only costs time."""
    mean, error = truth[RAYLEIGH]
    low, high = (500.0, -1000.0, -1000.0), (600.0, 1000.0, 1000.0)
    values = np.full((20, 20, 2), RAYLEIGH.extinction)
    values[-1, -1, -1] *= factor
    slab = world.grid(values, low, high)
    found = gates(dense(world, RAYLEIGH, slab=slab), spp=200_000, seed=7)
    agree(found, mean, error)


@pytest.mark.slow
def test_environment_and_slab_scatter_together(world):
    """Vertices before the slab count as well: both estimators agree in an environment."""
    environment = world.homogeneous(5e-3, "rayleigh_polarized")
    slab = world.grid(np.full((4, 4, 3), 0.03), (495.0, -40.0, -40.0), (510.0, 40.0, 40.0))
    images = []
    for estimator, samples in (("gated", 300_000), ("analog", 1_500_000)):
        scene = world.scene(
            world.lidar(
                (1, 1),
                (490.0, 515.0),
                environment=world.ENVIRONMENT,
                gate_count=5,
                fov_half_mrad=30.0,
            ),
            {"estimator": estimator, "max_order": 4, "orders": True},
            environment=environment,
            slab=world.box((495.0, -40.0, -40.0), (510.0, 40.0, 40.0), slab, world.ENVIRONMENT),
        )
        images.append(gates(scene, spp=samples, seed=3))
    gated, analog = images
    z = (gated[:, 0] - analog[:, 0]) / np.hypot(gated[:, 4], analog[:, 4])
    assert np.abs(z).max() < 3.5, z
    second = gated[:, 6].sum(), analog[:, 6].sum()
    assert abs(second[0] / second[1] - 1) < 0.05


@pytest.mark.slow
@pytest.mark.parametrize("variant", ["llvm_ad_mono", "llvm_ad_rgb"], indirect=True)
def test_unpolarised_variants_agree(world, truth, variant):
    mean, error = truth[FORWARD]
    found = gates(dense(world, FORWARD), spp=500_000, seed=9)
    assert (found[:, 1:4] == 0).all()
    agree(found, mean, error)
