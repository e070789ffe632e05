"""All methods on rendered images of the exactly known wind, and the causes of their errors.

The case of the tables of winds, observed by the backscatter lidar: the texture is extinction, 1 /
km on average, of spheroids (the experiments' aerosol), in a slab of 2.5 m at 500 m and, 0.1 s
later, at 485 m; a Gaussian beam of 2 mrad; a detector by day. Single scattering only: multiple
scattering is 0.3 % of the signal there.
"""

from collections.abc import Sequence

import numpy as np
import xarray as xr

from lidar_mi.assessment.metrics.error_budget import CAUSES
from lidar_mi.atmosphere.vortices.cores import Core
from lidar_mi.experiment.graph import call
from lidar_mi.experiment.stages.error_budget import budgets
from lidar_mi.experiment.stages.rendering import scan_plans
from lidar_mi.experiment.truth.extinction import Truth
from lidar_mi.instrument.detector_noise import noisy_scan
from lidar_mi.rendering.backscatter import extrude, render_scans
from lidar_mi.rendering.phase import ScatteringAir, scatterer
from lidar_mi.rendering.variant import use_variant
from lidar_mi.retrieval.wind.methods import METHODS
from lidar_mi.schema.experiment import Experiment

from .cases import CIRCULATION, CORE_RADIUS, DT, SEPARATION, SPACING, Pair, vortex_pair_images
from .report import Comparison, row

ENERGIES = (1e-3, 10e-3, 100e-3)
EXTINCTION = 1e-3
SHORT = {
    "detector_noise": "detector",
    "monte_carlo": "simulation",
    "beam_blur": "beam",
    "window": "window",
    "shear": "shear",
    "time_step": "paths",
    "method": "method",
}


def compare(
    repeats: int = 5,
    columns: int = 219,
    rows: int = 139,
    samples: int = 64,
    methods: Sequence[str] = tuple(METHODS),
) -> Comparison:
    """Errors and fractions averaged over as many textures as ``repeats``."""
    title = f"Wind from rendered images of {columns} x {rows} beams, all methods"
    found = {}
    for seed in range(1, repeats + 1):
        pair = vortex_pair_images(0.0, seed, columns, rows)
        truth, experiment = slab_of(pair), sensor(pair, samples, methods)
        cores = [Core(o.y, o.z, o.core_radius, o.circulation) for o in pair.vortices]
        scans = images(experiment, truth, seed)
        for energy in ENERGIES:
            lidar = experiment.lidar.model_copy(update={"pulse_energy": energy})
            noisy = [
                noisy_scan(scan, lidar, experiment.detector, [seed, k])
                for k, scan in enumerate(scans)
            ]
            level = float((noisy[0]["Y_noise_std"] / noisy[0]["Y"]).median())
            limits = budgets(
                experiment.model_copy(update={"lidar": lidar}),
                truth,
                noisy,
                cores=cores,
                flagged=True,
            )
            found.setdefault(energy, []).append((level, limits))
    lines = []
    for energy, turns in found.items():
        noise = np.mean([level for level, _ in turns])
        case = f"{energy * 1e3:g} mJ per beam: noise of {noise:.1%} of the mean"
        for method in methods:
            mean = {
                key: float(np.mean([limits[method][key] for _, limits in turns]))
                for key in turns[0][1][method]
            }
            lines.append(
                row(
                    case,
                    f"lidar-mi {method}",
                    "m/s",
                    [mean["rmse_v"]],
                    [mean["outside_cores.rmse_v"]],
                    note=fractions(mean),
                )
            )
    return Comparison(
        title,
        "everywhere",
        "beyond 2 core radii",
        tuple(lines),
        (
            f"Rms error of v, mean over {repeats} textures, no vector left out; default settings.",
            (
                "Remark: percentage by which the mean square error of v decreases without a cause, "
                "everywhere / beyond 2 core radii: the detector's noise; the simulation's "
                f"({samples} samples per beam); the beam's width; averaging over the window; shear "
                "within it; curved paths in the time step; the method on perfect images. They "
                "need not add up to 100 %."
            ),
        ),
    )


def fractions(metrics: dict[str, float]) -> str:
    """Per cent of the mean square error of v by cause, everywhere / beyond the cores."""
    parts = []
    for cause in CAUSES:
        if f"{cause}.fraction_v" in metrics:
            pair = [metrics[f"{place}{cause}.fraction_v"] for place in ("", "outside_cores.")]
            parts.append(f"{SHORT[cause]} {' / '.join(f'{100 * x:.0f}' for x in pair)}")
    return ", ".join(parts)


def slab_of(pair: Pair) -> Truth:
    """The two images as extinction of a slab, uniform through its depth."""
    fields = tuple(
        (EXTINCTION * image).expand_dims(x=[501.25]).transpose("x", "y", "z")
        for image in (pair.first, pair.second)
    )
    wind = xr.Dataset({"v": pair.v, "w": pair.w}, attrs={"gates": (500.0, 502.5)})
    return Truth(fields, fields, wind)


def sensor(pair: Pair, samples: int, methods: Sequence[str]) -> Experiment:
    """The paper's lidar with the default detector."""
    extent = [float(np.ptp(pair.first[axis].values)) for axis in ("y", "z")]
    return Experiment(
        name="rendered",
        wake={
            "vortex_pair": {
                "circulation": CIRCULATION,
                "separation": SEPARATION,
                "core_radius": CORE_RADIUS,
                "width": extent[0],
                "height": extent[1],
            },
            "spacing": SPACING,
            "extinction": {"molecules": 0},
        },
        platform={"dt": DT},
        detector={},
        scattering={"phase": "aerosol", "aerosol": "spheroids"},
        render={"samples_per_beam": samples, "max_order": 1},
        retrieval={"methods": tuple(methods)},
    )


def images(experiment: Experiment, truth: Truth, seed: int) -> list[xr.Dataset]:
    """The two scans without a detector's noise."""
    use_variant(experiment.render.variant)
    plans = call(scan_plans, experiment, truth=truth)
    air = scatterer(experiment.scattering, ".", experiment.lidar.wavelength, lambda *_: None)
    solids = [
        extrude(field.isel(x=0).transpose("z", "y"), plans[0], experiment.lidar)
        for field in truth.extinction
    ]
    background = experiment.wake.extinction.background
    around = ScatteringAir(background, *air)
    return list(render_scans(solids, plans, experiment.lidar, around, experiment.render, seed))
