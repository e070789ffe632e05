"""Verdict on the cross-flow winds of a run: errors, efficiencies, strength of the true wind."""

from collections.abc import Sequence

import numpy as np
import xarray as xr

from lidar_mi.assessment.metrics.errors import error_statistics, wind_metrics
from lidar_mi.assessment.metrics.names import sweep_key, wind_key
from lidar_mi.atmosphere.vortices.cores import Core, outside_cores


def cross_flow_metrics(winds: xr.Dataset, cores: Sequence[Core]) -> dict[str, float]:
    """Errors and efficiencies of every method from every source, ``source.method.quantity``.

    Of winds (source, algorithm, z, y) with ``v_true``, ``v_bound`` and likewise of w (m s^-1),
    their flags and positions.
    """
    metrics: dict[str, float] = {}
    for source in winds["source"].values:
        for method in winds["algorithm"].values:
            wind = winds.sel(source=source, algorithm=method)
            true = wind[["v_true", "w_true"]].rename(v_true="v", w_true="w")
            numbers = wind_metrics(wind, true, list(cores)) | efficiency(wind) | skill(wind)
            numbers |= coverage(wind)
            metrics |= {wind_key(source, method, key): value for key, value in numbers.items()}
    return metrics


def efficiency(wind: xr.Dataset) -> dict[str, float]:
    """Cramer-Rao bound over the errors of a method, of v and w; valid vectors only.

    ``bound_*``: rms of the bound of one template, m/s. ``efficiency_*``: that over the rms error;
    above 1 where a method smooths over more than a template. Empty without noise.
    """
    metrics: dict[str, float] = {}
    for name in ("v", "w"):
        error = (wind[name] - wind[f"{name}_true"]).values
        bound = wind[f"{name}_bound"].values
        used = (wind["flag"].values == 0) & np.isfinite(error) & np.isfinite(bound)
        if used.any() and (bound[used] > 0).all():
            least = float(np.sqrt(np.mean(bound[used].astype(float) ** 2)))
            metrics[f"bound_{name}"] = least
            rmse = error_statistics(error, where=used)["rmse"]
            # without errors there is nothing to divide by
            metrics |= {f"efficiency_{name}": least / rmse} if rmse > 0 else {}
    return metrics


def coverage(wind: xr.Dataset) -> dict[str, float]:
    """Fractions of the errors of valid v and w within the stated errors.

    ``coverage_68_*``, ``coverage_95_*``: as of `errors.error_statistics`; empty for methods that
    state no errors.
    """
    metrics: dict[str, float] = {}
    for name in ("v", "w"):
        if f"{name}_stderr" not in wind:
            continue
        error = (wind[name] - wind[f"{name}_true"]).values
        parts = error_statistics(error, wind[f"{name}_stderr"].values, wind["flag"].values == 0)
        for key in ("coverage_68", "coverage_95"):
            metrics |= {f"{key}_{name}": parts[key]} if key in parts else {}
    return metrics


def skill(wind: xr.Dataset) -> dict[str, float]:
    """Standard errors as a method states them; empty for methods that state none.

    ``stderr_*``: rms standard error, m/s, of vectors that are valid, or whose only flag is
    `no_skill`. ``no_skill_fraction``: 1 where they equal the rms of the true wind or exceed it,
    else the fraction of all vectors with that flag.
    """
    from lidar_mi.flags import Flag

    flag = wind["flag"].values
    # no flag, or this one alone
    used = (flag | Flag.NO_SKILL.value) == Flag.NO_SKILL.value
    metrics: dict[str, float] = {}
    for name in ("v", "w"):
        stderr = wind[f"{name}_stderr"].values if f"{name}_stderr" in wind else np.nan
        stderr = np.broadcast_to(stderr, flag.shape)
        finite = used & np.isfinite(stderr)
        if finite.any():
            metrics[f"stderr_{name}"] = float(np.sqrt(np.mean(stderr[finite].astype(float) ** 2)))
    if len(metrics) == 2:
        true = [np.sqrt(np.mean(wind[f"{name}_true"].values ** 2)) for name in ("v", "w")]
        none = np.hypot(metrics["stderr_v"], metrics["stderr_w"]) >= np.hypot(*true)
        marked = float(((flag & Flag.NO_SKILL.value) > 0).mean())
        metrics["no_skill_fraction"] = 1.0 if none else marked
    return metrics


def true_wind_metrics(
    wind: xr.Dataset, cores: Sequence[Core], components: Sequence[str] = ("v", "w")
) -> dict[str, float]:
    """Rms of the true wind, m/s: a retrieval with errors as large has no skill.

    wind (..., z, y): the true wind at the positions of the vectors.
    """
    far = outside_cores(wind["y"].values, wind["z"].values[:, None], list(cores))
    metrics: dict[str, float] = {}
    for name in components:
        square = wind[name].transpose(..., "z", "y").values ** 2
        metrics[f"true_wind.rms_{name}"] = float(np.sqrt(square.mean()))
        if cores and far.any():
            beyond = square[..., far]
            metrics[f"true_wind.outside_cores.rms_{name}"] = float(np.sqrt(beyond.mean()))
    return metrics


def sweep_metrics(sweep: xr.Dataset) -> dict[str, float]:
    """Errors by sub-grid texture, ``texture_sweep.10_percent.rmse_v`` and so on.

    sweep (texture): ``rmse_v``, ``rmse_w`` (m s^-1), ``valid_fraction``; NaN, where nothing was
        retrieved, is omitted.
    """
    metrics: dict[str, float] = {}
    for rms in sweep["texture"].values:
        for name, value in sweep.sel(texture=rms).data_vars.items():
            if np.isfinite(value):
                metrics[sweep_key(rms, str(name))] = float(value)
    return metrics
