"""Which Mitsuba phase function stands for the scattering an experiment describes."""

from pathlib import Path

from ..errors import InputError


def phase_function(scattering, beside: str | Path = ".") -> dict:
    """The phase function's dictionary for ``mi.load_dict``.

    Parameters
    ----------
    scattering : lidar_mi.config.Scattering
    beside : path
        Folder in which a table is looked for.

    Raises
    ------
    InputError
        The table file does not exist.
    """
    match scattering.phase:
        case "rayleigh":
            return {"type": "rayleigh_polarized", "depolarization": scattering.depolarization}
        case "isotropic":
            return {"type": "isotropic"}
        case "henyey_greenstein":
            return {"type": "hg", "g": scattering.asymmetry}
    path = Path(beside) / scattering.table
    if not path.is_file():
        raise InputError(f"scattering.table: {path} not found; expected a scattering-matrix file")
    return {"type": "mueller", "table": str(path.resolve())}
