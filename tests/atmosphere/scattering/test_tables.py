"""Scattering tables: closed forms and conservation. Detects 1e-5 in a derived number, any
sign or column mistaken, and any physically impossible table accepted."""

import math
from dataclasses import replace

import numpy as np
import pytest

from lidar_mi.atmosphere.scattering.tables import ScatteringTable, describe, mix, rayleigh_table
from lidar_mi.errors import InputError


def haze(g=0.7, kept=0.8, step=0.25, **changes):
    """Henyey-Greenstein a1 with the simplest depolarising matrix: `kept` = a2/a1."""
    angle = np.linspace(0, 180, round(180 / step) + 1)
    cosine = np.cos(np.radians(angle))
    a1 = (1 - g * g) / (1 + g * g - 2 * g * cosine) ** 1.5
    zero = np.zeros_like(a1)
    elements = [a1, kept * a1, kept * cosine * a1, (2 * kept - 1) * cosine * a1, zero, zero]
    values = {
        "name": "haze",
        "wavelength": 532e-9,
        "extinction_cross_section": 2e-13,
        "albedo": 0.9,
        "number_density": 5e8,
        "provenance": "closed form",
    }
    return ScatteringTable(angle=angle, elements=np.stack(elements, axis=1), **(values | changes))


def test_derived_numbers_in_closed_form():
    g, kept, albedo = 0.7, 0.8, 0.9
    table = haze(g, kept)
    backward = (1 - g * g) / (1 + g) ** 3
    assert table.lidar_ratio == pytest.approx(4 * math.pi / (albedo * backward), rel=1e-12)
    assert table.backscatter_per_extinction == pytest.approx(1 / table.lidar_ratio, rel=1e-12)
    assert table.depolarization_ratio == pytest.approx((1 - kept) / (1 + kept), rel=1e-12)
    assert table.asymmetry == pytest.approx(g, abs=2e-4)  # interpolation on 0.25 degrees
    assert table.extinction == pytest.approx(1e-4, rel=1e-12)
    assert table.backscatter == pytest.approx(1e-4 / table.lidar_ratio, rel=1e-12)


@pytest.mark.parametrize("depolarization", [0.0, 0.0073, 0.0284, 0.3])
def test_rayleigh(depolarization):
    """Backscatter depolarisation d/(2 - d); Chandrasekhar's backward value; symmetric, so g = 0."""
    table = rayleigh_table(depolarization, 532e-9, 5.167e-31)
    d = depolarization
    assert table.depolarization_ratio == pytest.approx(d / (2 - d), abs=1e-14)
    gamma = d / (2 - d)
    backward = 3 / 2 * (1 + gamma) / (1 + 2 * gamma)
    assert table.lidar_ratio == pytest.approx(4 * math.pi / backward, rel=1e-12)
    assert table.asymmetry == pytest.approx(0, abs=1e-12)
    # at 90 degrees natural light comes back with intensities d : 1 (parallel : perpendicular)
    a1, b1 = table.at(90.0)[[0, 4]]
    assert (a1 + b1) / (a1 - b1) == pytest.approx(d, abs=1e-12)


def test_mixture_weights_by_hand():
    """0.3 of haze with albedo 0.9 and 0.1 of air: matrices as 0.27 to 0.1, albedo 0.37/0.4."""
    dry, air = haze(), rayleigh_table(0.03, 532e-9, 5e-31)
    both = mix([dry, air], [3e-5, 1e-5])
    expected = (0.27 * dry.at(both.angle) + 0.1 * air.at(both.angle)) / 0.37
    np.testing.assert_allclose(both.elements, expected, rtol=1e-12, atol=1e-15)
    assert both.albedo == pytest.approx(0.37 / 0.4, rel=1e-12)
    assert both.extinction == pytest.approx(4e-5, rel=1e-12)
    assert both.number_density == pytest.approx(3e-5 / 2e-13 + 1e-5 / 5e-31, rel=1e-12)
    # backscatter and extinction coefficients add, whatever the weights
    assert both.backscatter == pytest.approx(
        3e-5 / dry.lidar_ratio + 1e-5 / air.lidar_ratio, rel=1e-12
    )
    # so does scattered power times cosine
    assert 0.37 * both.asymmetry == pytest.approx(0.27 * dry.asymmetry, rel=1e-3)


def test_description_agrees_with_the_table(tmp_path):
    text = describe(haze())
    assert text["wavelength"] == "532 nm"
    assert text["extinction coefficient"] == "0.0001 m^-1"
    assert float(text["lidar ratio"].split()[0]) == pytest.approx(haze().lidar_ratio, rel=1e-3)
    assert all(isinstance(value, str) for value in text.values())


def broken(column, row, value):
    """A copy of the haze with one number changed (relative to a1 there)."""
    table = haze()
    elements = table.elements.copy()
    elements[row, column] = value * elements[row, 0]
    return lambda: replace(table, elements=elements)


@pytest.mark.parametrize(
    "make, words",
    [
        (lambda: replace(haze(), elements=2 * haze().elements), "averages to 2.0.*1 within 1 %"),
        (lambda: haze(g=0.97, step=10.0), "averages to .*denser angles"),
        (broken(1, 100, 1.01), r"\|a2\| above a1 at 25 degrees"),
        (broken(0, 100, -1.0), "a1: .* at 25 degrees; must be > 0"),
        (broken(3, 300, 0.95), r"\|a3 - a4\| above a1 - a2 at 75"),
        (broken(5, 360, 0.95), r"\(a3 \+ a4\)\^2"),
        (broken(4, 360, 0.95), r"a2 - b1"),
        (broken(4, 360, -0.95), r"a2 \+ b1"),
        (broken(2, 0, 0.7), "a2 = a3 at 0 degrees fails by 0.1"),
        (broken(2, -1, -0.7), "a2 = -a3 at 180 degrees"),
        (broken(3, -1, -0.65), "a4 = a1 - 2 a2 at 180"),
        (broken(4, 0, 0.01), "b1 = 0 at 0"),
        (broken(4, -1, 0.01), "b1 = 0 at 180"),
        (broken(5, 0, 0.01), "b2 = 0 at 0"),
        (broken(5, -1, 0.01), "b2 = 0 at 180"),
        (broken(1, 5, np.nan), "NaN"),
        (lambda: haze(albedo=1.2), "albedo: 1.2"),
        (lambda: haze(albedo=0.0), "albedo: 0.0"),
        (lambda: haze(wavelength=-1.0), "wavelength: -1.0"),
        (lambda: haze(extinction_cross_section=0.0), "extinction_cross_section: 0.0"),
        (lambda: haze(number_density=math.inf), "number_density: inf"),
        (lambda: replace(haze(), angle=haze().angle[::-1]), "rising from 0 to 180"),
        (lambda: replace(haze(), elements=haze().elements[:, :5]), "N x 6"),
        (lambda: rayleigh_table(0.6, 532e-9, 1e-31), "depolarization: 0.6"),
        (lambda: mix([haze()], [1.0, 2.0]), "1 tables and 2 extinctions"),
        (lambda: mix([haze()], [0.0]), "not all zero"),
        (lambda: mix([haze(), haze()], [1.0, -1.0]), ">= 0"),
        (lambda: mix([haze(), haze(wavelength=355e-9)], [1.0, 1.0]), "355 nm.*532 nm"),
    ],
)
def test_impossible_tables_are_refused(make, words):
    with pytest.raises(InputError, match=words):
        make()
