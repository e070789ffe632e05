"""From the lidar's estimates to the loads that the wake will bring.

The wind expected in a plane is that of the track there, carried on to the time of arrival. A track
that was lost remains good for the slabs that it has seen and the aircraft has not reached yet.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from lidar_mi.atmosphere.vortex import Vortex, velocity
from lidar_mi.encounter.aircraft import AircraftModel, AircraftState, Wind, flown_on, loads_in_wind
from lidar_mi.encounter.control import Preview
from lidar_mi.encounter.estimate import Estimate
from lidar_mi.encounter.pose import AircraftPose
from lidar_mi.retrieval.vortices.model import Profile
from lidar_mi.retrieval.vortices.pair import VortexPairFit
from lidar_mi.retrieval.vortices.track import Track, first_track, updated

# Distance (m) of planes and step (s) in time in which the pair is predicted.
_PLANES, _TIMES = 5.0, 0.05

# Slabs ahead of the newest one in which the track is still steered by: as many as it may miss.
_SLABS_BEYOND = 5


class Lidar(Protocol):
    """What a flight needs of a lidar: it is stepped from scan to scan."""

    def step(
        self, t: float, pose: AircraftPose | None = None, expected: VortexPairFit | None = None
    ) -> Estimate:
        """Scan at a time (s) from a pose; a pair may be expected in the slab."""
        ...


@dataclass(frozen=True, eq=False)
class Slab:
    """An estimate with the track after it; None before there was one."""

    estimate: Estimate
    track: Track | None


@dataclass(eq=False)
class Lookout:
    """Steps a lidar in flight and keeps the track of the vortices.

    Attributes
    ----------
    lidar : Lidar
    period : float
        From scan to scan, s.
    stride : float
        From slab to slab, m.
    latest : float
        Time of the last scan, s.
    slabs : list of Slab
        Those that were delivered, in their order.
    seen : callable, optional
        Called after every scan with the lidar's estimate.
    """

    lidar: Lidar
    period: float
    stride: float
    latest: float = np.inf
    seen: Callable[[Estimate], None] | None = None
    slabs: list[Slab] = field(default_factory=list)
    _waiting: list[Estimate] = field(default_factory=list)
    _usable: list[Track] = field(default_factory=list)
    _pairs: dict[tuple[int, int], np.ndarray] = field(default_factory=dict)
    _scans: int = 0
    _seen_at: tuple[float, float] = (np.nan, np.nan)

    def look(self, state: AircraftState) -> None:
        """Scan if it is time, and take what was delivered meanwhile."""
        if state.departed:
            return
        due = self._scans * self.period
        if due <= state.time + 1e-9 and due <= self.latest + 1e-9:
            pose = AircraftPose(state.x, state.y, state.z, state.roll, state.pitch, state.yaw)
            estimate = self.lidar.step(due, pose, self._expected())
            self._scans += 1
            self._waiting.append(estimate)
            self._seen_at = (estimate.x, estimate.time)
            if self.seen:
                self.seen(estimate)
        while self._waiting and self._waiting[0].delivered <= state.time + 1e-9:
            self._take(self._waiting.pop(0))

    @property
    def track(self) -> Track | None:
        """The newest one."""
        return self.slabs[-1].track if self.slabs else None

    def is_known(self, x: float) -> bool:
        """Whether a usable track reaches a plane, m: there is no wind ahead of all slabs."""
        reach = _SLABS_BEYOND * self.stride
        return any(x <= track.x + reach for track in self._usable)

    def wind(self, x, y, z, time: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Expected u, v, w (m/s) at places (m, path frame) and a time (s); u is not tracked.

        Linear between planes 5 m apart, in steps of 50 ms: a pair drifts by 3 cm in half a step.
        """
        x, y, z = np.broadcast_arrays(*(np.atleast_1d(np.asarray(a, float)) for a in (x, y, z)))
        v, w = np.zeros(x.shape), np.zeros(x.shape)
        below = np.floor(x / _PLANES).astype(int)
        for plane in np.unique(below):
            here = below == plane
            first, second = (self._pair(int(plane) + k, time) for k in (0, 1))
            fraction = float(x[here].mean()) / _PLANES - plane
            theta = (1 - fraction) * first + fraction * second
            v[here], w[here] = _pair_wind(theta, y[here], z[here], self._usable[-1].profile)
        return np.zeros(x.shape), v, w

    def preview(self, aircraft: AircraftModel) -> Callable[[AircraftState], Preview | None]:
        """Looks, then gives the loads expected by the track; None while there is none."""
        expected = preview_of(aircraft, self.wind)

        def ahead(state: AircraftState) -> Preview | None:
            self.look(state)
            return expected(state) if self.is_known(state.x) else None

        return ahead

    def _expected(self) -> VortexPairFit | None:
        """The pair that the track expects in the slab that the next scan completes."""
        track = self.track
        if track is None or track.lost:
            return None
        x, time = self._seen_at
        return track.pair_at(x + self.stride, time + self.period)

    def _pair(self, plane: int, time: float) -> np.ndarray:
        """Parameters in a plane, by the usable track with the slab nearest to it; remembered."""
        key = plane, round(time / _TIMES)
        if key not in self._pairs:
            x = plane * _PLANES
            track = min(self._usable, key=lambda t: min(abs(slab.x - x) for slab in t.slabs))
            self._pairs[key] = track.pair_at(x, key[1] * _TIMES).parameters
        return self._pairs[key]

    def _take(self, estimate: Estimate) -> None:
        before, pair = self.track, estimate.pair
        if before is None:
            valid = pair is not None and pair.success
            found = first_track(pair, estimate.x, estimate.time) if valid else None
        else:
            found = updated(before, pair, estimate.x, estimate.time)
        self.slabs.append(Slab(estimate, found))
        self._pairs.clear()
        if found is not None and found.usable:
            # the same track with one more slab replaces what it was before
            last = self._usable[-1].x if self._usable else None
            continued = any(slab.x == last for slab in found.slabs)
            self._usable[len(self._usable) - continued :] = [found]


def _pair_wind(theta: np.ndarray, y, z, profile: Profile):
    """v and w of a pair's parameters at places."""
    vortices = [
        Vortex(theta[k], float(np.exp(theta[k + 1])), theta[k + 2], theta[k + 3], profile)
        for k in (0, 4)
    ]
    return tuple(a + b for a, b in zip(velocity(vortices, y, z), theta[8:10], strict=True))


def preview_of(aircraft: AircraftModel, wind: Wind) -> Callable[[AircraftState], Preview]:
    """The wake's loads on any state flown on, in a wind that is known anywhere at any time."""

    def ahead(state: AircraftState) -> Preview:
        return lambda time: loads_in_wind(
            aircraft.strips, flown_on(state, time), wind, aircraft.density
        )

    return ahead
