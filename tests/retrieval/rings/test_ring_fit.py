"""Standard errors of rings of plates that are uneven in patches; frames made without the program.

Detects: errors that leave out what the fit takes up of uneven plates (2 times too small in patches
of 45 px), errors of the difference of two lines that hold only if plates moved both alike, uneven
plates that are not flagged.
"""

import math

import numpy as np
import pytest

from lidar_mi.retrieval.rings.analysis import analyse_rings
from tests.support.ring_frames import Frame

LINES = {"fraction": (0.62, 0.31), "height": (1.0, 0.5)}


def normalised_errors(frame: Frame, seed) -> list[float]:
    """Of the centre, the spacing, the fractions, and of the difference of two lines."""
    found = analyse_rings(frame.exposure(np.random.default_rng(seed)))
    assert found.uneven
    by_size = np.argsort(-found.fraction)
    off = found.fraction[by_size] - frame.fraction
    z = [*np.subtract(found.centre, frame.centre) / found.centre_std]
    z += [(found.spacing - frame.spacing) / found.spacing_std, *(off / found.fraction_std[by_size])]
    if len(off) == 2:
        variance = found.fraction_covariance
        z.append((off[0] - off[1]) / math.sqrt(np.trace(variance) - 2 * variance[0, 1]))
    return z


def allowed(number: int) -> float:
    """4 sigma above the rms of Student's law with 5 degrees of freedom: 5/3, variance 22.2."""
    return math.sqrt(5 / 3 + 4 * math.sqrt(22.2 / number))


def test_rings_say_that_plates_are_uneven():
    even, uneven = (
        analyse_rings(Frame(plates=plates, patch=40.0).exposure(np.random.default_rng(1)))
        for plates in (0.0, 0.01)
    )
    assert not even.uneven and uneven.uneven
    assert uneven.spacing_std > 10 * even.spacing_std
    assert "parts correlate" in repr(uneven) and "parts correlate" not in repr(even)


@pytest.mark.slow
@pytest.mark.parametrize("patch", [20.0, 35.0, 70.0])
@pytest.mark.parametrize("lines", [{}, LINES], ids=["one line", "two lines"])
def test_errors_of_patches_hold(patch, lines):
    frame, number = Frame(plates=0.005, patch=patch, **lines), 24
    z = np.array([normalised_errors(frame, [62, k]) for k in range(number)])
    assert np.sqrt(np.mean(np.square(z))) < allowed(3 * number)
    assert (np.sqrt(np.mean(np.square(z), 0)) < allowed(number)).all()
