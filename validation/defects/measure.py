"""What each method says of the images of a family: errors beyond those stated, vectors lost."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import xarray as xr

from lidar_mi.retrieval.wind.options import WindowSizes
from lidar_mi.retrieval.wind.pair import retrieve_wind
from lidar_mi.retrieval.wind.standard_errors import standard_errors
from lidar_mi.retrieval.wind.volume import retrieve_wind_volume

from .air import DT, SPACING, Air
from .families import Family

IMAGE_METHODS = ("variational", "multipass", "cc", "ws", "vortex_fit", "others")
"""``others``: `lidar_mi.standard_errors` of vectors of "multipass", as of another program."""
VOLUME_METHODS = ("variational", "correlation")
METHODS = tuple(dict.fromkeys((*IMAGE_METHODS, *VOLUME_METHODS)))
WINDOW, STRIDE = 16, 4
FAR = 4.0
"""Stated errors beyond which a valid vector is wrong."""
MOST_FAR, MOST_LOST = 0.01, 0.02
"""Of the vectors called valid; of those of clean images that were valid without checks."""


@dataclass(frozen=True)
class Outcome:
    """A row.

    Attributes
    ----------
    family, method : str
    seeds : int
    valid : float
        Fraction of valid vectors.
    far : float
        Of these, that of errors beyond `FAR` stated ones in a component; NaN without any.
    seeds_far : int
        Seeds with more than `MOST_FAR` of them.
    rmse, stated : float
        Of v and w (and u), m s^-1.
    variance : float
        Of the normalised errors.
    lost : float
        Fraction of the vectors that are valid without checks and not with them.
    """

    family: str
    method: str
    seeds: int
    valid: float
    far: float
    seeds_far: int
    rmse: float
    stated: float
    variance: float
    lost: float


def methods_of(family: Family) -> tuple[str, ...]:
    return IMAGE_METHODS if len(family.shape) == 2 else VOLUME_METHODS


def data_array(values: np.ndarray) -> xr.DataArray:
    """An image (z, y) or a volume (x, z, y) of 0.5 m."""
    names = "xzy"[-values.ndim :]
    axes = {
        name: (name, SPACING * np.arange(n), {"units": "m"})
        for name, n in zip(names, values.shape, strict=True)
    }
    return xr.DataArray(values, axes, tuple(names))


def retrieved(images: Sequence[np.ndarray], method: str, checks: bool = True) -> xr.Dataset:
    """The wind by a method."""
    pair = [data_array(image) for image in images]
    if pair[0].ndim > 2:
        return retrieve_wind_volume(*pair, DT, method)
    sizes = WindowSizes(8, WINDOW, STRIDE)
    if method != "others":
        return retrieve_wind(*pair, DT, method, windows=sizes, checks=checks)
    plain = retrieve_wind(
        *pair, DT, "multipass", windows=sizes, checks=False, standard_errors=False
    )
    given = [plain[name].where(plain["flag"] == 0) for name in "vw"]
    return standard_errors(*pair, *given, DT, window=8)


def errors(air: Air, wind: xr.Dataset) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Errors and standard errors (components, ...), m s^-1, and where vectors are valid."""
    names = {"z": "w", "y": "v"} if len(air.shape) == 2 else {"x": "u", "z": "w", "y": "v"}
    on = np.meshgrid(*(wind[axis].values for axis in names), indexing="ij")
    places = [
        wind[f"{axis}_vector"].values if f"{axis}_vector" in wind.coords else place
        for axis, place in zip(names, on, strict=True)
    ]
    true = air.motion(np.nan_to_num(np.stack(places)) / SPACING) * SPACING / DT
    found, stated = (
        np.stack([wind[f"{name}{what}"].values for name in names.values()])
        for what in ("", "_stderr")
    )
    valid = (wind["flag"].values == 0) & np.isfinite(found).all(0) & np.isfinite(stated).all(0)
    return found - true, stated, valid


def outcome(family: Family, method: str, seeds: Iterable[int], loss: bool = False) -> Outcome:
    """A row over seeds; ``loss``: also of how many vectors without checks are lost by them."""
    valid, score, rows, lost, number = [], [], [], [], []
    for seed in seeds:
        air, images = family.pair(seed, method == "vortex_fit")
        error, stated, good = errors(air, retrieved(images, method))
        valid.append(good.mean())
        score.append((error / stated)[:, good])
        rows.append(np.stack([error, stated])[:, :, good])
        if loss:
            before = retrieved(images, method, checks=False)["flag"].values == 0
            lost.append((before & ~good).sum())
            number.append(before.sum())
    far = [(np.abs(one) > FAR).any(0) for one in score]
    # vectors of a fit of few parameters share one error: each seed is one
    every, of_all = np.concatenate(far), np.concatenate(rows, 2)
    some = every.size > 0
    return Outcome(
        family.name,
        method,
        len(valid),
        float(np.mean(valid)),
        float(every.mean()) if some else np.nan,
        sum(bool(one.size) and one.mean() > MOST_FAR for one in far),
        *(float(np.sqrt(np.mean(part**2))) if some else np.nan for part in of_all),
        float(np.mean(np.concatenate(score, 1) ** 2)) if some else np.nan,
        float(np.sum(lost) / max(np.sum(number), 1)) if loss else np.nan,
    )
