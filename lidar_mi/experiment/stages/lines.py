"""Lines of sight of the Doppler lidar through the slab, each from images of rings."""

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr

from lidar_mi.assessment.metrics.requirements import RequirementTable, read_requirements
from lidar_mi.errors import InputError
from lidar_mi.experiment.graph import bundle
from lidar_mi.experiment.log import Log
from lidar_mi.experiment.stages.line_frames import PULSES, line_frames, line_images
from lidar_mi.experiment.stages.ring_images import Rings
from lidar_mi.experiment.stages.ring_instrument import pixel_noise
from lidar_mi.experiment.stages.ring_reference import (
    drifts,
    plate_error,
    plate_uncertainty,
    reference_frames,
    shared_covariance,
)
from lidar_mi.experiment.stages.ring_velocities import FRAMES, speeds_to_laser
from lidar_mi.experiment.truth.extinction import Truth
from lidar_mi.experiment.truth.flows import Flows
from lidar_mi.experiment.truth.slab import slab_mean
from lidar_mi.instrument.beams import Beams
from lidar_mi.instrument.doppler import DopplerLidar
from lidar_mi.instrument.doppler_scan import PlatformErrors, scan_wind, sight_volumes, wind_of_lines
from lidar_mi.instrument.scan import Scan
from lidar_mi.retrieval.combined.vectors import COMPONENTS
from lidar_mi.retrieval.method_names import RingCentre, RingMethod
from lidar_mi.schema.doppler import Doppler
from lidar_mi.schema.input_files import find_file
from lidar_mi.schema.platform import Platform
from lidar_mi.schema.sensor import Sensor
from lidar_mi.schema.wake import Wake
from lidar_mi.variables import variable

if TYPE_CHECKING:
    from lidar_mi.retrieval.rings.model import PixelNoise


# Selects the random streams of the drifts of the first scan.
_DRIFTS = 1 << 24


@bundle
class LineScan:
    """The lines of sight of the Doppler lidar, and the wind, or its states, that they meet."""

    sensor: Sensor
    doppler: Doppler
    platform: Platform
    seed: int
    states: xr.Dataset
    line_beams: Beams | None

    def true_lines(self, lidar: DopplerLidar, errors: PlatformErrors) -> xr.Dataset:
        """Lines of sight of a lidar with these errors of pointing, without noise: `scan_wind`."""
        return scan_wind(
            self.states,
            self.sensor.directions,
            lidar,
            0.0,
            self.seed,
            self.platform.speed,
            errors,
            self.line_beams,
        )


def requirement_tables(
    sensor: Sensor | None, wake: Wake, platform: Platform, search_path: Path
) -> Mapping[tuple[str, str], RequirementTable]:
    """The tables that the lidars are compared with, as `read_requirements` gives them.

    Raises InputError: a requirement table that is missing or not one.
    """
    path = sensor.requirements if sensor else None
    if path:
        return read_requirements(find_file(path, search_path, "sensor.requirements"))
    # the paper's are those of flight control: they do not apply to a platform at rest
    return read_requirements() if platform.speed else {}


def slab_wind(truth: Truth) -> xr.Dataset:
    """True u, v, w (m s^-1) on (z, y), averaged over the slab; u is 0 in a wake without it."""
    wind = truth.wind
    return wind if "u" in wind else wind.assign(u=xr.zeros_like(wind["v"]))


def states_of_wind(platform: Platform, slab_wind: xr.Dataset, flows: Flows) -> xr.Dataset:
    """The wind that lines of sight meet: that of `slab_wind`, or its states at both images' times.

    Dims (time, z, y) with the times 0 and dt where a wake has a second state.
    """
    if flows[1] is None:
        return slab_wind
    gates = slab_wind.attrs["gates"]
    states = [
        xr.Dataset({n: slab_mean(flow[n], gates) for n in COMPONENTS if n in flow})
        for flow in flows
        if flow is not None
    ]
    states = [s if "u" in s else s.assign(u=xr.zeros_like(s["v"])) for s in states]
    return xr.concat(states, xr.Variable("time", [0.0, platform.dt]))


