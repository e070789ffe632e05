"""Errors of a method on the image pairs of a family, against its stated standard errors."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from importlib.util import find_spec

import numpy as np

from benchmarks.cases import Pair
from benchmarks.methods import PEERS, RIM
from benchmarks.velocimetry import Field
from lidar_mi.retrieval.wind.options import WindowSizes
from lidar_mi.retrieval.wind.pair import retrieve_wind

from ..normalised import indicator, mean_over_groups, rms, sums_of_blocks
from .families import Family
from .images import DT, SPACING, Condition, ImagePair, pair

METHODS = ("variational", "multipass", "cc")
OTHERS = {"DIS": PEERS["OpenCV DIS"], "OpenPIV": PEERS["OpenPIV window deformation"]}
"""Other programs, with their packages: all their vectors count, and none has a standard error."""

STRIDE = 4
"""Vectors of one template share their pixels; every fourth one is nearly as informative as all."""
LEAST_VALID = 0.02
"""Fraction of valid vectors below which a row is listed as flagged, and not judged."""
VARIANCE = (0.8, 1.25)
"""Limits of the variance of normalised errors."""
FAR_VARIANCE = (0.5, 2.0)
"""Limits that no row may exceed."""
WITHIN_ONE, TOLERANCE = 0.683, 0.05
"""Fraction within one standard error, and its limit either way."""


@dataclass(frozen=True)
class Accuracy:
    """One row: errors of valid vectors against their standard errors.

    Attributes
    ----------
    family, condition, method : str
    seeds : int
    valid : float
        Fraction of valid vectors.
    rmse, stated : float
        Rms error of v and w, and rms standard error (NaN: none stated), m s^-1.
    wind : float
        Rms of v and w, the error without any skill, m s^-1.
    coverage_68, coverage_95, variance : (float, float)
        Fractions within 1 and 1.96 standard errors, variance of the normalised errors, each with
        its own standard error.
    """

    family: str
    condition: str
    method: str
    seeds: int
    valid: float
    rmse: float
    stated: float
    wind: float
    coverage_68: tuple[float, float]
    coverage_95: tuple[float, float]
    variance: tuple[float, float]

    @property
    def judged(self) -> bool:
        """Whether enough vectors are valid, and have standard errors."""
        return self.valid >= LEAST_VALID and np.isfinite(self.stated)

    @property
    def inside(self) -> bool:
        return self.variance_inside and self.coverage_inside

    @property
    def far(self) -> bool:
        return not FAR_VARIANCE[0] <= self.variance[0] <= FAR_VARIANCE[1]

    @property
    def variance_inside(self) -> bool:
        return VARIANCE[0] <= self.variance[0] <= VARIANCE[1]

    @property
    def coverage_inside(self) -> bool:
        return abs(self.coverage_68[0] - WITHIN_ONE) <= TOLERANCE

    @property
    def resolved(self) -> bool:
        """Whether uncertainties are below half the limits, or leave no doubt that a row is outside.

        The limits of the variance are equally far in its logarithm.
        """
        variance, error = self.variance
        apart = abs(np.log(variance)) - np.log(VARIANCE[1])
        far = abs(self.coverage_68[0] - WITHIN_ONE) - TOLERANCE
        return bool(
            error / variance <= max(np.log(VARIANCE[1]) / 2, apart / 2)
            and self.coverage_68[1] <= max(TOLERANCE / 2, far / 2)
        )


Errors = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]
"""Errors and standard errors of v and w, true winds (2, z, y), valid (z, y)."""


def missing(method: str) -> str:
    """Why a method cannot run; empty if it can."""
    package = OTHERS[method][1] if method in OTHERS else ""
    return f"{package} is not installed" if package and find_spec(package) is None else ""


def errors_of(images: ImagePair, method: str) -> Errors:
    """Of all vectors of a method on an image pair."""
    if method in OTHERS:
        return errors_of_field(images, program(images, OTHERS[method][0]))
    wind = retrieve_wind(
        images.first,
        images.second,
        DT,
        method,
        windows=WindowSizes(stride=STRIDE),
        noise=images.noise,
        blur=images.blur,
    )
    true = np.stack(images.wind(wind["y_vector"].values, wind["z_vector"].values))
    error, stated = (
        np.stack([wind[f"{name}{what}"].values for name in "vw"]) for what in ("", "_stderr")
    )
    return error - true, stated, true, (wind["flag"] == 0).values


def program(images: ImagePair, find: Callable[[Pair], Field]) -> Field:
    """What another program finds in the images."""
    grid = np.meshgrid(images.first["y"].values, images.first["z"].values)
    v, w = (images.first.copy(data=component) for component in images.wind(*grid))
    return find(Pair(images.first, images.second, v, w, ()))


def errors_of_field(images: ImagePair, field: Field) -> Errors:
    """Of displacements without standard errors, as densely as those of other methods.

    Vectors within `benchmarks.methods.RIM` pixels of the edge do not count.
    """
    found = np.stack([field.dy, field.dz])
    start = int(np.ceil(max(RIM - field.start, 0)))
    z, y = (
        np.arange(start, min(n, int(size - RIM - field.start)), STRIDE)
        for n, size in zip(field.dy.shape, images.first.shape, strict=True)
    )
    found = found[:, z[:, None], y] * SPACING
    first = [float(images.first[name][0]) for name in "yz"]
    places = np.meshgrid(
        *(low + (field.start + n) * SPACING for low, n in zip(first, (y, z), strict=True))
    )
    true = np.stack(images.wind(*(np.array(places) + field.moved * np.nan_to_num(found))))
    error = found / DT - true
    return error, np.full_like(error, np.nan), true, np.isfinite(error).all(0)


def accuracy(found: list[Errors], names: tuple[str, str, str]) -> Accuracy:
    """A row from the errors of each seed.

    Flows and images of the seeds are independent: standard errors are from the scatter over seeds.
    That of few seeds is itself uncertain, so it is taken to be at least that over blocks of 20 m.
    """
    errors = np.stack([np.where(valid, error, np.nan) for error, _, _, valid in found])
    stated = np.stack([np.where(valid, stderr, np.nan) for _, stderr, _, valid in found])
    score = errors / stated

    def mean_and_error(values):
        known = np.isfinite(values)
        seeds = np.where(known, values, 0.0).sum((1, 2, 3)), known.sum((1, 2, 3))
        mean, error = mean_over_groups(*seeds)
        blocks = sums_of_blocks(values.reshape(-1, *values.shape[2:]))
        return mean, float(np.fmax(error, mean_over_groups(*blocks)[1]))

    return Accuracy(
        *names,
        len(found),
        float(np.mean([valid for *_, valid in found])),
        rms(errors),
        rms(stated),
        rms(np.stack([true for _, _, true, _ in found])),
        mean_and_error(indicator(score, 1.0)),
        mean_and_error(indicator(score, 1.96)),
        mean_and_error(score**2),
    )


def measured(
    family: Family, condition: Condition, methods: Sequence[str], seeds: Iterable[int]
) -> list[Accuracy]:
    """A row for each method, all on the same image pairs."""
    found: dict[str, list[Errors]] = {method: [] for method in methods}
    for seed in seeds:
        images = pair(family, condition, seed)
        for method, errors in found.items():
            errors.append(errors_of(images, method))
    return [
        accuracy(errors, (family.name, condition.name, method)) for method, errors in found.items()
    ]
