"""Cost of both lidars: pulses, power, simultaneous beams, distances from which eyes are safe."""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import xarray as xr

from lidar_mi.assessment.metrics.requirements import RequirementTable
from lidar_mi.experiment.stages.timed_beams import lines_schedule, pulse_train
from lidar_mi.instrument.doppler import DopplerLidar, photons
from lidar_mi.instrument.eye_safety import PulsedBeam, assess_pulses
from lidar_mi.instrument.lidar import BackscatterLidar
from lidar_mi.instrument.pulse_budget import pulse_budget, pulses_for_error
from lidar_mi.instrument.scan import Scan, plan_scans
from lidar_mi.schema.platform import Platform
from lidar_mi.schema.sensor import Sensor

if TYPE_CHECKING:
    from lidar_mi.assessment.metrics.sensor import LidarCost


def lidar_costs(
    sensor: Sensor,
    doppler_lidar: DopplerLidar,
    lidar: BackscatterLidar,
    scan: Scan,
    platform: Platform,
    slab_wind: xr.Dataset,
    search_path: Path,
) -> "dict[str, LidarCost]":
    """Cost of the scans of "doppler" and "backscatter", at the pulse rates of their timing."""
    from lidar_mi.assessment.metrics.sensor import LidarCost

    doppler = doppler_lidar
    far = float(sensor.directions.ranges(doppler).max()) + doppler.range_bin / 2
    directions = sensor.directions.columns * sensor.directions.rows
    rate = sensor.slabs_per_second
    line_rate = sensor.pulses * lines_schedule(sensor, doppler, search_path).beam_rate
    lines = pulse_budget(
        directions,
        rate,
        sensor.pulses,
        doppler.pulse_energy,
        far,
        photons(doppler),
        directions * sensor.pulses / line_rate if math.isfinite(line_rate) else None,
    )
    plan = plan_scans(scan, slab_wind["y"].values, slab_wind["z"].values, (0.0,))[0]
    pulses, pulse_rate = pulse_train(scan, plan, search_path)
    beams, slabs = len(plan.y) * len(plan.z), 1 / platform.dt
    images = pulse_budget(
        beams,
        slabs,
        pulses,
        lidar.pulse_energy,
        float((plan.ranges()[-1] + plan.gate_length() / 2).max()),
        sending=beams * pulses / pulse_rate if pulse_rate else None,
    )
    radius = float(lidar.radius_at(0))
    safe = (
        _eye_safety(
            doppler,
            doppler.beam_radius,
            sensor.pulses * rate,
            sensor.exposure,
            (sensor.pulses, line_rate if math.isfinite(line_rate) else 0.0),
        ),
        _eye_safety(lidar, radius, pulses * rate, sensor.exposure, (pulses, pulse_rate)),
    )
    return {
        "doppler": LidarCost(
            lines.pulses_per_second,
            lines.average_power,
            lines.beams,
            lines.photons_per_direction,
            **safe[0],
        ),
        "backscatter": LidarCost(
            images.pulses_per_second, images.average_power, images.beams, **safe[1]
        ),
    }


def pulses_needed(
    sensor: Sensor, requirements: Mapping[tuple[str, str], RequirementTable], lines: xr.Dataset
) -> int | None:
    """Pulses per direction for the smallest required error of v_LOS; None: none is required."""
    rows = (row for table in requirements.values() for row in table.rows)
    limits = [r.maximum for r in rows if r.quantity == "error_v_los" and math.isfinite(r.maximum)]
    stated = lines["v_los_std"].where(lines["v_los"].notnull(), drop=True)
    if not limits or not stated.size:
        return None
    # the error of a single pulse: that of a mean of n pulses is 1 / sqrt(n) of it
    one = math.sqrt(sensor.pulses * float((stated.values**2).mean()))
    return pulses_for_error(one, min(limits))


def _eye_safety(
    beam: BackscatterLidar | DopplerLidar,
    radius: float,
    rate: float,
    exposure: float,
    burst: tuple[float, float],
) -> dict[str, float]:
    """Limits of one beam, by the names of `LidarCost`; none for pulses without a duration."""
    if not beam.pulse_duration > 0:
        return {}
    pulsed = PulsedBeam(
        beam.wavelength, beam.pulse_energy, beam.pulse_duration, radius, beam.divergence_full
    )
    safety = assess_pulses(pulsed, rate, exposure, burst=burst)
    # metrics are JSON, which has no infinity
    distances = {
        name: getattr(safety, name)
        for name in ("hazard_distance", "aided_hazard_distance")
        if math.isfinite(getattr(safety, name))
    }
    return {"permissible_exposure": safety.limit.exposure} | distances
