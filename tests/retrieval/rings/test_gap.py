"""Gap of an etalon from lines of known wavelength.

Detects: an order lost or doubled, lines taken for each other, a standard error that does not hold
the gap, an ambiguity that is not told.
"""

import numpy as np
import pytest

from lidar_mi.errors import InputError
from lidar_mi.retrieval.rings.analysis import analyse_rings
from lidar_mi.retrieval.rings.gap import gap_from_fractions, gap_from_lines
from tests.support.ring_frames import Frame

ARGON, THORIUM = 487.986e-9, 487.873e-9
GAP = 0.885e-3


def fractions(gap, lines):
    return [2 * gap / line % 1 for line in lines]


def test_closed_form_of_two_lines():
    """The difference of the orders alone: (K + e1 - e2) / (2 D), D that of the wavenumbers."""
    lines = ARGON, THORIUM
    e = fractions(GAP, lines)
    std = 1e-3
    found = gap_from_fractions(e, [std, std], lines, 1e-3, 0.5e-3)
    difference = 1 / ARGON - 1 / THORIUM
    by_hand = (round(2 * GAP * difference - e[0] + e[1]) + e[0] - e[1]) / (2 * difference)
    assert by_hand == pytest.approx(GAP, rel=1e-9)
    bound = np.sqrt(2) * std / abs(2 * difference)
    # candidates are half a wavelength apart and leave the ends of the distribution out
    assert found.gap == pytest.approx(GAP, abs=0.1 * bound)
    assert found.gap_std == pytest.approx(bound, rel=0.06)
    # half a wavelength from candidate to candidate, one of them the truth
    np.testing.assert_allclose(np.diff(found.candidate), ARGON / 2, rtol=1e-3)
    nearest = np.abs(found.candidate - GAP).argmin()
    assert found.candidate[nearest] == pytest.approx(GAP, abs=1e-12)
    assert list(found.order[nearest]) == [int(2 * GAP / line) for line in lines]
    assert found.chi_square[nearest] == pytest.approx(0, abs=1e-12)


def test_ambiguity_is_told():
    """Without a nominal gap every 1 / (2 D) agrees; none of them is preferred."""
    lines = ARGON, THORIUM
    found = gap_from_fractions(fractions(GAP, lines), [1e-3, 1e-3], lines)
    assert np.isnan(found.gap) and np.isnan(found.gap_std)
    step = 1 / (2 / THORIUM - 2 / ARGON)
    np.testing.assert_allclose(np.diff(found.group), step, atol=1e-3 * step)
    assert len(found.group) == pytest.approx(0.1 / step, abs=1)
    assert np.abs(found.group - GAP).min() < 1e-7
    assert "gap, 1 of" in repr(found)


def test_third_line_resolves_the_order():
    """Benoit's three lines of cadmium in air, at a fraction's error of 0.01: one candidate."""
    lines = 643.84722e-9, 508.58240e-9, 479.99107e-9
    gap = 10.000123e-3
    found = gap_from_fractions(fractions(gap, lines), [0.01] * 3, lines, 10e-3, 4e-6)
    assert len(found.candidate) == 1
    assert found.gap == pytest.approx(gap, abs=1e-12)
    per_gap = 2 / np.array(lines)
    assert found.gap_std == pytest.approx(0.01 / np.sqrt((per_gap**2).sum()), rel=1e-6)


def two_lines(faint=0.1, seed=2):
    """Frame of an etalon of 0.885 mm; the spacing is in proportion to the wavelength."""
    frame = Frame(
        shape=(240, 280),
        centre=(136.2, 122.8),
        spacing=7000.0,
        fraction=tuple(fractions(GAP, (ARGON, THORIUM))),
        height=(1.0, faint),
        ratio=(1.0, THORIUM / ARGON),
        finesse=18.0,
    )
    return frame.exposure(np.random.default_rng(seed), photons=300.0)


@pytest.mark.slow
def test_gap_from_a_frame():
    """The faint thorium line a tenth as high as argon's: 0.885 mm within 4 standard errors."""
    rings = analyse_rings(two_lines())
    found = gap_from_lines(rings, (ARGON, THORIUM), GAP, 0.4e-3)
    assert abs(found.gap - GAP) < 4 * found.gap_std
    assert found.gap_std < 3e-6
    # the other way round is another gap
    other = gap_from_lines(rings, (THORIUM, ARGON), GAP, 0.6e-3)
    assert abs(other.group - GAP).min() > 20 * found.gap_std


@pytest.mark.slow
def test_lines_of_one_height_are_not_told_apart():
    rings = analyse_rings(two_lines(faint=0.95))
    with pytest.raises(InputError, match="either order of the wavelengths"):
        gap_from_lines(rings, (ARGON, THORIUM), GAP, 0.6e-3)
    found = gap_from_lines(rings, (ARGON, THORIUM), GAP, 0.1e-3)
    assert abs(found.gap - GAP) < 4 * found.gap_std


def test_refused():
    lines = ARGON, THORIUM
    e = fractions(GAP, lines)
    for arguments, message in (
        ((e[:1], [1e-3], lines[:1]), "1 for 1 fractions"),
        ((e, [1e-3], lines), "2 for 2 fractions"),
        ((e, [1e-3, 1e-3], (ARGON, ARGON)), "twice"),
        ((e, [0.0, 1e-3], lines), "fraction_std: 0 is not allowed"),
        ((e, {}, lines), "fraction_std: dict is not allowed; expected"),
        ((e, np.array(1e-3), lines), "fraction_std: 0 dimensions are not allowed"),
        ((e, [1e-3, 1e-3], (488.0, 487.0)), "wavelength: 488 is not allowed"),
        (([0.2, 1.4], [1e-3, 1e-3], lines), "fraction: 1.4"),
        ((e, [1e-3, 1e-3], lines, GAP), "expected both"),
        ((e, [1e-3, 1e-3], lines, -1.0, 0.1), "nominal: -1 m"),
        ((e, [1e-3, 1e-3], lines, 1.4e-3, 0.1e-3), "none from 1.3 to 1.5 mm agrees"),
        ((e, [1e-3, 1e-3], lines, None, None, 0.5), "refractive_index"),
    ):
        with pytest.raises(InputError, match=message) as stop:
            gap_from_fractions(*arguments)
        assert "\n" not in str(stop.value)
    single = analyse_rings(Frame(shape=(200, 220), spacing=5000.0, centre=(101.0, 99.0)).mean())
    with pytest.raises(InputError, match=r"2 for 1 line\(s\) in the rings"):
        gap_from_lines(single, lines)
