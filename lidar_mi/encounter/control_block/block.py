"""The lidar of a flight as a block for control design: filters, delay, coloured noise, losses."""

import math
from collections.abc import Sequence

import numpy as np
import scipy
import xarray as xr

from lidar_mi.encounter.control_block.filter_fit import (
    BEFORE,
    FilterFit,
    autocovariance,
    fit_filter,
    fit_process,
)
from lidar_mi.encounter.control_block.gust_axes import GUSTS
from lidar_mi.encounter.control_block.losses import gust_dependence, loss_chain
from lidar_mi.encounter.control_block.sensor_samples import MARGIN, SensorSamples
from lidar_mi.errors import InputError
from lidar_mi.variables import Variable, variable

MOST_AFTER = 3
"""Planes beyond the estimated one that may have a weight, if they are scanned by then."""

FREQUENCIES = 101
"""From 0 to the Nyquist frequency."""

Variables = dict[str, Variable]
"""Of a data set, by name."""

_SQUARE = "square of the axis' units"
_STATE = {
    "units": "1",
    "long_name": "x(k+1) = A x(k) + B input(k), output(k) = C x(k) + D input(k)",
}


def control_block(flights: Sequence[SensorSamples]) -> xr.Dataset:
    """The block of one sensor, from all flights that it made.

    Its input k is the true gust, of every axis that the lidar has, in the plane that it begins to
    scan at the time k dt, and white noise with the covariance `noise_covariance`. Its output k is
    the newest estimate at the time k dt; it is lost where a chain with `loss_transition` is in its
    second state. The wing is in the plane `arrival` seconds after the first scan, `lead` seconds
    after the delivery.

    flights: of one timing, range and span, as of `pooled`.

    Raises InputError: too few slabs; an input that is zero, as in air at rest.

    Returns
    -------
    xr.Dataset
        ``A``, ``B``, ``C``, ``D``, ``dt``, ``noise_covariance``, ``loss_transition``; filters,
        noise and spectra of every axis with their standard errors. Each variable has units and a
        meaning.
    """
    one = flights[0]
    # margins without an estimate part the flights, and a row without a gust
    truth, estimate = (
        np.concatenate([_with_margins(flight, name) for flight in flights])
        for name in ("truth", "estimate")
    )
    measured = [k for k in range(len(GUSTS)) if np.isfinite(estimate[:, k]).any()]
    if not measured:
        raise InputError(
            f"{_range(one)}: no slab has valid vectors on all of the wing; expected a lidar whose "
            f"images cover the span of {one.span:g} m"
        )
    axes = [tuple(GUSTS)[k] for k in measured]
    delay_steps = math.ceil(one.delay / one.period - 1e-6)
    fits = []
    for axis, k in zip(axes, measured, strict=True):
        if not np.nanstd(truth[:, k]):
            raise InputError(
                f"{_range(one)}: {axis} is the same in all slabs, so that no filter shows; "
                "expected a flight in turbulence or in a wake"
            )
        try:
            fits.append(fit_filter(estimate[:, k], truth[:, k], min(MOST_AFTER, delay_steps)))
        except InputError as error:
            raise InputError(f"{_range(one)}: {axis}: {error}") from error
    innovations = np.stack([fit.innovations for fit in fits])
    innovations = innovations[:, np.isfinite(innovations).all(axis=0)]
    covariance = innovations @ innovations.T / innovations.shape[1]
    # variances are those of all samples of an axis
    scale = np.sqrt([fit.innovation_variance for fit in fits] / np.diag(covariance))
    covariance = covariance * np.outer(scale, scale)
    units = [GUSTS[axis][0] for axis in axes]
    block = xr.Dataset(
        {
            **state_space(fits, delay_steps),
            "noise_covariance": variable(
                ("noise", "noise_2"),
                covariance,
                "product of the axes' units",
                "of the white noise inputs",
            ),
            **_gust_model(truth[:, measured]),
            **_timing(one, delay_steps),
            **_numbers(flights, fits),
            **_losses(flights, measured),
            **_spectra(fits, one.period, delay_steps),
        },
        {"axis": axes},
    )
    block["axis_units"] = "axis", np.array(units, dtype=object)
    block["axis_meaning"] = "axis", np.array([GUSTS[a][1] for a in axes], dtype=object)
    return block


