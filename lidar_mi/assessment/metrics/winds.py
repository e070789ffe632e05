"""Verdict on the cross-flow winds of a run: errors, efficiencies, strength of the true wind."""

from collections.abc import Sequence

import numpy as np
import xarray as xr

from lidar_mi.assessment.metrics.cores import Core, outside_cores
from lidar_mi.assessment.metrics.errors import error_statistics, wind_metrics
from lidar_mi.assessment.metrics.names import sweep_key, wind_key


def cross_flow_metrics(found: xr.Dataset, cores: Sequence[Core]) -> dict[str, float]:
    """Errors and efficiencies of every method from every source, ``source.method.quantity``.

    Parameters
    ----------
    found : xr.Dataset, dims (source, algorithm, z, y)
        v, w, ``v_true``, ``w_true``, ``v_bound``, ``w_bound`` (m s^-1), flag and the vectors'
        positions.
    cores : sequence of Core
        True vortices.
    """
    metrics: dict[str, float] = {}
    for source in found["source"].values:
        for method in found["algorithm"].values:
            wind = found.sel(source=source, algorithm=method)
            true = wind[["v_true", "w_true"]].rename(v_true="v", w_true="w")
            numbers = wind_metrics(wind, true, list(cores)) | efficiency(wind)
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
            metrics[f"efficiency_{name}"] = least / error_statistics(error, where=used)["rmse"]
    return metrics


def true_wind_metrics(
    wind: xr.Dataset, cores: Sequence[Core], components: Sequence[str] = ("v", "w")
) -> dict[str, float]:
    """Rms of the true wind, m/s: a retrieval with errors as large has no skill.

    Parameters
    ----------
    wind : xr.Dataset, dims (..., z, y)
        The true wind at the positions of the vectors.
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

    Parameters
    ----------
    sweep : xr.Dataset, dim (texture)
        ``rmse_v``, ``rmse_w`` (m s^-1), ``valid_fraction``; NaN, where nothing was retrieved, is
        left out.
    """
    metrics: dict[str, float] = {}
    for rms in sweep["texture"].values:
        for name, value in sweep.sel(texture=rms).data_vars.items():
            if np.isfinite(value):
                metrics[sweep_key(rms, str(name))] = float(value)
    return metrics
