"""Errors of retrieved winds against the truth."""

from typing import Any

import numpy as np
import scipy
import xarray as xr
from numpy.typing import ArrayLike

from lidar_mi.atmosphere.vortices.cores import Core, outside_cores
from lidar_mi.flags import masks_of


def truth_at_vectors(wind: xr.Dataset, truth: xr.Dataset) -> xr.Dataset:
    """The true wind at the position and time of each retrieved vector, NaN without a position.

    wind: from `lidar_mi.retrieval.wind.pair.retrieve_wind`: coordinates y_vector, z_vector.
    truth: v, w (m s^-1) on (z, y); the flow is taken to be steady over dt. Cubic interpolation.
    """
    axes = {name: truth[name].values for name in ("z", "y")}
    places = {name: wind[f"{name}_vector"].values for name in axes}
    inside = np.ones(wind["v"].shape, bool)
    for name, axis in axes.items():
        # NaN is in no interval
        inside &= (places[name] >= axis[0]) & (places[name] <= axis[-1])
    components = {}
    for name in ("v", "w"):
        spline = scipy.interpolate.RectBivariateSpline(
            *axes.values(), truth[name].transpose("z", "y").values, s=0
        )
        values = np.full(inside.shape, np.nan)
        values[inside] = spline.ev(places["z"][inside], places["y"][inside])
        components[name] = (wind["v"].dims, values, wind[name].attrs)
    return xr.Dataset(components)


def direction(v: xr.DataArray, w: xr.DataArray) -> Any:
    """Direction of the cross-flow wind, radians from +y towards +z."""
    return np.arctan2(w, v)


def deviations(wind: xr.Dataset, reference: xr.Dataset) -> xr.Dataset:
    """Differences wind - reference of v, w, speed (m s^-1) and direction (rad, within +-pi)."""
    turned = direction(wind["v"], wind["w"]) - direction(reference["v"], reference["w"])
    return xr.Dataset(
        {
            "v": wind["v"] - reference["v"],
            "w": wind["w"] - reference["w"],
            "speed": np.hypot(wind["v"], wind["w"]) - np.hypot(reference["v"], reference["w"]),
            # the shorter way round
            "direction": (turned + np.pi) % (2 * np.pi) - np.pi,
        }
    )


def error_statistics(
    error: ArrayLike, stderr: ArrayLike | None = None, where: ArrayLike = True
) -> dict[str, float]:
    """Statistics of errors, and their consistency with the standard errors.

    error: estimate less truth; NaN where there is no estimate.
    stderr: standard errors as stated, of the same shape and unit. Errors without a positive, finite
        one are included in ``rmse`` and ``bias`` only.
    where: which errors are included.

    Returns
    -------
    dict
        ``rmse`` and ``bias`` (unit of the error); with ``stderr`` also ``stderr`` (rms of those
        stated), ``normalised_error_variance`` (mean square of error over standard error, 1
        where errors are as stated), ``coverage_68`` and ``coverage_95`` (fraction within 1 and 1.96
        standard errors, 0.683 and 0.950 for Gaussian errors). Empty where no error counts.
    """
    error = np.asarray(error)
    chosen = np.isfinite(error) & where
    if not chosen.any():
        return {}
    values = error[chosen]
    statistics = {"rmse": np.sqrt(np.mean(values**2)), "bias": np.mean(values)}
    if stderr is not None:
        sigma = np.broadcast_to(stderr, error.shape)[chosen]
        positive = np.isfinite(sigma) & (sigma > 0)
        if positive.any():
            normalised = values[positive] / sigma[positive]
            statistics |= {
                "stderr": np.sqrt(np.mean(sigma[positive] ** 2)),
                "normalised_error_variance": np.mean(normalised**2),
                "coverage_68": np.mean(np.abs(normalised) < 1),
                "coverage_95": np.mean(np.abs(normalised) < 1.96),
            }
    return {name: float(value) for name, value in statistics.items()}


def wind_metrics(wind: xr.Dataset, truth: xr.Dataset, cores: list[Core]) -> dict[str, float]:
    """Errors of one retrieval, as flat keys.

    ``rmse_*``, ``bias_*``, ``p50_*`` and ``p90_*`` (percentiles of the absolute error) of v, w,
    speed (m s^-1) and direction (rad, weighted by nothing) over valid vectors (flag 0);
    ``outside_cores.*`` the same beyond two core radii, ``all.*`` over every vector that has a
    displacement, flagged or not; ``valid_fraction`` and ``retrieved_fraction`` of all vectors.
    """
    error = deviations(wind, truth)
    retrieved = np.isfinite(error["v"].values) & np.isfinite(error["w"].values)
    valid = retrieved & (wind["flag"].values == 0)
    far = outside_cores(wind["y_vector"].values, wind["z_vector"].values, cores)
    metrics = {
        "valid_fraction": float(valid.mean()),
        "retrieved_fraction": float(retrieved.mean()),
        **_statistics(error, valid),
    }
    if cores:
        metrics |= {f"outside_cores.{k}": x for k, x in _statistics(error, valid & far).items()}
    metrics |= {f"all.{k}": x for k, x in _statistics(error, retrieved).items()}
    return metrics


def _statistics(error: xr.Dataset, chosen: np.ndarray) -> dict[str, float]:
    if not chosen.any():
        return {}
    statistics: dict[str, float] = {}
    for name in ("v", "w", "speed", "direction"):
        numbers = error_statistics(error[name].values, where=chosen)
        statistics |= {f"{key}_{name}": value for key, value in numbers.items()}
        for rank in (50, 90):
            percentile = np.percentile(np.abs(error[name].values[chosen]), rank)
            statistics[f"p{rank}_{name}"] = float(percentile)
    return statistics


def error_by_quality(
    wind: xr.Dataset, truth: xr.Dataset, quality: str, bins: int = 12
) -> xr.Dataset:
    """Dependence of the error on a window's texture: rms error of v and w in bins of a quality.

    All vectors with a displacement, flagged or not, in ``bins`` groups of equal number. Returns
    ``rmse`` (m s^-1, both components together), ``valid`` (fraction of unflagged vectors) and the
    median of ``quality`` ("texture", relative slope per pixel, or "isotropy") of each group, dim
    ``group``.
    """
    error = deviations(wind, truth)
    # per component
    square = (error["v"] ** 2 + error["w"] ** 2).values / 2
    retrieved = np.isfinite(square) & np.isfinite(wind[quality].values)
    order = np.argsort(wind[quality].values[retrieved])
    values = wind[quality].values[retrieved][order]
    groups = [g for g in np.array_split(np.arange(len(order)), bins) if len(g)]
    square, flag = square[retrieved][order], wind["flag"].values[retrieved][order]
    return xr.Dataset(
        {
            "rmse": ("group", [float(np.sqrt(square[g].mean())) for g in groups]),
            "valid": ("group", [float((flag[g] == 0).mean()) for g in groups]),
            quality: ("group", [float(np.median(values[g])) for g in groups]),
        }
    )


def commonest_flag(flag: xr.DataArray) -> str:
    """The most frequent flag, in words; ``flag`` has its CF attributes."""
    fractions = {
        meaning: float(((flag.values & mask) != 0).mean())
        for meaning, mask in masks_of(flag.attrs).items()
    }
    worst = max(fractions, key=fractions.__getitem__)
    return f"{round(100 * fractions[worst])} % have the flag {worst}"
