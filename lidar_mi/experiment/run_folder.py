"""The folder of a run: whose it is, which file belongs to which result, how far it came."""

import hashlib
import platform
from collections.abc import Mapping
from importlib.metadata import version
from pathlib import Path
from typing import Any

import xarray as xr

from lidar_mi import __version__
from lidar_mi.assessment.metrics.names import current_name
from lidar_mi.errors import InputError
from lidar_mi.experiment import log, reading
from lidar_mi.experiment.schema import Experiment
from lidar_mi.experiment.stages import rendering
from lidar_mi.experiment.truth import find_file
from lidar_mi.instrument.detector_noise import without_noise
from lidar_mi.io import exr
from lidar_mi.io.json import read_json, write_json
from lidar_mi.io.netcdf import write_netcdf
from lidar_mi.io.text import write_text
from lidar_mi.io.vortex_file import write_vortices
from lidar_mi.io.yaml import parse_yaml, read_yaml, to_yaml
from lidar_mi.rendering.phase import table_files

RECORD, LOG, METRICS, REPORT = "experiment.yaml", "log.txt", "metrics.json", "report.html"
FIGURES = "figures"
IMAGES = tuple(f"{name}.exr" for name in rendering.IMAGES)
RENDERED = (*IMAGES, "fringes_*.exr")
"""Images that an earlier run of the same experiment leaves to the next one."""
RESULTS = {
    "wind": "wind.nc",
    "wind_volume": "wind_volume.nc",
    "v_los": "v_los.nc",
    "lines": "lines_of_sight.nc",
    "wind3d": "wind3d.nc",
    "vortices": "vortex.json",
}
"""File of a result, by its stage."""

# other versions of these may give other images
_RENDERED_BY = ("lidar-mi", "mitsuba", "drjit")
_LIBRARIES = ("mitsuba", "drjit", "numpy", "scipy", "torch", "kornia", "OpenEXR", "xarray")


class RunFolder:
    """What a run keeps, each result in its file as soon as it is there.

    Rendered images are read back, so that a resumed run and one that was not see the same float32
    values.

    Parameters
    ----------
    path : path
    experiment : Experiment
    beside : path
        Folder in which files named by the experiment are looked for first.
    """

    def __init__(self, path: str | Path, experiment: Experiment, beside: str | Path):
        self.path = Path(path)
        self.figures = self.path / FIGURES
        self.log = self.path / LOG
        self._experiment = experiment
        self.record: dict[str, Any] = {
            "experiment": parse_yaml(reading.dump(experiment), experiment.name),
            "files": _checksums(experiment, beside),
            "versions": {
                "lidar-mi": __version__,
                "python": platform.python_version(),
                **{name: version(name) for name in _LIBRARIES},
            },
        }

    def claim(self, overwrite: bool) -> None:
        """Make the folder this experiment's, keeping images of the very same one.

        Raises
        ------
        InputError
            The folder holds images of another experiment or version, and ``overwrite`` is not set;
            or it is no run folder.
        """
        folder, marker = self.path, self.path / RECORD
        if marker.is_file():
            other = _difference(read_record(folder), self.record)
            if other:
                images = [path for pattern in RENDERED for path in folder.glob(pattern)]
                if images and not overwrite:
                    raise InputError(
                        f"{folder}: holds a run of {other}; expected an empty folder (-o DIR), or "
                        "--overwrite to replace it"
                    )
                # nothing of the other experiment may be taken for a result of this one
                old = [folder / name for name in (*RESULTS.values(), METRICS, REPORT, LOG)]
                for path in (*images, *old, *self.figures.glob("*.png")):
                    path.unlink(missing_ok=True)
        elif folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
            raise InputError(f"{folder}: is no run folder; expected an empty or a new one (-o DIR)")
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(f"{folder}: cannot be made ({error.strerror})") from None
        write_text(marker, to_yaml(self.record))

    def kept(self, part: str) -> xr.Dataset | None:
        """A rendered image, without a detector's noise; None: it is not there."""
        path = self._image(part)
        if not path.is_file():
            return None
        if part in rendering.IMAGES:
            return without_noise(exr.read_scan(path))
        return exr.read_fringes(path)

    def keep_part(self, part: str, value: xr.Dataset) -> xr.Dataset:
        """Write a rendered image; returns it as it is read."""
        write = exr.write_scan if part in rendering.IMAGES else exr.write_fringes
        write(self._image(part), value)
        kept = self.kept(part)
        assert kept is not None
        return kept

    def keep(self, name: str, value: Any) -> None:
        """Write a result into its file, if it has one; None: there is no such result."""
        if name == "scans":
            self._keep_noise(value)
        if name not in RESULTS:
            return
        path = self.path / RESULTS[name]
        if value is None:
            path.unlink(missing_ok=True)
        elif name == "vortices":
            about = {"experiment": self._experiment.name, "source": f"lidar-mi {__version__}"}
            write_vortices(path, value.pairs, **about)
        else:
            write_netcdf(value, path)

    def keep_verdict(self, metrics: Mapping[str, float], page: str) -> None:
        """Write metrics and report: the run is done."""
        write_json(self.path / METRICS, metrics)
        write_text(self.path / REPORT, page)

    def _image(self, part: str) -> Path:
        return self.path / f"{part}.exr"

    def _keep_noise(self, scans: list[xr.Dataset]) -> None:
        """Put noisy images beside those without noise, in the same files."""
        for part, scan in zip(rendering.IMAGES, scans, strict=True):
            if "Y_noisy" in scan and "Y_noisy" not in exr.read_scan(self._image(part)):
                exr.write_scan(self._image(part), scan)


