"""Verdict on winds in three dimensions."""

from collections.abc import Sequence

import numpy as np
import xarray as xr

from lidar_mi.assessment.metrics.errors import error_statistics
from lidar_mi.assessment.metrics.names import wind_key
from lidar_mi.assessment.metrics.winds import true_wind_metrics
from lidar_mi.atmosphere.vortices.cores import Core, outside_cores

COMPONENTS = ("u", "v", "w")


def volume_metrics(winds: xr.Dataset, cores: Sequence[Core]) -> dict[str, float]:
    """Errors against the truth, ``source.method.quantity``, of valid vectors (flag 0).

    ``rmse_u`` and so on, ``bias_u``, ``stderr_u``, ``normalised_error_variance_u``,
    ``coverage_68_u`` as of `errors.error_statistics`; ``outside_cores.rmse_u`` beyond two core
    radii, ``all.rmse_u`` over every vector, ``true_wind.rms_u`` of the wind itself at the same
    places.

    winds (source, algorithm, x, z, y): u, v, w, their ``_true`` and ``_stderr`` (m s^-1), flag.
    """
    true = winds[[f"{name}_true" for name in COMPONENTS]]
    true = true.rename({f"{name}_true": name for name in COMPONENTS})
    metrics = true_wind_metrics(true, cores, COMPONENTS)
    y, z = winds["y"].values, winds["z"].values[:, None]
    far = np.broadcast_to(outside_cores(y, z, list(cores)), winds["u_true"].shape)
    for source in winds["source"].values:
        for method in winds["algorithm"].values:
            wind = winds.sel(source=source, algorithm=method)
            for key, value in _errors(wind, far).items():
                metrics[wind_key(source, method, key)] = value
    return metrics


def _errors(wind: xr.Dataset, far: np.ndarray) -> dict[str, float]:
    valid = wind["flag"].values == 0
    metrics = {"valid_fraction": float(valid.mean())}
    for name in COMPONENTS:
        error, stderr = (wind[name] - wind[f"{name}_true"]).values, wind[f"{name}_stderr"].values
        statistics = error_statistics(error, stderr, valid)
        beyond, everywhere = error_statistics(error, where=valid & far), error_statistics(error)
        for key in ("rmse", "bias", "stderr", "normalised_error_variance", "coverage_68"):
            if key in statistics:
                metrics[f"{key}_{name}"] = statistics[key]
        if beyond:
            metrics[f"outside_cores.rmse_{name}"] = beyond["rmse"]
        if everywhere:
            metrics[f"all.rmse_{name}"] = everywhere["rmse"]
    return metrics