def state_space(fits: Sequence[FilterFit], delay_steps: int) -> Variables:
    """A, B, C, D of independent axes: inputs are all gusts, then all noises."""
    parts = [_axis_state_space(fit, delay_steps) for fit in fits]
    a = scipy.linalg.block_diag(*(part[0] for part in parts))
    c = scipy.linalg.block_diag(*(part[2] for part in parts))
    b, d = (
        np.hstack(
            [
                scipy.linalg.block_diag(*(p[k][:, column : column + 1] for p in parts))
                for column in (0, 1)
            ]
        )
        for k in (1, 3)
    )
    return {
        "A": (("state", "state_2"), a, _STATE),
        "B": (("state", "input"), b, _STATE),
        "C": (("output", "state"), c, _STATE),
        "D": (("output", "input"), d, _STATE),
    }


def _gust_model(truth: np.ndarray) -> Variables:
    """The true wind of these flights as white noise through a filter, axis by axis."""
    fits = [fit_process(values - np.nanmean(values)) for values in truth.T]
    parts = [_process_state_space(lags) for lags, _ in fits]
    a, b, c = (scipy.linalg.block_diag(*(part[k] for part in parts)) for k in range(3))
    about = {"units": "1", "long_name": "the gusts of these flights from white noise, as A to D"}
    innovations = [variance for _, variance in fits]
    variances = [autocovariance(*fit, 1)[0] for fit in fits]
    return {
        "gust_A": (("gust_state", "gust_state_2"), a, about),
        "gust_B": (("gust_state", "axis"), b, about),
        "gust_C": (("axis_2", "gust_state"), c, about),
        "gust_D": (("axis_2", "axis"), np.eye(len(fits)), about),
        "gust_innovations": variable(
            "axis", np.array(innovations), _SQUARE, "variances of this white noise"
        ),
        "gust_variance": variable(
            "axis", np.array(variances), _SQUARE, "of the gusts of this model"
        ),
    }


