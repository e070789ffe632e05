"""Files that an experiment names: where they are searched."""

from importlib.resources import files
from pathlib import Path

from lidar_mi.errors import InputError


def find_file(name: str, search_path: str | Path, field: str) -> Path:
    """A file named by an experiment: as stated, in the folder of the experiment, or shipped."""
    shipped = Path(str(files("lidar_mi.scenes")))
    for candidate in (Path(search_path) / name, shipped / name):
        # a reader says what it expects instead of a folder, such as a Zarr store
        if candidate.is_file() or (candidate.is_dir() and candidate.suffix):
            return candidate
    samples = sorted(p.name for p in shipped.glob("*.nc")) if field == "wake.file" else []
    raise InputError(
        f"{field}: {name} not found; looked in {Path(search_path).resolve()} and the shipped "
        "samples" + (f" ({', '.join(samples)})" if samples else "")
    )
