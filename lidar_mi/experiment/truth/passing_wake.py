"""The air that passes a coherent lidar on the ground: a wake, the mean wind and turbulence.

Frame of the passage: x along the flight, forward; y left; z the height above the ground; x = y = 0
where the wake begins; time 0 at the first line. The lidar's frame: to the east, to the north, up.
"""

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.integrate import cumulative_trapezoid

from lidar_mi.atmosphere.air.shear import LogarithmicShear
from lidar_mi.atmosphere.air.turbulence import Turbulence
from lidar_mi.atmosphere.vortices.ground_effect import PairAboveGround
from lidar_mi.atmosphere.vortices.vortex import Vortex
from lidar_mi.atmosphere.vortices.wake_decay import sarpkaya_decay_time
from lidar_mi.atmosphere.vortices.wake_path import Components
from lidar_mi.atmosphere.vortices.wake_volume import VolumeAlongPath
from lidar_mi.errors import InputError
from lidar_mi.experiment.truth.file_wake import pairs_in, read_planes, refuse_ages, with_extinction
from lidar_mi.experiment.truth.turbulent_air import turbulent_air
from lidar_mi.instrument.coherent.weighting import Signal
from lidar_mi.schema.coherent import AirAtTheGround, CoherentDoppler, Passage
from lidar_mi.schema.input_files import find_file
from lidar_mi.schema.wake import ExtinctionMapping, VortexPair, Wake


