"""What the simulation's own noise adds to the cross-flow wind, which is no error of the lidar."""

from collections.abc import Sequence

import numpy as np
import xarray as xr

from lidar_mi.experiment.graph import bundle
from lidar_mi.experiment.log import Log
from lidar_mi.experiment.observation import Observation
from lidar_mi.experiment.stages.rendering import gridded_scans
from lidar_mi.experiment.stages.winds import (
    Estimation,
    attenuated_backscatter_stderr,
    known_blur,
    pixel_times,
    rendered_pairs,
    window_settings,
)
from lidar_mi.instrument.lidar import BackscatterLidar
from lidar_mi.instrument.scan import ScanPlan
from lidar_mi.rendering.settings import RenderSettings


@bundle
class _Images:
    """Both scans: as detected beam by beam, on the grid of the winds, and where they looked."""

    detected: Sequence[xr.Dataset]
    scans: Sequence[xr.Dataset]
    plans: Sequence[ScanPlan]


def simulation_noise(
    observation: Observation,
    lidar: BackscatterLidar,
    render: RenderSettings,
    estimation: Estimation,
    seed: int,
    images: _Images,
    wind: xr.Dataset,
    log: Log,
) -> xr.Dataset | None:
    """Changes of the wind by as much noise again as the simulation's, by every method.

    A realisation of the Monte Carlo error is added to both images and the wind is retrieved once
    more: of common random numbers that which the images have, else noise of the stated standard
    errors. To first order the changes of the wind have the variance that the simulation's noise has
    in it, through whatever the method does with it.

    Returns
    -------
    xr.Dataset, dims (algorithm, z, y), or None
        v, w (m s^-1), of the most complete images; NaN where one of both vectors is not valid. None
        where the noise has no more than ``render.monte_carlo_fraction`` of the detector's
        variance: neither has it then of the wind's.
    """
    from lidar_mi.retrieval.wind.pair import retrieve_wind

    fraction = max(one.attrs.get("monte_carlo_fraction", np.inf) for one in images.detected)
    if fraction <= render.monte_carlo_fraction:
        return None
    log.bar("retrieving winds with more noise of the simulation", None)
    wake, platform, scan = observation.wake, observation.platform, observation.scan
    retrieval = estimation.retrieval
    random = np.random.default_rng([seed, 2])
    noisier = [_with_more_noise(one, random) for one in images.detected]
    pairs = rendered_pairs(wake, scan, gridded_scans(platform, noisier))
    source, (changed, _) = pairs.popitem()
    # methods that weight by noise are to do so as before
    before, noise = rendered_pairs(wake, scan, images.scans)[source]
    # which pixels scattered beams reach depends on the wind between them, and so on the noise
    pair = [one.where(first.notnull()) for one, first in zip(changed, before, strict=True)]
    times = pixel_times(wake, scan, images.scans)
    changes = []
    for method in retrieval.methods:
        noisy = retrieve_wind(
            pair[0],
            pair[1],
            dt=platform.dt,
            method=method,
            noise=noise,
            times=times,
            blur=known_blur(retrieval, lidar, images.plans[0]),
            standard_errors=False,
            **window_settings(retrieval, estimation.device),
        )
        first = wind.sel(source=source, algorithm=method)
        valid = (noisy["flag"].values == 0) & (first["flag"].values == 0)
        changes.append(
            xr.Dataset(
                {
                    name: (("z", "y"), np.where(valid, noisy[name] - first[name].values, np.nan))
                    for name in ("v", "w")
                }
            )
        )
    return xr.concat(changes, "algorithm").assign_coords(algorithm=list(wind["algorithm"].values))


def _with_more_noise(scan: xr.Dataset, random: np.random.Generator) -> xr.Dataset:
    """A scan with a realisation of its Monte Carlo error in addition, the same in both images."""
    if "S0_mc_error" in scan:
        first = scan.isel(gate=0)
        noise = (scan["Y"] * first["S0_mc_error"] / first["S0"].where(first["S0"] > 0)).fillna(0.0)
    else:
        stderr = attenuated_backscatter_stderr(scan)
        noise = stderr * random.standard_normal(stderr.shape)
    names = [name for name in ("Y", "Y_noisy") if name in scan]
    return scan.assign({name: scan[name] + noise for name in names})
