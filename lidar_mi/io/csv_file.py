"""Tables as comma-separated text: one row a vector, units in the head, flags also in words."""

from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from lidar_mi.flags import masks_of
from lidar_mi.io.text import write_text


def write_csv(path: str | Path, data: xr.Dataset) -> None:
    """Write all values of a data set, one row for each place.

    Columns are coordinates, then variables, as ``v [m s-1]``; numbers of the whole data set
    are repeated in every row. ``y_vector`` and ``z_vector`` are there only where they differ from
    ``y`` and ``z``. After a column of flags, ``flag in words`` has the reasons,
    or ``valid``. Missing numbers are ``NaN``.
    """
    rows = data.expand_dims("row") if not data.dims else data
    table = rows.to_dataframe(dim_order=[str(dim) for dim in rows.dims]).reset_index()
    places = [axis for axis in ("x", "y", "z") if axis in data.coords]
    # positions that equal the centres of the windows are omitted
    same = [
        vector
        for axis in places
        if (vector := f"{axis}_vector") in data.coords and (data[axis] == data[vector]).all()
    ]
    labels = [str(name) for name in data.coords if name not in (*places, *same)]
    columns = [*labels, *places, *(str(name) for name in data.data_vars)]
    table = table[columns]
    for name in columns:
        if "flag_masks" in data[name].attrs:
            words = _in_words(table[name].to_numpy(), data[name].attrs)
            table.insert(table.columns.get_loc(name) + 1, f"{name} in words", words)
    heads = {
        name: f"{name} [{data[name].attrs['units']}]"
        for name in columns
        if "units" in data[name].attrs
    }
    write_text(path, table.rename(columns=heads).to_csv(index=False, na_rep="NaN"))


def _in_words(flags: np.ndarray, attributes: dict[str, Any]) -> list[str]:
    """Reasons of every flag, ``valid`` where there is none."""
    masks = masks_of(attributes)
    words = {
        int(flag): " ".join(name for name, mask in masks.items() if int(flag) & mask)
        for flag in np.unique(flags)
    }
    return [words[int(flag)] or "valid" for flag in flags]
