"""Mitsuba phase function and albedo for the scattering of an experiment."""

import math
from importlib.resources import files
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from lidar_mi.atmosphere.scattering.molecules import molecular_scattering, molecular_table
from lidar_mi.atmosphere.scattering.particle_scattering import Notice
from lidar_mi.atmosphere.scattering.tables import ScatteringTable, mix, rayleigh_table
from lidar_mi.errors import InputError
from lidar_mi.io.scattering_table import aerosol_table, is_complete, read_table

Keys: TypeAlias = Any
"""Keys of the section ``scattering``, or of one of its parts; their schema is in a room above."""

_SHIPPED = Path(str(files("lidar_mi.scenes")))


class Scatterer(NamedTuple):
    """``phase``: dictionary of the phase function, see `loadable`; ``albedo``."""

    phase: dict[str, Any]
    albedo: float


class Molecules(NamedTuple):
    """Uniform molecular part of the air: extinction (m^-1), phase function, albedo."""

    extinction: float
    phase: dict[str, Any]
    albedo: float


class ScatteringAir(NamedTuple):
    """Of what a scene is full: the surroundings of a slab, and how both scatter.

    extinction: of the surroundings, m^-1.
    phase, albedo: as of `Scatterer`, of slab and surroundings; ``phase`` also with a table as an
        array.
    molecules: part of the extinction, here and in the slab, with a phase function of its own.
    """

    extinction: float
    phase: dict[str, Any]
    albedo: float
    molecules: Molecules | None = None


def molecules(extinction: float, wavelength: float, band: str = "cabannes") -> Molecules | None:
    """Molecules of a given extinction coefficient; None without any.

    The coefficient (m^-1) is that of the whole Rayleigh band, whatever band is received.
    """
    if extinction == 0:
        return None
    air = molecular_scattering(wavelength, band=band)
    phase = {"type": "rayleigh_polarized", "depolarization": air.depolarization}
    return Molecules(extinction, phase, air.albedo)


def scatterer(
    scattering: Keys,
    folder: str | Path = ".",
    wavelength: float = 532e-9,
    notice: Notice = lambda text, fraction: None,
) -> Scatterer:
    """Phase function and albedo of an experiment's air.

    scattering: its own albedo, if given, replaces that of the scatterers.
    folder: of the tables.
    wavelength: of the laser, m; aerosols and molecules scatter accordingly.
    notice: called with the progress of a table that must be computed first.

    Raises InputError: a table that does not exist, that cannot be read or is for another
    wavelength; an aerosol without a table at this one.
    """
    albedo = 1.0
    match scattering.phase:
        case "rayleigh":
            phase = {"type": "rayleigh_polarized", "depolarization": scattering.depolarization}
        case "molecules":
            air = molecular_scattering(wavelength, band=scattering.band)
            phase = {"type": "rayleigh_polarized", "depolarization": air.depolarization}
            albedo = air.albedo
        case "isotropic":
            phase = {"type": "isotropic"}
        case "henyey_greenstein":
            phase = {"type": "hg", "g": scattering.asymmetry}
        case "mixture":
            fractions = [part.fraction for part in scattering.parts]
            tables = [
                _table(part, folder, wavelength, f"scattering.parts.{index}", notice)
                for index, part in enumerate(scattering.parts)
            ]
            phase, albedo = _tabulated(mix(tables, fractions))
        case "table" if not is_complete(table_files(scattering, folder)["scattering.table"]):
            path = table_files(scattering, folder)["scattering.table"]
            phase = {"type": "mueller", "table": str(path)}
        case _:
            table = _table(scattering, folder, wavelength, "scattering", notice)
            phase, albedo = _tabulated(table)
    return Scatterer(phase, albedo if scattering.albedo is None else scattering.albedo)


def backscatter_phase_function(air: Scatterer) -> float:
    """Fraction of the scattered light that is scattered straight back, per solid angle, sr^-1.

    1 / (4 pi) where light is scattered evenly; Rayleigh's is 3 / (8 pi).
    """
    evenly = 1 / (4 * math.pi)
    match air.phase:
        case {"type": "isotropic"}:
            return evenly
        case {"type": "hg", "g": g}:
            return evenly * (1 - g) / (1 + g) ** 2
        case {"type": "rayleigh_polarized", "depolarization": factor}:
            return evenly * float(rayleigh_table(factor, 1.0, 1.0).elements[-1, 0])
        case {"type": "mueller", "table": np.ndarray() as rows}:
            return evenly * float(rows[-1, 1])
    # a table without a cross-section, which the plugin alone reads
    import drjit as dr
    import mitsuba as mi

    phase = mi.load_dict(air.phase)
    at = dr.zeros(mi.MediumInteraction3f)
    at.wi = mi.Vector3f(0, 0, 1)
    at.sh_frame = mi.Frame3f(mi.Vector3f(0, 0, -1))
    value, _ = phase.eval_pdf(mi.PhaseFunctionContext(None), at, mi.Vector3f(0, 0, 1))
    intensity = value[0, 0] if mi.is_polarized else value
    return float(np.ravel(np.array(intensity))[0])


def table_files(scattering: Keys, folder: str | Path = ".") -> dict[str, Path]:
    """The table files that an experiment names, by the field that names them.

    They are searched in the folder, then among those of the package.

    Raises InputError: one of them does not exist.
    """
    named = {f"scattering.parts.{k}.table": part for k, part in enumerate(scattering.parts or ())}
    files = {}
    for field, part in ({"scattering.table": scattering} | named).items():
        if part.table is not None:
            files[field] = _table_file(part.table, folder, field).resolve()
    return files


def _table_file(name: str, folder: str | Path, field: str) -> Path:
    """A table in a folder, or else among those of the package."""
    path = Path(folder) / name
    for candidate in (path, _SHIPPED / name):
        if candidate.is_file():
            return candidate
    raise InputError(f"{field}: {path} not found; expected a scattering-matrix file")


def _table(
    part: Keys, folder: str | Path, wavelength: float, field: str, notice: Notice
) -> ScatteringTable:
    """One kind of scatterer as a table."""
    match part.phase:
        case "rayleigh":
            # only fractions of the extinction matter: any cross-section will do
            return rayleigh_table(part.depolarization, wavelength, 1.0)
        case "molecules":
            return molecular_table(wavelength, band=part.band)
        case "aerosol":
            return aerosol_table(part.aerosol, wavelength, notice)
    path = _table_file(part.table, folder, f"{field}.table")
    table = read_table(path)
    if not math.isclose(table.wavelength, wavelength, rel_tol=1e-6):
        raise InputError(
            f"{field}.table: {path} is not allowed; it is for {table.wavelength * 1e9:g} nm, "
            f"expected lidar.wavelength = {wavelength * 1e9:g} nm"
        )
    return table


def _tabulated(table: ScatteringTable) -> Scatterer:
    rows = np.column_stack([table.angle, table.elements])
    return Scatterer({"type": "mueller", "table": rows}, table.albedo)


def loadable(phase: dict[str, Any]) -> dict[str, Any]:
    """The dictionary of a phase function for ``mi.load_dict``: its table is a tensor."""
    import mitsuba as mi

    table = phase.get("table")
    return phase | {"table": mi.TensorXf(table)} if isinstance(table, np.ndarray) else phase
