"""Verdict on a coherent lidar's lines of sight, and on the winds and vortices from them."""

from collections.abc import Mapping, Sequence
from itertools import pairwise

import numpy as np
import xarray as xr

from lidar_mi.assessment.metrics.errors import error_statistics

PREFIX = "coherent."
"""Prefix of all metrics here."""

PUBLISHED = {"circulation_error": 0.04, "place_error": 0.06}
"""Published errors of circulation and place for simulated scans with known truth, relative to the
circulation and the separation (DLR's LES Lidar Simulator; J. Atmos. Oceanic Technol. 42(3),
2025)."""

_QUANTITIES = ("y", "z", "circulation")
_CIRCULATION = "circulation_5_15"


def lines_metrics(lines: xr.Dataset) -> dict[str, float]:
    """Number of lines, and noise of their velocities: as stated, and against the truth.

    ``coherent.lines``, ``coherent.noise`` (median of the stated standard errors, m/s),
    ``coherent.rmse_v_los`` and ``coherent.bias_v_los`` (m/s), ``coherent.cnr`` (median, dB), of
    gates with a signal, ``coherent.signal_fraction`` of all.
    """
    signal = lines["flag"] == 0
    metrics = {
        f"{PREFIX}lines": float(lines.sizes["time"]),
        f"{PREFIX}signal_fraction": float(signal.mean()),
    }
    if not signal.any():
        return metrics
    detected = lines[["radial_velocity", "radial_velocity_true", "radial_velocity_stderr", "snr"]]
    detected = detected.where(signal)
    error = error_statistics(detected["radial_velocity"] - detected["radial_velocity_true"])
    return metrics | {
        f"{PREFIX}noise": float(detected["radial_velocity_stderr"].median()),
        f"{PREFIX}cnr": float(10 * np.log10(detected["snr"].median())),
        f"{PREFIX}rmse_v_los": error["rmse"],
        f"{PREFIX}bias_v_los": error["bias"],
    }


def profile_metrics(winds: xr.Dataset) -> dict[str, float]:
    """Errors of valid winds, ``coherent.winds.rmse_u`` ..., and how many are valid."""
    valid = winds["flag"].values == 0
    metrics = {f"{PREFIX}winds.valid_fraction": float(valid.mean())}
    for name in "uvw":
        error = (winds[name] - winds[f"{name}_true"]).values
        statistics = error_statistics(error, winds[f"{name}_stderr"].values, valid)
        metrics |= {f"{PREFIX}winds.{key}_{name}": value for key, value in statistics.items()}
    return metrics


def vortex_errors(vortices: xr.Dataset) -> xr.Dataset:
    """Errors of every vortex, NaN where the scan is flagged, dims (scan, vortex).

    Returns
    -------
    xr.Dataset
        ``circulation_error`` (of the mean over rings of 5 to 15 m, relative to the true one),
        ``y_error`` and ``z_error`` in separations of the wake, ``place_error`` their distance, all
        signed but the last; and ``y_normalised``, ``z_normalised``, ``circulation_normalised`` over
        the standard errors.
    """
    errors = {}
    valid = (vortices["flag"] == 0).values[:, None]
    for name in _QUANTITIES:
        key = _CIRCULATION if name == "circulation" else name
        true = vortices[f"{key}_true"].values
        error, stderr = vortices[key].values - true, vortices[f"{key}_stderr"].values
        size = true if key == _CIRCULATION else vortices.attrs["separation"]
        errors[f"{name}_error"] = np.where(valid, error / size, np.nan)
        errors[f"{name}_normalised"] = np.where(valid, error / stderr, np.nan)
    errors["place_error"] = np.hypot(errors["y_error"], errors["z_error"])
    return xr.Dataset(
        {name: (("scan", "vortex"), values) for name, values in errors.items()},
        {"age": vortices["age"]},
    )


