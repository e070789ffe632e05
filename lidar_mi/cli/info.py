"""``lidar-mi info``: contents of a file or a folder of results, properties of a scatterer."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from lidar_mi.cli.options import complete_contents, quantity
from lidar_mi.cli.terminal import output, print_answer, print_rows, print_table
from lidar_mi.progress import progress
from lidar_mi.tables import Table

if TYPE_CHECKING:
    from lidar_mi.experiment.describe import Section

CAMPAIGN = "campaign.yaml"
"""Record in the folder of a campaign."""

COLLECTED = "campaign.nc"
"""Its data set."""

EXAMPLES = (
    "lidar-mi info outputs/wake_backscatter",
    "lidar-mi info image_t1.exr",
    "lidar-mi info spheroids",
    "lidar-mi info molecules --wavelength '355 nm' --altitude '8500 m'",
)


def info(
    what: Annotated[
        str,
        typer.Argument(
            help="EXR or NetCDF file, lines of sight (.hpl, .csv) or scattering table (.txt), "
            "folder of a run, of variants or of a campaign, or a name: molecules, spheroids, "
            "spheres, continental, sea_salt, dust, droplets, soot.",
            autocompletion=complete_contents,
        ),
    ],
    wavelength: Annotated[
        str | None, typer.Option(help="Of a named scatterer. Default: 532 nm.")
    ] = None,
    altitude: Annotated[
        str | None, typer.Option(help="Of molecules, in the standard atmosphere. Default: 0 m.")
    ] = None,
) -> None:
    """Show the contents of a file or a folder of results, or the scattering by an aerosol or air.

    Of scatterers: extinction and backscatter coefficient with the number of particles,
    single-scattering albedo, lidar ratio, depolarisation ratio.
    """
    from lidar_mi.experiment.describe import sections

    if (Path(what) / CAMPAIGN).is_file():
        from lidar_mi.campaign.status import campaign_status

        for table in campaign_status(what).tables():
            print_table(table)
        if (Path(what) / COLLECTED).is_file():
            from lidar_mi.campaign.report import campaign_answer

            print_answer([campaign_answer(what)])
        return
    with progress() as notice:
        tables = list(
            sections(
                what,
                quantity("--wavelength", wavelength, "m", "532 nm"),
                quantity("--altitude", altitude, "m", "8500 m"),
                notice,
            )
        )
    folder = Path(what)
    if folder.is_dir():
        _show_folder(folder, tables)
        return
    for title, rows in tables:
        print_rows(title, rows)


def _show_folder(folder: Path, tables: Sequence["Section"]) -> None:
    """The answer, the contents and the numbers of a run or of a study."""
    from lidar_mi.experiment.folder.records import (
        STUDY,
        answers,
        failure,
        read_metrics,
        read_record,
    )

    reason, metrics = failure(folder), read_metrics(folder)
    if metrics is None and not reason:
        output.print("unfinished: no metrics.json yet; run it again to resume")
    for part, answer in answers(folder):
        if part:
            output.print(f"\n{part}", style="bold")
        print_answer(answer)
    for title, rows in tables:
        print_rows(title, rows)
    if reason:
        output.print(f"failed: {reason}", soft_wrap=True)
    elif metrics is not None and not (folder / STUDY).is_file():
        for table in _results(folder, metrics, read_record(folder)["experiment"]):
            print_table(table)
    if (folder / STUDY).is_file() and not reason:
        output.print(f"more of a variant: lidar-mi info {folder}/VARIANT", soft_wrap=True)


def _results(
    folder: Path, metrics: Mapping[str, float], experiment: Mapping[str, Any]
) -> list[Table]:
    """The numbers of a flight or of a run."""
    from lidar_mi.experiment.describe import value_at

    if value_at(experiment, "encounter") is not None:
        from lidar_mi.assessment.metrics.encounter import CONTROLLER
        from lidar_mi.assessment.report.encounter import encounter_summary
        from lidar_mi.experiment.export_flight import FLIGHT_FILES
        from lidar_mi.io.netcdf import read_netcdf

        flights = folder / FLIGHT_FILES["series"]
        about = read_netcdf(flights).attrs if flights.is_file() else {}
        return encounter_summary(metrics, about.get(CONTROLLER, ""))
    from lidar_mi.assessment.report.summary import summary

    numbers = value_at(experiment, "doppler.retrieval.averaged")
    averaged = [n for n in numbers if isinstance(n, int)] if isinstance(numbers, list) else ()
    return summary(metrics, averaged)
