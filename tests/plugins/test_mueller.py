"""Tabulated scattering matrices against amplitudes, closed forms and their own samples.

Detects: an element in the wrong place or of the wrong sign, interpolation worse than its
truncation error (2e-5 of the phase function for 1 degree), a scale off by 1e-5, a density that
deviates from the samples by some 1 % in any of 1440 cells.
"""

import math
import re

import mitsuba as mi
import numpy as np
import pytest
from scipy.stats import chi2

pytestmark = pytest.mark.usefixtures("variant")

DEGREES = np.arange(181.0)


def rayleigh_table(degrees=DEGREES):
    """a1 a2 a3 a4 b1 b2 of dipole scattering, about 1 (Hansen & Travis 1974, eq. 2.14)."""
    cosine = np.cos(np.radians(degrees))
    parallel, mixed, across = 0.75 * (1 + cosine**2), -0.75 * (1 - cosine**2), 1.5 * cosine
    return np.column_stack([degrees, parallel, parallel, across, across, mixed, 0 * cosine])


def forward_peaked_table(degrees=DEGREES):
    """A phase function like large particles': peak of 2 degrees, halo, glory; half depolarised."""
    theta = np.radians(degrees)
    a1 = 200 * np.exp(-((degrees / 2) ** 2)) + 1 + 2 * np.exp(-(((180 - degrees) / 3) ** 2))
    half = 0.5 * a1
    sign = np.cos(theta)
    return np.column_stack([degrees, a1, half, half * sign, 0.2 * a1 * sign, 0 * a1, 0 * a1])


def plugin(table):
    return mi.load_dict({"type": "mueller", "table": mi.TensorXf(table)})


def directions_at(optics, rng, degrees):
    incident = optics.unit_vectors(rng, len(degrees))
    across = optics.perpendicular(incident, rng)
    angle = np.radians(degrees)[:, None]
    return incident, incident * np.cos(angle) + across * np.sin(angle)


def test_matrix_is_that_of_its_amplitudes(optics):
    """E'_par = S2 E_par, E'_per = S1 E_per with complex amplitudes, as of spheres.

    The elements of Bohren & Huffman 1983, eq. 4.77, in the table; fields in space scattered by
    the amplitudes; random directions and polarisation. b2 is of the order of a1 here.
    """
    rng = np.random.default_rng(2)
    degrees = np.linspace(0, 180, 61)
    theta = np.radians(degrees)
    amplitude = [1 + 0.4 * np.cos(theta) + 0.8j * np.sin(theta) * k for k in (1, -0.5)]
    # forward: S1 = S2, backward: S2 = -S1
    s1, s2 = amplitude[0], amplitude[1] * np.cos(theta)
    a1, b1 = (abs(s2) ** 2 + abs(s1) ** 2) / 2, (abs(s2) ** 2 - abs(s1) ** 2) / 2
    s33, s34 = (s1 * s2.conj()).real, (s2 * s1.conj()).imag
    assert np.abs(s34).max() > 0.5
    table = np.column_stack([degrees, a1, a1, s33, s33, b1, s34])
    integral = (
        2
        * np.pi
        * np.trapezoid(
            np.interp(t := np.radians(np.linspace(0, 180, 60001)), theta, a1) * np.sin(t), t
        )
    )

    pick = rng.integers(1, 60, 300)  # away from 0 and 180, where the plane is arbitrary
    incident, scattered = directions_at(optics, rng, degrees[pick])
    normal = optics.normalized(np.cross(incident, scattered))
    field = optics.jones(rng, incident)
    parallel = (field * np.cross(normal, incident)).sum(-1, keepdims=True)
    perpendicular = (field * normal).sum(-1, keepdims=True)
    radiated = s2[pick, None] * parallel * np.cross(normal, scattered)
    radiated = radiated + s1[pick, None] * perpendicular * normal
    expected = optics.stokes(radiated, *optics.axes(scattered)) / integral

    matrix, _ = optics.evaluate(plugin(table), incident, scattered)
    found = np.einsum("nij,nj->ni", matrix, optics.stokes(field, *optics.axes(incident)))
    assert np.abs(found - expected).max() < 3e-6


@pytest.mark.parametrize("scale", [1.0, 37.0])
@pytest.mark.parametrize("table", [rayleigh_table, forward_peaked_table])
def test_scaled_to_one_over_the_sphere(optics, table, scale):
    """a1 is linear between the nodes: dense trapezoids; all elements share the factor."""
    values = table()
    values[:, 1:] *= scale
    degrees = np.linspace(0, 180, 36001)
    angle = np.radians(degrees)
    scattered = np.stack([np.sin(angle), 0 * angle, np.cos(angle)], -1)
    incident = np.tile([0.0, 0, 1], (len(angle), 1))
    matrix, _ = optics.evaluate(plugin(values), incident, scattered)
    integral = 2 * np.pi * np.trapezoid(matrix[:, 0, 0] * np.sin(angle), angle)
    assert integral == pytest.approx(1, abs=1e-5)
    # away from the forward peak, where rounding of the angle matters
    nodes = slice(1000, None, 200)
    ratio = matrix[nodes, 3, 3] / matrix[nodes, 0, 0]
    assert ratio == pytest.approx((values[:, 4] / values[:, 1])[5:], abs=1e-3)