def _process_state_space(lags: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A, B, C of n_k = sum a_i n_{k-i} + e_k with the input e, D = 1; the states are past n."""
    p = len(lags)
    a = np.zeros((p, p))
    b, c = np.zeros((p, 1)), lags[None, :].copy()
    if p:
        a[0] = lags
        a[range(1, p), range(p - 1)] = 1.0
        b[0, 0] = 1.0
    return a, b, c


def _axis_state_space(
    fit: FilterFit, delay_steps: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Of one axis: a line of past gusts, and a line of past noise; inputs gust and white noise."""
    # state i is the gust i + 1 steps ago; a plane as far ahead as this one was is not yet past
    past = np.concatenate([np.zeros(delay_steps - fit.after), fit.taps])
    line = np.eye(len(past) - 1, k=-1)
    entry, taps = np.eye(len(past) - 1, 1), past[None, 1:]
    a, b, c = (
        scipy.linalg.block_diag(gust, noise)
        for gust, noise in zip((line, entry, taps), _process_state_space(fit.lags), strict=True)
    )
    # both add up to one output
    return a, b, c.sum(axis=0, keepdims=True), np.array([[past[0], 1.0]])


def _timing(one: SensorSamples, delay_steps: int) -> Variables:
    arrival = one.distance / one.speed
    values = {
        "dt": (one.period, "s", "from sample to sample: the period of the scans"),
        "range": (one.distance, "m", "of the plane when it is scanned for the first time"),
        "delay": (one.delay, "s", "from the first scan of a plane to its estimate"),
        "delay_steps": (delay_steps, "1", "the same in samples, rounded up; part of A, B, C, D"),
        "arrival": (arrival, "s", "from the first scan of a plane to the wing in it"),
        "lead": (arrival - one.delay, "s", "from the estimate to the wing in its plane"),
        "airspeed": (one.speed, "m s-1", "true airspeed"),
        "span": (one.span, "m", "of the wing over which winds are averaged"),
        "roll_moment_per_gust": (
            one.roll_moment_per_gust,
            "N m s rad-1",
            "rolling moment of the wind per p: minus the roll damping",
        ),
        "lift_per_gust": (one.lift_per_gust, "N s m-1", "force upwards of the wind per w"),
    }
    return {name: variable((), *about) for name, about in values.items()}


def _numbers(flights: Sequence[SensorSamples], fits: Sequence[FilterFit]) -> Variables:
    """Parameters of the axes, with standard errors; taps and lags that an axis lacks are 0."""

    def padded(name: str) -> np.ndarray:
        rows = [np.atleast_1d(getattr(fit, name)) for fit in fits]
        if rows[0].ndim == 2:
            rows = [np.sqrt(np.diagonal(row)) for row in rows]
        longest = max(1, *(len(row) for row in rows))
        return np.array([np.pad(row, (0, longest - len(row))) for row in rows])

    def column(values: Sequence[float], units: str, text: str) -> Variable:
        return variable("axis", np.array(values, float), units, text)

    noise, noise_stderr = zip(*(fit.noise_variance for fit in fits), strict=True)
    values = np.array([fit.parameters for fit in fits]).T
    errors = np.sqrt([np.diag(fit.covariance) for fit in fits]).T
    tap, lag = ("axis", "tap"), ("axis", "lag")
    texts = {
        "offset": ("of the axis", "mean error; not part of A, B, C, D"),
        "gain": ("1", "of a constant wind: the sum of taps"),
        "decay_before": ("1", "r: of taps from plane to plane before the estimated one"),
        "decay_after": ("1", "s: of taps from plane to plane after the estimated one"),
    }
    numbers = {}
    for name, value, error in zip(texts, values, errors, strict=True):
        units, text = texts[name]
        numbers[name] = column(value, units, text)
        numbers[f"{name}_stderr"] = column(error, units, f"standard error of {name}")
    return numbers | {
        "taps": variable(
            tap,
            np.array([fit.taps for fit in fits]),
            "1",
            "weights of the planes `tap` planes before the estimated one",
        ),
        "tap": variable("tap", np.arange(-fits[0].after, BEFORE + 1), "1", "planes before"),
        "lags": variable(lag, padded("lags"), "1", "a: autoregression of the noise"),
        "lags_stderr": variable(lag, padded("lags_covariance"), "1", "standard error of lags"),
        "noise_variance": column(noise, _SQUARE, "of the error that the filter leaves"),
        "noise_variance_stderr": column(noise_stderr, _SQUARE, "standard error of noise_variance"),
        "slabs": column([fit.count for fit in fits], "1", "from which the axis is identified"),
        "flights": variable((), len(flights), "1", "from which it is identified"),
    }


def _losses(flights: Sequence[SensorSamples], measured: list[int]) -> Variables:
    """The chain of lost estimates, and whether it describes them."""
    lost = [~np.isfinite(flight.estimate[:, measured]).all(axis=1) for flight in flights]
    chain = loss_chain(lost)
    dependence = [gust_dependence(lost, [one.truth[:, k] for one in flights]) for k in measured]
    ratio, ratio_p = np.array(dependence).T
    probability, run = chain.probability, chain.mean_run
    texts = {
        "loss_probability": (probability[0], "of an estimate to be lost"),
        "loss_probability_stderr": (probability[1], "standard error of loss_probability"),
        "loss_run": (run[0], "mean number of estimates lost in succession"),
        "loss_run_stderr": (run[1], "standard error of loss_run"),
        "loss_memory_p": (chain.memory_p, "p value of runs of geometric lengths"),
        "loss_gust_ratio": (ratio, "mean square of the gust in lost slabs over that in all"),
        "loss_gust_p": (ratio_p, "p value of losses that do not depend on the gust"),
    }
    losses = {
        name: variable(("axis",) if np.ndim(value) else (), value, "1", text)
        for name, (value, text) in texts.items()
    }
    text = "probability from received, lost to received, lost"
    losses["loss_transition"] = variable(("loss", "loss_2"), chain.transition, "1", text)
    return losses


def _spectra(fits: Sequence[FilterFit], dt: float, delay_steps: int) -> Variables:
    cycles = np.linspace(0, 0.5, FREQUENCIES)
    delayed = np.exp(-2j * np.pi * cycles * delay_steps)
    noise = [fit.noise_spectrum(cycles) for fit in fits]
    dims = ("axis", "frequency")
    response, response_stderr = zip(*(fit.response(cycles) for fit in fits), strict=True)
    psd, psd_stderr = (2 * dt * np.array(part) for part in zip(*noise, strict=True))
    density = f"{_SQUARE} per Hz"
    return {
        "frequency": variable("frequency", cycles / dt, "Hz", "as the wing meets it"),
        "response": variable(
            dims, np.array(response) * delayed, "1", "of the estimate to the gust, with its delay"
        ),
        "response_stderr": variable(
            dims, np.array(response_stderr), "1", "standard error of response"
        ),
        "noise_psd": variable(dims, psd, density, "power spectral density of the error, one-sided"),
        "noise_psd_stderr": variable(dims, psd_stderr, density, "standard error of noise_psd"),
    }


def _with_margins(flight: SensorSamples, name: str) -> np.ndarray:
    margin = np.full((MARGIN, len(GUSTS)), np.nan)
    around = (margin, margin) if name == "estimate" else (flight.truth_before, flight.truth_after)
    return np.concatenate([around[0], getattr(flight, name), around[1], margin[:1]])


def _range(one: SensorSamples) -> str:
    return f"control block at {one.distance:.4g} m"
