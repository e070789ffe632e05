"""Vectors as data for the report's interactive map."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import xarray as xr

from lidar_mi.atmosphere.vortices.cores import Core
from lidar_mi.flags import masks_of

# A map about as dense as vectors can be selected on a screen.
_COLUMNS = 55


def map_data(
    wind: xr.Dataset, components: Sequence[str], cores: Sequence[Core], colour: str = ""
) -> dict[str, Any]:
    """Every n-th vector with its truth, standard error and flag, ready for JSON.

    wind (z, y): ``NAME`` and ``NAME_true`` of every component, m/s, v and w among them;
        ``NAME_stderr`` where there are any; ``flag`` with its CF attributes. Vectors are at
        y_vector, z_vector or, where these are missing, at the nodes.
    cores: true vortices.
    colour: what colours show at first: a component, or the speed of v and w.

    Returns
    -------
    dict
        Lists of equal length for all vectors, row by row from below; NaN becomes None.
    """
    every = max(1, round(wind.sizes["y"] / _COLUMNS))
    thin = wind.isel(z=slice(every // 2, None, every), y=slice(every // 2, None, every))
    thin = thin.transpose("z", "y", ...)
    shape = thin.sizes["z"], thin.sizes["y"]

    def numbers(name: str) -> list[float | None]:
        values = np.broadcast_to(thin[name].transpose("z", "y", ..., missing_dims="ignore"), shape)
        return [round(float(v), 3) if np.isfinite(v) else None for v in values.ravel()]

    place = {}
    for axis in ("y", "z"):
        node = np.meshgrid(thin["y"], thin["z"])[0 if axis == "y" else 1]
        at = thin[f"{axis}_vector"].values if f"{axis}_vector" in thin.variables else node
        place[axis] = [round(float(p), 2) for p in np.where(np.isfinite(at), at, node).ravel()]
    step = every * float(wind["y"][1] - wind["y"][0]) if wind.sizes["y"] > 1 else 1.0
    return {
        **place,
        "alt_text": _alt_text(thin, place, numbers("v"), numbers("w")),
        "colour": colour,
        "step": step,
        "components": [
            {
                "name": name,
                "retrieved": numbers(name),
                "true": numbers(f"{name}_true"),
                "stderr": numbers(f"{name}_stderr") if f"{name}_stderr" in thin else None,
            }
            for name in components
        ],
        "flag": [int(bits) for bits in thin["flag"].values.ravel()],
        "flags": {
            str(mask): meaning.replace("_", " ")
            for meaning, mask in masks_of(thin["flag"].attrs).items()
        },
        "cores": [[round(core.y, 2), round(core.z, 2)] for core in cores],
    }


def _alt_text(
    thin: xr.Dataset,
    place: Mapping[str, list[float]],
    v: Sequence[float | None],
    w: Sequence[float | None],
) -> str:
    """How many vectors there are, and the longest of the valid ones."""
    speed = np.hypot(np.array(v, dtype=float), np.array(w, dtype=float))
    speed[thin["flag"].values.ravel() != 0] = np.nan
    valid = int(np.isfinite(speed).sum())
    if not valid:
        return f"none of {speed.size} vectors is valid"
    k = int(np.nanargmax(speed))
    return (
        f"{valid} of {speed.size} vectors are valid, the longest is {speed[k]:.3g} m/s at "
        f"y = {place['y'][k]:g} m, z = {place['z'][k]:g} m"
    )
