"""Variances of a linear system whose matrices follow a Markov chain.

x(k+1) = A_i x(k) + B_i w(k),  y(k) = C_i x(k) + D_i w(k)  in the mode i = i(k), with white w. The
second moments X_j = E[x x' 1{mode j}] obey the coupled Lyapunov equations

X_j = sum_i p_ij (A_i X_i A_i' + pi_i B_i W B_i')

(Costa, Fragoso and Marques, Discrete-Time Markov Jump Linear Systems, 2005, chapter 3).
"""

import itertools

import numpy as np
from numpy.typing import ArrayLike

from lidar_mi.errors import InputError

_CONVERGED = 1e-8
_ROUNDS, _SHRINKS = 200, 0.9  # in so many samples the changes shrink by this factor or more


def stationary_distribution(transition: ArrayLike) -> np.ndarray:
    """Probabilities of the modes of a chain with one recurrent class; (modes,).

    transition (modes, modes): p_ij, from mode i to mode j; rows sum to 1.

    Raises InputError: not a matrix of probabilities.
    """
    p = np.asarray(transition, float)
    if p.ndim != 2 or p.shape[0] != p.shape[1] or (p < 0).any() or not np.allclose(p.sum(1), 1):
        raise InputError(
            f"jump_linear.transition: {p.tolist()} is not allowed; expected a square matrix of "
            "probabilities whose rows sum to 1"
        )
    balance = np.vstack([p.T - np.eye(len(p)), np.ones(len(p))])
    probability = np.linalg.lstsq(balance, np.eye(1, len(p) + 1, len(p))[0], rcond=None)[0]
    return np.clip(probability, 0.0, 1.0)


def jump_covariance(
    a: ArrayLike, b: ArrayLike, c: ArrayLike, d: ArrayLike, transition: ArrayLike, noise: ArrayLike
) -> np.ndarray:
    """Stationary covariance of the outputs; (outputs, outputs).

    With one mode this is the discrete Lyapunov equation.

    a, b, c, d (modes, rows, columns): matrices of the modes.
    transition (modes, modes): p_ij, from mode i to mode j.
    noise (inputs, inputs): covariance W of the white input, which is independent of the mode.

    Raises InputError: the system has no finite variance, or the transition is none.
    """
    a, b, c, d = (np.asarray(one, float) for one in (a, b, c, d))
    p, w = np.asarray(transition, float), np.asarray(noise, float)
    probability = stationary_distribution(p)
    modes = range(len(p))
    drive = [probability[i] * b[i] @ w @ b[i].T for i in modes]
    x, change, before = np.zeros((len(p), *a.shape[1:])), np.inf, np.inf
    # from 0 the second moments grow to their limit, as those of a system that was at rest
    for number in itertools.count(1):
        moments = np.stack([a[i] @ x[i] @ a[i].T + drive[i] for i in modes])
        new = np.einsum("ij,iab->jab", p, moments)
        rate, change = abs(new - x).max() / change, abs(new - x).max()
        x = new
        if change <= _CONVERGED * (1 - rate) * abs(x).max():
            break
        if number % _ROUNDS == 0:
            if not change < _SHRINKS * before:
                raise InputError(
                    "jump_linear: the system is not stable in the mean square; expected matrices "
                    "and a chain whose variances stay finite"
                )
            before = change
    outputs = [c[i] @ x[i] @ c[i].T + probability[i] * d[i] @ w @ d[i].T for i in modes]
    return np.asarray(sum(outputs))
