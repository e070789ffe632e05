"""Families of flows, their images, and the statistics of errors on them. Unit and physics tiers.

Detects: turbulence of another spectrum or with the wrong divergence, a flow that is not what its
family says, air that is not carried exactly, a family without a purpose, an error bar that is too
small or too large and passes, a row that passes because it is uncertain.
"""

from dataclasses import replace

import numpy as np
import pytest
import xarray as xr

from benchmarks.velocimetry import Field
from tests.support.flows import axes, origin
from validation.flows import __main__ as quick_look
from validation.flows import families, images, measure, table
from validation.flows.families import BY_NAME, FAMILIES, Family
from validation.flows.images import BASE, FURTHER, TEXTURES, Condition, pair
from validation.flows.measure import Accuracy, accuracy
from validation.flows.turbulence import PERIOD, turbulence

GRID = np.meshgrid(*axes(219, 139))
CLEAN = Condition("clean")


def gradients(wind, y, z, step=0.05):
    """dv/dy, dv/dz, dw/dy, dw/dz by differences."""
    (right, left), (up, down) = (
        [np.array(wind(y + sign * a, z + sign * b)) for sign in (1, -1)]
        for a, b in ((step, 0), (0, step))
    )
    (vy, wy), (vz, wz) = (right - left) / (2 * step), (up - down) / (2 * step)
    return vy, vz, wy, wz


# --- turbulence


def longitudinal(k, largest, smallest, rms, slope, planar):
    """One-dimensional spectrum of the component along the line, m^3 s^-2, closed integral.

    Three dimensions: Pope 2000, Turbulent Flows, eq. 6.214; two: the same integral in the plane.
    """
    limits = 2 * np.pi / largest, 2 * np.pi / smallest
    q = np.geomspace(*limits, 4000)
    energy = q**-slope
    energy *= (1.0 if planar else 1.5) * rms**2 / np.trapezoid(energy, q)
    inside = np.clip(1 - (k[:, None] / q) ** 2, 0, None)
    kernel = 4 / np.pi * np.sqrt(inside) if planar else inside
    return np.trapezoid(energy / q * kernel, q, axis=1)


SPECTRA = {
    "k^-5/3": (40.0, 3.0, 2.0, 5 / 3, False),
    "k^-2.5": (60.0, 4.0, 3.0, 2.5, False),
    "planar k^-3": (50.0, 4.0, 5.0, 3.0, True),
    "planar k^-5/3": (40.0, 3.0, 2.0, 5 / 3, True),
}


