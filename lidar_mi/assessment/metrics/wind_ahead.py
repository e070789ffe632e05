"""The wind expected on the wing at its arrival against the wind that it meets."""

import numpy as np
import xarray as xr


def wind_ahead_metrics(track: xr.Dataset) -> dict[str, float]:
    """Rms errors (m/s) of v and w, rms of both, and fractions within one and two stated errors.

    track: with the wind expected at arrivals, dims (arrival, place); without it there are no
        metrics.
    """
    if "arrival_v" not in track:
        return {}
    metrics, normalised = {}, []
    for name in "vw":
        truth = track[f"arrival_{name}_true"].values
        error = track[f"arrival_{name}"].values - truth
        metrics[f"wind_ahead.{name}_error"] = float(np.sqrt(np.mean(error**2)))
        metrics[f"wind_ahead.{name}_rms"] = float(np.sqrt(np.mean(truth**2)))
        stderr = np.maximum(track[f"arrival_{name}_stderr"].values, np.finfo(float).tiny)
        normalised.append(np.abs(error) / stderr)
    for count in (1, 2):
        metrics[f"wind_ahead.within_{count}_sigma"] = float(np.mean(np.array(normalised) <= count))
    return metrics
