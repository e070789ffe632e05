"""The part of a report that compares a sensor with the requirements of flight control."""

from lidar_mi.assessment.metrics.requirements import Judged, as_rows, fulfilled
from lidar_mi.assessment.report.page import Tables

_VERDICTS = {True: "fulfilled", False: "not fulfilled", None: "not judged in all rows"}


def compliance(judged: Judged, speed: float, legend: str) -> Tables | None:
    """Tables of the phases that are flown at an air speed (m/s), row by row; None: there are none.

    The legend says how the sensor's properties were measured.
    """
    flown = [table for table in judged if table[0].applies_at(speed)]
    if not flown:
        return None
    of_flight = " of flight control" if speed else ""
    return compared(
        f"Compliance with the requirements{of_flight}",
        f"{legend} A margin is the distance from the limit, as a fraction of it. Phases of flight "
        "at another air speed are not assessed.",
        flown,
    )


def compared(heading: str, legend: str, judged: Judged) -> Tables:
    """A table of every phase, row by row, with its verdict as the title."""
    tables = [
        (
            f"{table.title}, {table.phase}: {_VERDICTS[fulfilled(findings)]}",
            ["verdict", "measured", "required", "margin"],
            [
                (name, "", (verdict, measured, required, margin))
                for name, required, measured, margin, verdict in as_rows(findings)
            ],
        )
        for table, findings in judged
    ]
    return Tables(heading, legend, tables)
