"""Soundings: pressure and temperature by altitude, from CSV or NetCDF."""

from pathlib import Path
from typing import NamedTuple

import numpy as np

from lidar_mi.errors import InputError
from lidar_mi.io.timed_table import read_timed_table

_UNITS = {"altitude": "m", "pressure": "Pa", "temperature": "K"}


class Sounding(NamedTuple):
    """Altitude (m, ascending), pressure (Pa) and temperature (K), arrays of one length."""

    altitude: np.ndarray
    pressure: np.ndarray
    temperature: np.ndarray


def read_sounding(path: str | Path) -> Sounding:
    """A sounding from a table with the columns altitude, pressure and temperature.

    A CSV file has them in its head, with units: "altitude (m), pressure (hPa), temperature (K)";
    a NetCDF file as variables with the attribute ``units``. A pressure must have one. Other
    columns, such as humidity, are ignored: water vapour changes the scattering of air by less than
    1 %.

    Raises InputError: as of `read_timed_table`; a column that is missing, a pressure or temperature
    that is not above 0.
    """
    table = read_timed_table(path, _UNITS, axis="altitude")
    missing = [name for name in _UNITS if name not in table]
    if missing:
        raise InputError(
            f"{path}: {', '.join(missing)} missing; expected columns {', '.join(_UNITS)}"
        )
    for name in ("pressure", "temperature"):
        if not (table[name] > 0).all():
            raise InputError(
                f"{path}: {name}: {table[name].min():g} {_UNITS[name]} is not allowed; expected "
                "above 0"
            )
    return Sounding(*(table[name] for name in _UNITS))
