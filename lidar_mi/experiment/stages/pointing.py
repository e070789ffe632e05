"""Where the beams of both scans are, and where they are reported."""

from collections.abc import Sequence

from lidar_mi.assessment.metrics.pointing import ScanPointing, scan_pointing
from lidar_mi.instrument.scan import ScanPlan
from lidar_mi.schema.platform import Platform


def beam_pointing(platform: Platform, plans: Sequence[ScanPlan]) -> ScanPointing | None:
    """Times, places and pointing errors of the beams; None: all at once, from known poses."""
    timed = [(plan, plan.beams) for plan in plans if plan.beams is not None]
    if not timed:
        return None
    # the middle of the gates, in the frame of the air
    middles = [plan.position + plan.centre for plan, _ in timed]
    return scan_pointing(
        plans[0].y,
        plans[0].z,
        platform.dt,
        [beams.time for _, beams in timed],
        [beams.true_places(x) for (_, beams), x in zip(timed, middles, strict=True)],
        [beams.reported_places(x) for (_, beams), x in zip(timed, middles, strict=True)],
    )
