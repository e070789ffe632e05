"""The report of a campaign, from its data set."""

from collections.abc import Sequence
from pathlib import Path

from lidar_mi.assessment.report.campaign import answer, page
from lidar_mi.campaign.collect import open_campaign
from lidar_mi.campaign.folder import RECORD, REPORT, open_folder
from lidar_mi.io.text import read_text, write_text


def campaign_answer(folder: str | Path) -> str:
    """The first sentences of a campaign's report."""
    return answer(open_campaign(open_folder(folder).path))


def write_report(folder: str | Path, metrics: Sequence[str] | None = None) -> Path:
    """Write ``report.html`` of a campaign; returns its path.

    metrics: names of those to show. Default: errors, requirements and vortices.

    Raises InputError: no campaign in the folder, or no such metric.
    """
    opened = open_folder(folder)
    data = open_campaign(opened.path)
    resolved = read_text(opened.path / RECORD, "the record of a campaign")
    path = opened.path / REPORT
    write_text(path, page(data, resolved, metrics))
    return path
