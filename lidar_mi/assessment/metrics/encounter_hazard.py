"""How severe an encounter with a wake is, and when a flight through it counts as a hazard.

Severity is the rolling moment needed against the wake over the largest that the controls have. The
simplified hazard areas around wake vortices end where it is 0.2: outside, pilots in full-flight
simulators found every encounter uncritical (Schwarz and Hahn 2006). It is a limit of undisturbed
flight, not of an accident. It describes the wake alone: controls that act before the wake add
moments.

A hazard is what the aircraft does: a bank angle at which the monitoring pilot calls out on a
stabilised approach (Flight Safety Foundation 2000, briefing note 7.1).
"""

import math

import numpy as np
from numpy.typing import ArrayLike

ACCEPTED_RATIO = 0.2
"""Roll control ratio of the wake up to which it is uncritical (Schwarz and Hahn 2006)."""

ACCEPTED_BANK = math.radians(7)
"""Largest bank angle (rad) on an approach without a call-out (Flight Safety Foundation 2000)."""


def roll_control_ratio(moment: ArrayLike, largest: float) -> float:
    """Largest rolling moment of a wake over the largest of all controls at full deflection (N m).

    NaN if any moment is.
    """
    return float(np.abs(np.asarray(moment, dtype=float)).max()) / largest


def is_hazardous(bank: float) -> bool:
    """Whether the largest bank angle of a flight (rad) is beyond `ACCEPTED_BANK`; NaN is."""
    return not abs(bank) <= ACCEPTED_BANK
