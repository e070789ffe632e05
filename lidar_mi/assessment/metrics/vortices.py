"""Verdict on a fitted vortex pair: vortices of the true wind, errors of the fit."""

from collections.abc import Mapping, Sequence
from enum import StrEnum
from typing import TYPE_CHECKING

import numpy as np
import xarray as xr

from lidar_mi.assessment.metrics.errors import error_statistics
from lidar_mi.assessment.metrics.names import vortex_key
from lidar_mi.atmosphere.vortices.cores import Core, outside_cores, ring_averages

if TYPE_CHECKING:
    from lidar_mi.retrieval.vortices.pair import VortexPairFit


class Origin(StrEnum):
    """Data that a vortex pair is fitted to."""

    IMAGES = "images"
    VECTORS = "vectors"


ORIGIN_NAMES: Mapping[str, str] = {Origin.IMAGES: "images", Origin.VECTORS: "wind vectors"}
"""Names of the origins in figures, tables and warnings."""


def true_pair(wind: xr.Dataset, cores: Sequence[Core]) -> dict[str, float]:
    """Vortices of a true wind, by the names of `VortexPairFit.quantities`.

    Circulations and the velocity of the pair are averages over rings of 5 to 15 m about the cores
    (`cores.ring_averages`); what is undetermined (one vortex only, rings beyond the field) is
    omitted. Circulation far from the core is that of a model, not of a flow.
    """
    true: dict[str, float] = {}
    advecting = []
    for core in cores:
        # positive on the port side, as behind a lifting wing
        side = "port" if core.circulation > 0 else "starboard"
        true |= {f"{side}_core_radius": core.radius, f"{side}_y": core.y, f"{side}_z": core.z}
        rings = ring_averages(wind, core, [other for other in cores if other is not core])
        if rings is not None:
            true[f"{side}_circulation_5_15"] = rings.circulation
            advecting.append((rings.v, rings.w))
    if len(cores) == 2:
        port, starboard = cores
        true |= {
            "separation": float(np.hypot(port.y - starboard.y, port.z - starboard.z)),
            "centre_y": (port.y + starboard.y) / 2,
            "centre_z": (port.z + starboard.z) / 2,
        }
    if len(advecting) == 2:
        true["drift_v"], true["drift_w"] = (float(mean) for mean in np.mean(advecting, axis=0))
    return true


def core_metrics(cores: Sequence[Core]) -> dict[str, float]:
    """Places (m), radii (m) and circulations (m^2 s^-1) of the true cores, ``wake.port_core.y``."""
    metrics = {}
    for core in cores:
        side = "port" if core.circulation > 0 else "starboard"
        for key in ("y", "z", "radius", "circulation"):
            metrics[f"wake.{side}_core.{key}"] = getattr(core, key)
    return metrics


def vortex_metrics(
    fits: "Mapping[str, VortexPairFit]", truth: xr.Dataset, cores: Sequence[Core]
) -> dict[str, float]:
    """Quantities of the true and the fitted pairs, and the errors of the fitted wind.

    ``vortex.ORIGIN.QUANTITY`` and ``..._stderr``; over the whole slab ``rmse_v``, ``rmse_w`` (m/s)
    and ``normalised_error_variance_*`` as of `errors.error_statistics`, ``outside_cores.rmse_*``
    beyond two core radii. Fits are by `Origin`; the truth is v, w (m s^-1) on (z, y).
    """
    metrics = {vortex_key("truth", key): x for key, x in true_pair(truth, cores).items()}
    for origin, fit in fits.items():
        numbers = _quantities(fit) | _model_errors(fit, truth, cores)
        metrics |= {vortex_key(origin, key): value for key, value in numbers.items()}
    return metrics


def _quantities(fit: "VortexPairFit") -> dict[str, float]:
    numbers = {"correlation": fit.correlation, "model_error": fit.model_error}
    if np.isfinite(fit.chi2):
        numbers["chi2"] = fit.chi2
    for name, quantity in fit.quantities.items():
        numbers |= {name: quantity.value, f"{name}_stderr": quantity.stderr}
    return {name: float(value) for name, value in numbers.items()}


def _model_errors(
    fit: "VortexPairFit", truth: xr.Dataset, cores: Sequence[Core]
) -> dict[str, float]:
    y, z = truth["y"].values[None, :], truth["z"].values[:, None]
    model, far = fit.wind(y, z), outside_cores(y, z, list(cores))
    metrics = {}
    for name in ("v", "w"):
        error = model[name].values - truth[name].transpose("z", "y").values
        statistics = error_statistics(error, model[f"{name}_stderr"].values)
        for key in ("rmse", "normalised_error_variance"):
            if key in statistics:
                metrics[f"{key}_{name}"] = statistics[key]
        if cores and far.any():
            beyond = error_statistics(error, where=far)
            metrics[f"outside_cores.rmse_{name}"] = beyond["rmse"]
    return metrics
