"""The vortices of an experiment: a pair fitted to the pictures and to the wind found in them.

The fit says what wake vortices are described by, and is a model of the wind that can be evaluated
anywhere: what a controller would fly with.
"""

import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import xarray as xr

from lidar_mi import __version__
from lidar_mi.assessment.metrics.cores import find_cores, outside_cores
from lidar_mi.assessment.report.page import Chapter
from lidar_mi.assessment.report.vortices import SOURCES, draw_all, true_pair, vortex_chapter
from lidar_mi.errors import InputError
from lidar_mi.experiment.run_folder import IMAGES, Log
from lidar_mi.experiment.schema import Experiment
from lidar_mi.experiment.stages.backscatter import rendered_pairs
from lidar_mi.experiment.stages.sensor import WIND
from lidar_mi.experiment.truth import make_truth
from lidar_mi.io import exr
from lidar_mi.io.netcdf import open_netcdf, read_netcdf
from lidar_mi.io.vortex_file import write_vortices
from lidar_mi.retrieval.lines.combine import CombinedFlag
from lidar_mi.retrieval.vortices.image_fit import fit_vortices
from lidar_mi.retrieval.vortices.pair import VortexPairFit
from lidar_mi.retrieval.vortices.vector_fit import fit_vortices_to_wind

VORTEX = "vortex.json"


def prepare(
    experiment: Experiment, beside: str | Path
) -> Callable[[Path, Log], tuple[dict[str, float], Chapter]]:
    """What it returns fits the pictures and winds that the other chains leave in the folder."""
    truth = make_truth(experiment, beside).wind
    return lambda folder, log: _run(experiment, truth, folder, log)


def _run(experiment, truth, folder, log) -> tuple[dict[str, float], Chapter]:
    start = time.perf_counter()
    log("fitting vortex pairs")
    picture, vectors = _seen(experiment, folder)
    ways = {"images": lambda: fit_vortices(*picture[0], experiment.platform.dt, picture[1])}
    if experiment.sensor or vectors is not None:
        ways["vectors"] = lambda: _from_vectors(vectors)
    fits, refused = {}, {}
    for name, way in ways.items():
        try:
            found = way()
        except InputError as error:
            refused[name] = str(error)
            continue
        if found.success:
            fits[name] = found
        else:
            refused[name] = "; ".join(found.reasons)
    for name, reason in refused.items():
        log.remark(f"no vortex pair from the {SOURCES[name]}: {reason}")
    write_vortices(
        folder / VORTEX, fits, experiment=experiment.name, source=f"lidar-mi {__version__}"
    )
    cores = find_cores(truth)
    true = true_pair(truth, cores)
    metrics = {f"vortex.truth.{key}": value for key, value in true.items()}
    for name, found in fits.items():
        numbers = _quantities(found) | model_errors(found, truth, cores)
        metrics |= {f"vortex.{name}.{key}": value for key, value in numbers.items()}
    drawn = draw_all(folder / "figures", picture[0][0], vectors, truth, fits, cores, log)
    metrics["timing.vortex_s"] = round(time.perf_counter() - start, 3)
    return metrics, vortex_chapter(metrics, fits, refused, drawn)


def _seen(experiment, folder):
    """The pair of pictures with its noise, and the wind found in it (None: none was)."""
    scans = [exr.read_scan(folder / name) for name in IMAGES]
    source, picture = list(rendered_pairs(experiment, scans).items())[-1]
    if experiment.sensor:
        if not (folder / WIND).is_file():
            return picture, None
        found = read_netcdf(folder / WIND)
        # v and w do not need lines of sight
        flag = found["flag"] & CombinedFlag.NO_CROSSFLOW.value
        return picture, found.assign(flag=flag)
    local = [name for name in experiment.retrieval.methods if name != "vortex_fit"]
    if not local:
        return picture, None
    with open_netcdf(folder / "wind.nc") as winds:
        found = winds.sel(source=source, algorithm=local[0]).load()
    return picture, found.set_coords(["y_vector", "z_vector"])


def _from_vectors(vectors) -> VortexPairFit:
    if vectors is None:
        raise InputError("vectors: none were found")
    return fit_vortices_to_wind(vectors)


def _quantities(fit: VortexPairFit) -> dict[str, float]:
    numbers = {"correlation": fit.correlation, "flow_error": fit.flow_error}
    if np.isfinite(fit.chi2):
        numbers["chi2"] = fit.chi2
    for name, quantity in fit.quantities.items():
        numbers |= {name: quantity.value, f"{name}_stderr": quantity.stderr}
    return {name: float(value) for name, value in numbers.items()}


def model_errors(fit: VortexPairFit, truth: xr.Dataset, cores) -> dict[str, float]:
    """How far the fitted wind is from the truth all over the slab.

    ``rmse_v``, ``rmse_w`` (m/s), ``reduced_variance_*`` (1 where errors are as stated), and
    ``outside_cores.rmse_*`` beyond two core radii.
    """
    y, z = truth["y"].values[None, :], truth["z"].values[:, None]
    model, far = fit.wind(y, z), outside_cores(y, z, cores)
    metrics = {}
    for name in ("v", "w"):
        error = model[name].values - truth[name].transpose("z", "y").values
        reduced = error / model[f"{name}_stderr"].values
        metrics |= {
            f"rmse_{name}": float(np.sqrt((error**2).mean())),
            f"reduced_variance_{name}": float((reduced**2).mean()),
        }
        if cores and far.any():
            metrics[f"outside_cores.rmse_{name}"] = float(np.sqrt((error[far] ** 2).mean()))
    return metrics