def _difference(before: dict, now: dict) -> str | None:
    """What makes an earlier run's images another experiment's; None: nothing does."""
    if any(before.get(key) != now[key] for key in ("experiment", "files")):
        return "another experiment"
    for name in _RENDERED_BY:
        earlier = before["versions"].get(name)
        if earlier != now["versions"][name]:
            return f"{name} {earlier}, this is {now['versions'][name]}"
    return None


def _checksums(experiment: Experiment, beside: str | Path) -> dict[str, str]:
    """SHA-256 of the files an experiment names: a changed file is another experiment."""
    if experiment.wake is None:
        return {}
    paths = table_files(experiment.scattering, beside)
    if experiment.wake.file:
        paths["wake.file"] = find_file(experiment.wake.file, beside, "wake.file")
    return {field: hashlib.sha256(path.read_bytes()).hexdigest() for field, path in paths.items()}


def read_record(folder: str | Path) -> dict:
    """Record of a run folder: ``experiment`` (resolved), ``files`` (checksums), ``versions``.

    Raises
    ------
    InputError
        The folder's experiment.yaml is missing or was not written by a run.
    """
    marker = Path(folder) / RECORD
    if not marker.is_file():
        raise InputError(f"{folder}: no experiment.yaml in it; expected a run folder")
    try:
        record = read_yaml(marker, "a run's record")
    except InputError:
        record = None
    if not isinstance(record, dict) or not all(
        isinstance(record.get(key), dict) for key in ("experiment", "versions")
    ):
        raise InputError(f"{marker}: not written by a run; expected a run folder")
    return record


def read_metrics(folder: str | Path) -> dict[str, float] | None:
    """Metrics of the run or the study in a folder, by today's names; None: it is not done.

    Raises
    ------
    InputError
        The folder's metrics.json was not written by a run.
    """
    path = Path(folder) / METRICS
    if not path.is_file():
        return None
    metrics = read_json(path, "metrics of a run")
    if not isinstance(metrics, dict) or not all(map(_is_number, metrics.values())):
        raise InputError(f"{path}: not written by a run; expected names with numbers")
    return {current_name(key): value for key, value in metrics.items()}


def _is_number(value: object) -> bool:
    return isinstance(value, float) or (isinstance(value, int) and abs(value) < 2**63)


def failure(folder: str | Path) -> str | None:
    """What the last run in a folder failed from; None: it did not, or was only stopped."""
    return log.failure(Path(folder) / LOG)
