"""Errors of winds retrieved from the extinction against its sub-grid texture."""

from dataclasses import replace

import numpy as np
import xarray as xr

from lidar_mi.assessment.metrics.errors import error_statistics, truth_at_vectors
from lidar_mi.experiment.log import Log
from lidar_mi.experiment.observation import Observation
from lidar_mi.experiment.stages.winds import Estimation, window_settings
from lidar_mi.experiment.truth.clear_air import ClearAir
from lidar_mi.experiment.truth.extinction import true_air
from lidar_mi.experiment.truth.flows import Flows, advection_by
from lidar_mi.retrieval.method_names import ImageMethod

LEVELS = (0.0, 0.02, 0.05, 0.1, 0.2, 0.4)
"""Relative rms of the texture."""


def texture_sweep(
    observation: Observation,
    estimation: Estimation,
    seed: int,
    flows: Flows,
    clear_air: ClearAir,
    log: Log,
) -> xr.Dataset:
    """Errors of cross-correlation on extinction pairs of more and less sub-grid texture.

    Returns
    -------
    xr.Dataset, dim (texture)
        ``rmse_v``, ``rmse_w`` (m s^-1) over every vector with a displacement, NaN where there is
        none; ``valid_fraction``.
    """
    from lidar_mi.retrieval.wind.pair import retrieve_wind

    wake = observation.wake
    points, advected = [], advection_by(observation, flows)
    for index, rms in enumerate(LEVELS):
        log.bar(f"retrieving winds at {rms:.0%} texture", index / len(LEVELS))
        texture = wake.texture.model_copy(update={"rms": rms})
        textured = replace(observation, wake=wake.model_copy(update={"texture": texture}))
        truth = true_air(textured, seed, flows, clear_air, advected=advected)
        wind = retrieve_wind(
            truth.image(0),
            truth.image(1),
            dt=observation.platform.dt,
            method=ImageMethod.CC,
            **window_settings(estimation.retrieval, estimation.device),
        )
        true = truth_at_vectors(wind, truth.wind)
        v, w = (wind[name].values - true[name].values for name in ("v", "w"))
        known = np.isfinite(v) & np.isfinite(w)
        rmse = [error_statistics(e, where=known).get("rmse", np.nan) for e in (v, w)]
        points.append([*rmse, float((known & (wind["flag"].values == 0)).mean())])
    values = np.array(points).reshape(len(LEVELS), 3).T
    about = (
        ("rmse_v", "rms error of v", "m s-1"),
        ("rmse_w", "rms error of w", "m s-1"),
        ("valid_fraction", "fraction of valid vectors", "1"),
    )
    return xr.Dataset(
        {
            name: ("texture", column, {"long_name": text, "units": unit})
            for (name, text, unit), column in zip(about, values, strict=True)
        },
        {"texture": ("texture", list(LEVELS), {"long_name": "relative rms", "units": "1"})},
    )
