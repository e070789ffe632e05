"""Which Mitsuba phase function stands for the scattering an experiment describes."""

from pathlib import Path

import mitsuba as mi
import numpy as np

from ..atmosphere.particles import aerosol_table
from ..errors import InputError


def phase_function(scattering, beside: str | Path = ".", wavelength: float = 532e-9) -> dict:
    """The phase function's dictionary for ``mi.load_dict``.

    Parameters
    ----------
    scattering : lidar_mi.config.Scattering
    beside : path
        Folder in which a table is looked for.
    wavelength : float
        Of the laser, m; a named aerosol scatters accordingly.

    Raises
    ------
    InputError
        The table file does not exist, or the aerosol has no table at this wavelength.
    """
    match scattering.phase:
        case "rayleigh":
            return {"type": "rayleigh_polarized", "depolarization": scattering.depolarization}
        case "isotropic":
            return {"type": "isotropic"}
        case "henyey_greenstein":
            return {"type": "hg", "g": scattering.asymmetry}
        case "aerosol":
            table = aerosol_table(scattering.aerosol, wavelength)
            return {
                "type": "mueller",
                "table": mi.TensorXf(np.column_stack([table.angle, table.elements])),
            }
    path = Path(beside) / scattering.table
    if not path.is_file():
        raise InputError(f"scattering.table: {path} not found; expected a scattering-matrix file")
    return {"type": "mueller", "table": str(path.resolve())}


def albedo(scattering, wavelength: float = 532e-9) -> float:
    """Single-scattering albedo: as stated, else the named aerosol's own, else 1."""
    if scattering.albedo is not None:
        return scattering.albedo
    if scattering.phase == "aerosol":
        return aerosol_table(scattering.aerosol, wavelength).albedo
    return 1.0