@pytest.mark.parametrize("table", [rayleigh_table, forward_peaked_table])
def test_samples_follow_the_density(optics, table):
    """Chi-square over 180 rings x 8 sectors, 1 % level over both tables, seed 6.

    The density is integrated over each ring by Gauss-Legendre in the angle.
    """
    rng = np.random.default_rng(6)
    number = 2_000_000
    phase = plugin(table())
    wo, _, _ = phase.sample(
        mi.PhaseFunctionContext(),
        optics.interaction(np.tile([0.0, 0, 1], (number, 1))),
        mi.Float(rng.random(number)),
        mi.Point2f(mi.Float(rng.random(number)), mi.Float(rng.random(number))),
    )
    x, y, z = np.array(wo).astype(float)
    rings = np.cos(np.radians(DEGREES))[::-1]
    sectors = np.linspace(-np.pi, np.pi, 9)
    found, _, _ = np.histogram2d(z, np.arctan2(y, x), [rings, sectors])

    point, weight = np.polynomial.legendre.leggauss(4)
    theta = np.radians(DEGREES)[::-1]
    middle, half = (theta[1:] + theta[:-1]) / 2, (theta[:-1] - theta[1:]) / 2
    angle = (middle[:, None] + half[:, None] * point).ravel()
    scattered = np.stack([np.sin(angle), 0 * angle, np.cos(angle)], -1)
    _, density = optics.evaluate(phase, np.tile([0.0, 0, 1], (len(angle), 1)), scattered)
    ring = (density * np.sin(angle)).reshape(-1, len(point)) @ weight
    fraction = 2 * np.pi * half * ring
    assert fraction.sum() == pytest.approx(1, abs=5e-6)
    expected = np.repeat(fraction[:, None] * number / 8, 8, 1)
    enough = expected > 10
    assert found[~enough].sum() < 1e-3 * number
    statistic = ((found - expected)[enough] ** 2 / expected[enough]).sum()
    assert chi2.sf(statistic, enough.sum() - 1) > 0.005


@pytest.mark.parametrize("table", [rayleigh_table, forward_peaked_table])
def test_weight_is_value_over_density(optics, table):
    """And that is one for natural light."""
    rng = np.random.default_rng(3)
    number = 20_000
    incident = np.tile([0.0, 0.6, 0.8], (number, 1))
    phase = plugin(table())
    wo, weight, pdf = phase.sample(
        mi.PhaseFunctionContext(),
        optics.interaction(incident),
        mi.Float(rng.random(number)),
        mi.Point2f(mi.Float(rng.random(number)), mi.Float(rng.random(number))),
    )
    matrix, density = optics.evaluate(phase, incident, np.array(wo).T)
    weight = np.array(weight)[:, :, 0].transpose(2, 0, 1)
    difference = np.abs(weight - matrix / density[:, None, None]).max()
    assert difference < 1e-5  # of an angle that is exact to rounding
    assert np.array(pdf) == pytest.approx(density, rel=1e-4)
    natural = weight[:, 0, 0]
    assert np.abs(natural - 1).max() < 1e-6  # the density is the value


@pytest.mark.parametrize("suffix", [".txt", ".npy"])
def test_table_from_a_file(optics, tmp_path, suffix):
    path = tmp_path / f"table{suffix}"
    table = forward_peaked_table(np.linspace(0, 180, 37))
    if suffix == ".npy":
        np.save(path, table)
    else:
        np.savetxt(path, table, header="angle a1 a2 a3 a4 b1 b2")
    rng = np.random.default_rng(4)
    incident, scattered = directions_at(optics, rng, rng.uniform(0, 180, 50))
    found, _ = optics.evaluate(
        mi.load_dict({"type": "mueller", "table": str(path)}), incident, scattered
    )
    given, _ = optics.evaluate(plugin(table), incident, scattered)
    assert np.abs(found - given).max() < 1e-6


