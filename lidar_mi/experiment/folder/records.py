"""Contents of the folder of a run or of a study, read without the code that computes them."""

import functools
import hashlib
import re
from pathlib import Path
from typing import Any

from lidar_mi.errors import InputError
from lidar_mi.experiment import log
from lidar_mi.io.json import read_json
from lidar_mi.io.text import read_text
from lidar_mi.io.yaml import read_yaml
from lidar_mi.schema.experiment import NAME

RECORD, LOG, METRICS, REPORT = "experiment.yaml", "log.txt", "metrics.json", "report.html"
SUMMARY = "summary.txt"
"""The answer of a run, a sentence a line."""
STUDY = "study.yaml"
"""Record of a study: its name and its variants."""


def read_record(folder: str | Path) -> dict[str, Any]:
    """Record of a run folder: ``experiment`` (resolved), ``files`` (checksums), ``versions``.

    Raises InputError: the folder's experiment.yaml is missing or was not written by a run.
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
    """Metrics of the run or the study in a folder, by today's names; None: not complete.

    Raises InputError: the folder's metrics.json was not written by its run.
    """
    path, marker = Path(folder) / METRICS, Path(folder) / RECORD
    if not path.is_file():
        return None
    metrics = read_json(path, "metrics of a run")
    if not isinstance(metrics, dict) or not all(map(_is_number, metrics.values())):
        raise InputError(f"{path}: not written by a run; expected names with numbers")
    if marker.is_file():  # a study has none
        checksum = read_record(folder).get("metrics", "")
        if checksum is None:  # of an earlier run; this one is incomplete
            return None
        # older versions wrote no checksum
        if checksum and checksum != file_checksum(path):
            raise InputError(f"{path}: was changed or copied here; expected the metrics of its run")
    return metrics


def read_answer(folder: str | Path) -> list[str]:
    """The answer of the run in a folder, see `lidar_mi.assessment.report.answer`.

    Empty: not complete, or of an earlier version.
    """
    path = Path(folder) / SUMMARY
    return read_text(path, "the summary of a run").splitlines() if path.is_file() else []


def read_study(
    folder: str | Path,
) -> tuple[str, dict[str, dict[str, Any] | None], dict[str, dict[str, float]]]:
    """The contents of a study's folder.

    Raises InputError: a file in it that was not written by a study.

    Returns
    -------
    name : str
        Of the study.
    records : dict
        By variant, as of `read_record`; None: not run yet.
    metrics : dict
        By variant; of those that are done.
    """
    folder = Path(folder)
    try:
        record = read_yaml(folder / STUDY, "a study's record")
        name, variants = str(record["name"]), [str(key) for key in record["variants"]]
        if not all(re.fullmatch(NAME, key) for key in variants):
            raise KeyError("variants")
    except (InputError, TypeError, KeyError):
        raise InputError(f"{folder / STUDY}: not written by a study; expected its folder") from None
    started = {key: (folder / key / RECORD).is_file() for key in variants}
    records = {key: read_record(folder / key) if started[key] else None for key in variants}
    metrics = {key: read_metrics(folder / key) for key in variants}
    return name, records, {key: numbers for key, numbers in metrics.items() if numbers is not None}


def answers(folder: str | Path) -> list[tuple[str, list[str]]]:
    """Answers of the variants in a study's folder, or of a run's own, with an empty name."""
    folder = Path(folder)
    if not (folder / STUDY).is_file():
        return [("", read_answer(folder))]
    _, records, _ = read_study(folder)
    return [(variant, read_answer(folder / variant)) for variant in records]


def failure(folder: str | Path) -> str | None:
    """The error that ended the last run in a folder; None: none, or it was only stopped."""
    return log.failure(Path(folder) / LOG)


def file_checksum(path: Path) -> str:
    """SHA-256 of a file as it is now."""
    status = path.stat()
    return _checksum_of(path, status.st_size, status.st_mtime_ns)


@functools.lru_cache(64)
def _checksum_of(path: Path, size: int, changed: int) -> str:
    """Checksum of a file in this state: many runs of one process read the same file."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


def _is_number(value: object) -> bool:
    return isinstance(value, float) or (isinstance(value, int) and abs(value) < 2**63)
