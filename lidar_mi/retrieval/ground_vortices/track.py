"""Vortices followed over the scans: a Kalman filter and smoother of the fits.

State: the four numbers of each vortex (core radius in m), then the wind along y and z that carries
them and the relative rate of decay of their circulations. Vortices move with that wind and their
induction (`swirl.motion`).
"""

from typing import Any

import numpy as np
import scipy
import xarray as xr

from lidar_mi.atmosphere.vortices.vortex import Model
from lidar_mi.retrieval.ground_vortices.dataset import NUMBERS
from lidar_mi.retrieval.ground_vortices.swirl import OF_VORTEX, motion
from lidar_mi.retrieval.vortices import kalman

GATE = 0.999
"""Probability up to which a fit's departure from its prediction is accepted."""

_LAGRANGIAN = 6.5  # Kolmogorov's constant of a fluid particle in time (Pope 2000, 12.3)
_DISSIPATION = 0.71  # times sigma^3 / L, of von Karman's spectrum with Kolmogorov's constant 1.5
_WIND = 1.0  # m/s, of the wind that carries the vortices before the second scan
_DECAY, _DECAY_SPREAD = 0.005, 0.01  # 1/s: between slow diffusion and rapid decay
_CORE_GROWTH = 0.03  # of the core radius, per root of second
_CIRCULATION = 0.003  # of the circulation, per root of second: it differs along the axis


def tracked(vortices: xr.Dataset, ground: float | None) -> xr.Dataset:
    """The data set with the smoothed numbers of every scan between the first and last valid one.

    A fit with a flag, or beyond the gate, is not used; the vortices are predicted there. The data
    set is that of `vortex_dataset`, in the order of time; the ground's height is in m.
    """
    model = vortices.attrs["profile"]
    number = vortices.sizes["vortex"]
    measured = np.stack([vortices[name].values for name in NUMBERS], -1).reshape(-1, 4 * number)
    seconds = (vortices["time"].values - vortices["time"].values[0]) / np.timedelta64(1, "s")
    valid = np.flatnonzero(vortices["flag"].values == 0)
    used = np.zeros(vortices.sizes["scan"], bool)
    values, stderr = np.full(measured.shape, np.nan), np.full(measured.shape, np.nan)
    if valid.size:
        states: list[tuple[np.ndarray, np.ndarray]] = []
        steps: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
        scans = np.arange(valid[0], valid[-1] + 1)
        for k in scans:
            error = vortices["covariance"].values[k]
            if k == valid[0]:
                wind = float(vortices["wind"].values[k])
                state = np.concatenate([measured[k], [wind, 0.0, _DECAY]])
                spread = np.array([_WIND, _WIND, _DECAY_SPREAD]) ** 2
                covariance = scipy.linalg.block_diag(error, np.diag(spread))
                used[k] = True
            else:
                dt = float(seconds[k] - seconds[k - 1])
                state, transition, noise = _predicted(state, dt, vortices, k, ground, model)
                covariance = transition @ covariance @ transition.T + noise
                steps.append((transition, noise, state))
                if vortices["flag"].values[k] == 0:
                    observation = measured[k], error, np.eye(measured.shape[1], len(state))
                    square = kalman.innovation(state, covariance, *observation)
                    if square <= scipy.stats.chi2.ppf(GATE, measured.shape[1]):
                        state, covariance = kalman.updated(state, covariance, *observation)
                        used[k] = True
            states.append((state, covariance))
        for k in range(len(scans) - 2, -1, -1):
            transition, noise, predicted = steps[k]
            states[k] = kalman.smoothed(states[k], transition, noise, predicted, states[k + 1])
        for k, (state, covariance) in zip(scans, states, strict=True):
            values[k] = state[: 4 * number]
            stderr[k] = np.sqrt(np.diag(covariance))[: 4 * number]
    more: dict[str, Any] = {
        "track_used": ("scan", used, {"long_name": "whether the track uses the fit"})
    }
    for n, name in enumerate(NUMBERS):
        for suffix, part in (("tracked", values), ("tracked_stderr", stderr)):
            about = {
                "units": vortices[name].attrs["units"],
                "long_name": f"{vortices[name].attrs['long_name']}, of all scans together"
                + (": standard error" if "stderr" in suffix else ""),
            }
            more[f"{name}_{suffix}"] = ("scan", "vortex"), part[:, n::OF_VORTEX], about
    return vortices.assign(more)


def _predicted(
    state: np.ndarray,
    dt: float,
    vortices: xr.Dataset,
    scan: int,
    ground: float | None,
    model: Model,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """State after a time, its derivatives and the covariance of the process noise."""
    step = 1e-5 * np.maximum(np.abs(state), 1.0)
    shifted = np.concatenate([[state], state + np.diag(step), state - np.diag(step)])
    after = _moved(shifted, dt, ground, model)
    size = len(state)
    transition = ((after[1 : 1 + size] - after[1 + size :]) / (2 * step)[:, None]).T
    number = (size - 3) // OF_VORTEX
    sigma, length = (
        float(np.nanmedian(vortices[name].values)) for name in ("turbulence", "turbulence_length")
    )
    dissipation = _DISSIPATION * sigma**3 / length
    separation = np.ptp(state[: OF_VORTEX * number : OF_VORTEX]) if number > 1 else 30.0
    # eddies smaller than the pair move each vortex on its own, for much longer than a scan
    place = (dissipation * max(separation, 10.0)) ** (2 / 3) * dt**2
    variance = np.zeros(size)
    for k in range(number):
        first = OF_VORTEX * k
        variance[first : first + 2] = place
        variance[first + 2] = (_CIRCULATION * state[first + 2]) ** 2 * dt
        variance[first + 3] = (_CORE_GROWTH * state[first + 3]) ** 2 * dt
    variance[-3:-1] = _LAGRANGIAN * dissipation * dt
    return after[0], transition, np.diag(variance)


def _moved(state: np.ndarray, dt: float, ground: float | None, model: Model) -> np.ndarray:
    """States (..., numbers) a time later, by the method of Runge and Kutta of second order."""
    wind, decay = state[..., -3:-1], state[..., -1:]
    vortices = state[..., :-3].reshape(*state.shape[:-1], -1, OF_VORTEX).copy()
    vortices[..., 3] = np.log(np.maximum(vortices[..., 3], 0.1))
    still = np.zeros((*state.shape[:-1], 1))

    def speed(where: np.ndarray) -> np.ndarray:
        return motion(where, still, 0.0, ground, model) + wind[..., None, :]

    half = vortices.copy()
    half[..., :2] += dt / 2 * speed(vortices)
    after = state.copy()
    places = vortices[..., :2] + dt * speed(half)
    after[..., :-3] = np.concatenate(
        [
            places,
            (vortices[..., 2] * np.exp(-decay * dt))[..., None],
            state[..., :-3].reshape(vortices.shape)[..., 3:],
        ],
        -1,
    ).reshape(after[..., :-3].shape)
    return after
