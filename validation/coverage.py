"""Winds from images that do not show the same air: errors against the standard errors stated."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import lru_cache, partial
from importlib.resources import files
from pathlib import Path

import numpy as np
import xarray as xr

import lidar_mi as lm
from lidar_mi.assessment.metrics.errors import truth_at_vectors
from lidar_mi.atmosphere.vortices.vortex import velocity, vortex_pair
from lidar_mi.experiment.truth.blur import blur_by_beam
from lidar_mi.experiment.truth.flows import flows_of, mean_flow
from lidar_mi.retrieval.wind.options import WindowSizes
from lidar_mi.retrieval.wind.pair import retrieve_wind
from lidar_mi.retrieval.wind.volume import retrieve_wind_volume
from tests.support.flows import axes, data_array, origin, plane_waves, texture

from .normalised import indicator, mean_over_groups, rms, sums_of_blocks
from .report import Check, Row

TITLE = "Standard errors of winds where air changes"
INTRODUCTION = (
    "Winds are retrieved from image pairs of known wind. The second image shows the air of the "
    "first one, moved by the wind. In most cases something else changes as well: the image is "
    "another state of the simulation, a part of the texture is replaced, or the instrument "
    "changes. The last rows are volumes advected in three dimensions, rendered images, and both "
    "lidars as one sensor. 68 and 95 % of the errors of valid vectors should be within 1 and 1.96 "
    "standard errors, and the normalised errors should have the variance 1. All seeds have the "
    "wind of one wake. The uncertainty of each number is therefore its scatter over blocks of the "
    "image, each with all seeds. The errors of one `vortex_fit` have ten parameters in common; "
    "its fits with different seeds count as independent only as far as their errors differ. Bold: "
    "a coverage wrong by more than 5 percentage points, or a variance outside 0.8 to 1.25, by "
    "more than the uncertainty, if 1 % or more of the vectors are valid. Cases and causes: "
    "[standard errors](../standard_errors.md#standard-errors-where-air-changes)."
)

SCENES = Path(str(files("lidar_mi.scenes")))
METHODS = ("variational", "vortex_fit", "multipass", "cc", "ws")
"""Of winds in a plane."""
TOLERANCE = {"coverage_68": 0.05, "coverage_95": 0.05}
EXPECTED = {"coverage_68": 0.683, "coverage_95": 0.950}
VARIANCE = (0.8, 1.25)
"""Of the normalised errors."""
LEAST_VALID = 0.01
"""Fraction of valid vectors below which a row is not judged."""
STRIDE = 4
"""Vectors of one template share their pixels; every fourth one is nearly as informative as all."""

PARAMETERS = {"vortex_fit": 10}
"""Of methods whose errors all over an image have few parameters in common."""

Pair = tuple[xr.DataArray, xr.DataArray, xr.Dataset, float | xr.DataArray | None]
"""Both images, the true wind at mid-time, the noise given to the retrieval."""


@dataclass(frozen=True)
class Coverage:
    """Errors of valid vectors against their standard errors, each number with its own error.

    Attributes
    ----------
    case, method : str
    rmse, stated : float
        Rms error of v and w (and u, where it is found), and rms standard error, m/s.
    wind : float
        Rms of the true wind, m/s, the error without any skill.
    coverage_68, coverage_95, variance : (float, float)
        Value and standard error.
    valid : float
        Fraction of valid vectors.
    """

    case: str
    method: str
    rmse: float
    stated: float
    wind: float
    coverage_68: tuple[float, float]
    coverage_95: tuple[float, float]
    variance: tuple[float, float]
    valid: float


def shipped_wake(
    second: str, rms: float, seed: int, noise: float | None = None, bright: bool = False
) -> Pair:
    """The extinction of the shipped wake: advected, or its true state 0.1 s later.

    With white noise of this fraction of the largest value, or of each pixel's in the first image
    (``bright``), which is told, or without any, which is not told.
    """
    experiment = lm.load_experiment(
        SCENES / "wake_backscatter.yaml",
        seed=seed,
        wake={"second": second, "texture": {"rms": rms}},
    )
    truth = lm.make_truth(experiment)
    images = [truth.image(0), truth.image(1)]
    if noise is None:
        return *images, truth.wind, None
    level = noise * (images[0] if bright else float(images[0].max()))
    random = np.random.default_rng([seed, 1])
    images = [image + level * random.standard_normal(image.shape) for image in images]
    return *images, truth.wind, level


def _vortex_wind(columns: int, rows: int):
    y, z = axes(columns, rows)
    vortices = vortex_pair(400.0, separation=47.1, core_radius=3.0)
    wind = partial(velocity, vortices)
    return y, z, wind


def replaced_texture(fraction: float, seed: int, noise: float = 0.01) -> Pair:
    """Exactly advected texture; a fraction of the variance of image 2 is unrelated texture."""
    y, z, wind = _vortex_wind(219, 139)
    grid = np.meshgrid(y, z)
    waves, other = (plane_waves(s, 3.0, 0.5) for s in (seed, seed + 1000))
    first = texture(waves, *grid)
    moved = texture(waves, *origin(wind, *grid, 0.1))
    new = texture(other, *grid)
    second = 1 + np.sqrt(1 - fraction) * (moved - 1) + np.sqrt(fraction) * (new - 1)
    return _with_noise(first, second, y, z, wind, noise, seed, noise)


def instrument(change: str, seed: int, noise: float = 0.01) -> Pair:
    """Exactly advected texture, observed with an instrumental error of 5 %.

    ``gain``: image 2 is brighter; ``gradient``: by an amount that grows from edge to edge;
    ``pattern``: both images are multiplied by a pattern that does not move.
    """
    y, z, wind = _vortex_wind(219, 139)
    grid = np.meshgrid(y, z)
    waves = plane_waves(seed, 3.0, 0.5)
    first, second = texture(waves, *grid), texture(waves, *origin(wind, *grid, 0.1))
    if change == "gain":
        second = 1.05 * second
    elif change == "gradient":
        second = second * (1 + 0.05 * grid[0] / y.max())
    else:
        fixed = texture(plane_waves(seed + 2000, 3.0, 0.5), *grid, contrast=0.05)
        first, second = first * fixed, second * fixed
    return _with_noise(first, second, y, z, wind, noise, seed, noise)


def nonuniform_noise(given: bool, seed: int) -> Pair:
    """Noise from 1 % to 10 % across the image; its map is given to the retrieval or not."""
    y, z, wind = _vortex_wind(219, 139)
    grid = np.meshgrid(y, z)
    waves = plane_waves(seed, 3.0, 0.5)
    first, second = texture(waves, *grid), texture(waves, *origin(wind, *grid, 0.1))
    level = 0.01 * 10 ** ((grid[0] - y.min()) / np.ptp(y))
    return _with_noise(
        first, second, y, z, wind, level, seed, data_array(level, y, z) if given else None
    )


def _with_noise(first, second, y, z, wind, level, seed, noise) -> Pair:
    random = np.random.default_rng([seed, 1])
    images = [image + level * random.standard_normal(image.shape) for image in (first, second)]
    v, w = (data_array(a, y, z) for a in wind(*np.meshgrid(y, z)))
    return *(data_array(image, y, z) for image in images), xr.Dataset({"v": v, "w": w}), noise


def carried_volume(noise: float, seed: int) -> Pair:
    """Volumes of the shipped wake, carried along x, y and z, as the beams of `wake_3d` see them.

    With white noise of a fraction of each voxel, whose map is given. There is no renderer.
    """
    experiment = lm.load_experiment("wake_3d", seed=seed)
    flows = flows_of(experiment)
    truth, wind = lm.make_truth(experiment, flows=flows), mean_flow(flows)
    scan = experiment.scan
    gates = slice(scan.range, scan.range + scan.thickness)
    random = np.random.default_rng([seed, 1])
    volumes = []
    for air in truth.extinction:
        air = air.transpose("x", "z", "y").sel(x=gates)
        planes = [blur_by_beam(plane, experiment.lidar, float(plane["x"])) for plane in air]
        volumes.append(air.copy(data=np.stack([plane.values for plane in planes])))
    level = noise * volumes[0]
    volumes = [one + level.values * random.standard_normal(one.shape) for one in volumes]
    return *volumes, wind[["u", "v", "w"]].transpose("x", "z", "y"), level


@lru_cache(maxsize=8)
def rendered_images(seed: int) -> xr.Dataset:
    """Winds of `wake_backscatter` by all methods: the simulation's stored second state, all orders.

    Its lidar has no detector, so that the noise is that of the Monte Carlo samples.
    """
    experiment = lm.load_experiment(
        "wake_backscatter",
        seed=seed,
        wake={"second": "40.1 s"},
        retrieval={
            "methods": METHODS,
            "stride": STRIDE,
            "sources": "measured",
            "error_budget": False,
        },
    )
    return lm.run(experiment).wind.isel(source=-1)


def both_lidars(seed: int) -> xr.Dataset:
    """Wind by both lidars 150 m ahead, of the state that is stored 0.1 s later."""
    experiment = lm.load_experiment(
        "near_range",
        variant="at_150m",
        seed=seed,
        wake={"second": "40.1 s"},
        retrieval={"methods": ["variational"], "sources": "measured", "error_budget": False},
    )
    # as far apart as the vectors of the other cases
    return lm.run(experiment).wind3d[{name: slice(None, None, 2) for name in ("z", "y")}]


CASES: dict[str, Callable[[int], Pair]] = {
    **{
        f"advected, texture {100 * rms:.0f} %": partial(shipped_wake, "advect", rms)
        for rms in (0.0, 0.02, 0.05, 0.1, 0.2)
    },
    **{
        f"stored state at t2, texture {100 * rms:.0f} %": partial(shipped_wake, "40.1 s", rms)
        for rms in (0.0, 0.02, 0.05, 0.1, 0.2)
    },
    **{
        f"{words}, texture {100 * rms:.0f} %, noise {100 * noise:g} %": partial(
            shipped_wake, second, rms, noise=noise
        )
        for words, second, rms, noise in (
            ("advected", "advect", 0.0, 0.003),
            ("stored state at t2", "40.1 s", 0.0, 0.003),
            ("advected", "advect", 0.05, 0.01),
            ("advected", "advect", 0.2, 0.02),
            ("stored state at t2", "40.1 s", 0.1, 0.01),
        )
    },
    "stored state at t2, texture 10 %, noise 1 % of each pixel": partial(
        shipped_wake, "40.1 s", 0.1, noise=0.01, bright=True
    ),
    **{
        f"{100 * fraction:.0f} % of the texture replaced": partial(replaced_texture, fraction)
        for fraction in (0.0, 0.05, 0.1, 0.3)
    },
    "gain of 5 %": partial(instrument, "gain"),
    "gradient of 5 %": partial(instrument, "gradient"),
    "fixed pattern of 5 %": partial(instrument, "pattern"),
    "noise of 1 to 10 %, map given": partial(nonuniform_noise, True),
    "noise of 1 to 10 %, map not given": partial(nonuniform_noise, False),
}
"""Image pairs by seed."""


VOLUMES: dict[str, Callable[[int], Pair]] = {
    f"volume carried along x, y, z, noise {100 * noise:g} %": partial(carried_volume, noise)
    for noise in (0.008, 0.03)
}
"""Pairs of volumes by seed."""
VOLUME_METHODS = ("variational", "correlation")

RUNS: dict[str, tuple[Callable[[int], xr.Dataset], tuple[str, ...]]] = {
    "stored state at t2, texture 10 %, rendered, all orders": (rendered_images, METHODS),
    "the same by both lidars at 150 m": (both_lidars, ("sensor",)),
}
"""Winds of whole experiments by seed, with the true ones, and the methods in them."""

FEWER = 3
"""Seeds of the cases in a plane over those of volumes and of whole experiments, which take long."""


def _found_and_true(case: str, method: str, seed: int) -> tuple[xr.Dataset, xr.Dataset]:
    """Wind with standard errors and flags, and the true wind there, dims (..., z, y)."""
    if case in RUNS:
        wind = RUNS[case][0](seed)
        if "algorithm" in wind.dims:
            wind = wind.sel(algorithm=method)
        names = [name for name in "uvw" if name in wind]
        return wind, wind[[f"{n}_true" for n in names]].rename({f"{n}_true": n for n in names})
    if case in VOLUMES:
        first, second, truth, noise = VOLUMES[case](seed)
        wind = retrieve_wind_volume(
            first, second, 0.1, method, windows=WindowSizes(stride=STRIDE), noise=noise
        )
        return wind, truth.interp({name: wind[name] for name in ("x", "z", "y")})
    first, second, truth, noise = CASES[case](seed)
    wind = retrieve_wind(
        first, second, 0.1, method, windows=WindowSizes(stride=STRIDE), noise=noise
    )
    return wind, truth_at_vectors(wind, truth)


def measured(case: str, method: str, seeds) -> Coverage:
    """One row of the table, over all seeds."""
    errors, stated, valid, winds = [], [], [], []
    for seed in seeds:
        wind, true = _found_and_true(case, method, seed)
        is_valid = (wind["flag"] == 0).values
        for name in true:
            field = true[name].values
            errors.append(np.where(is_valid, wind[name].values - field, np.nan))
            stated.append(np.where(is_valid, wind[f"{name}_stderr"].values, np.nan))
            winds.append(field)
        valid.append(is_valid)
    # planes of volumes follow one another
    error, stderr = (np.stack(part).reshape(-1, *part[0].shape[-2:]) for part in (errors, stated))
    score = error / stderr
    most = PARAMETERS[method] * independent_pairs(error) if method in PARAMETERS else None
    return Coverage(
        case,
        method,
        rms(error),
        rms(stderr),
        rms(np.stack(winds)),
        _mean_and_error(indicator(score, 1.0), most),
        _mean_and_error(indicator(score, 1.96), most),
        _mean_and_error(score**2, most),
        float(np.mean(valid)),
    )


def table(repeats: int) -> Iterator[Coverage]:
    """All cases by all methods, seeds 1 to ``repeats``, or a third as many of what takes long."""
    for case in CASES:
        for method in METHODS:
            yield measured(case, method, range(1, repeats + 1))
    fewer = range(1, repeats // FEWER + 1)
    of_volumes = dict.fromkeys(VOLUMES, VOLUME_METHODS)
    for case, methods in (of_volumes | {case: run[1] for case, run in RUNS.items()}).items():
        for method in methods:
            yield measured(case, method, fewer)


def coverage(effort) -> Check:
    """Rows for 68 and 95 %, and the table of all numbers as text."""
    # of one wake's blocks the errors of a single seed are too alike to say how they scatter
    repeats = 3 if effort.scale == 1 else 12
    found = list(table(repeats))
    rows = [
        Row(
            f"{one.case}, {one.method}: {name.removeprefix('coverage_')} %",
            "normal distribution",
            EXPECTED[name],
            getattr(one, name)[0],
            getattr(one, name)[1],
            TOLERANCE[name],
        )
        for one in found
        for name in EXPECTED
        if one.valid > LEAST_VALID
    ]
    command = "python -m validation coverage" + (" --slow" if effort.scale > 1 else "")
    seeds = f"seeds 1 to {repeats} (of volumes and whole experiments 1 to {repeats // FEWER})"
    text = "\n".join(
        [
            f"Written by `{command}`, {seeds}; errors in m/s, of valid vectors. "
            f"{sum(any(_off(one)) for one in found)} of "
            f"{sum(one.valid > LEAST_VALID for one in found)} rows miss.",
            "",
            "| images | method | error | stated | wind | 68 % | 95 % | variance | valid |",
            "| --- | --- | ---: | ---: | ---: | ---: | ---: | ---: | ---: |",
            *map(_line, found),
        ]
    )
    return Check("Air that changes", text, tuple(rows))


CHECKS = (coverage,)


def _off(one: Coverage) -> tuple[bool, bool, bool]:
    """Whether 68 %, 95 % and variance are out of their limits by more than their own errors."""
    if one.valid <= LEAST_VALID:
        return False, False, False
    low, high = VARIANCE
    narrow, wide = (
        abs(getattr(one, name)[0] - expected) - TOLERANCE[name] > getattr(one, name)[1]
        for name, expected in EXPECTED.items()
    )
    variance, error = one.variance
    return narrow, wide, variance + error < low or variance - error > high


def _line(one: Coverage) -> str:
    if not one.valid:
        return f"| {one.case} | {one.method} | - | - | {one.wind:.1f} | - | - | - | all flagged |"

    def percent(value):
        return f"{100 * value[0]:.0f} ± {100 * value[1]:.0f}"

    variance = f"{one.variance[0]:.2f} ± {one.variance[1]:.2f}"
    judged = percent(one.coverage_68), percent(one.coverage_95), variance
    cells = [
        one.case,
        one.method,
        *(f"{value:.3f}" for value in (one.rmse, one.stated)),
        f"{one.wind:.1f}",
        *(f"**{text}**" if off else text for text, off in zip(judged, _off(one), strict=True)),
        f"{100 * one.valid:.0f} %",
    ]
    return f"| {' | '.join(cells)} |"


def independent_pairs(error: np.ndarray) -> float:
    """Number of image pairs whose errors are independent, from how much all are alike.

    Of N pairs with an error of correlation r between any two the mean scatters as that of
    N / (1 + (N - 1) r) independent ones (Kish 1965, Survey Sampling, sect. 5.4). The wind of all
    pairs is the same, and so is what a model of it leaves.

    Parameters
    ----------
    error : (2 N, z, y) array
        Of v and w in turn; NaN where there is none.
    """
    pairs = error.reshape(-1, 2, *error.shape[1:])
    number = len(pairs)
    known = np.isfinite(pairs).all(0)
    if number == 1 or not known.any():
        return float(number)
    common = np.mean(pairs.mean(0)[known] ** 2) / np.mean(pairs[:, known] ** 2)
    alike = np.clip((number * common - 1) / (number - 1), 0.0, 1.0)
    return number / (1 + (number - 1) * alike)


def _mean_and_error(values: np.ndarray, most: float | None = None) -> tuple[float, float]:
    """Mean, and its standard error from the scatter of the sums over blocks.

    Both components of a block in all images count as one: (images, z, y), images of v and w in
    turn. The standard error is at least that of ``most`` independent values, and that of a single
    one where all values are in one block.
    """
    mean, error = mean_over_groups(*sums_of_blocks(values))
    if np.isfinite(mean) and (most or np.isnan(error)):
        error = np.fmax(error, np.nanstd(values) / np.sqrt(most or 1))
    return mean, float(error)
