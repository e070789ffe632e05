"""When an encounter with a wake counts as a hazard: two limits, each with its source.

The first is that of the simplified hazard areas around wake vortices: outside, the rolling moment
needed against the wake stays below a fraction of the largest that the controls have, and pilots in
full-flight simulators found every encounter uncritical (Schwarz and Hahn 2006). It says nothing
about what is just above the limit; it is a limit of undisturbed flight, not of an accident. The
second is the bank angle at which the monitoring pilot calls out on a stabilised approach (Flight
Safety Foundation 2000, briefing note 7.1).
"""

import math

import numpy as np
from numpy.typing import ArrayLike

ACCEPTED_RATIO = 0.2
"""Roll control ratio below which an encounter is uncritical (Schwarz and Hahn 2006)."""

ACCEPTED_BANK = math.radians(7)
"""Bank angle (rad) beyond which it is called out on an approach (Flight Safety Foundation 2000)."""


def roll_control_ratio(moment: ArrayLike, largest: float) -> float:
    """Largest rolling moment in a flight over the largest that the controls have.

    With the moment of the wake alone this is the ratio of Schwarz and Hahn (2006); with what the
    controls have not cancelled it is the part that the aircraft still feels.

    Parameters
    ----------
    moment : array_like
        Rolling moment over time, N m.
    largest : float
        Of all controls at full deflection, N m, > 0.

    Returns
    -------
    float
        NaN if any moment is.
    """
    return float(np.abs(np.asarray(moment, dtype=float)).max()) / largest


def is_hazardous(ratio: float, bank: float) -> bool:
    """Whether an encounter is beyond either limit; NaN is.

    Parameters
    ----------
    ratio : float
        From `roll_control_ratio`.
    bank : float
        Largest bank angle of the flight, rad.
    """
    return not (ratio <= ACCEPTED_RATIO and abs(bank) <= ACCEPTED_BANK)