@dataclass(frozen=True, eq=False)
class MeanWind:
    """Wind along the flight and to its left by height: the same everywhere, and a surface layer."""

    along: float
    left: float
    layer: LogarithmicShear | None

    def at(self, height: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Both components (m/s) at heights above the ground (m)."""
        speed = np.zeros_like(height) if self.layer is None else self.layer.wind_at(height)
        towards = 0.0 if self.layer is None else self.layer.towards
        return self.along + math.cos(towards) * speed, self.left + math.sin(towards) * speed

    def to_the_left(self, height: np.ndarray) -> np.ndarray:
        """The component to the left alone."""
        return self.at(height)[1]


@dataclass(frozen=True, eq=False)
class PassingWake:
    """All of the air, seen from the lidar.

    gusts: frozen in the mean wind at ``height`` unless it evolves.
    height: m.
    heading: of the flight, rad, clockwise from north.
    position: of the lidar, m.
    """

    wake: PairAboveGround | VolumeAlongPath | None
    mean: MeanWind
    gusts: Turbulence | None
    height: float
    heading: float
    position: tuple[float, float, float]

    def places(self, east: np.ndarray, north: np.ndarray, up: np.ndarray) -> Components:
        """x, y, z (m) of places relative to the lidar."""
        s, c = math.sin(self.heading), math.cos(self.heading)
        x0, y0, z0 = self.position
        return x0 + s * east + c * north, y0 - c * east + s * north, z0 + up

    def wind(
        self, east: np.ndarray, north: np.ndarray, up: np.ndarray, time: np.ndarray
    ) -> Components:
        """Wind (m/s) to the east, to the north and up; a `WindField` about the lidar."""
        u, v, w = self.in_frame(*self.places(east, north, up), time)
        return *self.to_east_and_north(u, v), w

    def to_east_and_north(self, u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Components along the flight and to its left in the lidar's frame."""
        s, c = math.sin(self.heading), math.cos(self.heading)
        return s * u - c * v, c * u + s * v

    def in_frame(self, x: np.ndarray, y: np.ndarray, z: np.ndarray, time: np.ndarray) -> Components:
        """u, v, w (m/s) in the frame of the passage; x is along the flight."""
        u, v = self.mean.at(z)
        w = np.zeros_like(z)
        if isinstance(self.wake, PairAboveGround):
            swirl = self.wake.wind(y, z, time)
            v, w = v + swirl[0], w + swirl[1]
        elif self.wake is not None:
            of_wake = self.wake.wind(x, y, z, time)
            u, v, w = u + of_wake[0], v + of_wake[1], w + of_wake[2]
        if self.gusts is not None:
            along, left = self.mean.at(np.array(self.height))
            of_gusts = self.gusts.velocity(x - along * time, y - left * time, z, time)
            u, v, w = u + of_gusts[0], v + of_gusts[1], w + of_gusts[2]
        return u, v, w

    def vortices(self, time: float) -> tuple[Vortex, Vortex] | None:
        """Port and starboard vortex in a plane across the flight; None: no wake."""
        if self.wake is None:
            return None
        if isinstance(self.wake, PairAboveGround):
            return self.wake.vortices(time)
        return self.wake.vortices(0.0, time)


def passing_wake(
    doppler: CoherentDoppler, wake: Wake | None, seed: int, search_path: Path, last: float
) -> PassingWake:
    """The air of an experiment until a time (s).

    Raises InputError: a file without two vortices in its plane; keys that it does not allow;
    turbulence out of range.
    """
    passage, air = doppler.passage, doppler.air
    mean = _mean(air)
    passing: PairAboveGround | VolumeAlongPath | None = None
    if wake is not None and wake.vortex_pair is not None:
        passing = _pair(wake.vortex_pair, passage, mean, last)
    elif wake is not None:
        passing = _plane(wake, passage, mean, search_path)
    gusts = (
        None
        if air.turbulence is None
        else turbulent_air(air.turbulence, passage.height, seed, "doppler.air")
    )
    return PassingWake(passing, mean, gusts, passage.height, passage.heading, doppler.position)


def echo(doppler: CoherentDoppler, wake: Wake | None, air: PassingWake) -> Signal | None:
    """Power of the echo over that at ``signal.range`` in the background alone; None: 1 everywhere.

    Extinction over the square of the range times the transmittance there and back. Between the
    lidar and the first point of a line there is the background.
    """
    if doppler.signal.profile == "constant":
        return None
    background = (ExtinctionMapping() if wake is None else wake.extinction).background
    if not background > 0:
        raise InputError(
            "wake.extinction.background: 0 is not allowed with doppler.signal.profile "
            "lidar_equation; expected above 0, or constant"
        )
    reference, inside = doppler.signal.range, air.wake

    def power(east: np.ndarray, north: np.ndarray, up: np.ndarray, time: np.ndarray) -> np.ndarray:
        distance = np.sqrt(east**2 + north**2 + up**2)
        alpha = np.full(distance.shape, background)
        if isinstance(inside, VolumeAlongPath):
            alpha = inside.extinction(*air.places(east, north, up), time)
        passed = cumulative_trapezoid(alpha, distance, axis=-1, initial=0.0)
        depth = background * (distance[..., :1] - reference) + passed
        return alpha / background * (reference / distance) ** 2 * np.exp(-2 * depth)

    return power


def _mean(air: AirAtTheGround) -> MeanWind:
    layer, shear = None, air.logarithmic_shear
    if shear is not None:
        layer = LogarithmicShear(
            shear.speed, shear.reference, shear.roughness, shear.towards, shear.reference
        )
    return MeanWind(*air.wind, layer)


def _pair(pair: VortexPair, passage: Passage, mean: MeanWind, last: float) -> PairAboveGround:
    decay = passage.decay_time
    if passage.dissipation_rate is not None:
        decay = sarpkaya_decay_time(pair.circulation, pair.separation, passage.dissipation_rate)
    return PairAboveGround(
        pair.circulation,
        pair.separation,
        pair.core_radius,
        passage.height,
        last,
        passage.age,
        decay,
        mean.to_the_left,
        pair.model,
        passage.ground,
    )


def _plane(wake: Wake, passage: Passage, mean: MeanWind, search_path: Path) -> VolumeAlongPath:
    """A simulated plane, extruded, that drifts and sinks as it is: without decay, without ground.

    Beyond the file's edges the wind is that of two vortices at the places and with the circulation
    of those of the plane.
    """
    refuse_ages(
        "doppler.passage",
        {
            "age": passage.age,
            "decay_time": passage.decay_time,
            "dissipation_rate": passage.dissipation_rate,
        },
    )
    assert wake.file is not None  # of the kinds of wake that a coherent lidar observes
    path = find_file(wake.file, search_path, "wake.file")
    flow = with_extinction(read_planes(path, wake), wake)
    (port, starboard), (v, w) = pairs_in(flow, path.name)
    centre_y, centre_z = wake.centre or (
        float(np.mean([vortex.y for vortex in (*port, *starboard)])),
        float(np.mean([vortex.z for vortex in (*port, *starboard)])),
    )
    return VolumeAlongPath(
        flow,
        port,
        starboard,
        background=wake.extinction.background,
        drift=(v + float(mean.to_the_left(np.array(passage.height))), w),
        origin=(float(flow["x"][0]), centre_y, centre_z),
        miss=(0.0, passage.height),
    )
