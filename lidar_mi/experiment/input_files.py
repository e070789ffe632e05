"""Files that an experiment names: where they are searched."""

from importlib.resources import files
from pathlib import Path

from lidar_mi.errors import InputError


def find_file(name: str, beside: str | Path, field: str) -> Path:
    """A file named by an experiment: as given, beside the experiment, or shipped."""
    shipped = Path(str(files("lidar_mi.scenes")))
    for candidate in (Path(beside) / name, shipped / name):
        # a reader says what it expects instead of a folder, such as a Zarr store
        if candidate.is_file() or (candidate.is_dir() and candidate.suffix):
            return candidate
    samples = sorted(p.name for p in shipped.glob("*.nc")) if field == "wake.file" else []
    raise InputError(
        f"{field}: {name} not found; looked in {Path(beside).resolve()} and the shipped samples"
        + (f" ({', '.join(samples)})" if samples else "")
    )
