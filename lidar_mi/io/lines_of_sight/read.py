"""Lines of sight from files of any kind: which kind it is, all files as one data set."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import xarray as xr

from lidar_mi.arguments import checked_arguments
from lidar_mi.errors import InputError
from lidar_mi.io.lines_of_sight.csv_lines import read_csv_lines
from lidar_mi.io.lines_of_sight.dataset import assembled
from lidar_mi.io.lines_of_sight.flags import correct_steps, flags
from lidar_mi.io.lines_of_sight.halo import read_halo
from lidar_mi.io.lines_of_sight.netcdf_scans import NAMES, is_lines, read_netcdf_lines
from lidar_mi.io.lines_of_sight.scan import Scan, check

NETCDF = (".nc", ".nc4", ".cdf", ".netcdf")
"""Suffixes of NetCDF files."""

SUFFIXES = (".hpl", *NETCDF, ".csv", ".txt")
"""Suffixes of all kinds of files."""


@checked_arguments
def read_lines_of_sight(
    paths: str | Path | Sequence[str | Path],
    *,
    names: Mapping[str, str] | None = None,
    min_cnr: float | None = None,
    blind_range: float | None = None,
    range_step: float | None = None,
) -> xr.Dataset:
    r"""Lines of sight of a Doppler lidar from one file or several, in the order of time.

    Halo Photonics (.hpl), NetCDF of ARM (dlppi, dlrhi, dlfpt), WindCube and CfRadial 1 and 2, other
    NetCDF and tables (CSV) with a mapping of names. Nothing is omitted: invalid values are flagged,
    and anything unusual is stated in the attribute ``remarks``, one line each.

    Parameters
    ----------
    paths : path or sequence of paths
        Files of one lidar.
    names : mapping, optional
        Our name to the file's, where they differ: {"radial_velocity": "-v_los"}. Ours are time,
        azimuth, elevation, range, radial_velocity, snr, spectral_width, attenuated_backscatter,
        pitch, roll, latitude, longitude, altitude. A minus sign before the file's name reverses the
        sign of a radial velocity that is positive toward the lidar; a plus sign retains the sign
        where the file says that it is.
    min_cnr : float, optional
        Least carrier-to-noise ratio, dB, of a velocity that is not flagged. Default: -21 dB, of
        WindCube -27 dB.
    blind_range : float, optional
        Gates nearer than this are flagged, m. Default: 90 m of Halo Photonics and ARM, and gates
        that hold the reflection of the pulse, where a scan shows them.
    range_step : float, optional
        Distance of neighbouring gates, m, where that of the file is wrong. Default: the file's,
        unless the noise shows that gates overlap which it states to be adjacent.

    Returns
    -------
    xr.Dataset, dims (time, range)
        `radial_velocity` (m s-1, positive away from the lidar), `snr` (ratio of powers, 1),
        `spectral_width` (m s-1) and `attenuated_backscatter` (m-1 sr-1) where the files have them,
        `flag` (0: valid, else bits by ``flag_meanings``). Coordinates: `time` (UTC), `range` (m),
        `azimuth` and `elevation` (degrees, of a line), `sweep`, `pitch` and `roll` (degrees),
        `latitude`, `longitude` and `altitude` where they are known.

    Raises
    ------
    InputError
        A file that cannot be read, of an unknown kind, without any line; an unknown name; lidars at
        different places.

    Examples
    --------
    >>> from pathlib import Path
    >>> import lidar_mi as lm
    >>> table = "time,azimuth,elevation,range [km],radial_velocity\n0,360,75,0.3,1.5\n"
    >>> _ = Path("lines.csv").write_text(table)
    >>> lines = lm.read_lines_of_sight("lines.csv")
    >>> float(lines["radial_velocity"].sel(range=300.0)[0]), lines.attrs["scan"]
    (1.5, 'stare')
    """
    files = [paths] if isinstance(paths, str | Path) else list(paths)
    if not files:
        raise InputError("paths: none is not allowed; expected files of lines of sight")
    for name in names or {}:
        if name not in NAMES:
            raise InputError(f"names: {name!r} is not known; allowed: {', '.join(NAMES)}")
    if range_step is not None and not 0 < range_step < np.inf:
        raise InputError(f"range_step: {range_step} m is not allowed; expected above 0 m")
    scans: list[tuple[str, Scan, np.ndarray]] = []
    thresholds: dict[str, float] = {}
    for path in map(Path, files):
        for scan in _scans(path, names or {}):
            if range_step is not None:
                _step(scan, range_step)
            scan = check(scan, path)
            if range_step is None:
                correct_steps(scan, min_cnr)
            flag, thresholds = flags(scan, min_cnr, blind_range)
            scans.append((path.name, scan, flag))
    return assembled(scans, thresholds)


def is_lines_of_sight(path: Path) -> bool:
    """Whether a file holds lines of sight under known names, by its suffix and contents."""
    return path.suffix.lower() == ".hpl" or (path.suffix.lower() in NETCDF and is_lines(path))


def _scans(path: Path, names: Mapping[str, str]) -> list[Scan]:
    suffix = path.suffix.lower()
    if suffix == ".hpl":
        return [read_halo(path)]
    if suffix in NETCDF:
        return read_netcdf_lines(path, names)
    if suffix in (".csv", ".txt"):
        return [read_csv_lines(path, names)]
    raise InputError(
        f"{path}: {suffix or 'no suffix'} is no kind of lines of sight; expected "
        f"{', '.join(SUFFIXES)}"
    )


def _step(scan: Scan, step: float) -> None:
    """Ranges with another distance of the gates, the first with its near end where it is."""
    first = scan.range[..., :1]
    scan.range = first + step * np.arange(scan.range.shape[-1])
    scan.remarks.append(f"gates are {step:g} m apart, as given")