def check_lines(line_scan: LineScan, scan: Scan, rings: Rings) -> None:
    """Check that both lidars observe the same air, in the Doppler lidar's velocity range.

    Raises InputError: lidars that do not observe the same slab, lines that leave the wake, speeds
    beyond the unambiguous range.
    """
    sensor, states, speed = line_scan.sensor, line_scan.states, line_scan.platform.speed
    reference_frames(sensor.pulses, line_scan.doppler.reference.every, PULSES)
    lidar, beams = line_scan.doppler.lidar, line_scan.line_beams
    middle = scan.range + scan.thickness / 2
    if abs(lidar.range - middle) > lidar.range_bin / 2:
        raise InputError(
            f"doppler.lidar.range: {lidar.range:g} m is not allowed with sensor; expected at most "
            f"half a range bin from the middle of the slab, {middle:g} m: "
            f"{middle - lidar.range_bin / 2:g} to {middle + lidar.range_bin / 2:g} m (set both, "
            "with scan.range)"
        )
    # lines that leave the wake, bins that reach the telescope
    directions = sensor.directions
    try:
        going = directions.directions() if beams is None else beams.direction
        volumes = sight_volumes(going, directions.ranges(lidar, beams), lidar)[0]
        wind_of_lines(states, volumes if beams is None else volumes + beams.origin[:, None])
    except InputError as error:
        raise InputError(f"sensor.directions: {error}") from None
    # a bound for all directions
    fastest = speed + float(np.sqrt(sum(states[n] ** 2 for n in COMPONENTS)).max())
    limit = rings.model.velocity_range / 2
    if fastest > limit:
        raise InputError(
            f"platform.speed: {speed:g} m/s is not allowed with sensor; "
            f"expected less than {limit:.0f} m/s with the wind, half an order of doppler.etalon"
        )


def measure_lines(line_scan: LineScan, rings: Rings, assumed_rings: Rings, log: Log) -> xr.Dataset:
    """Line-of-sight velocities retrieved from the Doppler lidar's rings.

    ``assumed_rings`` has the models of the instrument that the retrieval assumes.

    The frames of each line (`line_frames`) are evaluated by the annular fit, which states its
    standard error.

    Returns
    -------
    xr.Dataset, dim (line)
        From `scan_wind`, with ``v_los``, its random ``v_los_std`` and ``v_los_systematic``, which
        are common to all lines (m s^-1), as retrieved; NaN where an image gives none.
    """
    sensor, doppler, seed = line_scan.sensor, line_scan.doppler, line_scan.seed
    lines = line_scan.true_lines(doppler.lidar, sensor.errors)
    true = lines["v_los_true"].values
    log(f"measuring {len(true)} lines of sight, {sensor.pulses} pulses each")
    images = line_images(doppler, rings, true.min(), true.max())
    noises = line_noises(doppler, sensor.pulses, rings)
    retrieved = np.empty((4, len(true)))
    # so many frames at once as memory holds
    for start in range(0, len(true), FRAMES):
        log.bar(f"retrieving line of sight {start + 1} of {len(true)}", start / len(true))
        chunk = slice(start, min(start + FRAMES, len(true)))
        air, laser, reference = line_frames(
            doppler, rings, images, lines, range(chunk.start, chunk.stop), sensor.pulses, seed
        )
        retrieved[:, chunk] = speeds_to_laser(
            air,
            laser[reference],
            doppler,
            assumed_rings,
            noises,
            RingMethod.ANNULAR,
            RingCentre.FREE,
        )
    return with_speeds(lines, retrieved, doppler, sensor.pulses, seed)


def line_noises(doppler: Doppler, pulses: int, rings: Rings) -> "list[PixelNoise]":
    """Noise of the pixels of a line's frame, and of the frame of the laser."""
    averaged, _ = reference_frames(pulses, doppler.reference.every, PULSES)
    return [pixel_noise(doppler.ccd, rings.modes, number) for number in (pulses, averaged)]


def with_speeds(
    lines: xr.Dataset, speeds: np.ndarray, doppler: Doppler, pulses: int, seed: int, scan: int = 0
) -> xr.Dataset:
    """Lines with the speeds that were read, the drifts behind the laser's frames and their errors.

    Lines are of `scan_wind`, speeds (4, lines) with their errors, m/s, of `speeds_to_laser`; pulses
    are those of a line. Where one frame of the laser serves several lines there is a
    ``v_los_covariance`` (line, other_line), m^2 s^-2. The seed and the number of the scan select
    the drifts.
    """
    v_los, std, systematic, laser_std = speeds
    streams = [seed, _DRIFTS + scan]
    drift, drift_std = drifts(doppler, pulses, streams, range(len(v_los)), PULSES)
    # all at once: each variable that a data set takes later copies and aligns it again
    variables: dict[str, tuple[Any, ...]] = {
        "v_los": ("line", v_los + drift + plate_error(doppler), lines.variables["v_los"].attrs),
        # independent errors: variances add
        "v_los_std": ("line", np.hypot(std, drift_std), lines.variables["v_los_std"].attrs),
        "v_los_systematic": variable(
            "line",
            np.hypot(systematic, plate_uncertainty(doppler)),
            "m s-1",
            "systematic standard error common to all lines",
        ),
    }
    shared = shared_covariance(doppler, pulses, laser_std, PULSES)
    if shared is not None:
        text = "covariance of the random errors of v_los by the laser's frames, beside v_los_std"
        variables["v_los_covariance"] = variable(("line", "other_line"), shared, "m2 s-2", text)
    return lines.assign(variables)
