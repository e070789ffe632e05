"""From the lidar's estimates to the loads of the wind ahead.

The wind expected in a plane is that of the track there, predicted to the time of arrival. A lost
track remains valid for its slabs that are still ahead of the aircraft. With a `WindAhead` the wind
of the air about the vortices is that of the slabs' vectors.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Protocol, runtime_checkable

import numpy as np
import torch
from numpy.typing import ArrayLike

from lidar_mi.aircraft.control import Preview
from lidar_mi.aircraft.planning import HORIZON
from lidar_mi.aircraft.pose import AircraftPose
from lidar_mi.aircraft.state import AircraftModel, AircraftState, Wind, loads_in_wind
from lidar_mi.encounter.ahead.arrivals import Arrival, wing_places
from lidar_mi.encounter.ahead.wind_ahead import WindAhead
from lidar_mi.encounter.lidar.estimate import Estimate
from lidar_mi.retrieval.vortices.model import widened
from lidar_mi.retrieval.vortices.model import wind as pair_wind
from lidar_mi.retrieval.vortices.pair import VortexPairFit
from lidar_mi.retrieval.vortices.track import Track, first_track, updated
from lidar_mi.retrieval.vortices.track_motion import MEAN_WIND

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

    period: from scan to scan, s.
    stride: from slab to slab, m.
    latest: time of the last scan, s.
    on_estimate: called with the lidar's estimate after every scan.
    ahead: learns the wind about the vortices from the vectors; without it the wind is that of the
        track alone.
    slabs: those that were delivered, in their order.
    arrivals: with `ahead`: the wind expected on the wing as it reached each slab.
    """

    lidar: Lidar
    period: float
    stride: float
    latest: float = np.inf
    on_estimate: Callable[[Estimate], None] | None = None
    ahead: WindAhead | None = None
    slabs: list[Slab] = field(default_factory=list)
    arrivals: list[Arrival] = field(default_factory=list)
    _undelivered: list[Estimate] = field(default_factory=list)
    _winds: list[Estimate] = field(default_factory=list)
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
            if self.ahead is not None and estimate.wind is not None:
                self._winds.append(estimate)
            self._last_slab = (estimate.x, estimate.time)
            if self.on_estimate:
                self.on_estimate(estimate)
        # latency: what the lidar has not delivered is not known yet
        now = state.time + 1e-9
        while self._undelivered and self._undelivered[0].delivered <= now:
            self._track(self._undelivered.pop(0))
        while self._winds and _wind_time(self._winds[0]) <= now:
            self._learn(self._winds.pop(0), state.x)
        self._arrive(state)

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
        nearest to it. With `ahead` it is that of its vortices, and of the air about them; beyond
        the track it fades over the `HORIZON` of control, as a lost preview does.
        """
        x, y, z, time = np.broadcast_arrays(*(np.asarray(a, float) for a in (x, y, z, time)))
        # u stays 0: the pair of two images has no wind along the path
        wind = np.zeros((3, *x.shape))
        if self.ahead is None:
            wind[1:] = _tracked(self._usable, x, y, z, time)
        else:
            if self._usable:
                wind[1:] = self._vortices(x, y, z, time)
            if self.ahead:
                wind[1:] += self.ahead.at(x, y, z, time, error=False)[0]
        u, v, w = wind
        return u, v, w

    def _vortices(
        self, x: np.ndarray, y: np.ndarray, z: np.ndarray, time: np.ndarray, width: float = 0.0
    ) -> np.ndarray:
        """Those of the usable tracks alone, without mean wind; see `wind_ahead.Vortices`."""
        return self._remaining(x) * _tracked(self._usable, x, y, z, time, vortices=width)

    def _remaining(self, x: np.ndarray) -> np.ndarray:
        """Fraction of the tracked vortices in planes beyond the last slab."""
        end = self._usable[-1].x + _SLABS_BEYOND * self.stride
        return np.clip(1 - (x - end) / (HORIZON * self.stride / self.period), 0.0, 1.0)

    def preview(self, aircraft: AircraftModel, state: AircraftState) -> Preview | None:
        """The loads expected from a state on; None while nothing is known."""
        known = self.covers(state.x) or bool(self.ahead)
        return preview_in(self.wind, aircraft, state) if known else None

    def _expected(self) -> VortexPairFit | None:
        """The pair that the track expects in the slab that the next scan completes."""
        track = self.track
        if track is None or track.lost:
            return None
        x, time = self._last_slab
        return track.pair_at(x + self.stride, time + self.period)

    def _arrive(self, state: AircraftState) -> None:
        """Record the wind expected on the wing in the slabs that it has reached."""
        while self.ahead and len(self.arrivals) < len(self.slabs):
            slab = self.slabs[len(self.arrivals)].estimate
            if slab.x > state.x:
                break
            y = state.y + wing_places(self.ahead.span)
            x, z, time = (np.full_like(y, a) for a in (slab.x, state.z, state.time))
            _, stderr = self.ahead.at(x, y, z, time)
            if self._usable:
                stderr = np.hypot(stderr, self._vortex_errors(slab.x, y, z, state.time))
            wind = np.stack(self.wind(x, y, z, time)[1:])
            self.arrivals.append(Arrival(slab.x, state.time, y, state.z, wind, stderr))

    def _vortex_errors(self, x: float, y: np.ndarray, z: np.ndarray, time: float) -> np.ndarray:
        """Standard errors (2, n) of v and w by those of the tracked vortices in a plane, m/s."""
        track = self._usable[_nearest(self._usable, np.array(x))]
        pair = track.pair_at(x, time)
        at_y, at_z = torch.as_tensor(y), torch.as_tensor(z)
        slopes = torch.autograd.functional.jacobian(
            lambda theta: pair_wind(theta, at_y, at_z, track.profile),
            torch.as_tensor(pair.parameters),
        ).numpy()
        # the mean wind is that of the vectors
        slopes[..., MEAN_WIND] = 0.0
        fraction = float(self._remaining(np.array(x)))
        return fraction * np.sqrt(np.einsum("cnk,kl,cnl->cn", slopes, pair.covariance, slopes))

    def _learn(self, estimate: Estimate, place: float) -> None:
        assert self.ahead is not None and estimate.wind is not None  # as it is in the queue
        vortices = self._vortices if self._usable else None
        self.ahead.add(estimate.x, estimate.time, estimate.wind, vortices, place)

    def _track(self, estimate: Estimate) -> None:
        before, pair, track = self.track, estimate.pair, None
        if before is not None:
            track = updated(before, pair, estimate.x, estimate.time)
        elif pair is not None and pair.success:
            track = first_track(pair, estimate.x, estimate.time)
        self.slabs.append(Slab(estimate, track))
        if track is not None and track.usable:
            # a track with one more slab replaces itself; a new track follows the lost one, whose
            # slabs the aircraft has yet to reach
            last = self._usable[-1].x if self._usable else None
            continued = any(slab.x == last for slab in track.slabs)
            self._usable[len(self._usable) - continued :] = [track]


def _wind_time(estimate: Estimate) -> float:
    """When the wind of an estimate is delivered, s."""
    return estimate.delivered if estimate.wind_delivered is None else estimate.wind_delivered


def _tracked(
    tracks: Sequence[Track],
    x: np.ndarray,
    y: np.ndarray,
    z: np.ndarray,
    time: np.ndarray,
    vortices: float | None = None,
) -> np.ndarray:
    """v and w (2, ...) of the track with the slab nearest to each place.

    With `vortices` those of the vortices alone, in a Gaussian mean of this standard deviation, m.
    """
    nearest = _nearest(tracks, x)
    velocity = np.zeros((2, *x.shape))
    for k, track in enumerate(tracks):
        here = nearest == k
        theta = torch.as_tensor(track.parameters_at(x[here], time[here]))
        if vortices is not None:
            theta[MEAN_WIND] = 0.0
            theta = widened(theta, vortices)
        at_y, at_z = (torch.as_tensor(a[here]) for a in (y, z))
        velocity[:, here] = pair_wind(theta, at_y, at_z, track.profile).numpy()
    return velocity


def _nearest(tracks: Sequence[Track], x: np.ndarray) -> np.ndarray:
    """Which of the tracks has the slab nearest to each place."""
    away = [np.abs(x[..., None] - [one.x for one in t.slabs]).min(-1) for t in tracks]
    return np.argmin(away, axis=0)


def preview_in(wind: Wind, aircraft: AircraftModel, state: AircraftState) -> Preview:
    """The loads of a wind, known anywhere at any time, on an aircraft that goes on from a state."""
    return partial(loads_in_wind, aircraft.strips, state, wind, aircraft.density)
