"""The Doppler lidar of a flight: frames of its lines of sight through the slab of two scans.

All lines are recorded half way between both scans, in time and in place. Their range bins lie in
the slab.
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import xarray as xr
from scipy.spatial.transform import Rotation

from lidar_mi.aircraft.pose import AircraftPose
from lidar_mi.atmosphere.vortices.wake_path import WakeAlongPath
from lidar_mi.encounter.lidar.slabs import Gates
from lidar_mi.errors import InputError
from lidar_mi.experiment.stages.line_frames import PULSES, LineImages, line_frames, line_images
from lidar_mi.experiment.stages.ring_images import Rings, ring_instrument
from lidar_mi.experiment.stages.ring_reference import reference_frames
from lidar_mi.experiment.truth.wake_along_path import encounter_of
from lidar_mi.instrument.beams import Beams
from lidar_mi.instrument.doppler_scan import scan_wind
from lidar_mi.schema.doppler import Doppler
from lidar_mi.schema.experiment import Experiment
from lidar_mi.schema.sensor import Sensor

if TYPE_CHECKING:
    import torch


# m/s by which the wind in a wake changes the speed along a line, at most: noise-free images are
# tabulated over these speeds.
_FASTEST_WIND = 60.0


class Midway(NamedTuple):
    """Place and velocity of an aircraft between two scans; path frame, m and m/s."""

    place: np.ndarray
    velocity: np.ndarray

    @classmethod
    def between(cls, before: AircraftPose, now: AircraftPose, period: float) -> "Midway":
        """From the poses at both scans."""
        first, last = (np.array([pose.x, pose.y, pose.z]) for pose in (before, now))
        return cls((first + last) / 2, (last - first) / period)


class LineFrames(NamedTuple):
    """The frames that the Doppler lidar records of a slab.

    lines (line): from `scan_wind`, in the frame of the aircraft, with the true speeds.
    air (lines, height, width): photoelectrons.
    laser (frames, height, width)
    own: the laser's frame of every line.
    scan: number of the scan that completes the slab.
    """

    lines: xr.Dataset
    air: "torch.Tensor"
    laser: "torch.Tensor"
    own: list[int]
    scan: int


@dataclass(frozen=True, eq=False)
class DopplerScans:
    """The true Doppler lidar, which records frames.

    experiment: its `doppler.lidar.range` is that of the slabs.
    doppler: those of the experiment.
    rings: the true instrument.
    """

    experiment: Experiment
    sensor: Sensor
    doppler: Doppler
    rings: Rings
    images: LineImages

    def frames(
        self,
        wake: WakeAlongPath,
        number: int,
        x: float,
        time: float,
        midway: Midway,
        misalignment: Rotation | None = None,
    ) -> LineFrames:
        """Frames of all lines of sight of a slab.

        number: of the scan that completes the slab.
        x: plane of the slab, m.
        time: half way between both scans, s.
        misalignment: true attitude of the lidar relative to the one by which its beams are aimed.
        """
        sensor, seed = self.sensor, self.experiment.seed
        lidar = self.doppler.lidar.model_copy(update={"range": x - midway.place[0]})
        aimed = sensor.directions.directions()
        true = aimed if misalignment is None else misalignment.apply(aimed)
        origin = np.zeros_like(aimed)
        # the speed along the path is an argument of its own of `scan_wind`
        drift = np.broadcast_to(midway.velocity * [0, 1, 1], aimed.shape)
        beams = Beams(np.zeros(len(aimed)), origin, true, origin, aimed, drift, drift)

        def wind(points: np.ndarray) -> np.ndarray:
            place_x, y, z = np.moveaxis(points + midway.place, -1, 0)
            return np.stack(wake.wind(place_x, y, z, time), -1)

        # each slab has noise of its own, the same whenever its scan is repeated
        own_seed = int(np.random.SeedSequence([seed, number]).generate_state(1)[0])
        lines = scan_wind(
            wind,
            sensor.directions,
            lidar,
            0.0,
            own_seed,
            float(midway.velocity[0]),
            sensor.errors,
            beams,
        )
        air, laser, own = line_frames(
            self.doppler,
            self.rings,
            self.images,
            lines,
            range(len(aimed)),
            sensor.pulses,
            seed,
            number,
        )
        return LineFrames(lines, air, laser, own, number)


def doppler_scans(experiment: Experiment, gates: Gates) -> DopplerScans | None:
    """The Doppler lidar of an encounter, checked; None where its experiment has no `sensor`.

    Raises InputError: times of lines, a range that is not that of the slabs, an aircraft too fast
    for the etalon.
    """
    sensor = experiment.sensor
    if sensor is None:
        return None
    if sensor.timing is not None:
        raise InputError("sensor.timing: not allowed in an encounter; expected none")
    experiment = at_the_slabs(experiment, gates)
    doppler = experiment.fringes
    assert doppler is not None  # as there is a sensor
    # refuses numbers of pulses that have no frame of the laser
    reference_frames(sensor.pulses, doppler.reference.every, PULSES)
    rings = ring_instrument(doppler)
    speed = encounter_of(experiment).path.speed
    limit = rings.model.velocity_range / 2
    if speed + _FASTEST_WIND > limit:
        raise InputError(
            f"encounter.path.speed: {speed:g} m/s is not allowed with sensor; expected less than "
            f"{limit - _FASTEST_WIND:.0f} m/s, half an order of doppler.etalon less the wind"
        )
    # oblique lines see less of the aircraft's speed
    slowest = speed * float(sensor.directions.directions()[:, 0].min())
    images = line_images(doppler, rings, slowest - _FASTEST_WIND, speed + _FASTEST_WIND)
    return DopplerScans(experiment, sensor, doppler, rings, images)


def at_the_slabs(experiment: Experiment, gates: Gates) -> Experiment:
    """An encounter whose Doppler lidar, if there is one, has the slabs' range.

    Raises InputError: its own range is another one.
    """
    doppler = experiment.fringes
    if experiment.sensor is None or doppler is None:
        return experiment
    lidar = doppler.lidar
    middle = gates.look_ahead + (gates.depth - gates.stride) / 2
    if "range" in lidar.model_fields_set and abs(lidar.range - middle) > lidar.range_bin / 2:
        raise InputError(
            f"doppler.lidar.range: {lidar.range:g} m is not allowed in an encounter; expected that "
            f"of its slabs, {middle:.4g} m, or none"
        )
    lidar = lidar.model_copy(update={"range": middle})
    doppler = doppler.model_copy(update={"lidar": lidar})
    return experiment.model_copy(update={"doppler": doppler})
