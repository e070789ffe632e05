"""Vortices and wind of a window by generalised least squares, and the errors of both."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import scipy
import torch

from lidar_mi.atmosphere.vortices.vortex import Model
from lidar_mi.retrieval.ground_vortices.swirl import OF_VORTEX, motion, node_angles, radial_velocity
from lidar_mi.retrieval.ground_vortices.turbulence import LENGTHS
from lidar_mi.retrieval.ground_vortices.window import Window
from lidar_mi.retrieval.likelihood.scoring import damped_scoring

WIND_TERMS = 3
"""Of the background: its polynomial in height."""

CORE_SPREAD = 0.5
"""Standard deviation of the logarithm of the core radius before the scan."""

OTHER_PROFILE = 0.3
"""Standard deviation of the fraction of the other profile: real vortices have neither."""

UNEVEN_SWIRL = 0.03
"""Standard deviation of the departure of a real swirl from a round one, relative.

Chosen on planes of one simulated wake, which therefore does not judge: 90 % of its errors are
within 95 % intervals, without it 84 %; 0.06 makes intervals of circulations too wide.
"""

_STEPS, _FIRST_STEPS = 20, 12
_SAME = 9.0  # of the misfit: another fit that is nearly as likely
_ENOUGH = 1e-3  # standard errors squared, at which steps end
_RATIO = 1.5  # of the strengths of turbulence that are compared
_MOST_STEPS = 8
_ROUNDING = 3e-4  # of the variance: interpolation of the covariance
_LEAST_TURBULENCE, _MOST_TURBULENCE = 0.01, 5.0  # m/s


@dataclass(frozen=True)
class Assumptions:
    """What a fit assumes.

    model {"lamb_oseen", "burnham_hallock"}
    ground: height of the ground above the lidar, m; None: no images.
    core_radius: likely core radius, m.
    """

    model: Model = "lamb_oseen"
    ground: float | None = None
    core_radius: float = 3.0


@dataclass(frozen=True, eq=False)
class Air:
    """Turbulence: strength of a component (m/s) and length (m)."""

    sigma: float
    length: float


@dataclass(frozen=True, eq=False)
class State:
    """What a fit determines.

    vortices (n, 4): `OF_VORTEX`.
    departures (n, 2): of their motion along y and z from induction and mean wind, m/s.
    other_profile (1,): fraction of the other profile in that of both.
    wind (terms,): polynomial in height.
    """

    vortices: np.ndarray
    departures: np.ndarray
    other_profile: np.ndarray
    wind: np.ndarray

    @property
    def vector(self) -> np.ndarray:
        """All numbers."""
        return np.concatenate(
            [self.vortices.ravel(), self.departures.ravel(), self.other_profile, self.wind]
        )

    def of(self, vector: np.ndarray) -> "State":
        """The state of such numbers."""
        first, second = self.vortices.size, self.departures.size
        return State(
            vector[:first].reshape(-1, OF_VORTEX),
            vector[first : first + second].reshape(-1, 2),
            vector[first + second : first + second + 1],
            vector[first + second + 1 :],
        )


@dataclass(frozen=True, eq=False)
class Fit:
    """A state at a time with its errors.

    covariance (numbers, numbers)
    time, reference: s after the scan's start, and height (m) that the wind's polynomial is about.
    air: the likeliest turbulence.
    misfit: normalised square of the residuals and of the departures from the prior.
    dof: cells less numbers that the scan alone determines.
    log_likelihood: restricted, of the likeliest turbulence.
    """

    state: State
    covariance: np.ndarray
    time: float
    reference: float
    air: Air
    misfit: float
    dof: int
    converged: bool
    log_likelihood: float = -np.inf


def crossing_time(window: Window, vortices: np.ndarray) -> float:
    """Mean time at which the lines cross the vortices, s."""
    angle = np.arctan2(vortices[:, 1], vortices[:, 0])
    lines = window.lines
    return float(np.interp(angle, lines.angle, lines.time).mean())


def start_state(window: Window, vortices: np.ndarray) -> State:
    """A state of vortices (n, 4), of the mean of the window as wind."""
    wind = np.zeros(WIND_TERMS)
    wind[0] = np.mean(window.velocity / np.cos(window.lines.angle[window.line]))
    return State(vortices, np.zeros((len(vortices), 2)), np.zeros(1), wind)


def fitted(
    window: Window, starts: Sequence[np.ndarray], air: Air, assumed: Assumptions
) -> tuple[Fit, list[np.ndarray]]:
    """The likeliest fit from several starts (vortices, 4); the vortices of those as likely.

    Turbulence is estimated from the residuals; ``air`` is the first guess.
    """
    first = Problem(
        window, assumed, crossing_time(window, starts[0]), float(starts[0][:, 1].mean())
    )
    factor = first.factor(air)
    ends = [
        first.minimised(start_state(window, start), factor, air, _FIRST_STEPS)[0]
        for start in starts
    ]
    ends.sort(key=lambda end: end.misfit)
    best = ends[0].state
    # times and heights relative to the fitted vortices
    vortices = best.vortices
    problem = replace(
        first, time=crossing_time(window, vortices), reference=float(vortices[:, 1].mean())
    )
    problem.__dict__["turbulence"] = first.turbulence
    problem = problem.with_uneven_swirl(best)
    best = start_state(window, vortices)
    end, _ = problem.minimised(best, factor, air)
    air, _ = problem.likeliest(end.state, air, (air.length,))
    end, converged = problem.minimised(best, problem.factor(air), air)
    air, models = problem.likeliest(end.state, air)
    others = [end.state.vortices for end in ends[1:] if end.misfit - ends[0].misfit < _SAME]
    return problem.averaged(end.state, air, models, converged), others


def residuals(window: Window, fit: Fit, assumed: Assumptions) -> np.ndarray:
    """Velocities of the cells less those of a fit (n,), m/s."""
    problem = Problem(window, assumed, fit.time, fit.reference)
    return problem.columns(fit.state)[:, 0]


@dataclass(frozen=True, eq=False)
class Problem:
    """The velocities of a window as a function of a state, and how likely they are.

    time, reference: at which the vortices are where the state says, s, and height (m) of the wind's
        polynomial.
    uneven (n, n): covariance of the swirl's departure from round vortices, (m/s)^2.
    """

    window: Window
    assumed: Assumptions
    time: float
    reference: float
    uneven: np.ndarray | float = 0.0

    def with_uneven_swirl(self, state: State) -> "Problem":
        """The same with the covariance of the difference of real vortices from round ones.

        It is in proportion to the velocities of each vortex in the cells, and correlated over its
        core across the lines and over a gate along them.
        """
        lines = self.window.lines
        ranges, angle = lines.ranges[self.window.gate], lines.angle[self.window.line]
        across = ranges.mean() * (angle[:, None] - angle)
        along = (ranges[:, None] - ranges) / self.window.lidar.gate_length
        _, time = node_angles(lines)
        total = np.zeros(across.shape)
        for vortex in state.vortices:
            places = np.broadcast_to(vortex[:2], (*time.shape, 2))
            value, _ = radial_velocity(
                lines, places, vortex[2:], self.assumed.ground, self.assumed.model
            )
            size = UNEVEN_SWIRL * value[self.window.line, self.window.gate]
            near = np.exp(-((across * np.exp(-vortex[3])) ** 2 + along**2) / 2)
            total += np.outer(size, size) * near
        uneven = replace(self, uneven=total)
        uneven.__dict__["turbulence"] = self.turbulence
        return uneven

    @cached_property
    def turbulence(self) -> np.ndarray:
        """Covariances (lengths, n, n) of unit variance."""
        window = self.window
        wind = np.median(window.velocity / np.cos(window.lines.angle[window.line]))
        return window.turbulence(LENGTHS, float(wind))

    def factor(self, air: Air) -> np.ndarray:
        """Lower factor of the covariance of the cells."""
        full = self.turbulence[LENGTHS.index(air.length)]
        covariance = air.sigma**2 * full + self.window.noise + self.uneven
        covariance[np.diag_indices_from(covariance)] += _ROUNDING * air.sigma**2 * full[0, 0]
        return scipy.linalg.cholesky(covariance, lower=True, check_finite=False)

    def predicted(self, state: State) -> tuple[np.ndarray, np.ndarray]:
        """Velocities (n,) of the cells and their derivatives (n, numbers)."""
        lines, number = self.window.lines, len(state.vortices)
        ground, model = self.assumed.ground, self.assumed.model
        speed, speed_by = self._speeds(state)
        _, time = node_angles(lines)
        later = time - self.time
        value = np.zeros((len(lines.time), len(lines.ranges)))
        slope = np.zeros((len(state.vector), *value.shape))
        since = (lines.time - self.time)[:, None]
        for k in range(number):
            places = state.vortices[k, :2] + later[..., None] * speed[k]
            fraction = float(state.other_profile[0])
            swirl, by = radial_velocity(
                lines, places, state.vortices[k, 2:], ground, model, fraction
            )
            value += swirl
            slope[OF_VORTEX * k : OF_VORTEX * (k + 1)] += by[:4]
            # every parameter changes the vortices' motion
            slope[-len(state.wind) - 1] += by[4]
            moved = by[5:] + by[:2] * since
            slope += np.tensordot(speed_by[k].T, moved, 1)
        height = lines.ranges * np.sin(lines.angle)[:, None] - self.reference
        cos = np.cos(lines.angle)[:, None]
        for k in range(len(state.wind)):
            term = cos * height**k
            value += state.wind[k] * term
            slope[len(slope) - len(state.wind) + k] += term
        at = self.window.line, self.window.gate
        return value[at], slope[:, *at].T

    def _speeds(self, state: State) -> tuple[np.ndarray, np.ndarray]:
        """Speeds (vortices, 2) and their derivatives (vortices, 2, numbers)."""
        vector = state.vector
        step = 1e-5 * np.maximum(np.abs(vector), 1.0)
        shifted = vector + np.concatenate([[np.zeros_like(step)], np.diag(step), -np.diag(step)])
        first, second = state.vortices.size, state.departures.size
        speed = motion(
            shifted[:, :first].reshape(len(shifted), -1, OF_VORTEX),
            shifted[:, first + second + 1 :],
            self.reference,
            self.assumed.ground,
            self.assumed.model,
        ) + shifted[:, first : first + second].reshape(len(shifted), -1, 2)
        ahead, behind = speed[1 : 1 + len(step)], speed[1 + len(step) :]
        slope = (ahead - behind) / (2 * step)[:, None, None]
        return speed[0], np.moveaxis(slope, 0, -1)

    def prior(self, state: State, air: Air) -> tuple[np.ndarray, np.ndarray]:
        """Departure of a state from the prior, and the inverse variances (numbers,)."""
        vector = state.vector
        likely, weight = np.zeros_like(vector), np.zeros_like(vector)
        cores = slice(3, state.vortices.size, OF_VORTEX)
        likely[cores], weight[cores] = np.log(self.assumed.core_radius), CORE_SPREAD**-2
        moves = slice(state.vortices.size, state.vortices.size + state.departures.size)
        weight[moves] = max(air.sigma, _LEAST_TURBULENCE) ** -2
        weight[moves.stop] = OTHER_PROFILE**-2
        return vector - likely, weight

    def minimised(
        self, state: State, factor: np.ndarray, air: Air, steps: int = _STEPS
    ) -> tuple["_Expansion", bool]:
        """The state of the least misfit, and whether steps have converged."""

        def moved(last: _Expansion, step: torch.Tensor) -> _Expansion:
            tried = last.state.of(last.state.vector + step.numpy())
            return self.at(self._limited(last.state, tried), factor, air)

        return damped_scoring(
            self.at(state, factor, air),
            moved,
            lambda last, tried: tried.misfit - last.misfit,
            steps,
            _ENOUGH,
        )

    def _limited(self, state: State, tried: State) -> State:
        """A step limited to half a gate, and to a factor of 2 in the core."""
        move = tried.vortices - state.vortices
        limit = np.array([15.0, 15.0, np.inf, 0.7])
        vortices = state.vortices + np.clip(move, -limit, limit)
        vortices[:, 3] = np.clip(vortices[:, 3], np.log(0.3), np.log(30.0))
        return replace(tried, vortices=vortices)

    def columns(self, state: State) -> np.ndarray:
        """Velocities less those predicted, and derivatives of these, (n, 1 + numbers)."""
        value, slope = self.predicted(state)
        return np.column_stack([self.window.velocity - value, slope])

    def at(
        self, state: State, factor: np.ndarray, air: Air, columns: np.ndarray | None = None
    ) -> "_Expansion":
        """Misfit, Fisher matrix and score of a state."""
        columns = self.columns(state) if columns is None else columns
        white = scipy.linalg.solve_triangular(factor, columns, lower=True, check_finite=False)
        residual, basis = white[:, 0], white[:, 1:]
        away, weight = self.prior(state, air)
        misfit = float(residual @ residual + away @ (weight * away))
        score = torch.from_numpy(basis.T @ residual - weight * away)
        return _Expansion(state, misfit, torch.from_numpy(basis.T @ basis + np.diag(weight)), score)

    def evaluated(self, columns: np.ndarray, state: State, air: Air) -> "_Model":
        """Restricted likelihood, covariance and step of a state under some turbulence."""
        factor = self.factor(air)
        point = self.at(state, factor, air, columns)
        fisher, score = point.fisher.numpy(), point.score.numpy()
        weight = self.prior(state, air)[1]
        root = scipy.linalg.cho_factor(fisher)
        step = scipy.linalg.cho_solve(root, score)
        misfit = point.misfit - float(score @ step)
        known = weight[weight > 0]
        likelihood = (
            -np.log(np.diag(factor)).sum()
            - np.log(np.diag(root[0])).sum()
            + np.log(known).sum() / 2
            - misfit / 2
        )
        covariance = scipy.linalg.cho_solve(root, np.eye(len(fisher)))
        return _Model(air, float(likelihood), covariance, step, misfit)

    def likeliest(
        self, state: State, start: Air, lengths: tuple[float, ...] = LENGTHS
    ) -> tuple[Air, list["_Model"]]:
        """The likeliest turbulence, and all that were tried.

        For each length the strengths around the likeliest one, a factor apart.
        """
        columns, models = self.columns(state), []
        first = round(np.log(start.sigma) / np.log(_RATIO))
        low = round(np.log(_LEAST_TURBULENCE) / np.log(_RATIO))
        high = round(np.log(_MOST_TURBULENCE) / np.log(_RATIO))
        for length in lengths:
            tried: dict[int, _Model] = {}

            def at(k: int, length: float = length, tried: dict[int, _Model] = tried) -> float:
                if not low <= k <= high:
                    return -np.inf
                if k not in tried:
                    tried[k] = self.evaluated(columns, state, Air(_RATIO**k, length))
                return float(tried[k].likelihood)

            best = first
            for _ in range(_MOST_STEPS):
                next_ = max((best - 1, best, best + 1), key=at)
                if next_ == best:
                    break
                best = next_
            first = best
            models += list(tried.values())
        return max(models, key=lambda model: model.likelihood).air, models

    def averaged(self, state: State, air: Air, models: list["_Model"], converged: bool) -> Fit:
        """State and covariance over all turbulence, each weighted by its likelihood.

        A strength and a length are likely in proportion to the logarithm of their interval.
        """
        likelihood = np.array([model.likelihood for model in models])
        weight = np.exp(likelihood - likelihood.max())
        weight /= weight.sum()
        steps = np.stack([model.step for model in models])
        mean = weight @ steps
        deviation = steps - mean
        within = np.einsum("m,mab->ab", weight, np.stack([model.covariance for model in models]))
        best = models[int(likelihood.argmax())]
        final = self._limited(state, state.of(state.vector + mean))
        free = (self.prior(state, air)[1] == 0).sum()
        return Fit(
            final,
            within + np.einsum("m,ma,mb->ab", weight, deviation, deviation),
            self.time,
            self.reference,
            air,
            best.misfit,
            int(self.window.velocity.size - free),
            converged,
            float(likelihood.max()),
        )


@dataclass(frozen=True, eq=False)
class _Model:
    air: Air
    likelihood: float
    covariance: np.ndarray
    step: np.ndarray
    misfit: float


@dataclass(frozen=True, eq=False)
class _Expansion:
    """A state with the misfit, the Fisher matrix and the score of likelihood and prior there."""

    state: State
    misfit: float
    fisher: torch.Tensor
    score: torch.Tensor

    @property
    def parameters(self) -> torch.Tensor:
        return torch.from_numpy(self.state.vector)
