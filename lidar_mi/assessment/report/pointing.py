"""The chapter of a report on the time that scans take and on the poses of their beams."""

from collections.abc import Mapping, Sequence

from lidar_mi.assessment.digits import three
from lidar_mi.assessment.figures.panels import Drawn
from lidar_mi.assessment.report.page import Chapter, Tables


def pointing_chapter(metrics: Mapping[str, float], drawn: Sequence[Drawn]) -> Chapter:
    """Beam times and pointing in words, as a figure and as a table."""
    lead = [f"The beams of a scan are sent in {1e3 * metrics['pointing.scan_time']:.3g} ms."]
    far = max(metrics["pointing.rms_y"], metrics["pointing.rms_z"])
    if far > 0:
        v, w = metrics["pointing.bias_v"], metrics["pointing.bias_w"]
        lead.append(
            f"In the slab the beams are up to {100 * far:.2g} cm (rms along an axis) from their "
            f"reported places. The difference between the scans adds {v:+.2g} m/s to v and "
            f"{w:+.2g} m/s to w of all vectors."
        )
    rows = [
        ("rms of true less reported place", "m", "rms_y", "rms_z"),
        ("mean apparent wind", "m/s", "bias_v", "bias_w"),
        ("rotation of the apparent wind", "rad/s", "rotation"),
    ]
    table = [
        (name, unit, [three(metrics[f"pointing.{key}"]) for key in keys])
        for name, unit, *keys in rows
    ]
    numbers = Tables(
        heading="Pointing",
        legend="Errors of the reported poses in the plane in the middle of the gates, and what "
        "their difference between the two scans adds to the wind.",
        tables=[("both scans", ("y", "z"), table)],
    )
    return Chapter("Scan time and pointing", lead, drawn, numbers)
