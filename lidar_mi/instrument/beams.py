"""The beams of a scan: when each one looks, from where and where to, in truth and as reported."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Beams:
    """Every beam of a scan, in film order: row by row from the top left, or in order of time.

    Light takes the true pose, the retrieval is told the reported one. Lengths in m; x is measured
    in the frame of the air, in which the gates are fixed: the telescope is at ``ScanPlan.position``
    at the scan's reference time, and the middle of the gates at ``position + centre``.

    Attributes
    ----------
    time : (n,) array
        s, from the scan's reference time, the middle of its duration.
    origin, direction : (n, 3) arrays
        True place of the telescope and true unit vectors.
    reported_origin, reported_direction : (n, 3) arrays
        The same as the retrieval is told them.
    """

    time: np.ndarray
    origin: np.ndarray
    direction: np.ndarray
    reported_origin: np.ndarray
    reported_direction: np.ndarray

    def true_places(self, x: float) -> np.ndarray:
        """Where the beams cross the plane at x, in the frame of the air: y, z in m, (n, 2)."""
        return _crossings(self.origin, self.direction, x)

    def reported_places(self, x: float) -> np.ndarray:
        """Where the beams as reported cross the plane at x: y, z in m, (n, 2)."""
        return _crossings(self.reported_origin, self.reported_direction, x)


def _crossings(origin: np.ndarray, direction: np.ndarray, x: float) -> np.ndarray:
    distance = (x - origin[:, 0]) / direction[:, 0]
    return origin[:, 1:] + distance[:, None] * direction[:, 1:]
