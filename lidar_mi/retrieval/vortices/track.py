"""The track of a pair of vortices over successive slabs of air along a flight path.

An extended Kalman filter of the pair's parameters and of its slopes along the path
(`lidar_mi.retrieval.vortices.track_motion`), fed with the fits of the slabs. Slabs do not overlap,
so that their images have different photons. But large eddies reach over several slabs: the part of
an error that is by the ambient wind (`VortexPairFit.shared`) is a state of its own, a Gauss-Markov
process along the path (Bar-Shalom, Li, Kirubarajan 2001, 8.2). An error that all slabs have in
common, such as a drift of the reported attitude, does not average out: keep it out of the fits, and
add it to what `Track.pair_at` returns (`VortexPairFit.with_common_error`).
"""

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
import torch
from numpy.typing import ArrayLike
from scipy.stats import chi2

from lidar_mi.errors import InputError
from lidar_mi.retrieval.vortices import kalman
from lidar_mi.retrieval.vortices.model import PARAMETERS, Profile
from lidar_mi.retrieval.vortices.pair import VortexPairFit
from lidar_mi.retrieval.vortices.track_motion import (
    CIRCULATIONS,
    CORES,
    MEAN_WIND,
    PLACES,
    SLOPES,
    Wandering,
    advected,
    advected_states,
    oblique_drift,
    unsteady,
    wandered,
)

MEASURED = len(PARAMETERS)
_MOVING = MEASURED + len(SLOPES)
# A fit is the parameters plus the error that slabs share; in a state that follows the slopes.
_OBSERVED = np.hstack([np.eye(MEASURED), np.zeros((MEASURED, len(SLOPES))), np.eye(MEASURED)])
# Least variance of the shared error, over that of the fit: covariances must have an inverse.
_LEAST_SHARED = 1e-6
# Kinds of quantities that may misfit, each by itself: circulations, core radii, places and the mean
# wind, as they are measured, and as a state has them, with the slopes beside the places.
_KINDS = (
    (CIRCULATIONS, CIRCULATIONS),
    (CORES, CORES),
    (PLACES, [*PLACES, *range(MEASURED, _MOVING)]),
    (MEAN_WIND, MEAN_WIND),
)
# Of port and starboard, along y and z.
_MEAN_SLOPES = np.array([[0.5, 0, 0.5, 0], [0, 0.5, 0, 0.5]])


@dataclass(frozen=True)
class TrackSettings:
    """What a track assumes, accepts, and when it is lost.

    wandering: how much the wake departs from a straight, steady pair.
    slope, unlike_slope: standard deviations of the slopes before a second slab: of their mean over
        both vortices, and of each from it. 1 allows for crossing angles up to 60 degrees; 0.15 for
        Crow waves of 20 % of the separation, or vortices that converge by 9 degrees.
    gate: probability up to which the normalised innovation is accepted: of correct fits 1 in 1000
        is rejected.
    patience: the track is lost after so many slabs without an update: 5 at 10 Hz are 0.5 s, the
        time there is to act.
    window: newest slabs whose innovations are compared with what is stated, see `Track.inflation`.
    memory: slabs that are stored to predict planes behind the newest: 64 at 7.5 m are 480 m.
    least_updates: of a usable track: with two the slopes have no redundancy, and no innovation
        tested them.
    circulation_error, place_error: largest standard errors of a usable track, relative and in m. An
        error of 10 % of the circulation leaves 10 % of the rolling moment. With 1 m of place the
        moment on an elliptic wing of 29 m errs by up to 16 % of its largest (core radius 3 m). Both
        together leave 19 %, so that four fifths are removed.

    Raises InputError: a value out of range.
    """

    wandering: Wandering = field(default_factory=Wandering)
    slope: float = 1.0
    unlike_slope: float = 0.15
    gate: float = 0.999
    patience: int = 5
    window: int = 10
    memory: int = 64
    least_updates: int = 3
    circulation_error: float = 0.1
    place_error: float = 1.0

    def __post_init__(self) -> None:
        for name in ("slope", "unlike_slope", "circulation_error", "place_error"):
            if not 0 < getattr(self, name) < np.inf:
                raise InputError(
                    f"track.{name}: {getattr(self, name)!r} is not allowed; a number > 0 is"
                )
        if not 0 < self.gate < 1:
            raise InputError(f"track.gate: {self.gate!r} is not allowed; between 0 and 1")
        for name in ("patience", "window", "memory", "least_updates"):
            value = getattr(self, name)
            if not (isinstance(value, int) and value >= 1):
                raise InputError(f"track.{name}: {value!r} is not allowed; a whole number >= 1 is")


