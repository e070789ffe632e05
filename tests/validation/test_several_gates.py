"""The study of gates beside the imaged one, on fields of known motion. Unit tier.

Detects: a derivative of the wrong order or scale, a correction of the wrong sign, a speed along x
that is not that of the air.
"""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from validation import gates_beside, several_gates

MIDDLES = several_gates.GATE * (np.arange(5) - 2)


@pytest.mark.parametrize(("number", "order"), [(3, 2), (5, 4)])
def test_derivative_of_polynomials(number, order):
    gates = np.array([MIDDLES**k for k in range(order + 1)]).T[:, :, None]
    some = slice(1, 4) if number == 3 else slice(0, 5)
    found = gates_beside.along_x(gates[some], several_gates.GATE)[:, 0]
    assert found == pytest.approx([0, 1, *[0] * (order - 1)], abs=1e-12)


def test_what_a_speed_along_x_changes_is_removed():
    """Air of structures of 2.5 m, standard deviation, that moves by 1 m/s: 70 % at least."""
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
    before = second[2] - first[2]
    after = np.subtract(*several_gates.corrected(first, second, np.full((80, 100), u), 5)[::-1])
    assert after.std() < 0.3 * before.std()
