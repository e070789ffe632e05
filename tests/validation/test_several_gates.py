"""The study of gates beside the imaged one, on fields of known motion. Unit tier.

Detects: a derivative of the wrong order or scale, a correction of the wrong sign, a speed along x
that is not that of the air.
"""

import numpy as np
import pytest
import xarray as xr
from scipy.ndimage import gaussian_filter

from validation import several_gates

MIDDLES = several_gates.GATE * (np.arange(5) - 2)


@pytest.mark.parametrize(("number", "order"), [(3, 2), (5, 4)])
def test_derivative_of_polynomials(number, order):
    gates = np.array([MIDDLES**k for k in range(order + 1)]).T[:, :, None]
    found = several_gates.derivative(gates, number)[:, 0]
    assert found == pytest.approx([0, 1, *[0] * (order - 1)], abs=1e-12)


def test_a_speed_along_x_is_found_and_removed(monkeypatch):
    """Air of 8 m waves and longer that moves by 1 m/s: means of 20 rows are right to 15 %."""
    random, u, planes = np.random.default_rng(2), 1.0, np.arange(250)
    air = gaussian_filter(random.standard_normal((250, 80, 100)), (25, 5, 5), mode="wrap")
    air = 5 + air / air.std()
    moved = np.fft.irfft(
        np.fft.rfft(air, axis=0)
        * np.exp(-2j * np.pi * np.fft.rfftfreq(250, 0.1) * u * several_gates.DT)[:, None, None],
        250,
        axis=0,
    )
    middles = 125 + np.round(MIDDLES / 0.1).astype(int)
    first, second = (
        np.stack([volume[np.abs(planes - m) <= 12].mean(0) for m in middles])
        for volume in (air, moved)
    )
    monkeypatch.setattr(several_gates, "SPEED", 100.0)  # nothing is expected of it
    calm = np.zeros((2, 2))
    wind = xr.Dataset(
        {"v": (("z", "y"), calm), "w": (("z", "y"), calm)}, {"z": [0.0, 79.0], "y": [0.0, 99.0]}
    )
    found = several_gates.estimated(first, second, wind, (0.0, 0.0), 1.0, 5)
    assert found[20:-20, 20:-20].mean() == pytest.approx(u, rel=0.15)
    before = second[2] - first[2]
    after = np.subtract(*several_gates.corrected(first, second, np.full((80, 100), u), 5)[::-1])
    assert after.std() < 0.3 * before.std()