@dataclass(frozen=True, eq=False)
class Slab:
    """The state of a track in one slab, and its transition from the slab before.

    x, time: m and s.
    state, covariance (ndarray, shapes (24,) and (24, 24)): parameters, slopes and shared errors
        after the update of the slab, if there was one.
    predicted (24,): before it.
    transition, noise (24, 24): derivatives of the prediction by the state of the slab before, and
        the covariance that the random walks add.
    innovation: normalised square of the fit's departure from the prediction, also of a rejected
        fit; None where there is nothing to compare.
    by_kind: the same of circulations, core radii, places and mean wind alone; empty where it is
        None.
    """

    x: float
    time: float
    state: np.ndarray
    covariance: np.ndarray
    predicted: np.ndarray
    transition: np.ndarray
    noise: np.ndarray
    innovation: float | None = None
    by_kind: tuple[float, ...] = ()


@dataclass(frozen=True, eq=False)
class Track:
    """A pair of vortices followed from slab to slab.

    slabs: the newest last.
    fit: the last that was used.
    updates, rejected: fits used, and fits beyond the gate or of a pair of the opposite sense.
    missed: slabs since the last update.
    """

    slabs: tuple[Slab, ...]
    fit: VortexPairFit
    settings: TrackSettings
    updates: int = 1
    rejected: int = 0
    missed: int = 0

    @property
    def x(self) -> float:
        """Plane of the newest slab, m."""
        return self.slabs[-1].x

    @property
    def time(self) -> float:
        """Of the newest slab, s."""
        return self.slabs[-1].time

    @property
    def state(self) -> np.ndarray:
        """Parameters and slopes (14,) in the newest slab."""
        return self.slabs[-1].state[:_MOVING]

    @property
    def covariance(self) -> np.ndarray:
        """Of the state, (14, 14)."""
        return self.slabs[-1].covariance[:_MOVING, :_MOVING]

    @property
    def profile(self) -> Profile:
        """Of the swirl."""
        return self.fit.profile

    @property
    def innovation(self) -> tuple[float, int] | None:
        """That of the newest slab, and its degrees of freedom; None where there is none."""
        square = self.slabs[-1].innovation
        return None if square is None else (square, MEASURED)

    @cached_property
    def inflation(self) -> np.ndarray:
        """Factors (14,) of the state's variances that the recent innovations ask for, 1 or more.

        For each kind of quantity the sum of the squared normalised innovations, of rejected fits
        too, over its degrees of freedom (Birge 1932, Phys. Rev. 40, 207-227), where the sum is
        beyond the gate; else 1. The kinds share the gate's rate of false alarms. Above 1 the wake
        is curved, or the fits err, by more than stated.
        """
        recent = [slab.by_kind for slab in self.slabs[-self.settings.window :] if slab.by_kind]
        factors = np.ones(_MOVING)
        gate = 1 - (1 - self.settings.gate) / len(_KINDS)
        for kind, (measured, states) in enumerate(_KINDS):
            total, freedom = sum(squares[kind] for squares in recent), len(measured) * len(recent)
            if recent and total > chi2.ppf(gate, freedom):
                factors[states] = total / freedom
        return factors

    @property
    def lost(self) -> bool:
        """Whether too many slabs went by without an update; the next accepted fit starts anew."""
        return self.missed >= self.settings.patience

    @property
    def usable(self) -> bool:
        """Whether the track is certain enough to act upon; see `TrackSettings`."""
        spread = np.sqrt(self.inflation * np.diagonal(self.covariance))
        limits = self.settings
        relative = spread[CIRCULATIONS] / np.abs(self.state[CIRCULATIONS])
        return bool(
            not self.lost
            and self.updates >= limits.least_updates
            and relative.max() <= limits.circulation_error
            and spread[PLACES].max() <= limits.place_error
        )

    def pair_at(self, x: float, time: float) -> VortexPairFit:
        """The pair in a plane at a time, from all slabs so far.

        From the slab nearest to the plane, whose state all later slabs have improved
        (Rauch-Tung-Striebel), it moves along the slopes and with the drift. Its covariance
        grows by the random walks over the distance and the time from that slab. Both are multiplied
        by `inflation`, and the unknown steady rates are added. The velocity of a curved pair is
        uncertain by the difference of this slab's mutual induction from the mean over all. Beyond
        the newest slab this is the prediction of the filter.

        x: m along the path, anywhere.
        time: s; that of the wing's arrival in the plane, say.

        Raises InputError: values that are not finite.

        Returns
        -------
        VortexPairFit
            With the mean slopes of both vortices. Model error and correlation are those of the last
            fit that was used. Not a success where the track is lost.
        """
        _check_finite(x=x, time=time)
        nearest = int(np.argmin([abs(slab.x - x) for slab in self.slabs]))
        # smoothed, not filtered: later slabs determine the slopes and the mean wind
        slab, (state, covariance) = self.slabs[nearest], self._smoothed[nearest]
        state, covariance = state[:_MOVING], covariance[:_MOVING, :_MOVING]
        wandering = self.settings.wandering
        dt = time - slab.time
        state, covariance, _, _ = _predicted(
            state, covariance, x - slab.x, dt, wandering, self.profile
        )
        # a straight pair has the same induction in all slabs
        by_curvature = self._inductions[:, nearest] - self._inductions.mean(1)
        root = np.sqrt(self.inflation)
        covariance = np.outer(root, root) * covariance + unsteady(
            state, dt, wandering, by_curvature
        )
        return replace(
            self.fit,
            parameters=state[:MEASURED],
            covariance=covariance[:MEASURED, :MEASURED],
            slopes=_MEAN_SLOPES @ state[MEASURED:],
            slope_covariance=_MEAN_SLOPES @ covariance[MEASURED:, MEASURED:] @ _MEAN_SLOPES.T,
            reasons=(f"no update in {self.missed} slabs",) if self.lost else (),
        )

    def parameters_at(self, x: ArrayLike, time: ArrayLike) -> np.ndarray:
        """The parameters of `pair_at` alone, in many planes and at many times at once.

        x, time (...): m and s; they broadcast.

        Returns
        -------
        ndarray, shape (10, ...)
        """
        x, time = np.broadcast_arrays(np.asarray(x, float), np.asarray(time, float))
        places, times = (np.array([getattr(s, name) for s in self.slabs]) for name in ("x", "time"))
        nearest = np.abs(x[..., None] - places).argmin(-1)
        states = np.stack([state[:_MOVING] for state, _ in self._smoothed], -1)[:, nearest]
        advected = advected_states(states, x - places[nearest], time - times[nearest], self.profile)
        return advected[:MEASURED]

    @cached_property
    def _smoothed(self) -> list[tuple[np.ndarray, np.ndarray]]:
        """State and covariance of every slab, given all fits."""
        # from the newest backwards: that one has no later fits
        smoothed = [(self.slabs[-1].state, self.slabs[-1].covariance)]
        for slab, later in zip(self.slabs[-2::-1], self.slabs[:0:-1], strict=True):
            smoothed.append(
                kalman.smoothed(
                    (slab.state, slab.covariance),
                    later.transition,
                    later.noise,
                    later.predicted,
                    smoothed[-1],
                )
            )
        return smoothed[::-1]

    @cached_property
    def _inductions(self) -> np.ndarray:
        """Drift without the mean wind in the smoothed slabs, (2, number), m/s."""
        states = np.array([state[:_MOVING] for state, _ in self._smoothed]).T
        # the rest of the drift is mutual induction
        states[MEAN_WIND] = 0
        return oblique_drift(torch.as_tensor(states), self.profile).numpy()


