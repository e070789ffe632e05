"""The table of instrument defects, on a small camera with few frames.

Detects: a case whose frames lack the defect, a reference shot that is not subtracted, a retrieval
that is given other frames than those of the table, and errors not compared with those stated.
"""

import numpy as np
import pytest

from validation import instrument
from validation.instrument import CASES, INSTRUMENT, Outcome, Retrieved

SMALL = INSTRUMENT.binned(4)


@pytest.mark.parametrize(
    "case",
    [
        pytest.param(case, marks=[pytest.mark.slow] * (case not in ("none", instrument.BOW)))
        for case in instrument.closed_forms()
    ],
)
def test_bias_is_the_closed_form(case):
    *expected, _ = instrument.closed_forms(SMALL)[case]
    found = instrument.measured(CASES[case], 6, 1, instrument=SMALL)
    for outcome, bias in zip(found.values(), expected, strict=True):
        sigma = np.sqrt((outcome.stated**2).mean() / 6)
        # a wedge makes the profile skew: 0.03 m/s more
        assert outcome.bias == pytest.approx(bias, abs=4 * sigma + 0.1)
        # plates times pupil: 50 m/s that chi-square does not show
        assert outcome.chi_square < 1.2 or case == instrument.WEDGE


def test_retrievals_get_the_frames_of_a_pulse_and_their_errors_are_compared():
    seen = {}

    def guess(laser, air):
        seen["shapes"] = tuple(laser.shape), tuple(air.shape)
        v = instrument.SPEED + np.array([0.5, -0.5, 3.0, -1.0])
        return Retrieved(v, np.ones(4), np.ones(4))

    found = instrument.measured(CASES["none"], 4, 3, {"guess": guess}, SMALL)["guess"]
    assert seen["shapes"] == ((4, *SMALL.shape), (4, *SMALL.shape))
    assert found.bias == pytest.approx(0.5)
    assert found.coverage(1.96) == 0.75
    assert "| none | +0.50 ± 0.89 | 1.00 | 50 % | 1.00 |" in instrument.table(
        {"none": {"guess": found}}
    )


def test_bias_has_a_standard_error():
    error = np.random.default_rng(1).normal(size=400)
    assert Outcome(error, error, 1.0).bias_std == pytest.approx(1 / 20, rel=4 / np.sqrt(800))
