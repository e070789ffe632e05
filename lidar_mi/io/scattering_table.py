"""Scattering tables as text files, and those shipped with the package."""

import math
from importlib.resources import files
from pathlib import Path

import numpy as np

from lidar_mi import __version__
from lidar_mi.atmosphere.scattering.aerosols import aerosol
from lidar_mi.atmosphere.scattering.particle_scattering import Notice, make_table
from lidar_mi.atmosphere.scattering.tables import ScatteringTable
from lidar_mi.errors import InputError
from lidar_mi.io.text import read_text, write_text

# Required header lines.
_HEADER = {
    "name": str,
    "wavelength_m": float,
    "extinction_cross_section_m2": float,
    "single_scattering_albedo": float,
    "number_density_m-3": float,
    "provenance": str,
}


def write_table(table: ScatteringTable, path: str | Path) -> None:
    """Write a table as text: ``# key: value`` lines, then angle and six elements per line.

    `numpy.loadtxt` and the ``mueller`` phase function read it directly. The derived numbers
    (lidar ratio and so on) are written as information; `read_table` computes them.
    """
    values = {
        "name": table.name,
        "wavelength_m": f"{table.wavelength:.9g}",
        "extinction_cross_section_m2": f"{table.extinction_cross_section:.7e}",
        "single_scattering_albedo": f"{table.albedo:.9g}",
        "number_density_m-3": f"{table.number_density:.7g}",
        "provenance": " ".join(table.provenance.split()),
    }
    derived = {
        "lidar_ratio_sr": f"{table.lidar_ratio:.5g}",
        "linear_depolarization_ratio_180": f"{table.depolarization_ratio:.5g}",
        "asymmetry_parameter": f"{table.asymmetry:.5g}",
        "software": f"lidar-mi {__version__}",
    }
    lines = ["# Scattering matrix, rows (a1,b1,0,0) (b1,a2,0,0) (0,0,a3,b2) (0,0,-b2,a4)"]
    lines += [f"# {key}: {value}" for key, value in (values | derived).items()]
    lines += ["# angle/degree a1 a2 a3 a4 b1 b2"]
    for angle, row in zip(table.angle, table.elements, strict=True):
        # adding zero turns -0.0 into 0.0
        lines.append(f"{angle:g} " + " ".join(f"{value + 0.0:.6e}" for value in row))
    write_text(path, "\n".join(lines) + "\n")


def read_table(path: str | Path) -> ScatteringTable:
    """Read a table written by `write_table`.

    Raises InputError: no such file, a missing or wrong header line, or a matrix that fails `check`.
    """
    text = read_text(path, "a scattering-matrix table")
    rows = [line for line in text.splitlines() if line.partition("#")[0].strip()]
    if not rows:
        raise InputError(f"{path}: no row of numbers; expected seven a line: angle and a1 ... b2")
    try:
        numbers = np.loadtxt(rows, ndmin=2)
    except ValueError as error:
        reason = " ".join(str(error).split())
        raise InputError(f"{path}: not a table of seven numbers a line ({reason})") from None
    if numbers.ndim != 2 or numbers.shape[1] != 7:
        raise InputError(
            f"{path}: {numbers.shape[-1]} columns; expected seven: angle and a1 ... b2"
        )
    header = {}
    for line in text.splitlines():
        key, colon, value = line.lstrip("# ").partition(":")
        if line.startswith("#") and colon and key in _HEADER:
            header[key] = value.strip()
    values = []
    for key, kind in _HEADER.items():
        if key not in header:
            raise InputError(f"{path}: no line '# {key}: ...'; a table must state its {key}")
        try:
            values.append(kind(header[key]))
        except ValueError:
            raise InputError(f"{path}, {key}: {header[key]!r} is not a number") from None
    name, wavelength, cross_section, albedo, number_density, provenance = values
    try:
        return ScatteringTable(
            name,
            wavelength,
            numbers[:, 0],
            numbers[:, 1:],
            cross_section,
            albedo,
            number_density,
            provenance,
        )
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


def is_complete(path: Path) -> bool:
    """Whether a table has a header with albedo and wavelength, as `write_table` writes it."""
    try:
        return "# single_scattering_albedo:" in path.read_text()
    except UnicodeDecodeError:  # .npy
        return False


def aerosol_table(
    name: str, wavelength: float, notice: Notice = lambda text, fraction: None
) -> ScatteringTable:
    """The table of one of `AEROSOLS` at a wavelength (m): the shipped one, or one of `make_table`.

    Raises InputError: as `make_table`; ``scatrs`` is needed only where no table ships (all do at
    532 nm).
    """
    file = f"aerosol_{aerosol(name).name}_{wavelength * 1e9:.0f}nm.txt"
    shipped = Path(str(files("lidar_mi.scenes") / file))
    if shipped.is_file():
        table = read_table(shipped)
        if math.isclose(table.wavelength, wavelength, rel_tol=1e-6):
            return table
    return make_table(name, wavelength, notice=notice)