def first_track(
    pair: VortexPairFit, x: float, time: float, settings: TrackSettings | None = None
) -> Track:
    """A track that begins with the fit of one slab.

    pair: accepted, with the port vortex of positive circulation.
    x, time: plane of the slab, m, and time at which the fit is valid, s.

    Raises InputError: a fit that is not accepted or has no covariance, circulations of the wrong
    signs, numbers that are not finite.
    """
    _check_finite(x=x, time=time)
    if not _is_fit(pair):
        reason = pair.reasons[0] if pair.reasons else "numbers that are no pair and its covariance"
        raise InputError(f"pair: {reason}; expected an accepted fit")
    if not _rotates_as_wake(pair):
        port, starboard = pair.parameters[CIRCULATIONS]
        raise InputError(
            f"pair: circulations of {port:.0f} (port) and {starboard:.0f} m2/s are not allowed; "
            "port is positive, starboard negative"
        )
    settings = settings or TrackSettings()
    # one plane shows nothing of the slopes: they have their prior
    state = np.concatenate([pair.parameters, np.zeros(len(SLOPES) + MEASURED)])
    covariance = np.zeros((len(state), len(state)))
    shared = _shared(pair)
    covariance[:MEASURED, :MEASURED] = pair.covariance
    # parameters = fit - shared error - own error: hence the other sign
    covariance[_MOVING:, _MOVING:] = shared
    covariance[:MEASURED, _MOVING:] = covariance[_MOVING:, :MEASURED] = -shared
    # of each slope, and of port and starboard in common
    covariance[MEASURED:_MOVING, MEASURED:_MOVING] = settings.unlike_slope**2 * np.eye(
        len(SLOPES)
    ) + settings.slope**2 * np.kron(np.ones((2, 2)), np.eye(2))
    # there is no slab before that it could have come from
    nothing = np.zeros_like(covariance)
    slab = Slab(float(x), float(time), state, covariance, state, nothing, nothing)
    return Track((slab,), pair, settings)


