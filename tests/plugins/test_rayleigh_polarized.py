"""The Rayleigh phase matrix against dipole scattering of electric fields.

Detects: a matrix element or a rotation wrong by 1e-5 of the phase function, an error of 1e-6 in
the normalisation, a density that deviates from the samples by some 1 % in any of 5000 cells.
"""

import math

import mitsuba as mi
import numpy as np
import pytest
from mitsuba.chi2 import ChiSquareTest, PhaseFunctionAdapter, SphericalDomain

pytestmark = pytest.mark.usefixtures("variant")

BACKSCATTER = 3 / (8 * math.pi)
WORLD_DIRECTIONS = [
    (1, 0, 0),
    (-1, 0, 0),
    (0, 1, 0),
    (0, 0, 1),
    (0, 0, -1),
    (0.99, 0.1, -0.06),
    (1, -2, 3),
    (-1, -1, 0.2),
]


def phase(depolarization=0.0):
    return mi.load_dict({"type": "rayleigh_polarized", "depolarization": depolarization})


def onto_common_axis(optics, matrix, incident, scattered, axis):
    """A Mueller matrix about Mitsuba's axes turned to one axis perpendicular to both directions."""

    def turn(direction, current, target):
        """Matrix that refers Stokes vectors to ``target`` instead of ``current``."""
        cosine = (current * target).sum(-1)
        sine = (np.cross(current, target) * direction).sum(-1)
        cos2, sin2 = cosine**2 - sine**2, 2 * sine * cosine
        turned = np.zeros((len(direction), 4, 4))
        turned[:, 0, 0] = turned[:, 3, 3] = 1
        turned[:, 1, 1] = turned[:, 2, 2] = cos2
        turned[:, 1, 2], turned[:, 2, 1] = sin2, -sin2
        return turned

    into = turn(incident, axis, optics.axes(incident)[0])
    back = turn(scattered, optics.axes(scattered)[0], axis)
    return back @ matrix @ into


@pytest.mark.parametrize("offset", [0.0, 1e-7, 1e-6, 1e-5, 1e-3], ids=lambda o: f"{o:g}rad")
def test_backscatter_is_diag_1_1_m1_m1(optics, offset):
    """At 180 degrees, where the scattering plane vanishes, and so near it that rounding decides.

    The matrix itself changes by no more than the square of the offset.
    """
    rng = np.random.default_rng(1)
    incident = optics.normalized(np.array(WORLD_DIRECTIONS, float)).repeat(20, 0)
    axis = optics.perpendicular(incident, rng)
    # turned about the common axis, so that it stays perpendicular to both
    scattered = -incident * math.cos(offset) + np.cross(axis, incident) * math.sin(offset)
    matrix, _ = optics.evaluate(phase(), incident, scattered)
    turned = onto_common_axis(optics, matrix, incident, scattered, axis)
    expected = np.broadcast_to(BACKSCATTER * np.diag([1, 1, -1, -1]), turned.shape)
    assert np.abs(turned - expected).max() < 2e-6 * BACKSCATTER + offset**2


def uniaxial_dipoles(depolarization):
    """Polarisabilities of randomly oriented molecules, as tensors (m, 3, 3), and their weights.

    A molecule a (1/3 trace) + g (u u^T - 1/3) along u has depolarisation for natural light
    6 g^2 / (45 a^2 + 7 g^2). Scattered intensities are polynomials of degree 4 in u, for which
    this set of directions (Gauss-Legendre in cos, equidistant in azimuth) averages exactly.
    """
    a = 1.0
    g = math.sqrt(45 * depolarization / (6 - 7 * depolarization)) * a
    cosine, weight = np.polynomial.legendre.leggauss(4)
    azimuth = 2 * np.pi * np.arange(7) / 7
    cosine, azimuth = (v.ravel() for v in np.meshgrid(cosine, azimuth))
    weight = np.tile(weight, 7) / 14
    sine = np.sqrt(1 - cosine**2)
    u = np.stack([sine * np.cos(azimuth), sine * np.sin(azimuth), cosine], -1)
    tensor = a * np.eye(3) + g * (u[:, :, None] * u[:, None, :] - np.eye(3) / 3)
    # all light that leaves: 8 pi / 3 times |p|^2 averaged over orientations
    power = 8 * np.pi / 3 * (a**2 + 2 * g**2 / 9)
    return tensor, weight / power


