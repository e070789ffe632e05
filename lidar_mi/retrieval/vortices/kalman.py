"""Kalman filter and smoother of a state that linear measurements observe.

Covariances are updated in Joseph's form, a sum of positive semidefinite terms: they stay symmetric
and positive whatever the gain and the rounding (Bar-Shalom, Li, Kirubarajan 2001, Estimation with
Applications to Tracking and Navigation, 5.2.3; Bierman 1977, Factorization Methods for Discrete
Sequential Estimation, II.5).
"""

from collections.abc import Sequence

import numpy as np
from scipy.linalg import cho_factor, cho_solve


def updated(
    state: np.ndarray,
    covariance: np.ndarray,
    measured: np.ndarray,
    error: np.ndarray,
    observed: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """State and covariance after a measurement.

    state, covariance (ndarray, shapes (n,) and (n, n)): before.
    measured, error (ndarray, shapes (m,) and (m, m)): the measurement and its covariance; its error
        is independent of that of the state.
    observed (m, n): derivatives H of the measurement by the state.
    """
    cross = observed @ covariance
    # K = P H^T S^-1
    gain = cho_solve(cho_factor(cross @ observed.T + error), cross).T
    remains = np.eye(len(state)) - gain @ observed
    after = remains @ covariance @ remains.T + gain @ error @ gain.T
    return state + gain @ (measured - observed @ state), (after + after.T) / 2


def innovation(
    state: np.ndarray,
    covariance: np.ndarray,
    measured: np.ndarray,
    error: np.ndarray,
    observed: np.ndarray,
    part: Sequence[int] | None = None,
) -> float:
    """Normalised square of a measurement's departure from its prediction: chi-square of (m,).

    Arguments as of `updated`; `part`: of these measured quantities alone.
    """
    chosen = np.arange(len(measured)) if part is None else np.asarray(part)
    departure = (measured - observed @ state)[chosen]
    factor = cho_factor((observed @ covariance @ observed.T + error)[np.ix_(chosen, chosen)])
    return float(departure @ cho_solve(factor, departure))


def smoothed(
    filtered: tuple[np.ndarray, np.ndarray],
    transition: np.ndarray,
    noise: np.ndarray,
    predicted: np.ndarray,
    later: tuple[np.ndarray, np.ndarray],
) -> tuple[np.ndarray, np.ndarray]:
    """State and covariance given what was measured later, too.

    One step back of Rauch, Tung and Striebel (1965, AIAA J. 3, 1445-1450). With the gain
    G = P F^T (F P F^T + Q)^-1 the covariance P + G (P' - F P F^T - Q) G^T is written as
    (1 - G F) P (1 - G F)^T + G (Q + P') G^T.

    filtered (n,), (n, n): state and covariance P after the update of this step.
    transition, noise (n, n): F and Q from this step to the next.
    predicted (n,): state of the next step before its update.
    later (n,), (n, n): smoothed state and covariance P' of the next step.
    """
    state, covariance = filtered
    cross = transition @ covariance
    gain = cho_solve(cho_factor(cross @ transition.T + noise), cross).T
    remains = np.eye(len(state)) - gain @ transition
    after = remains @ covariance @ remains.T + gain @ (noise + later[1]) @ gain.T
    return state + gain @ (later[0] - predicted), (after + after.T) / 2