def updated(track: Track, pair: VortexPairFit | None, x: float, time: float) -> Track:
    """The track after one more slab.

    pair: the slab's fit. None, a fit that is not accepted, or one without a positive definite
        covariance: the track is predicted only. The same holds for a fit beyond the gate or of
        circulations of the wrong signs, which counts as rejected. After `patience` such slabs the
        track is lost, and the next accepted fit begins a new one, whose counts of fits begin anew.
    x, time: plane of the slab, m, and time at which its fit is valid, s, after that of the last
        slab.

    Raises InputError: time that does not advance, numbers that are not finite, another profile.
    """
    _check_finite(x=x, time=time)
    if not time > track.time:
        raise InputError(f"time: {time:g} s is not allowed; the last slab's is {track.time:g} s")
    fit = pair if pair is not None and _is_fit(pair) else None
    if fit is not None and fit.profile != track.profile:
        raise InputError(f"pair.profile: {fit.profile!r} is not that of the track")
    if track.lost and fit is not None and _rotates_as_wake(fit):
        return first_track(fit, x, time, track.settings)
    last = track.slabs[-1]
    state, covariance, transition, noise = _predicted_with_shared(
        last.state,
        last.covariance,
        x - track.x,
        time - track.time,
        track.settings.wandering,
        fit or track.fit,
    )
    predicted, square, used = state, None, None
    by_kind: tuple[float, ...] = ()
    if fit is not None:
        measured = fit.parameters, _own(fit), _OBSERVED
        # also of what is rejected below: `Track.inflation` counts it
        square = kalman.innovation(state, covariance, *measured)
        by_kind = tuple(
            kalman.innovation(state, covariance, *measured, part=kind) for kind, _ in _KINDS
        )
        if _rotates_as_wake(fit) and square <= chi2.ppf(track.settings.gate, MEASURED):
            used = fit
            state, covariance = kalman.updated(state, covariance, *measured)
    slab = Slab(
        float(x), float(time), state, covariance, predicted, transition, noise, square, by_kind
    )
    return Track(
        slabs=(*track.slabs, slab)[-track.settings.memory :],
        fit=used or track.fit,
        settings=track.settings,
        updates=track.updates + (used is not None),
        rejected=track.rejected + (fit is not None and used is None),
        missed=track.missed + 1 if used is None else 0,
    )


