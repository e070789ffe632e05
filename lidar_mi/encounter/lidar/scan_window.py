"""Where the scan of the backscatter lidar looks: straight ahead, or at the pair."""

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from lidar_mi.schema.encounter import Encounter

if TYPE_CHECKING:  # slabs are described without torch
    from lidar_mi.retrieval.vortices.pair import VortexPairFit

# Least probability of a vortex at which a scan moves towards a pair that is not tracked.
_LEAST_PROBABILITY = 0.5
# Largest step of a scan over its size: what the slab's other image does not show is lost.
_LARGEST_STEP = 0.1


def window_reach(encounter: Encounter) -> float:
    """Largest distance of the scan's middle from straight ahead in the farther slab, m."""
    return encounter.look_ahead * math.tan(encounter.window.reach) * encounter.window.follow


@dataclass(eq=False)
class ScanWindow:
    """The middle of every scan of a flight, y and z about the aircraft.

    It moves towards the middle of the pair in the farther slab: the expected one, moved on along
    its slopes; else the likeliest one of the newest estimate, where a vortex is more probable than
    not; else back to straight ahead. Each scan moves by a tenth of its size at most.

    size: of the image along y and z, m.
    """

    encounter: Encounter
    size: tuple[float, float]
    _middles: dict[int, np.ndarray] = field(default_factory=dict)
    _estimates: "dict[float, VortexPairFit]" = field(default_factory=dict)

    def at(
        self, number: int, place: tuple[float, float], expected: "VortexPairFit | None"
    ) -> tuple[float, float]:
        """Of a scan, m.

        number: of the scan.
        place: y and z of the aircraft, m.
        expected: in the nearer slab of this scan.
        """
        if not self.encounter.window.follow:
            return 0.0, 0.0
        before = self._middles.get(number - 1, np.zeros(2))
        wanted = self._wanted(number, expected)
        offset = np.zeros(2) if wanted is None else wanted - place
        # both ends of a step are within reach, and so is all of it
        offset = offset * min(1.0, window_reach(self.encounter) / max(np.hypot(*offset), 1e-9))
        step = offset - before
        most = _LARGEST_STEP * np.array(self.size)
        middle = before + step * min(1.0, *(most / np.maximum(np.abs(step), 1e-9)))
        # for a step that is repeated, the one before is needed as well
        self._middles = {n: m for n, m in self._middles.items() if n == number - 1}
        self._middles[number] = middle
        return float(middle[0]), float(middle[1])

    def add(self, delivered: float, pair: "VortexPairFit") -> None:
        """An estimate that is delivered at a time, s."""
        self._estimates[delivered] = pair

    def _wanted(self, number: int, expected: "VortexPairFit | None") -> np.ndarray | None:
        """Middle of the pair in the farther slab, path frame, m; None if none is known."""
        if expected is not None:
            slopes = expected.slopes if expected.slopes is not None else np.zeros(2)
            return _middle(expected) + slopes * self.encounter.path.speed / self.encounter.rate
        now = number / self.encounter.rate + 1e-9
        known = [time for time in self._estimates if time <= now]
        if not known:
            return None
        newest = self._estimates[max(known)]
        # a step that is repeated needs the one before
        oldest = max(known) - 1 / self.encounter.rate
        self._estimates = {t: p for t, p in self._estimates.items() if t >= oldest - 1e-9}
        if not newest.probability >= _LEAST_PROBABILITY:
            return None
        return _middle(newest) if np.isfinite(newest.parameters).all() else None


def _middle(pair: "VortexPairFit") -> np.ndarray:
    return np.array([pair.parameters[[2, 6]].mean(), pair.parameters[[3, 7]].mean()])
