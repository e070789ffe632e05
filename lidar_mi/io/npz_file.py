"""NumPy archives of named arrays."""

import json
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from lidar_mi.io.atomic import write_atomically


def write_npz(path: str | Path, data: xr.Dataset) -> None:
    """Write all variables under their names, which ``numpy.load`` reads without pickles.

    The text ``about`` is JSON: for each variable its ``dims``, ``units`` and ``long_name``.
    """
    values: dict[str, Any] = {}
    about: dict[str, Any] = {}
    for name, variable in data.variables.items():
        text = variable.dtype.kind in "OUS"
        values[str(name)] = variable.values.astype(str) if text else variable.values
        attributes = {key: str(value) for key, value in variable.attrs.items()}
        about[str(name)] = {"dims": [str(dim) for dim in variable.dims], **attributes}
    buffer = BytesIO()
    values["about"] = np.array(json.dumps(about))
    np.savez_compressed(buffer, **values)
    write_atomically(path, buffer.getbuffer())