def _predicted(
    state: np.ndarray,
    covariance: np.ndarray,
    dx: float,
    dt: float,
    wandering: Wandering,
    profile: Profile,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """State and covariance after a move, its derivatives, the covariance that the walks add."""
    reached, by_path, by_time = advected(state, dx, dt, profile)
    path_walk, time_walk = wandered(state, dx, dt, wandering)
    transition = by_time @ by_path
    # the walk along the path comes first, so that it drifts on in time
    noise = by_time @ path_walk @ by_time.T + time_walk
    return reached, transition @ covariance @ transition.T + noise, transition, noise


def _predicted_with_shared(
    state: np.ndarray,
    covariance: np.ndarray,
    dx: float,
    dt: float,
    wandering: Wandering,
    fit: VortexPairFit,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """`_predicted` with the shared error, whose covariance becomes that of a fit."""
    reached, _, moved, walked = _predicted(
        state[:_MOVING], covariance[:_MOVING, :_MOVING], dx, dt, wandering, fit.profile
    )
    correlation = np.exp(-abs(dx) / fit.shared_length) if fit.shared_length > 0 else 0.0
    transition, noise = np.zeros((2, len(state), len(state)))
    transition[:_MOVING, :_MOVING], noise[:_MOVING, :_MOVING] = moved, walked
    transition[_MOVING:, _MOVING:] = correlation * np.eye(MEASURED)
    noise[_MOVING:, _MOVING:] = (1 - correlation**2) * _shared(fit)
    reached = np.concatenate([reached, correlation * state[_MOVING:]])
    return reached, transition @ covariance @ transition.T + noise, transition, noise


def _shared(pair: VortexPairFit) -> np.ndarray:
    """Covariance of the error that successive slabs share; next to none where none is stated."""
    least = _LEAST_SHARED * np.diag(np.diagonal(pair.covariance))
    return least if pair.shared is None else (1 - _LEAST_SHARED) * pair.shared + least


def _own(pair: VortexPairFit) -> np.ndarray:
    """Covariance of the error of one slab alone."""
    return pair.covariance - _shared(pair)


def _is_fit(pair: VortexPairFit) -> bool:
    """Whether there is an accepted fit with a covariance that can be used."""
    if not (pair.success and np.isfinite(pair.parameters).all()):
        return False
    if not np.isfinite(pair.covariance).all():
        return False
    try:
        # normalised innovations take a positive definite covariance
        np.linalg.cholesky(pair.covariance)
    except np.linalg.LinAlgError:
        return False
    return True


def _rotates_as_wake(pair: VortexPairFit) -> bool:
    """Whether port is the vortex of positive circulation, starboard that of negative."""
    port, starboard = pair.parameters[CIRCULATIONS]
    return bool(port > 0 > starboard)


def _check_finite(**numbers: float) -> None:
    for name, value in numbers.items():
        if not np.isfinite(value):
            raise InputError(f"{name}: {value!r} is not allowed; any finite number is")
