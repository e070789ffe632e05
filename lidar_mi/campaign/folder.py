"""The folder of a campaign: its description, its points, images that points share.

The state of a campaign is that of its files: a point is done when its folder has `metrics.json`.
A process that is killed leaves no such file, and its point is done again.
"""

import shutil
from collections.abc import Iterable, Mapping, Sequence
from contextlib import AbstractContextManager, suppress
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

from lidar_mi import __version__
from lidar_mi.campaign.description import Campaign, checked_campaign
from lidar_mi.campaign.points import Points
from lidar_mi.errors import InputError
from lidar_mi.experiment.folder.records import METRICS
from lidar_mi.experiment.folder.run_folder import made_by, new_record, refuse_strangers
from lidar_mi.experiment.pipeline import stages_of, storing_stages
from lidar_mi.io.folder import locked, make_folder
from lidar_mi.io.json import read_json, to_json
from lidar_mi.io.text import read_text, write_text
from lidar_mi.io.yaml import read_yaml, to_yaml
from lidar_mi.progress import Notice
from lidar_mi.schema import reading
from lidar_mi.schema.experiment import Experiment
from lidar_mi.schema.shipped import experiment_file

RECORD, INDEX, OUTCOME = "campaign.yaml", "points.txt", "outcome.json"
DATA, REPORT = "campaign.nc", "report.html"
POINTS, IMAGES = "points", "images"
ATTEMPTS = "attempts.txt"
RUN = "run"
"""Run folder in that of a point, with ``keep: everything``."""

_HASH_LENGTH = 20
"""Characters of a hash that name a folder: 80 bits, by which 10^7 points collide with a probability
of 4e-11."""


class Row(NamedTuple):
    """One point in the index: the hash of its settings, inputs and version; those of its images.

    Images have one for each of `lidar_mi.experiment.pipeline.storing_stages`.
    """

    point: str
    images: tuple[str, ...]


class Outcome(NamedTuple):
    """The outcome of a point: "done" or "failed", why, seconds by step, and how many images."""

    status: str
    message: str
    seconds: dict[str, float]
    rendered: int
    reused: int


@dataclass(frozen=True)
class CampaignFolder:
    """A campaign's folder, with the points that its record describes."""

    path: Path
    points: Points

    @property
    def campaign(self) -> Campaign:
        """The description."""
        return self.points.campaign

    @cached_property
    def index(self) -> list[Row]:
        """A row for each point, by its number."""
        path = self.path / INDEX
        rows = []
        for line in read_text(path, "the index of a campaign").splitlines():
            point, *images = line.split()
            rows.append(Row(point, tuple(images)))
        if len(rows) != len(self.points):
            raise InputError(
                f"{path}: {len(rows)} points; expected {len(self.points)}, as {RECORD} describes"
            )
        return rows

    def place(self, number: int) -> Path:
        """Folder of a point."""
        name = self.index[number].point
        return self.path / POINTS / name[:2] / name

    def images(self, signature: str) -> Path:
        """Folder of images of one signature."""
        return self.path / IMAGES / signature[:_HASH_LENGTH]

    def metrics(self, number: int) -> dict[str, float | None] | None:
        """Metrics of a point; None: there are none yet, or their file is damaged."""
        return _read_mapping(self.place(number) / METRICS, "metrics of a point")

    def is_done(self, number: int) -> bool:
        """Whether a point's metrics are there and whole."""
        return self.metrics(number) is not None

    def outcome(self, number: int) -> Outcome | None:
        """The outcome of a point; None: there is none yet."""
        return read_outcome(self.place(number))

    def drop_images(self, signature: str) -> None:
        """Remove images that no point needs any more."""
        shutil.rmtree(self.images(signature), ignore_errors=True)
        with suppress(OSError):  # the folder holds images of other signatures
            (self.path / IMAGES).rmdir()

    def claimed(self) -> AbstractContextManager[None]:
        """Lock the folder for the one process that hands out its points."""
        return locked(self.path)


def _read_mapping(path: Path, expected: str) -> dict[str, Any] | None:
    """Content of a JSON file; None: missing or torn, so that its point is computed again."""
    try:
        content = read_json(path, expected) if path.is_file() else None
    except InputError:
        return None
    return content if isinstance(content, dict) else None


def read_outcome(place: Path) -> Outcome | None:
    """The outcome of the point in a folder; None: there is none yet, or its file is damaged."""
    path = place / OUTCOME
    content = _read_mapping(path, "outcome of a point")
    if content is None:
        return None
    try:
        return Outcome(**content)
    except TypeError:
        raise InputError(f"{path}: was not written by a campaign; expected its outcome") from None


def write_outcome(place: Path, outcome: Outcome) -> None:
    """Write the outcome of a point."""
    write_text(place / OUTCOME, to_json(outcome._asdict()))


def read_base(campaign: Campaign, origin: str | Path) -> tuple[dict[str, Any], Path]:
    """Keys of the base experiment and the folder of its file.

    Raises InputError: no such experiment; one with variants.
    """
    neighbour = Path(origin).parent / campaign.base
    path = neighbour if neighbour.is_file() else experiment_file(campaign.base)
    base = dict(reading.read_keys(path))
    variants = base.pop("variants", None)
    if variants and "variant" not in campaign.sweep:
        raise InputError(
            f"{origin}: base: {campaign.base} has variants; expected an experiment without, or the "
            "campaign of its variants: lidar-mi campaign run " + str(campaign.base)
        )
    # a name in the base names only its run
    return base, path.parent.resolve()


