"""Beams in time: the schedule of a scan, flown along the platform's true and reported motion."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from lidar_mi.errors import InputError
from lidar_mi.instrument.beams import Beams, Targets, steered_beams
from lidar_mi.instrument.doppler import DopplerLidar
from lidar_mi.instrument.motion import ANGLES, PLACES, Motion, Pose, trajectory, true_pose
from lidar_mi.instrument.reported import Reported, reported_pose
from lidar_mi.instrument.scan import Scan, ScanPlan
from lidar_mi.instrument.scan_timing import Directions, ScanTiming, Schedule
from lidar_mi.io.timed_table import read_timed_table
from lidar_mi.schema.experiment import Experiment
from lidar_mi.schema.input_files import find_file
from lidar_mi.schema.platform import Platform
from lidar_mi.schema.sensor import Sensor


def is_steady(platform: Platform) -> bool:
    """Whether the platform flies straight and its pose is known."""
    return (platform.motion or Motion()) == Motion() and (
        platform.reported or Reported()
    ) == Reported()


def timed_plans(
    scan: Scan, platform: Platform, seed: int, plans: Sequence[ScanPlan], search_path: Path
) -> list[ScanPlan]:
    """The plans of both scans with their beams; as they are where nothing takes time or moves.

    Raises InputError: a table or trajectory that cannot be used, a scan longer than the time
    between the scans, a scanner beyond its limits, a pose from which the slab is not reached.
    """
    if (scan.timing is None or scan.timing.is_instant) and is_steady(platform):
        return list(plans)
    by_angle = scan.aim == "angles"
    pose_at = _poses(platform, seed, search_path)
    timed = []
    for number, plan in enumerate(plans):
        schedule = scan_schedule(scan, plan, search_path)
        _fits("scan.timing", schedule, platform.dt, "platform.dt")
        # a stream for each scan: what one draws does not depend on the other
        jitter = np.random.default_rng([seed, 3, 4, number + 1])
        targets = Targets(
            schedule.time, schedule.places, plan.centre, plan.position, body_fixed=by_angle
        )
        beams = _beams(targets, scan, platform, seed, pose_at, number, jitter)
        timed.append(replace(plan, beams=beams))
    return timed


def scan_schedule(scan: Scan, plan: ScanPlan, search_path: Path) -> Schedule:
    """Times and nominal places of the beams of a scan of the backscatter lidar."""
    return _schedule(
        scan.timing, "scan.timing", plan.y, plan.z, plan.centre, scan.aim == "angles", search_path
    )


def pulse_train(scan: Scan, plan: ScanPlan, search_path: Path) -> tuple[int, float]:
    """Pulses of a beam and their rate while they are sent, Hz; a rate of 0 is not known."""
    if scan.timing is None:
        return 1, 0.0
    pulses = scan.pulses_per_beam
    rate = pulses * scan_schedule(scan, plan, search_path).beam_rate
    return pulses, rate if np.isfinite(rate) else 0.0


def lines_schedule(sensor: Sensor, doppler_lidar: DopplerLidar, search_path: Path) -> Schedule:
    """Times of the Doppler lidar's lines of sight, and their places in the plane of its range."""
    distance = doppler_lidar.range
    y, z = (distance * nodes for nodes in sensor.directions.nodes())
    return _schedule(sensor.timing, "sensor.timing", y, z, distance, True, search_path)


def line_beams(
    sensor: Sensor,
    doppler_lidar: DopplerLidar,
    scan: Scan,
    platform: Platform,
    seed: int,
    search_path: Path,
) -> Beams | None:
    """Beams of the Doppler lidar's lines of sight, about the first scan's reference time.

    None where nothing takes time or moves.
    """
    if (sensor.timing is None or sensor.timing.is_instant) and is_steady(platform):
        return None
    schedule = lines_schedule(sensor, doppler_lidar, search_path)
    _fits("sensor.timing", schedule, 1 / sensor.slabs_per_second, "1 / sensor.slabs_per_second")
    # of a scanner of its own
    jitter = np.random.default_rng([seed, 3, 5, 1])
    pose_at = _poses(platform, seed, search_path)
    targets = Targets(schedule.time, schedule.places, doppler_lidar.range, body_fixed=True)
    return _beams(targets, scan, platform, seed, pose_at, 0, jitter)