def test_tables_of_the_package_are_found_from_anywhere(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert mi.load_dict({"type": "mueller", "table": "aerosol_dust_532nm.txt"})


@pytest.mark.parametrize("variant", ["llvm_ad_mono", "llvm_ad_rgb"], indirect=True)
def test_unpolarised_variants_give_a1(optics, variant):
    rng = np.random.default_rng(5)
    degrees = rng.uniform(0, 180, 100)
    incident, scattered = directions_at(optics, rng, degrees)
    value, _ = plugin(rayleigh_table()).eval_pdf(
        mi.PhaseFunctionContext(), optics.interaction(incident), optics.vector3(scattered)
    )
    expected = 3 / (16 * math.pi) * (1 + np.cos(np.radians(degrees)) ** 2)
    for channel in np.array(value):
        assert channel == pytest.approx(expected, abs=2e-5)


def edited(change):
    table = rayleigh_table()
    change(table)
    return table


@pytest.mark.parametrize(
    ("table", "message"),
    [
        (rayleigh_table()[:, :6], r"shape (181, 6).* N x 7 numbers with N >= 3"),
        (rayleigh_table()[[0, -1]], r"shape (2, 7).* N x 7 numbers with N >= 3"),
        (rayleigh_table().ravel(), r"shape (1267,).* N x 7 numbers"),
        (edited(lambda t: t.__setitem__((7, 3), np.nan)), "NaN or infinity.* finite numbers"),
        (edited(lambda t: t.__setitem__((7, 3), np.inf)), "NaN or infinity.* finite numbers"),
        (rayleigh_table()[1:], r"angles 1 ... 180.* angles rising from 0 to 180"),
        (rayleigh_table()[:-1], r"angles 0 ... 179.* angles rising from 0 to 180"),
        (rayleigh_table()[::-1], r"angles 180 ... 0.* angles rising from 0 to 180"),
        (edited(lambda t: t.__setitem__((7, 0), 6.0)), "angles rising from 0 to 180"),
        (edited(lambda t: t.__setitem__((7, 1), 0.0)), "a1 down to 0.* a1 above 0"),
        (edited(lambda t: t.__setitem__((7, 1), -1.0)), "a1 down to -1.* a1 above 0"),
        (edited(lambda t: t.__setitem__((7, 5), 9.0)), "an element above a1.* no element larger"),
    ],
)
def test_bad_tables_are_named(table, message):
    head, _, rest = message.partition(".*")
    with pytest.raises(RuntimeError) as error:
        plugin(table)
    last = str(error.value).splitlines()[-1]
    assert re.search(r"mueller\.table: .* is not allowed; expected", last)
    assert head in last and rest.strip() in last


@pytest.mark.parametrize(
    ("name", "content", "expected"),
    [
        ("absent.txt", None, "a readable file"),
        ("words.txt", b"0 one two\n", "N lines of 7 numbers"),
        ("ragged.txt", b"0 1 1 1 1 0 0\n90 1 1\n", "N lines of 7 numbers"),
        ("empty.txt", b"", "N x 7 numbers"),
        ("broken.npy", b"\x93NUMPY\x01", "N lines of 7 numbers"),
        ("empty.npy", b"", "N lines of 7 numbers"),
    ],
)
@pytest.mark.filterwarnings("ignore:loadtxt")
def test_bad_files_are_named(tmp_path, name, content, expected):
    path = tmp_path / name
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(RuntimeError) as error:
        mi.load_dict({"type": "mueller", "table": str(path)})
    last = str(error.value).splitlines()[-1]
    assert re.search(r"mueller\.table: .* is not allowed; expected", last)
    assert expected in last


def test_missing_table_is_named():
    with pytest.raises(RuntimeError, match=r"mueller\.table: None is not allowed; expected"):
        mi.load_dict({"type": "mueller"})


@pytest.mark.parametrize("step", [1.0, 2.5])
def test_a_table_is_exchanged_through_traverse(optics, step):
    """A phase function with a new table, of as many angles or not, is that made from it."""
    rng = np.random.default_rng(5)
    table = rayleigh_table(np.arange(0, 180 + step, step))
    changed, made = plugin(forward_peaked_table()), plugin(table)
    parameters = mi.traverse(changed)
    np.testing.assert_allclose(parameters["table"].numpy(), forward_peaked_table(), rtol=1e-6)
    parameters["table"] = mi.TensorXf(table)
    parameters.update()
    incident, scattered = directions_at(optics, rng, rng.uniform(0, 180, 200))
    for one, other in zip(
        optics.evaluate(changed, incident, scattered),
        optics.evaluate(made, incident, scattered),
        strict=True,
    ):
        np.testing.assert_allclose(one, other, rtol=1e-5, atol=1e-7)


def test_a_bad_table_is_refused_through_traverse():
    parameters = mi.traverse(plugin(rayleigh_table()))
    parameters["table"] = mi.TensorXf(rayleigh_table()[:, :6])
    with pytest.raises(Exception, match="expected N x 7 numbers"):
        parameters.update()