@pytest.mark.parametrize("depolarization", [0.0, 0.028, 0.3])
def test_stokes_vectors_are_those_of_radiating_dipoles(optics, depolarization):
    """Fields E' = k' x (k' x alpha E) for random directions and random elliptic polarisation."""
    rng = np.random.default_rng(3)
    incident, scattered = optics.unit_vectors(rng, 400), optics.unit_vectors(rng, 400)
    field = optics.jones(rng, incident)
    tensors, weights = uniaxial_dipoles(depolarization)
    expected = 0
    for tensor, weight in zip(tensors, weights, strict=True):
        radiated = np.cross(scattered, np.cross(scattered, field @ tensor))
        expected = expected + weight * optics.stokes(radiated, *optics.axes(scattered))
    matrix, _ = optics.evaluate(phase(depolarization), incident, scattered)
    given = optics.stokes(field, *optics.axes(incident))
    assert np.abs(given[:, 3]).max() > 0.9  # circular light is among them
    found = np.einsum("nij,nj->ni", matrix, given)
    assert np.abs(found - expected).max() < 1e-6


@pytest.mark.parametrize("depolarization", [0.0, 0.028, 0.45])
def test_integrates_to_one_over_the_sphere(optics, depolarization):
    """Exact: the phase function is a quadratic in the cosine; only rounding is left."""
    cosine, weight = np.polynomial.legendre.leggauss(8)
    sine = np.sqrt(1 - cosine**2)
    scattered = np.stack([sine, 0 * sine, cosine], -1)
    matrix, pdf = optics.evaluate(phase(depolarization), np.tile([0.0, 0, 1], (8, 1)), scattered)
    assert 2 * np.pi * (weight * matrix[:, 0, 0]).sum() == pytest.approx(1, abs=1e-6)
    assert pdf == pytest.approx(matrix[:, 0, 0], rel=1e-6)


@pytest.mark.parametrize("depolarization", [0.0, 0.3])
@pytest.mark.parametrize("wi", [(0, 0, 1), (0.6, -0.64, 0.48)])
def test_samples_follow_the_density(depolarization, wi):
    """Chi-square, 1 % level over the four cases, seed 0."""
    sample, density = PhaseFunctionAdapter(
        "rayleigh_polarized",
        {"type": "rayleigh_polarized", "depolarization": depolarization},
        wi=list(wi),
    )
    test = ChiSquareTest(
        SphericalDomain(), sample, density, sample_dim=3, sample_count=500_000, res=51, ires=8
    )
    assert test.run(significance_level=0.01, test_count=4, quiet=True), test.messages


@pytest.mark.parametrize(
    "variant", ["llvm_ad_mono", "llvm_ad_rgb", "llvm_ad_spectral"], indirect=True
)
def test_unpolarised_variants_give_natural_light(optics, variant):
    """The value is the (1, 1) element: 3 / (16 pi) (1 + cos^2) without depolarisation."""
    rng = np.random.default_rng(6)
    incident, scattered = optics.unit_vectors(rng, 50), optics.unit_vectors(rng, 50)
    value, pdf = phase().eval_pdf(
        mi.PhaseFunctionContext(), optics.interaction(incident), optics.vector3(scattered)
    )
    cosine = (incident * scattered).sum(-1)
    expected = 3 / (16 * math.pi) * (1 + cosine**2)
    assert np.array(pdf) == pytest.approx(expected, rel=1e-5)
    for channel in np.array(value):
        assert channel == pytest.approx(expected, rel=1e-5)


@pytest.mark.parametrize(
    ("value", "expected"),
    [(-0.01, r"0 <= value < 0\.5"), (0.5, r"0 <= value < 0\.5"), (math.nan, "a finite number")],
)
def test_impossible_depolarisation_is_named(value, expected):
    named = rf"rayleigh_polarized\.depolarization: .* is not allowed; expected {expected}"
    with pytest.raises(RuntimeError, match=named):
        phase(value)


def test_depolarization_can_be_changed():
    phase, expected = (
        mi.load_dict({"type": "rayleigh_polarized", "depolarization": d}) for d in (0.0, 0.028)
    )
    parameters = mi.traverse(phase)
    parameters["depolarization"] = 0.028
    parameters.update()
    cosine = mi.Float(np.linspace(-1, 1, 9))
    np.testing.assert_array_equal(phase.phase(cosine), expected.phase(cosine))
    parameters["depolarization"] = 0.5
    with pytest.raises(ValueError, match=r"depolarization: 0\.5 is not allowed"):
        parameters.update()
