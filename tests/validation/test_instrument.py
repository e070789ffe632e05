"""The table of instrument defects, on a small camera with few frames.

Detects: a case whose frames lack the defect, a reference shot that is not subtracted, a retrieval
that is given other frames than those of the table, and errors not compared with those stated;
a calibration that leaves a defect (slow), a stated systematic error that is not in the table.
"""

import numpy as np
import pytest

from lidar_mi.retrieval.rings.reference_error import ReferenceUncertainty
from validation import instrument
from validation.instrument import CASES, INSTRUMENT, Outcome, Retrieved

SMALL = INSTRUMENT.binned(4)


@pytest.mark.slow
@pytest.mark.parametrize(
    "case",
    [
        pytest.param(case, marks=[pytest.mark.slow] * (case not in ("none", instrument.BOW)))
        for case in instrument.closed_forms()
    ],
)
def test_bias_is_the_closed_form(case):
    *expected, _ = instrument.closed_forms(SMALL)[case]
    found = instrument.measured(CASES[case], 6, 1, instrument.uncalibrated, SMALL)
    for outcome, bias in zip(found.values(), expected, strict=True):
        sigma = np.sqrt((outcome.stated**2).mean() / 6)
        # a wedge makes the profile skew: 0.03 m/s more
        assert outcome.bias == pytest.approx(bias, abs=4 * sigma + 0.1)
        # plates times pupil: 50 m/s that chi-square does not show
        assert outcome.chi_square < 1.2 or case == instrument.WEDGE


@pytest.mark.slow
@pytest.mark.parametrize("case", instrument.MENDED)
def test_calibration_mends(case):
    found = instrument.measured(CASES[case], 20, 7, instrument.calibrated_first, SMALL)
    for one in found.values():
        allowed = np.sqrt((one.stated**2).mean() / 20 + (one.systematic**2).mean())
        # five calibrations that differ by 0.04 m/s
        assert abs(one.bias) < 4 * allowed < 0.2


@pytest.mark.slow
@pytest.mark.parametrize("case", instrument.KNOWN)
def test_what_calibration_cannot_mend_is_stated(case):
    known = instrument.KNOWN[case]
    found = instrument.measured(CASES[case], 6, 8, instrument.calibrated_first, SMALL, known)
    one = found["difference"]
    assert abs(one.bias) == pytest.approx(known.total, abs=4 * one.bias_std + 0.1)
    assert one.coverage(1.96) == 1


def test_retrievals_get_the_frames_of_a_pulse_and_their_errors_are_compared():
    seen = {}

    def guess(frames):
        seen["shapes"] = tuple(tuple(part.shape) for part in frames)
        v = instrument.SPEED + np.array([0.5, -0.5, 4.0, -1.0])
        return {"guess": Retrieved(v, np.ones(4), np.full(4, 0.75), np.ones(4))}

    found = instrument.measured(CASES["none"], 4, 3, guess, SMALL)
    assert seen["shapes"] == tuple((count, *SMALL.shape) for count in (20, 4, 4))
    assert found["guess"].bias == pytest.approx(0.75)
    # random and systematic error together are 1.25
    assert found["guess"].coverage(1.96) == 0.75
    lines = instrument.table({"none": found}, systematic=True)
    assert "| none | +0.75 ± 1.13 | 1.00 | 0.75 | 75 % | 75 % | 1.00 |" in lines
    beside = ReferenceUncertainty(wavelength=1e-6, gap=1e-2, laser_drift=2e6)
    found = instrument.measured(CASES["none"], 4, 3, guess, SMALL, beside)
    assert found["guess"].systematic == pytest.approx(1.25)


def test_refused_frames_are_in_the_table():
    outcome = Outcome(np.array([1.0, 0.0]), np.ones(2), np.zeros(2), 1.0)
    lines = instrument.table({"none": {"guess": outcome}, "bad": {}})
    assert lines[-1].count("|") == lines[-2].count("|") and "refused" in lines[-1]


def test_coverage_has_a_standard_error():
    """Pulses that share a calibration are no independent ones: two of four calibrations miss."""
    error = np.repeat([0.5, 0.5, 2.0, 2.0], 100)
    one, zero = np.ones(400), np.zeros(400)
    assert Outcome(error, one, zero, 1.0).coverage_std(1) == pytest.approx(0.0233, abs=1e-4)
    shared = Outcome(error, one, zero, 1.0, calibrations=4)
    assert shared.coverage_std(1) == pytest.approx(np.sqrt(1 / 3) / 2)
    assert shared.coverage(1) == 0.5 and shared.bias_std == 0


def test_calibrations_have_frames_of_their_own():
    seen = []

    def guess(frames):
        seen.append(frames)
        v = instrument.SPEED + np.arange(2.0)
        return {"guess": Retrieved(v, np.ones(2), np.zeros(2), np.ones(2))}

    small = INSTRUMENT.binned(12)
    found = instrument.measured(CASES["none"], 2, 3, guess, small, calibrations=2)["guess"]
    assert found.calibrations == 2 and found.error.tolist() == [0, 1, 0, 1]
    frames = [part[k] for one in seen for part in one for k in range(2)]
    assert len({tuple(frame.flatten()[:50].tolist()) for frame in frames}) == len(frames)
