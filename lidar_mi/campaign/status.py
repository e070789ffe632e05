"""How far a campaign is, from its files alone."""

from collections import defaultdict
from dataclasses import dataclass, field
from pathlib import Path

from lidar_mi.campaign.folder import ATTEMPTS, CampaignFolder, Outcome, open_folder
from lidar_mi.tables import Table, Tabular


@dataclass(repr=False)
class Status(Tabular):
    """Counts of a campaign's points and images.

    total, done, failed, running: points; ``running`` ones have started and not ended, or were
        killed.
    rendered, reused: images.
    seconds: time in each step, summed over points; 0 where there is none.
    failures: a failed point's values, its message, its folder.
    """

    name: str
    total: int
    done: int = 0
    failed: int = 0
    running: int = 0
    rendered: int = 0
    reused: int = 0
    seconds: defaultdict[str, float] = field(default_factory=lambda: defaultdict(float))
    failures: list[tuple[str, str, str]] = field(default_factory=list)

    def add(self, outcome: Outcome) -> None:
        """Count a point that has ended."""
        self.done += outcome.status == "done"
        self.failed += outcome.status == "failed"
        self.rendered += outcome.rendered
        self.reused += outcome.reused
        for step, value in outcome.seconds.items():
            self.seconds[step] += value

    @property
    def finished(self) -> int:
        """Points that are done or failed."""
        return self.done + self.failed

    def remaining(self) -> float:
        """Processor time of the points that are not finished, at the mean of those that are, s."""
        mean = self.seconds["total"] / self.finished if self.finished else float("nan")
        return mean * (self.total - self.finished)

    def slowest(self) -> str:
        """The step that takes most of the time; empty: not known."""
        steps = {step: value for step, value in self.seconds.items() if step != "total"}
        return max(steps, key=lambda step: steps[step]) if steps else ""

    def tables(self) -> list[Table]:
        """Counts, and what failed."""
        rows = [
            ("points", str(self.total)),
            ("done", str(self.done)),
            ("failed", str(self.failed)),
            ("running or interrupted", str(self.running)),
            ("images rendered", str(self.rendered)),
            ("images re-used", str(self.reused)),
        ]
        if self.finished:
            mean = self.seconds["total"] / self.finished
            rows.append(("time of a point", f"{mean:.3g} s, most of it: {self.slowest()}"))
        if self.finished and self.finished < self.total:
            rows.append(
                ("time left", f"{self.remaining():.3g} s, divided by the number of workers")
            )
        tables = [Table(f"campaign {self.name}", rows)]
        if self.failures:
            heads = ("failed point", "message", "folder")
            tables.append(Table("", self.failures[:20], heads))
        return tables


def campaign_status(folder: str | Path) -> Status:
    """How far the campaign in a folder is; also while it runs."""
    opened = open_folder(folder)
    status = Status(opened.campaign.name, len(opened.points))
    for number in range(status.total):
        count(opened, number, status)
    return status


def count(folder: CampaignFolder, number: int, status: Status) -> None:
    """Add the outcome of a point to a status."""
    place = folder.place(number)
    outcome = folder.outcome(number)
    if folder.is_done(number):
        status.add(outcome or Outcome("done", "", {}, 0, 0))
    # before the outcome: a failed point that is tried again has both files
    elif (place / ATTEMPTS).is_file():
        status.running += 1
    elif outcome is not None:
        status.add(outcome)
        if outcome.status == "failed":
            where = str(place.relative_to(folder.path))
            status.failures.append((folder.points.title(number), outcome.message, where))
