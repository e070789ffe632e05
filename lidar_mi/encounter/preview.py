"""From the lidar's estimates to the loads that the wake will bring.

The wind expected in a plane is that of the track there, carried on to the time of arrival. A track
that was lost remains good for the slabs that it has seen and the aircraft has not reached yet.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
import torch
from numpy.typing import ArrayLike

from lidar_mi.encounter.aircraft import AircraftModel, AircraftState, Wind, loads_in_wind
from lidar_mi.encounter.control import Preview
from lidar_mi.encounter.estimate import Estimate
from lidar_mi.encounter.pose import AircraftPose
from lidar_mi.retrieval.vortices.model import wind as pair_wind
from lidar_mi.retrieval.vortices.pair import VortexPairFit
from lidar_mi.retrieval.vortices.track import Track, first_track, updated

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

    def wind(
        self, x: ArrayLike, y: ArrayLike, z: ArrayLike, time: ArrayLike
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Expected u, v, w (m/s) at places (m, path frame) and times (s); u is not tracked.

        Places and times broadcast. Each place is told by the usable track with the slab nearest to
        it.
        """
        x, y, z, time = np.broadcast_arrays(*(np.asarray(a, float) for a in (x, y, z, time)))
        away = [np.abs(x[..., None] - [one.x for one in t.slabs]).min(-1) for t in self._usable]
        nearest = np.argmin(away, axis=0)
        found = np.zeros((3, *x.shape))
        for k, track in enumerate(self._usable):
            here = nearest == k
            theta = torch.as_tensor(track.parameters_at(x[here], time[here]))
            places = (torch.as_tensor(a[here]) for a in (y, z))
            found[1:, here] = pair_wind(theta, *places, track.profile).numpy()
        return tuple(found)

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

    def _take(self, estimate: Estimate) -> None:
        before, pair = self.track, estimate.pair
        if before is None:
            valid = pair is not None and pair.success
            found = first_track(pair, estimate.x, estimate.time) if valid else None
        else:
            found = updated(before, pair, estimate.x, estimate.time)
        self.slabs.append(Slab(estimate, found))
        if found is not None and found.usable:
            # the same track with one more slab replaces what it was before
            last = self._usable[-1].x if self._usable else None
            continued = any(slab.x == last for slab in found.slabs)
            self._usable[len(self._usable) - continued :] = [found]


def preview_of(aircraft: AircraftModel, wind: Wind) -> Callable[[AircraftState], Preview]:
    """The wake's loads on any state flown on, in a wind that is known anywhere at any time."""

    def ahead(state: AircraftState) -> Preview:
        return lambda time: loads_in_wind(aircraft.strips, state, wind, aircraft.density, time)

    return ahead
