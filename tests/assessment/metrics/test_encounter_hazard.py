"""Limits of an encounter: detects a wrong side of a limit, a sign, a NaN that passes."""

import numpy as np
import pytest

from lidar_mi.assessment.metrics.encounter_hazard import (
    ACCEPTED_BANK,
    ACCEPTED_RATIO,
    is_hazardous,
    roll_control_ratio,
)


def test_ratio_of_the_largest_moment_of_either_sign():
    assert roll_control_ratio([0.0, 1e5, -3e5], 1e6) == pytest.approx(0.3)
    assert np.isnan(roll_control_ratio([0.0, np.nan], 1e6))


@pytest.mark.parametrize(
    ("bank", "expected"), [(6.9, False), (7.1, True), (-7.1, True), (np.nan, True)]
)
def test_limits(bank, expected):
    assert ACCEPTED_RATIO == 0.2 and np.degrees(ACCEPTED_BANK) == pytest.approx(7)
    assert is_hazardous(np.radians(bank)) is expected
