"""The part of the wind's error that is noise of the simulation, not of the lidar."""

import math
from collections.abc import Mapping, Sequence
from itertools import product
from typing import NamedTuple

import numpy as np
import xarray as xr

from lidar_mi.assessment.metrics.names import (
    OUTSIDE_CORES,
    RENDERED,
    Source,
    far_from_cores,
    wind_key,
)
from lidar_mi.atmosphere.vortices.cores import Core, outside_cores


def sample_metrics(scans: Sequence[xr.Dataset]) -> dict[str, float]:
    """Monte Carlo samples of both scans, and their noise relative to a detector's.

    ``backscatter.samples_per_beam``; behind a detector ``backscatter_noisy.monte_carlo_fraction``,
    their variance over that of the detector's noise, in the scan with the larger ratio, see
    `lidar_mi.rendering.samples.monte_carlo_fraction`.
    """
    metrics: dict[str, float] = {}
    if "samples_per_beam" in scans[0].attrs:
        key = f"{Source.BACKSCATTER}.samples_per_beam"
        metrics[key] = float(scans[0].attrs["samples_per_beam"])
    # without it in one scan the larger ratio is unknown
    fraction = max(scan.attrs.get("monte_carlo_fraction", math.inf) for scan in scans)
    if math.isfinite(fraction):
        metrics[f"{Source.NOISY}.monte_carlo_fraction"] = float(fraction)
    return metrics


def simulation_metrics(
    changes: xr.Dataset, winds: xr.Dataset, cores: Sequence[Core]
) -> dict[str, float]:
    """Standard deviation of the wind by the simulation's noise, for each method.

    changes (algorithm, z, y): v, w (m s^-1) from
        `lidar_mi.experiment.stages.simulation_noise.simulation_noise`.
    winds (source, algorithm, z, y): the winds; the last source is that of the changes.
    cores: true vortices.

    Returns
    -------
    dict
        ``SOURCE.METHOD.monte_carlo_v``, ``.monte_carlo_w`` (m s^-1), and with cores
        ``.outside_cores.monte_carlo_v`` beyond two core radii.
    """
    metrics: dict[str, float] = {}
    source = winds["source"].values[-1]
    for method in changes["algorithm"].values:
        wind = winds.sel(source=source, algorithm=method)
        far = outside_cores(wind["y_vector"].values, wind["z_vector"].values, list(cores))
        places = {"": np.ones_like(far)} | ({OUTSIDE_CORES: far} if cores else {})
        for place, inside in places.items():
            for name in ("v", "w"):
                values = changes[name].sel(algorithm=method).values[inside]
                values = values[np.isfinite(values)]
                if values.size:
                    key = wind_key(source, method, f"{place}monte_carlo_{name}")
                    metrics[key] = float(np.sqrt(np.mean(values**2)))
    return metrics


class SimulationPart(NamedTuple):
    """A method's error of v and w together, beyond two core radii where there are cores.

    fraction: of the mean square error that is noise of the simulation, 1 at most.
    place: `OUTSIDE_CORES` or nothing.
    """

    method: str
    fraction: float
    place: str

    def exceeds(self, allowed: float) -> bool:
        """Whether the simulation's part is more than ``allowed`` times all other parts."""
        return self.fraction > allowed * (1 - self.fraction)


def largest_parts(metrics: Mapping[str, xr.DataArray]) -> xr.DataArray | None:
    """Largest part of the simulation in any method's mean square error, at every point.

    At most 1; None if no point has any. NaN at points without `simulation_metrics`, where the part
    is as small as requested.
    """
    parts: list[xr.DataArray] = []
    for place, source in product((OUTSIDE_CORES, ""), RENDERED):
        for key in metrics:
            head, suffix, _ = key.partition(f".{place}monte_carlo_v")
            if suffix and head.startswith(f"{source}.") and key == head + suffix:
                pairs = [[f"{head}.{place}{n}_{c}" for c in "vw"] for n in ("monte_carlo", "rmse")]
                noise, error = ([metrics[k] ** 2 for k in keys] for keys in pairs)
                parts.append((noise[0] + noise[1]) / (error[0] + error[1]))
        if parts:
            break
    if not parts:
        return None
    return xr.concat(parts, "part", coords="minimal", compat="override").max("part").clip(max=1.0)


def simulation_parts(metrics: Mapping[str, float], methods: Sequence[str]) -> list[SimulationPart]:
    """The parts in winds from the most complete images, by every method with known errors.

    metrics: of a run, with those of `simulation_metrics`; empty without them.
    """
    place = far_from_cores(metrics, "true_wind.", "rms_")
    parts = []
    # with the detector's noise, if there are such images
    for source in reversed(RENDERED):
        for method in methods:
            noise, error = (
                sum(
                    metrics.get(wind_key(source, method, f"{place}{name}_{c}"), math.nan) ** 2
                    for c in "vw"
                )
                for name in ("monte_carlo", "rmse")
            )
            if error > 0 and noise >= 0:
                parts.append(SimulationPart(str(method), min(noise / error, 1.0), place))
        if parts:
            break
    return parts
