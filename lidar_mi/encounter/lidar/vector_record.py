"""The vectors of a flight's slabs in a data set, from which the flight is replayed."""

from collections.abc import Sequence

import numpy as np
import xarray as xr

from lidar_mi.encounter.lidar.estimate import Estimate
from lidar_mi.retrieval.along_path.vectors import counting, slab_vectors
from lidar_mi.retrieval.common_error import NAMES, ROTATION
from lidar_mi.variables import variable

VECTORS = ("vector_row", "vector_column")
"""Dims of the vectors in a slab."""

_FIELDS = ("v", "w", "v_stderr", "w_stderr", "vw_correlation")
_COMMON = (*NAMES, ROTATION)
_CENTRE = ("centre_y", "centre_z")


def recorded_vectors(estimates: Sequence[Estimate]) -> xr.Dataset:
    """The vectors that count of all slabs, dims (slab, vector_row, vector_column).

    NaN where a vector is rejected, has no standard error, or the slab has none; without variables
    if no slab has any.
    """
    slabs = [
        counting(one.wind) if one.wind is not None and "v_stderr" in one.wind else None
        for one in estimates
    ]
    known = [slab for slab in slabs if slab is not None]
    if not known:
        return xr.Dataset()
    rows, columns = (max(slab.sizes[name] for slab in known) for name in ("z", "y"))
    shape = (len(slabs), rows, columns)
    fields = {name: np.full(shape, np.nan, np.float32) for name in _FIELDS}
    z, y = np.full(shape[:2], np.nan), np.full((shape[0], columns), np.nan)
    common = {name: np.zeros(shape[0]) for name in (*_COMMON, *_CENTRE)}
    for number, slab in enumerate(slabs):
        if slab is None:
            continue
        z[number, : slab.sizes["z"]], y[number, : slab.sizes["y"]] = slab["z"], slab["y"]
        valid = slab_vectors(slab).valid
        part = (number, slice(slab.sizes["z"]), slice(slab.sizes["y"]))
        for name in _FIELDS:
            if name in slab:
                values = slab[name].transpose("z", "y").values
                fields[name][part] = np.where(valid, values, np.nan)
        for name in _COMMON:
            common[name][number] = float(slab[name]) if name in slab else 0.0
        about = slab[ROTATION].attrs if ROTATION in slab else {}
        for name in _CENTRE:
            common[name][number] = about.get(name, 0.0)
    dims = ("slab", *VECTORS)
    return xr.Dataset(
        {
            "vector_z": variable(dims[:2], z, "m", "place of the vectors"),
            "vector_y": variable(("slab", VECTORS[1]), y, "m", "the same"),
            **{f"vector_{name}": (dims, values) for name, values in fields.items()},
            **{f"vector_{name}": ("slab", values) for name, values in common.items()},
        },
        attrs={"vector_window": known[0].attrs["window"]},
    )


def wind_of(track: xr.Dataset, number: int) -> xr.Dataset | None:
    """The vectors of a slab as an `Estimate` has them; None where there are none."""
    if "vector_v" not in track:
        return None
    one = track.isel(slab=number)
    z, y = (one[f"vector_{name}"].values for name in ("z", "y"))
    rows, columns = np.isfinite(z).sum(), np.isfinite(y).sum()
    if not rows:
        return None
    fields = {name: one[f"vector_{name}"].values[:rows, :columns] for name in _FIELDS}
    flag = (~np.isfinite(fields["v"])).astype(np.uint16)
    centre = {name: float(one[f"vector_{name}"]) for name in _CENTRE}
    return xr.Dataset(
        {
            **{name: (("z", "y"), values) for name, values in fields.items()},
            "flag": (("z", "y"), flag),
            **{name: ((), float(one[f"vector_{name}"])) for name in NAMES},
            ROTATION: ((), float(one[f"vector_{ROTATION}"]), centre),
        },
        {"z": z[:rows], "y": y[:columns]},
        {"window": track.attrs["vector_window"]},
    )
