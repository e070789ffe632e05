"""Eye safety of the backscatter lidar's beams."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from lidar_mi.assessment.metrics.safety import ScanSafety
from lidar_mi.experiment.stages.timed_beams import pulse_train
from lidar_mi.instrument.eye_safety import PulsedBeam, assess_pulses, scan_hazard_distance
from lidar_mi.instrument.lidar import BackscatterLidar
from lidar_mi.instrument.scan import Scan, ScanPlan
from lidar_mi.schema.platform import Platform
from lidar_mi.schema.sensor import Sensor

EXPOSURE = 10.0
"""Time of exposure to the beams, s, unless given by the sensor."""


def scan_safety(
    lidar: BackscatterLidar,
    scan: Scan,
    platform: Platform,
    sensor: Sensor | None,
    plans: Sequence[ScanPlan],
    search_path: Path,
) -> ScanSafety | None:
    """Distances from which eyes are safe; None: pulses have no duration, so that no limit applies.

    Every direction has its pulses each ``platform.dt``, at the rate of ``scan.timing``.
    """
    plan, rate = plans[0], 1 / platform.dt
    if lidar.pulse_duration == 0:
        return None
    burst = pulse_train(scan, plan, search_path)
    exposure = sensor.exposure if sensor else EXPOSURE
    beam = PulsedBeam(
        lidar.wavelength,
        lidar.pulse_energy,
        lidar.pulse_duration,
        float(lidar.radius_at(0)),
        lidar.divergence_full,
    )
    one = assess_pulses(beam, rate * burst[0], exposure, burst=burst)
    spacing = float(np.mean([np.diff(plan.y).mean(), np.diff(plan.z).mean()])) / plan.centre
    beams = len(plan.y) * len(plan.z)
    return ScanSafety(
        permissible_exposure=one.limit.exposure,
        hazard_distance=one.hazard_distance,
        aided_hazard_distance=one.aided_hazard_distance,
        scan_hazard_distance=scan_hazard_distance(beam, spacing, beams, rate, exposure, burst),
        scan_power=lidar.pulse_energy * beams * burst[0] * rate,
    )
