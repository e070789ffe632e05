"""The scheme and the fractions of the comparison with a stored state. Unit tier.

Detects: a scheme that moves the wrong way, makes extrema or loses mass; a fraction of the wrong
part.
"""

import numpy as np
import pytest

from validation import stored_state


def test_the_scheme_transports_without_new_extrema():
    """A blob that moves by 3 and -2 cells; its summit is cut, the rest is of second order."""
    x, y, _ = np.indices((40, 40, 8))

    def blob(x0, y0):
        return np.exp(-((x - x0) ** 2 + (y - y0) ** 2) / (2 * 2.5**2))

    field, expected = blob(16, 22), blob(19, 20)
    wind = tuple(np.full(field.shape, speed) for speed in (3.0, -2.0, 0.0))
    after = stored_state.van_leer(field, wind, 1.0, 1.0, steps=12)
    assert after.min() > -1e-12 and after.max() < 1
    assert after.sum() == pytest.approx(field.sum(), rel=1e-7)
    centre = [(axis * after).sum() / after.sum() for axis in (x, y)]
    assert centre == pytest.approx([19, 20], abs=0.01)
    # upwind differences: 0.02
    assert np.sqrt(np.mean((after - expected) ** 2)) < 0.008


def test_a_uniform_field_stays_in_any_wind():
    rng = np.random.default_rng(1)
    wind = tuple(rng.normal(size=(9, 9, 9)) for _ in range(3))
    after = stored_state.van_leer(np.ones((9, 9, 9)), wind, 1.0, 0.3)
    assert np.abs(after - 1).max() < 1e-12


def test_fractions_of_independent_parts():
    """Variances 6, 3 and 1 of ten; the scheme's error is half of the residual."""
    rng = np.random.default_rng(2)
    parts = [np.sqrt(power) * rng.normal(size=(332, 332)) for power in (6.0, 3.0, 1.0)]
    start = rng.normal(size=(332, 332))
    along = start + parts[0] + parts[1]
    state = stored_state.States(
        start, start + parts[0], along, along + parts[2] / 2, along + parts[2]
    )
    found = stored_state.fractions(state)
    # 90000 values: variances to 0.5 %
    assert (found.in_plane, found.along) == pytest.approx((0.6, 0.3), abs=0.01)
    assert found.residual == pytest.approx(0.1, abs=0.003)
    assert found.correlation == pytest.approx(1) and found.explained == pytest.approx(0.75)
    # gradients of white noise over two spacings: variance 1 / (2 spacing^2)
    slope = 1 / (np.sqrt(2) * stored_state.SPACING)
    assert found.displacements == pytest.approx((2 / slope, 1 / slope), rel=0.02)
    sigma = stored_state.SMOOTHING / stored_state.SPACING
    assert found.smoothed == pytest.approx(1 / (4 * np.pi * sigma**2), rel=0.1)
    assert found.scheme_smoothed == pytest.approx(found.smoothed)
