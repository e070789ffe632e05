"""From the lidar's estimates to the loads of the wake ahead.

The wind expected in a plane is that of the track there, predicted to the time of arrival. A lost
track remains valid for its slabs that are still ahead of the aircraft.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Protocol, runtime_checkable

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

# Slabs beyond the newest one that a track still predicts: as many as it may miss before it is lost.
_SLABS_BEYOND = 5


@runtime_checkable
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
class WakeTracker:
    """Scans in flight and tracks the vortices from slab to slab.

    Attributes
    ----------
    lidar : Lidar
    period : float
        From scan to scan, s.
    stride : float
        From slab to slab, m.
    latest : float
        Time of the last scan, s.
    on_estimate : callable, optional
        Called with the lidar's estimate after every scan.
    slabs : list of Slab
        Those that were delivered, in their order.
    """

    lidar: Lidar
    period: float
    stride: float
    latest: float = np.inf
    on_estimate: Callable[[Estimate], None] | None = None
    slabs: list[Slab] = field(default_factory=list)
    _undelivered: list[Estimate] = field(default_factory=list)
    _usable: list[Track] = field(default_factory=list)
    _scans: int = 0
    _last_slab: tuple[float, float] = (np.nan, np.nan)

    def update(self, state: AircraftState) -> None:
        """Scan if a scan is due, and track the slabs delivered since the last call."""
        # an upset aircraft points its lidar nowhere: its poses may not even be finite
        if state.departed:
            return
        due = self._scans * self.period
        # times are sums of steps: they may fall short of a scan's by rounding
        if due <= state.time + 1e-9 and due <= self.latest + 1e-9:
            pose = AircraftPose(state.x, state.y, state.z, state.roll, state.pitch, state.yaw)
            estimate = self.lidar.step(due, pose, self._expected())
            self._scans += 1
            self._undelivered.append(estimate)
            self._last_slab = (estimate.x, estimate.time)
            if self.on_estimate:
                self.on_estimate(estimate)
        # latency: what the lidar has not delivered is not known yet
        while self._undelivered and self._undelivered[0].delivered <= state.time + 1e-9:
            self._track(self._undelivered.pop(0))

    @property
    def track(self) -> Track | None:
        """The newest one."""
        return self.slabs[-1].track if self.slabs else None

    def covers(self, x: float) -> bool:
        """Whether a usable track reaches the plane x (m)."""
        reach = _SLABS_BEYOND * self.stride
        return any(x <= track.x + reach for track in self._usable)

    def wind(
        self, x: ArrayLike, y: ArrayLike, z: ArrayLike, time: ArrayLike
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Expected u, v, w (m/s) at places (m, path frame) and times (s); u is not tracked.

        Places and times broadcast. The wind of each place is that of the usable track with the slab
        nearest to it.
        """
        x, y, z, time = np.broadcast_arrays(*(np.asarray(a, float) for a in (x, y, z, time)))
        away = [np.abs(x[..., None] - [one.x for one in t.slabs]).min(-1) for t in self._usable]
        nearest = np.argmin(away, axis=0)
        # u stays 0: the pair of two images has no wind along the path
        u, v, w = found = np.zeros((3, *x.shape))
        for k, track in enumerate(self._usable):
            here = nearest == k
            theta = torch.as_tensor(track.parameters_at(x[here], time[here]))
            at_y, at_z = (torch.as_tensor(a[here]) for a in (y, z))
            found[1:, here] = pair_wind(theta, at_y, at_z, track.profile).numpy()
        return u, v, w

    def preview(self, aircraft: AircraftModel, state: AircraftState) -> Preview | None:
        """The loads expected by the track from a state on; None while there is none.

        Calls `update` first.
        """
        self.update(state)
        return preview_in(self.wind, aircraft, state) if self.covers(state.x) else None

    def _expected(self) -> VortexPairFit | None:
        """The pair that the track expects in the slab that the next scan completes."""
        track = self.track
        if track is None or track.lost:
            return None
        x, time = self._last_slab
        return track.pair_at(x + self.stride, time + self.period)

    def _track(self, estimate: Estimate) -> None:
        before, pair, found = self.track, estimate.pair, None
        if before is not None:
            found = updated(before, pair, estimate.x, estimate.time)
        elif pair is not None and pair.success:
            found = first_track(pair, estimate.x, estimate.time)
        self.slabs.append(Slab(estimate, found))
        if found is not None and found.usable:
            # a track with one more slab replaces itself; a new track follows the lost one, whose
            # slabs the aircraft has yet to reach
            last = self._usable[-1].x if self._usable else None
            continued = any(slab.x == last for slab in found.slabs)
            self._usable[len(self._usable) - continued :] = [found]


def preview_in(wind: Wind, aircraft: AircraftModel, state: AircraftState) -> Preview:
    """The loads of a wind on an aircraft that goes on from a state.

    Parameters
    ----------
    wind : callable
        Known anywhere at any time.
    aircraft : AircraftModel
    state : AircraftState
    """
    return partial(loads_in_wind, aircraft.strips, state, wind, aircraft.density)