@pytest.mark.parametrize("name", SPECTRA)
def test_spectrum_along_a_line(name):
    """Six realisations, bands of 8 wave numbers, 4.5 standard errors from their scatter."""
    largest, smallest, rms, slope, planar = SPECTRA[name]
    points = np.arange(0, PERIOD, 1.0)
    y, z = np.meshgrid(points, points)
    found = []
    for seed in range(6):
        v, w = turbulence(
            np.random.default_rng(seed), largest, smallest, rms, slope=slope, planar=planar
        )(y, z)
        along_y = np.abs(np.fft.rfft(v, axis=1)).T ** 2
        along_z = np.abs(np.fft.rfft(w, axis=0)) ** 2
        power = (along_y.mean(1) + along_z.mean(1)) / 2 / len(points) ** 2
        found.append(2 * power * PERIOD / (2 * np.pi))
    k = 2 * np.pi / PERIOD * np.arange(len(points) // 2 + 1)
    expected = longitudinal(k, largest, smallest, rms, slope, planar)

    def bands(values):
        return values[..., 1:81].reshape(*values.shape[:-1], 10, 8).mean(-1)

    got, error = bands(np.array(found)).mean(0), bands(np.array(found)).std(0, ddof=1) / 6**0.5
    # five degrees of freedom: an error below a tenth is by chance
    error = np.maximum(error, 0.05 * bands(expected))
    resolved = bands(expected) > 1e-3 * bands(expected)[0]
    assert resolved.sum() >= 5
    assert (np.abs(got - bands(expected)) < 4.5 * error)[resolved].all()


@pytest.mark.parametrize("planar", [False, True])
def test_divergence_in_the_plane(planar):
    """None in two dimensions; in three that of isotropic turbulence.

    There <(dv/dy + dw/dz)^2> = <(du/dx)^2> = <(dv/dy)^2> = <(dv/dz)^2> / 2 (Batchelor 1953,
    sect. 3.4), each to 6 % with 10 planes of some 2000 independent eddies.
    """
    y, z = np.meshgrid(np.arange(0, PERIOD, 2.0), np.arange(0, PERIOD, 2.0))
    squares = []
    for seed in range(10):
        wind = turbulence(np.random.default_rng(seed), 30, 3, 2.0, planar=planar)
        vy, vz, wy, wz = gradients(wind, y, z)
        squares.append([np.mean(a**2) for a in (vy + wz, vy, wz, vz, wy)])
    divergence, vy, wz, vz, wy = np.mean(squares, axis=0)
    if planar:
        assert divergence < 1e-4 * vz
        # <(dv/dz)^2> = 3 <(dv/dy)^2>, as both components of the wave vector are alike
        assert (vz / vy, wy / wz) == pytest.approx((3, 3), rel=0.06)
    else:
        assert (divergence / vy, divergence / wz) == pytest.approx((1, 1), rel=0.06)
        assert (vz / vy, wy / wz) == pytest.approx((2, 2), rel=0.06)


# --- other flows


def test_swirl_and_circulation_of_vortices():
    draw = families.vortices(1, (5, 5), (3, 3))
    wind = draw(np.random.default_rng(3))
    fine = np.meshgrid(np.arange(-60, 60, 0.1), np.arange(-40, 40, 0.1))
    speed = np.hypot(*wind(*fine))
    assert speed.max() == pytest.approx(5, rel=1e-3)
    centre = [a.ravel()[np.argmax(np.hypot(*np.gradient(speed)))] for a in fine]
    angle = np.linspace(0, 2 * np.pi, 4000, endpoint=False)
    y, z = centre[0] + 25 * np.cos(angle), centre[1] + 25 * np.sin(angle)
    v, w = wind(y, z)
    circulation = np.mean(w * np.cos(angle) - v * np.sin(angle)) * 2 * np.pi * 25
    # a swirl of Gamma / (2 pi r) (1 - exp(-1.2564)) at the core
    assert abs(circulation) == pytest.approx(2 * np.pi * 3 * 5 / (1 - np.exp(-1.2564)), rel=1e-3)


@pytest.mark.parametrize(
    ("name", "circulations", "separation"),
    [("wide pair", (250, 450), 47.1), ("close pair", (80, 160), 20.0)],
)
def test_circulation_and_separation_of_a_pair(name, circulations, separation):
    """Around the half plane beyond the line of symmetry; midway the air moves by 2 Gamma / pi b."""
    wind = BY_NAME[name].flow(2)
    y = np.linspace(-15, 15, 30001)
    middle = y[np.argmin(np.abs(wind(y, np.full_like(y, 60.0))[0]))]
    z = np.arange(-5000, 5000, 0.05)
    w = wind(np.full_like(z, middle), z)[1]
    circulation = -w.sum() * 0.05
    assert circulations[0] < circulation < circulations[1]
    # the rest of the line has 0.3 % of the circulation
    assert 2 * circulation / (np.pi * -w.min()) == pytest.approx(separation, rel=5e-3)


@pytest.mark.parametrize("name", ["shear", "jet", "cells", "strain", "four vortices", "close pair"])
def test_flow_without_divergence(name):
    vy, _, _, wz = gradients(BY_NAME[name].flow(1), *GRID)
    assert np.abs(vy + wz).max() < 1e-2 * np.abs([vy, wz]).max() + 1e-9


@pytest.mark.parametrize(("name", "diverges"), [("strain", False), ("outflow", True)])
def test_flow_without_rotation(name, diverges):
    vy, vz, wy, wz = gradients(BY_NAME[name].flow(1), *GRID)
    assert np.abs(vz - wy).max() < 1e-3 * np.abs([vz, wy]).max() + 1e-9
    assert (np.abs(vy + wz).max() > 0.3) == diverges


@pytest.mark.parametrize(
    "name", ["simulated wake, x = 11 to 15 m", "simulated wake, x = 25 to 30 m"]
)
def test_simulated_wake_is_a_plane_of_the_file_beside_that_of_the_experiments(name):
    with xr.open_dataset(families.VOLUME) as stored:
        low, high = (float(word) for word in name.split(" = ")[1].removesuffix(" m").split(" to "))
        box = stored.isel(time=0).sel(x=slice(low, high)).transpose("x", "y", "z").load()
    assert np.abs(box["x"] - 20.5).min() > 4
    y, z = (box[axis].values - (box[axis].values[0] + box[axis].values[-1]) / 2 for axis in "yz")
    v = BY_NAME[name].flow(1)(*np.meshgrid(y, z, indexing="ij"))[0]
    turned = [v[::a, ::b] * a for a in (1, -1) for b in (1, -1)]
    nearest = min(np.abs(plane.values - one).max() for plane in box["v"] for one in turned)
    assert nearest < 1e-4


# --- families


@pytest.mark.slow
@pytest.mark.parametrize("family", FAMILIES, ids=lambda family: family.name)
def test_flow_is_drawn_by_the_seed_and_air_returns(family):
    """Back from where it came from: the second image is reversible."""
    y, z = (a[::23, ::23] for a in GRID)
    first, again, other = (np.array(family.flow(seed)(y, z)) for seed in (1, 1, 2))
    np.testing.assert_array_equal(first, again)
    assert np.abs(first - other).max() > 0.1
    assert 0.3 < np.sqrt(np.mean(first**2)) < 12
    wind = family.flow(1)
    np.testing.assert_allclose(origin(wind, *origin(wind, y, z, 0.1), -0.1), [y, z], atol=1e-4)


def test_halves():
    purposes = [family.purpose for family in FAMILIES]
    assert set(purposes) == {"build", "judge"}
    assert abs(purposes.count("build") - purposes.count("judge")) <= 2
    assert len(BY_NAME) == len(FAMILIES)
    assert {*families.chosen("judge"), *families.chosen("build")} == {*families.chosen()}
    judge = {family.name for family in families.chosen("judge")}
    assert judge >= {"jet", "cells", "strain", "many small vortices", "turbine"}


@pytest.mark.parametrize("purpose", ["build", "judge"])
def test_each_half_is_seen_in_all_conditions(purpose):
    seen = {c for family in families.chosen(purpose) for c in images.conditions_of(family)}
    assert seen == {*BASE, *FURTHER, *TEXTURES}
    assert {*images.TEXTURED} <= {*BY_NAME}


# --- images


def constant(v, w):
    def draw(random):
        return lambda y, z: (np.full(np.shape(y), float(v)), np.full(np.shape(y), float(w)))

    return Family("constant", "", "build", draw)


@pytest.mark.parametrize("condition", (CLEAN, *TEXTURES), ids=lambda condition: condition.texture)
def test_uniform_wind_shifts_the_image(condition):
    """10 and -5 m/s: 2 px to the right and 1 px down."""
    found = pair(constant(10, -5), replace(condition, noise=0.0), 1)
    moved = found.second.values[:-1, 2:]
    np.testing.assert_allclose(moved, found.first.values[1:, :-2], atol=1e-9)
    assert found.first.values.std() > 0.05


def test_blur_damps_the_texture():
    """The variance of exp(-(r / l)^2) by l^2 / (l^2 + 4 s^2), and the images stay shifted."""
    sharp, blurred = (
        [pair(constant(10, -5), replace(CLEAN, blur=blur), seed) for seed in range(4)]
        for blur in (0.0, 0.7)
    )
    ratio = np.mean(
        [b.first.values.var() / s.first.values.var() for b, s in zip(blurred, sharp, strict=True)]
    )
    assert ratio == pytest.approx(9 / (9 + 4 * 0.7**2), rel=0.03)
    one = blurred[0]
    np.testing.assert_allclose(one.second.values[:-1, 2:], one.first.values[1:, :-2], atol=1e-9)
    assert one.blur == pytest.approx(0.35)


@pytest.mark.parametrize("fraction", [0.1, 0.3])
def test_replaced_fraction(fraction):
    """Of the variance: that of air at rest, whose other part has the correlation 0."""
    squares = []
    for seed in range(4):
        found = pair(constant(0, 0), replace(CLEAN, replaced=fraction), seed)
        correlation = np.corrcoef(found.first.values.ravel(), found.second.values.ravel())[0, 1]
        squares.append(1 - correlation**2)
    # 8600 cells of texture: 4 standard errors
    assert np.mean(squares) == pytest.approx(fraction, abs=8 * np.sqrt(fraction / 8600))


@pytest.mark.parametrize("told", ["known", "unknown", "map"])
def test_noise_and_what_is_known_of_it(told):
    quiet = pair(constant(0, 0), CLEAN, 1)
    found = pair(constant(0, 0), Condition("noisy", 0.05, told), 1)
    noise = np.stack([found.first - quiet.first, found.second - quiet.second])
    level = 0.05 * (np.linspace(0.2, 1, 219) if told == "map" else np.ones(219))
    # 278 values in each column: 4.5 standard errors
    assert np.abs(noise.std((0, 1)) / level - 1).max() < 4.5 / np.sqrt(2 * 278)
    assert abs(np.corrcoef(noise[0].ravel(), noise[1].ravel())[0, 1]) < 4 / np.sqrt(219 * 139)
    if told == "map":
        np.testing.assert_allclose(found.noise.values, np.tile(level, (139, 1)))
    else:
        assert found.noise == {"known": 0.05, "unknown": None}[told]
    assert quiet.noise is None


# --- statistics


def normal_errors(seeds, factor=1.0, valid=1.0, spread=0.0, stream=1):
    """Errors ``factor`` times as large as stated, of images whose factors differ by ``spread``."""
    random = np.random.default_rng(stream)
    found = []
    for _ in range(seeds):
        stated = random.uniform(0.1, 0.5, (2, 31, 51))
        own = factor * np.exp(spread * random.standard_normal())
        error = own * stated * random.standard_normal(stated.shape)
        found.append((error, stated, np.ones_like(stated), random.uniform(size=(31, 51)) < valid))
    return found


NAMES = ("air", "images", "method")


@pytest.mark.parametrize("valid", [1.0, 0.3])
def test_errors_as_stated(valid):
    found = accuracy(normal_errors(8, valid=valid), NAMES)
    number = 8 * 2 * 31 * 51 * valid
    assert found.variance[0] == pytest.approx(1, abs=4 * np.sqrt(2 / number))
    for value, expected in ((found.coverage_68, 0.6827), (found.coverage_95, 0.95)):
        error = np.sqrt(expected * (1 - expected) / number)
        assert value[0] == pytest.approx(expected, abs=4 * error)
        # from 8 seeds, known to a quarter
        assert 0.4 * error < value[1] < 2.2 * error
    assert found.valid == pytest.approx(valid, abs=0.02) and found.seeds == 8
    assert found.rmse == pytest.approx(found.stated, rel=0.05) and found.wind == 1
    assert found.judged and found.inside and found.resolved and not found.far


@pytest.mark.parametrize(("factor", "variance"), [(1.5, 2.25), (1 / 1.5, 1 / 2.25)])
def test_errors_that_are_not_as_stated(factor, variance):
    """Larger or smaller by half: outside, both ways."""
    found = accuracy(normal_errors(4, factor), NAMES)
    assert found.variance[0] == pytest.approx(variance, rel=0.05)
    assert not found.variance_inside and not found.coverage_inside and not found.inside
    assert found.far and found.resolved


def test_scatter_of_flows_is_in_the_uncertainty():
    """Factors that differ from flow to flow: far more than the number of vectors lets expect."""
    found = [accuracy(normal_errors(6, spread=0.4, stream=s), NAMES).variance for s in range(40)]
    values, errors = np.array(found).T
    # 40 values: 11 % for their scatter, a systematic -15 % for six seeds of a skewed distribution
    assert np.sqrt(np.mean(errors**2)) == pytest.approx(values.std(ddof=1), rel=0.35)
    assert np.mean(errors) > 5 * np.sqrt(2 / (6 * 2 * 31 * 51))


def row(variance=(1.0, 0.02), narrow=(0.68, 0.01), valid=1.0, family="jet", **more):
    given = {"condition": "no noise", "method": "variational", "seeds": 4, **more}
    return Accuracy(
        family=family, valid=valid, rmse=0.1, stated=0.1, wind=3.0,
        coverage_68=narrow, coverage_95=(0.95, 0.01), variance=variance, **given,
    )  # fmt: skip


@pytest.mark.parametrize(
    ("variance", "narrow", "resolved"),
    [
        ((1.0, 0.10), (0.68, 0.02), True),
        ((1.0, 0.15), (0.68, 0.02), False),
        ((1.0, 0.10), (0.68, 0.03), False),
        # outside without doubt, though the uncertainty is large
        ((4.0, 1.0), (0.40, 0.05), True),
        ((1.4, 0.2), (0.60, 0.02), False),
        # near the limit, which it does not pass by its uncertainty
        ((1.3, 0.5), (0.68, 0.01), False),
    ],
)
def test_resolved(variance, narrow, resolved):
    found = row(variance, narrow)
    assert found.resolved is resolved and found.variance_inside == (variance[0] == 1)


# --- methods


def test_a_row_of_a_method():
    (found,) = measure.measured(BY_NAME["jet"], BASE[1], ["multipass"], [1])
    assert found.valid > 0.9 and found.rmse < 0.1 * found.wind
    assert 0.5 < found.variance[0] < 2 and (found.family, found.condition) == ("jet", "1 % known")


@pytest.mark.parametrize(("start", "moved"), [(0, 0.5), (3.5, 0.0)])
def test_displacements_of_another_program_are_compared_where_they_belong(start, moved):
    """A wind that grows along z, given exactly: no error, and none within 8 px of the edge."""

    def draw(random):
        return lambda y, z: (0.2 * np.asarray(z), np.full(np.shape(y), 3.0))

    found = pair(Family("shear", "", "build", draw), CLEAN, 1)
    shape = (139 - int(2 * start), 219 - int(2 * start))
    z = (np.arange(shape[0]) + start - 69) * 0.5
    dz = np.full(shape, 0.3 / 0.5)
    # of the air that moves by dz
    dy = np.tile((0.02 * (z + moved * 0.3) / 0.5)[:, None], (1, shape[1]))
    error, stated, true, valid = measure.errors_of_field(found, Field(dz, dy, start, moved))
    assert valid.all() and np.isnan(stated).all() and np.abs(error).max() < 1e-12
    assert np.abs(true[0]).max() < 0.2 * (69 - 8 + 1) * 0.5 and valid.size > 1400
    row = accuracy([(error, stated, true, valid)], NAMES)
    assert not row.judged and row.rmse < 1e-12


# --- the table


def lines_of(*rows):
    return [((BY_NAME[one.family], BASE[0]), [one]) for one in rows]


def test_required_rows_pass_inside_and_fail_outside():
    good = list(table.required(lines_of(*[row()] * 9, row((1.9, 0.1), (0.5, 0.01)))))
    assert len(good) == 3 and all(one.passed for one in good)
    bad = list(table.required(lines_of(*[row()] * 8, *[row((2.2, 0.1), (0.5, 0.01))] * 2)))
    assert len(bad) == 3 and not any(one.passed for one in bad)


def test_quick_look(capsys, tmp_path):
    given = ["--family", "jet", "--condition", "1 % known", "--methods", "cc", "--seeds", "1"]
    stored = tmp_path / "rows.json"
    assert quick_look.main([*given, "-o", str(stored)]) == 0
    head, line, *counts = capsys.readouterr().out.splitlines()
    assert head.startswith("family") and line.startswith("jet") and " cc " in line
    assert counts[-1].startswith("| judge | cc | 1 |")
    assert quick_look.main([*given, "--against", str(stored)]) == 0
    assert "error x 1.000, valid +0.00" in capsys.readouterr().out
