"""The folder of a run: whose it is, what was run in it, how far it came."""

import hashlib
import platform
import time
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path

from lidar_mi import __version__
from lidar_mi.errors import InputError
from lidar_mi.experiment import reading as config
from lidar_mi.experiment.schema import Experiment
from lidar_mi.experiment.truth import find_file
from lidar_mi.io.text import write_text
from lidar_mi.io.yaml import parse_yaml, read_yaml, to_yaml
from lidar_mi.rendering.phase import table_files

IMAGES = ("image_t1.exr", "image_t2.exr")
VOLUME = "wind_volume.nc"
PICTURES = (*IMAGES, "fringes_*.exr")
RESULTS = (
    "wind.nc",
    "v_los.nc",
    "lines_of_sight.nc",
    "wind3d.nc",
    VOLUME,
    "vortex.json",
    "metrics.json",
    "report.html",
    "log.txt",
)

# other versions of these may give other pictures
RENDERED_BY = ("lidar-mi", "mitsuba", "drjit")

FAILED = "failed: "

Notice = Callable[[str, float | None], None]
"""Called with what is running and how far it is (0 to 1, None: unknown)."""


def claim(folder: Path, experiment: Experiment, beside: str | Path, overwrite: bool) -> None:
    """Make the folder this experiment's, keeping pictures of the very same one."""
    marker = folder / "experiment.yaml"
    libraries = ("mitsuba", "drjit", "numpy", "scipy", "torch", "kornia", "OpenEXR", "xarray")
    record = {
        "experiment": parse_yaml(config.dump(experiment), experiment.name),
        "files": _checksums(experiment, beside),
        "versions": {
            "lidar-mi": __version__,
            "python": platform.python_version(),
            **{name: version(name) for name in libraries},
        },
    }
    if marker.is_file():
        before = read_record(folder)
        other = _difference(before, record)
        if other:
            pictures = [path for pattern in PICTURES for path in folder.glob(pattern)]
            if pictures and not overwrite:
                raise InputError(
                    f"{folder}: holds a run of {other}; expected an empty folder (-o DIR), or "
                    "--overwrite to replace it"
                )
            # nothing of the other experiment may be taken for a result of this one
            old = [folder / name for name in RESULTS]
            for path in (*pictures, *old, *(folder / "figures").glob("*.png")):
                path.unlink(missing_ok=True)
    elif folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise InputError(f"{folder}: is no run folder; expected an empty or a new one (-o DIR)")
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{folder}: cannot be made ({error.strerror})") from None
    write_text(marker, to_yaml(record))


def _difference(before: dict, now: dict) -> str | None:
    """What makes an earlier run's pictures another experiment's; None: nothing does."""
    if any(before.get(key) != now[key] for key in ("experiment", "files")):
        return "another experiment"
    for name in RENDERED_BY:
        version = before["versions"].get(name)
        if version != now["versions"][name]:
            return f"{name} {version}, this is {now['versions'][name]}"
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
    """What a run folder says it holds: ``experiment`` (resolved), ``files`` (checksums), ``versions``.

    Raises
    ------
    InputError
        The folder's experiment.yaml is missing or was not written by a run.
    """
    marker = Path(folder) / "experiment.yaml"
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


def failure(folder: str | Path) -> str | None:
    """What the last run in a folder failed from; None: it did not, or was only stopped."""
    path = Path(folder) / "log.txt"
    lines = path.read_text().splitlines() if path.is_file() else []
    _, _, text = lines[-1].split(" ", 2) if lines else ("", "", "")  # behind date and time
    return text.removeprefix(FAILED) if text.startswith(FAILED) else None


class Log:
    """Lines for the log file and the person in front of the screen."""

    def __init__(self, path: Path, notice: Notice):
        self.path, self.notice = path, notice
        self.warnings = []

    def __call__(self, text: str) -> None:
        with self.path.open("a") as file:
            file.write(f"{time.strftime('%Y-%m-%d %H:%M:%S')} {text}\n")
        self.notice(text, None)

    def remark(self, text: str) -> None:
        """A warning: something that a reader of the results must know."""
        self.warnings.append(text)
        self(f"warning: {text}")

    def fail(self, error: Exception) -> None:
        """Why the run ended, so that nobody takes it for one that was stopped and can go on."""
        self(f"{FAILED}{' '.join(str(error).split()) or type(error).__name__}")

    def bar(self, text: str, share: float) -> None:
        """Progress within a step: shown, not logged."""
        self.notice(text, share)
