"""Vortex filaments. Physics tier.

Detects: images or a remainder that are wrong, a velocity with divergence, lines without their
circulation, a table off the sum that it replaces. `validation.filaments` has straight lines, rings
and Crow's instability; tests/validation runs it.
"""

import math
from dataclasses import replace

import numpy as np
import pytest

from lidar_mi.atmosphere.vortices import crow
from lidar_mi.atmosphere.vortices.filament_table import FilamentTable
from lidar_mi.atmosphere.vortices.vortex import tangential_speed
from lidar_mi.errors import InputError

B, WAVE, CORE = 47.1, 405.0, 3.0
MODELS = ("lamb_oseen", "burnham_hallock")
AMPLITUDES = (0.0, 10.0, 30.0, 40.0)  # the last one: rings


def lines(amplitude, model="lamb_oseen", phase=0.0, core=CORE):
    return crow.crow_filaments(amplitude, B, WAVE, core, model, phase)


def near_lines(filaments, count, spread, seed=1):
    """Places scattered about the lines, m."""
    random = np.random.default_rng(seed)
    nodes = np.concatenate([curve.places for curve in filaments.curves])
    return nodes[random.integers(len(nodes), size=count)] + random.normal(0, spread, (count, 3))


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("amplitude", AMPLITUDES[1:])
def test_no_divergence_and_curl_of_a_core(amplitude, model):
    """Of central differences at 0.1 m: their error is (0.1/3)^2 / 6 = 2e-4 of the gradients."""
    filaments, h = lines(amplitude, model), 0.1
    places = near_lines(filaments, 200, 3.0)
    gradient = np.empty((3, 3, len(places)))
    for axis in range(3):
        ahead, behind = (filaments.velocity(places + s * h * np.eye(3)[axis]) for s in (1, -1))
        gradient[axis] = (ahead - behind).T / (2 * h)
    size = np.sqrt((gradient**2).sum((0, 1)))
    assert np.abs(np.einsum("iin->n", gradient)).max() < 5e-4 * size.max()


@pytest.mark.parametrize("amplitude", AMPLITUDES)
def test_circulation_about_a_line(amplitude):
    """The line integral of the velocity about each line: 1 less exp(-1.2564 12^2/3^2) = 2e-9.

    A loop across s at a crest, where lines and rings run along s.
    """
    angle = 2 * np.pi * np.arange(256) / 256
    filaments = lines(amplitude)
    for side, sign in ((1, 1.0), (-1, -1.0)):
        nodes = np.concatenate([c.places[c.places[:, 1] * side > 0] for c in filaments.curves])
        middle = nodes[np.argmin(np.abs(nodes[:, 0] - WAVE / 4))]
        loop = middle + 12.0 * np.stack([0 * angle, np.cos(angle), np.sin(angle)], axis=1)
        around = 12.0 * np.stack([0 * angle, -np.sin(angle), np.cos(angle)], axis=1)
        found = (filaments.velocity(loop) * around).sum() * 2 * np.pi / 256
        assert found == pytest.approx(sign, abs=2e-5)


@pytest.mark.parametrize("amplitude", AMPLITUDES)
def test_images_that_are_left_out(amplitude):
    """Two on each side, and straight lines beyond: 3e-4 of the largest swirl against 20."""
    places = np.random.default_rng(3).uniform((-200, -60, -40), (200, 60, 40), (50, 3))
    one = lines(amplitude)
    found, expected = one.velocity(places), replace(one, images=20).velocity(places)
    assert np.abs(found - expected).max() < 3e-4 * tangential_speed(CORE, 1.0, CORE)


def test_linking():
    """Waves touch at the amplitude of linking; rings have the area that was between the lines."""
    amplitude = crow.linking_amplitude(B)
    almost, rings = lines(amplitude * (1 - 1e-9)), lines(amplitude)
    assert len(almost.curves) == 2 and len(rings.curves) == 1
    port = almost.curves[0].places
    assert port[:, 1].min() == pytest.approx(0.0, abs=1e-6)
    one = rings.curves[0]
    area = 0.5 * (one.places[:, 0] * one.steps[:, 1] - one.places[:, 1] * one.steps[:, 0]).sum()
    # the port half runs along +s: about -n, so that the air within sinks
    assert area == pytest.approx(-B * WAVE, rel=1e-9)
    assert np.ptp(one.places[:, 2]) == pytest.approx(np.ptp(port[:, 2]), rel=1e-6)
    age = crow.linking_age(2.0, 400.0, B)
    assert crow.grown(2.0, age, 400.0, B) == pytest.approx(amplitude)
    # a factor e in t0 / 0.83
    assert age == pytest.approx(2 * np.pi * B**2 / 400 / 0.83 * math.log(amplitude / 2))


@pytest.mark.parametrize(
    ("amplitude", "model"),
    [
        (10.0, "lamb_oseen"),
        pytest.param(10.0, "burnham_hallock", marks=pytest.mark.slow),
        pytest.param(40.0, "lamb_oseen", marks=pytest.mark.slow),
    ],
)
def test_table_against_the_sum(amplitude, model):
    """Within 1 % of the largest swirl anywhere, 0.2 % rms; also periods away."""
    phase, core = 0.7, 5.0
    filaments = lines(amplitude, model, phase, core)
    table = FilamentTable(filaments, (0.25 - phase / (2 * np.pi)) * WAVE)
    fastest = tangential_speed(core, 1.0, core, model)
    random = np.random.default_rng(4)
    for places in (
        near_lines(filaments, 500, 3.0),
        random.uniform((-900, -70, -50), (900, 70, 50), (500, 3)),
        random.uniform((-400, -300, -250), (400, 300, 250), (500, 3)),
    ):
        error = table.velocity(places.T).T - filaments.velocity(places)
        assert np.abs(error).max() < 0.01 * fastest
        assert np.sqrt((error**2).mean()) < 0.002 * fastest


@pytest.mark.parametrize(
    ("change", "message"),
    [({"wavelength": 30.0}, "wavelength"), ({"core_radius": 15.0}, "core radius")],
)
def test_what_is_no_thin_line_is_refused(change, message):
    keys = {"amplitude": 1.0, "separation": B, "wavelength": WAVE, "core_radius": CORE} | change
    with pytest.raises(InputError, match=message):
        crow.crow_filaments(**keys)


def test_cores_too_thin_for_a_table_are_refused():
    with pytest.raises(InputError, match=r"expected cores of at least 1\.01 m"):
        FilamentTable(lines(1.0, core=0.9), WAVE / 4)
