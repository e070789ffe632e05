"""MATLAB files, version 5."""

from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import scipy
import xarray as xr

from lidar_mi.io.atomic import write_atomically


def write_mat(path: str | Path, data: xr.Dataset) -> None:
    """Write all variables under their names, texts as cell arrays.

    The structures ``units``, ``long_name`` and ``dims`` (names of the dimensions, in their order)
    have a field for each variable, ``flag_meanings`` one for each variable of flags: the reason
    that bit 1, 2, ... stands for. A dot in a name becomes an underscore.
    """
    about: dict[str, dict[str, Any]] = {"units": {}, "long_name": {}, "dims": {}}
    values: dict[str, Any] = {}
    for name, variable in data.variables.items():
        field = str(name).replace(".", "_")
        text = variable.dtype.kind in "OUS"
        values[field] = variable.values.astype(object) if text else variable.values
        about["dims"][field] = np.array(variable.dims, dtype=object)
        for key in ("units", "long_name"):
            if key in variable.attrs:
                about[key][field] = str(variable.attrs[key])
        if "flag_meanings" in variable.attrs:
            meanings = np.array(variable.attrs["flag_meanings"].split(), dtype=object)
            about.setdefault("flag_meanings", {})[field] = meanings
    buffer = BytesIO()
    scipy.io.savemat(
        buffer, {**values, **about}, long_field_names=True, do_compression=True, oned_as="row"
    )
    write_atomically(path, buffer.getbuffer())