def timing_files(experiment: Experiment, search_path: str | Path) -> dict[str, Path]:
    """Files of directions and of the trajectory, by the keys that name them."""
    motion, sensor = experiment.platform.motion, experiment.sensor
    named = {
        "scan.timing.table": experiment.scan.timing and experiment.scan.timing.table,
        "sensor.timing.table": sensor and sensor.timing and sensor.timing.table,
        "platform.motion.trajectory": motion and motion.trajectory,
    }
    return {key: find_file(name, search_path, key) for key, name in named.items() if name}


def _schedule(
    timing: ScanTiming | None,
    key: str,
    y: np.ndarray,
    z: np.ndarray,
    distance: float,
    by_angle: bool,
    search_path: Path,
) -> Schedule:
    if timing is None:
        # only the platform moves: all beams at the reference time
        timing = ScanTiming(pattern="serpentine", duration=0.0)
    table = _directions(timing.table, f"{key}.table", search_path) if timing.table else None
    try:
        return timing.schedule(y, z, distance, by_angle=by_angle, table=table)
    except InputError as error:
        raise InputError(f"{key}.{error}") from None


def _directions(name: str, key: str, search_path: Path) -> Directions:
    path = find_file(name, search_path, key)
    columns = read_timed_table(path, {"azimuth": "rad", "elevation": "rad"})
    for missing in {"azimuth", "elevation"} - set(columns):
        raise InputError(f"{path}: {missing} missing; expected columns t, azimuth, elevation")
    return Directions(columns["t"], columns["azimuth"], columns["elevation"], path.name)


def _fits(key: str, schedule: Schedule, interval: float, name: str) -> None:
    # rounding may put an equal duration above the interval
    if schedule.duration > interval * (1 + 1e-9):
        raise InputError(
            f"{key}: a scan of {schedule.duration:.4g} s is not allowed; expected at most "
            f"{name} = {interval:g} s, when the next one begins"
        )


def _poses(platform: Platform, seed: int, search_path: Path) -> Callable[[np.ndarray], Pose]:
    """The true pose at times since the first scan's reference time."""
    motion = platform.motion or Motion()
    recorded = None
    if motion.trajectory:
        key = "platform.motion.trajectory"
        path = find_file(motion.trajectory, search_path, key)
        columns = read_timed_table(path, dict.fromkeys(PLACES, "m") | dict.fromkeys(ANGLES, "rad"))
        recorded = trajectory(columns, platform.speed, path.name)
        _flies(platform, columns, path.name)

    def pose_at(time: np.ndarray) -> Pose:
        try:
            return true_pose(motion, time, platform.speed, seed, recorded)
        except InputError as error:
            raise InputError(f"platform.motion.trajectory: {error}") from None

    return pose_at


def _flies(platform: Platform, columns: dict[str, np.ndarray], source: str) -> None:
    """Refuse a trajectory along x at another speed than the platform's, by which the gates go."""
    if "x" not in columns:
        return
    time, x = columns["t"], columns["x"]
    mean = float((x[-1] - x[0]) / (time[-1] - time[0]))
    if abs(mean - platform.speed) > 1 + 0.05 * platform.speed:
        raise InputError(
            f"platform.motion.trajectory: {source} flies at {mean:.4g} m/s along x; expected "
            f"platform.speed = {platform.speed:g} m/s to 5 % and 1 m/s, or no column x"
        )


def _beams(
    targets: Targets,
    scan: Scan,
    platform: Platform,
    seed: int,
    pose_at: Callable[[np.ndarray], Pose],
    number: int,
    random: np.random.Generator,
) -> Beams:
    # both scans are of one flight, whose zero is the first one's reference time
    clock = number * platform.dt + targets.time
    true = reported = pose_at(clock)
    if platform.reported is not None and platform.reported != Reported():
        reported = reported_pose(platform.reported, pose_at, clock, platform.speed, seed, number)
    try:
        return steered_beams(
            targets,
            # in the frame of the air, in which the gates stay
            platform.speed - scan.follow,
            true,
            reported,
            jitter=platform.motion.scanner_jitter if platform.motion else 0.0,
            random=random,
        )
    except InputError as error:
        raise InputError(f"platform.motion: {error}") from None
