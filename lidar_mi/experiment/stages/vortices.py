"""The vortices of an experiment: a pair fitted to the images and to the wind retrieved from them.

The fit gives the parameters of the wake vortices, and a model of the wind that can be evaluated
anywhere, for use by a controller.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import xarray as xr

from lidar_mi.errors import InputError
from lidar_mi.experiment.log import Log
from lidar_mi.experiment.observation import Observation
from lidar_mi.experiment.stages.winds import (
    Estimation,
    common_error,
    pixel_times,
    rendered_pairs,
    retrieval_device,
)
from lidar_mi.instrument.scan import ScanPlan
from lidar_mi.retrieval.method_names import MOST_ACCURATE_FIRST
from lidar_mi.schema.retrieval import Retrieval
from lidar_mi.schema.sensor import Sensor

if TYPE_CHECKING:
    from lidar_mi.retrieval.vortices.pair import VortexPairFit


@dataclass(frozen=True)
class VortexFits:
    """Vortex pairs by the data they were fitted to.

    pairs: the accepted ones, by `Origin`.
    refused: reasons for which there is no other.
    method: method of the wind vectors; None if no pair was fitted to vectors.
    """

    pairs: "dict[str, VortexPairFit]"
    refused: dict[str, str]
    method: str | None = None


def combined_vectors(wind3d: xr.Dataset | None) -> xr.Dataset | None:
    """Cross-flow wind of both lidars, with the flags of v and w; None: there is none."""
    from lidar_mi.flags import CombinedFlag

    if wind3d is None:
        return None
    # v and w do not need lines of sight
    return wind3d.assign(flag=wind3d["flag"] & CombinedFlag.NO_CROSSFLOW.value)


def image_vectors(retrieval: Retrieval, wind: xr.Dataset) -> xr.Dataset | None:
    """Cross-flow wind of the experiment's most accurate method, None where there is none."""
    method = vectors_method(None, retrieval)
    if method is None:
        return None
    vectors = wind.isel(source=-1).sel(algorithm=method)
    return vectors.set_coords(["y_vector", "z_vector"])


def vectors_method(sensor: Sensor | None, retrieval: Retrieval) -> str | None:
    """Method whose vectors a vortex pair is fitted to; None where all methods fit vortices."""
    if sensor:
        return sensor.method
    return next((m for m in MOST_ACCURATE_FIRST if m in retrieval.methods), None)


def fit_pairs(
    observation: Observation,
    estimation: Estimation,
    sensor: Sensor | None,
    plans: Sequence[ScanPlan],
    scans: Sequence[xr.Dataset],
    vectors: xr.Dataset | None,
    log: Log,
) -> VortexFits:
    """Vortex pairs from the images and from the vectors, where there are or should be some."""
    from lidar_mi.assessment.metrics.vortices import ORIGIN_NAMES, Origin
    from lidar_mi.retrieval.vortices.image_fit import fit_vortices

    wake, platform, scan = observation.wake, observation.platform, observation.scan
    retrieval, device = estimation.retrieval, estimation.device
    with_vectors = sensor is not None or vectors is not None
    method = vectors_method(sensor, retrieval) if with_vectors else None
    log(f"fitting vortex pairs to the images{f' and to the vectors by {method}' if method else ''}")
    pair, noise = list(rendered_pairs(wake, scan, scans).values())[-1]
    times = pixel_times(wake, scan, scans)
    common, rotation = common_error(retrieval, platform, plans)
    # as functions: a refused fit to the images must not prevent that to the vectors
    ways: dict[Origin, Callable[[], VortexPairFit]] = {
        Origin.IMAGES: lambda: fit_vortices(
            pair[0], pair[1], platform.dt, noise, times=times, device=retrieval_device(device)
        ).with_common_error(common, common, rotation)
    }
    if with_vectors:
        ways[Origin.VECTORS] = lambda: _from_vectors(vectors)
    fits: dict[str, VortexPairFit] = {}
    refused: dict[str, str] = {}
    for origin, way in ways.items():
        try:
            fit = way()
        except InputError as error:
            refused[str(origin)] = str(error)
            continue
        if fit.success:
            fits[str(origin)] = fit
        else:
            refused[str(origin)] = "; ".join(fit.reasons)

    for name, reason in refused.items():
        log.remark(f"no vortex pair from the {ORIGIN_NAMES[Origin(name)]}: {reason}")
    return VortexFits(fits, refused, method)


def _from_vectors(vectors: xr.Dataset | None) -> "VortexPairFit":
    from lidar_mi.retrieval.vortices.vector_fit import fit_vortices_to_wind

    if vectors is None:
        raise InputError("vectors: no valid vectors")
    return fit_vortices_to_wind(vectors)