def create(points: Points, folder: str | Path, notice: Notice) -> CampaignFolder:
    """The folder of a campaign, with its record and index; an existing one of the same campaign.

    Every point's settings are checked before anything is written.

    Raises InputError: a point that is no experiment, two that are equal, the folder of another
    campaign.
    """
    folder = Path(folder)
    record = _record(points)
    refuse_strangers(folder, RECORD, "campaign's folder")
    if (folder / RECORD).is_file():
        existing = open_folder(folder)
        old = read_yaml(folder / RECORD, "the record of a campaign")
        changed = next((key for key, value in record.items() if old.get(key) != value), None)
        if changed:
            text = f"version {old.get(changed)}" if changed == "version" else f"another {changed}"
            raise InputError(
                f"{folder}: holds a campaign with {text}; expected another folder (-o DIR)"
            )
        return existing
    rows = _checked(points, notice)
    make_folder(folder)
    # the record last: with it the folder is that of a campaign
    lines = [" ".join((row.point, *row.images)) for row in rows]
    write_text(folder / INDEX, "\n".join(lines) + "\n")
    write_text(folder / RECORD, to_yaml(record))
    return CampaignFolder(folder, points)


def open_folder(folder: str | Path) -> CampaignFolder:
    """The folder of an existing campaign."""
    folder = Path(folder)
    path = folder / RECORD
    if not path.is_file():
        raise InputError(f"{folder}: no {RECORD} in it; expected the folder of a campaign")
    record = read_yaml(path, "the record of a campaign")
    try:
        campaign = checked_campaign(record["campaign"], str(path))
        points = Points(campaign, dict(record["base"]), record["beside"])
    except (TypeError, KeyError):
        raise InputError(f"{path}: not written by a campaign; expected its record") from None
    return CampaignFolder(folder, points)


def check_version(folder: CampaignFolder) -> None:
    """Refuse to compute points of another version's campaign.

    Raises InputError: results of two versions must not be mixed.
    """
    version = read_yaml(folder.path / RECORD, "the record of a campaign")["version"]
    if version != __version__:
        raise InputError(
            f"{folder.path}: a campaign of lidar-mi {version}; expected that version, this is "
            f"{__version__}"
        )


def _record(points: Points) -> dict[str, Any]:
    return {
        "campaign": points.campaign.model_dump(mode="json", exclude_defaults=True),
        "base": points.base,
        "beside": str(points.search_path),
        "version": __version__,
    }


def _checked(points: Points, notice: Notice) -> list[Row]:
    """The index of all points; each is a valid experiment, and no two are equal."""
    _check_keys(points)
    first: dict[str, int] = {}
    rows = []
    for number in range(len(points)):
        if number % 100 == 0:
            notice(f"checking {len(points)} points", number / len(points))
        experiment = points.experiment(number)
        row = _row(experiment, points.search_path)
        if row.point in first:
            raise InputError(
                f"{_differing(points, first[row.point], number)}: changes nothing between "
                f"{points.title(first[row.point])} and {points.title(number)}; expected points "
                "that differ"
            )
        first[row.point] = number
        rows.append(row)
    return rows


def _row(experiment: Experiment, search_path: Path) -> Row:
    record = new_record(experiment, search_path)
    graph = stages_of(experiment)
    images = [made_by(record, graph.keys(stage)) for stage in storing_stages(graph)]
    return Row(made_by(record)[:_HASH_LENGTH], tuple(images))


def _check_keys(points: Points) -> None:
    """Keys that vary must be keys of the base experiment."""
    settings = reading.settings(reading.check(points.base, points.campaign.base))
    for dimension in points.dimensions:
        for key in dimension.changes[0] if not dimension.named else ():
            section = key.rpartition(".")[0]
            inside = _section(settings, section)
            if inside is None:
                raise InputError(
                    f"sweep.{key}: not allowed, as {points.campaign.base} has no section "
                    f"{section}; expected a key of it, or the section under set"
                )


def _section(settings: Mapping[str, Any], key: str) -> Mapping[str, Any] | None:
    for part in key.split(".") if key else ():
        section = settings.get(part)
        if not isinstance(section, Mapping):
            return None
        settings = section
    return settings


def _differing(points: Points, first: int, second: int) -> str:
    """The first dimension in which two points differ, as a key of the description."""
    pairs = zip(points.index(first), points.index(second), strict=True)
    names = [f"sweep.{dimension.name}" for dimension in points.dimensions] + ["members"]
    return next(name for name, (a, b) in zip(names, pairs, strict=True) if a != b)


def signatures(rows: Sequence[Row], numbers: Iterable[int]) -> dict[str, int]:
    """How many of some points need the images of each signature."""
    counts: dict[str, int] = {}
    for number in numbers:
        for signature in rows[number].images:
            counts[signature] = counts.get(signature, 0) + 1
    return counts