def vortex_scan_metrics(vortices: xr.Dataset) -> dict[str, float]:
    """Errors of the vortices of all scans, and whether the standard errors hold.

    ``coherent.vortices.``: ``scans``, ``valid_fraction``; ``circulation_error`` and ``place_error``
    (medians of the sizes, of the circulation and of the separation), ``circulation_rms``,
    ``place_rms``, ``circulation_bias`` (mean); ``coverage_68_*`` and ``coverage_95_*``,
    ``normalised_error_variance_*`` of y, z and circulation. ``coherent.rv.``: the same errors by
    the method of radial velocities, and the fraction of the slices in which it finds both;
    ``coherent.track.``: of the places by all slices together.
    """
    errors, prefix = vortex_errors(vortices), f"{PREFIX}vortices."
    metrics = {
        f"{prefix}scans": float(vortices.sizes["scan"]),
        f"{prefix}valid_fraction": float((vortices["flag"] == 0).mean()),
    }
    metrics |= _sizes(f"{PREFIX}rv.", _peer_errors(vortices))
    localised = np.isfinite(vortices["y_rv"].values).all(1)
    metrics[f"{PREFIX}rv.valid_fraction"] = float(localised.mean())
    if not metrics[f"{prefix}valid_fraction"]:
        return metrics
    metrics |= _sizes(prefix, errors)
    metrics[f"{prefix}circulation_bias"] = float(np.nanmean(errors["circulation_error"]))
    if "y_tracked" in vortices:
        metrics |= _track_metrics(vortices)
    for name in _QUANTITIES:
        normalised = errors[f"{name}_normalised"].values
        statistics = error_statistics(normalised, np.ones_like(normalised))
        for key in ("coverage_68", "coverage_95", "normalised_error_variance"):
            metrics[f"{prefix}{key}_{name}"] = statistics[key]
    return metrics


def _sizes(prefix: str, errors: xr.Dataset) -> dict[str, float]:
    """Medians and rms of the sizes of errors."""
    metrics = {}
    for name in ("circulation", "place"):
        size = np.abs(errors[f"{name}_error"].values)
        if np.isfinite(size).any():
            metrics[f"{prefix}{name}_error"] = float(np.nanmedian(size))
            metrics[f"{prefix}{name}_rms"] = float(np.sqrt(np.nanmean(size**2)))
    return metrics


def _track_metrics(vortices: xr.Dataset) -> dict[str, float]:
    """Errors of the places tracked over all slices: ``coherent.track.place_error``, coverages."""
    relative, metrics = [], {}
    for name in "yz":
        error = (vortices[f"{name}_tracked"] - vortices[f"{name}_true"]).values
        relative.append(error / vortices.attrs["separation"])
        statistics = error_statistics(error, vortices[f"{name}_tracked_stderr"].values)
        for key in ("coverage_68", "coverage_95"):
            metrics[f"{PREFIX}track.{key}_{name}"] = statistics[key]
    metrics[f"{PREFIX}track.place_error"] = float(np.nanmedian(np.hypot(*relative)))
    return metrics


def _peer_errors(vortices: xr.Dataset) -> xr.Dataset:
    """Relative errors of circulation and place by the method of radial velocities."""
    away = {n: vortices[f"{n}_rv"] - vortices[f"{n}_rv_true"] for n in ("y", "z", _CIRCULATION)}
    return xr.Dataset(
        {
            "circulation_error": away[_CIRCULATION] / vortices[f"{_CIRCULATION}_rv_true"],
            "place_error": np.hypot(away["y"], away["z"]) / vortices.attrs["separation"],
        }
    )


def errors_by_age(vortices: xr.Dataset, bins: int = 4) -> Sequence[Mapping[str, float]]:
    """Medians of the errors in intervals of the wake's age with equal numbers of scans.

    Returns
    -------
    sequence of dict
        ``first`` and ``last`` age (s), ``scans`` and ``valid`` of them, ``circulation``, ``place``
        (medians, NaN: none).
    """
    errors = vortex_errors(vortices)
    order = np.argsort(vortices["age"].values)
    rows = []
    ends = np.linspace(0, order.size, min(bins, order.size) + 1).astype(int)
    for low, high in pairwise(ends):
        part = errors.isel(scan=order[low:high])
        valid = np.isfinite(part["place_error"].values)
        row = {
            "first": float(part["age"].min()),
            "last": float(part["age"].max()),
            "scans": float(high - low),
            "valid": float(valid.any(1).sum()),
        }
        for name in ("circulation", "place"):
            size = np.abs(part[f"{name}_error"].values[valid])
            row[name] = float(np.median(size)) if size.size else float("nan")
        rows.append(row)
    return rows
