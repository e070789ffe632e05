"""The platform's motion: how it departs from straight and level flight, and its unsteady scanner.

Pitch is positive nose up, yaw nose to port, roll port wing up.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Literal, Self, cast

import numpy as np
import scipy
from pydantic import Field, ValidationInfo, field_serializer, field_validator, model_validator

from lidar_mi.description import Description
from lidar_mi.errors import InputError
from lidar_mi.units import Angle, Frequency, Within, to_si

if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation

PLACES, ANGLES = ("x", "y", "z"), ("roll", "pitch", "yaw")

# Waves of a random process: their frequencies are strata of equal variance.
_WAVES = 64

TrueFrequency = Annotated[
    Frequency, Within(1e-6, 1e6, "from a slow roll to the vibration of a mirror")
]


class Sinusoid(Description):
    """A vibration of one axis: amplitude times sin(2 pi frequency t + phase)."""

    axis: Literal["x", "y", "z", "roll", "pitch", "yaw"] = Field(description="what vibrates")
    amplitude: Annotated[float, Within(0, 1000, "larger ones are no vibration")] = Field(
        description="m, or an angle with its unit"
    )
    frequency: TrueFrequency = Field(description="of the vibration")
    phase: Annotated[Angle, Within(-1000, 1000, "a turn is enough")] = Field(
        0.0, description="of the sine at the first scan"
    )

    @field_validator("amplitude", mode="before")
    @classmethod
    def _unit_of_the_axis(cls, value: object, info: ValidationInfo) -> float:
        is_angle = info.data.get("axis") in ANGLES
        return to_si(value, "rad" if is_angle else "m", "2 mrad" if is_angle else "10 cm")

    @field_serializer("amplitude", when_used="json")
    def _with_unit(self, value: float) -> str:
        return f"{value!r} {'rad' if self.axis in ANGLES else 'm'}"

    @model_validator(mode="after")
    def _small_angle(self) -> Self:
        if self.axis in ANGLES and self.amplitude > 1:
            raise ValueError(
                f"amplitude: {self.amplitude:g} rad is not allowed; expected at most 1 rad, with "
                "which beams still go ahead"
            )
        return self


class Attitude(Description):
    """Random roll, pitch and yaw, independent of each other, each with this spectrum."""

    rms: Annotated[Angle, Within(0, 0.3, "beams still go ahead")] = Field(
        description="of each of the three angles"
    )
    bandwidth: TrueFrequency = Field(description="at which the spectrum has half its power")


class Motion(Description):
    """How the platform departs from straight flight at its speed; nothing: not at all."""

    trajectory: str | None = Field(
        None, description="CSV or NetCDF file of t, x, y, z, roll, pitch, yaw"
    )
    sinusoids: tuple[Sinusoid, ...] = Field((), max_length=1000, description="added up")
    attitude: Attitude | None = Field(
        None, description="random attitude, by turbulence; not with trajectory"
    )
    scanner_jitter: Annotated[Angle, Within(0, 0.1, "small angles only")] = Field(
        0.0, description="rms of every beam, on both axes, independent of each other"
    )

    @model_validator(mode="after")
    def _one_attitude(self) -> Self:
        if self.trajectory is not None and self.attitude is not None:
            raise ValueError("attitude: not allowed with trajectory, which has it; expected one")
        return self


@dataclass(frozen=True)
class Pose:
    """Departure from straight and level flight, at n times: place (n, 3) in m, velocity in m/s.

    The n rotations ``attitude`` are from the body to the lidar's frame.
    """

    place: np.ndarray
    velocity: np.ndarray
    attitude: "Rotation"


@dataclass(frozen=True)
class Trajectory:
    """A flight, as a file has it: linear between its times, attitudes along great circles.

    time (n,): s since the first scan, ascending.
    place (n, 3): m in the lidar's frame; the first scan is made near 0.
    attitude: of n.
    source: its file, for messages.
    """

    time: np.ndarray
    place: np.ndarray
    attitude: "Rotation"
    source: str

    def at(self, time: np.ndarray, speed: float) -> Pose:
        """Departure from straight flight at a speed (m/s) along x.

        Raises InputError: times outside of the trajectory.
        """
        first, last = self.time[0], self.time[-1]
        # rounding of times in a file
        slack = 1e-9 * (last - first)
        if time.min() < first - slack:
            raise InputError(
                f"{self.source} begins at {first:g} s; expected from {time.min():.6g} s on, when "
                "the first pose is asked for"
            )
        if time.max() > last + slack:
            raise InputError(
                f"{self.source} ends at {last:g} s; expected until {time.max():.6g} s, the end of "
                "the last scan"
            )
        time = np.clip(time, first, last)
        place = np.stack([np.interp(time, self.time, axis) for axis in self.place.T], -1)
        # velocities are those of the straight pieces between the times
        part = np.clip(np.searchsorted(self.time, time, side="right") - 1, 0, len(self.time) - 2)
        velocity = (np.diff(self.place, axis=0) / np.diff(self.time)[:, None])[part]
        place[:, 0] -= speed * time
        velocity[:, 0] -= speed
        return Pose(place, velocity, scipy.spatial.transform.Slerp(self.time, self.attitude)(time))


def trajectory(columns: Mapping[str, np.ndarray], speed: float, source: str) -> Trajectory:
    """A trajectory from columns t (s), x, y, z (m), roll, pitch, yaw (rad).

    Columns that are missing are those of straight flight at the speed (m/s).
    """
    time = columns["t"]
    straight = {"x": speed * time}
    place, angles = (
        [columns.get(name, straight.get(name, np.zeros_like(time))) for name in names]
        for names in (PLACES, ANGLES)
    )
    return Trajectory(time, np.stack(place, -1), attitude(*angles), source)


def attitude(
    roll: float | np.ndarray, pitch: float | np.ndarray, yaw: float | np.ndarray
) -> "Rotation":
    """Rotation from the body to the lidar's frame by yaw, pitch and roll, in this order, rad."""
    # capitals: about axes that turn along; about y, to port, the nose goes down
    return scipy.spatial.transform.Rotation.from_euler(
        "ZYX", np.stack([yaw, np.negative(pitch), roll], -1)
    )


def tilted(directions: np.ndarray, rms: float, random: np.random.Generator) -> np.ndarray:
    """Unit vectors (n, 3), each tilted by normal angles (rms in rad) on two axes across it."""
    across = np.cross(directions, [0.0, 0.0, 1.0])
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    above = np.cross(across, directions)
    tilt = rms * random.standard_normal((2, len(directions), 1))
    directed = directions + tilt[0] * across + tilt[1] * above
    return directed / np.linalg.norm(directed, axis=1, keepdims=True)


def random_process(
    time: np.ndarray, rms: float, bandwidth: float, random: np.random.Generator
) -> np.ndarray:
    """A stationary Gaussian process at any times, (n,): a second-order Gauss-Markov one.

    The autocorrelation is rms^2 (1 + b |t|) exp(-b |t|), the spectrum falls with the fourth power
    beyond the bandwidth (half power): an angle whose rate is finite, as that of a body with
    inertia. It is a sum of waves with random amplitudes at frequencies drawn from the spectrum, one
    from each of as many parts of equal variance, and so a function of time alone: the same for any
    choice of times.

    Notes
    -----
    Spectral representation: Shinozuka and Deodatis 1991. The normalised spectrum,
    (1 + (w / b)^2)^-2, is Student's distribution of w sqrt(3) / b with three degrees of freedom.
    """
    # (1 + (w / b)^2)^-2 is 1/2 at w = b (2^(1/2) - 1)^(1/2)
    corner = 2 * math.pi * bandwidth / math.sqrt(math.sqrt(2) - 1)
    strata = (np.arange(_WAVES) + random.random(_WAVES)) / _WAVES
    # quantiles of the upper half of the distribution: frequencies are positive
    frequencies = corner / math.sqrt(3) * scipy.special.stdtrit(3, (1 + strata) / 2)
    cosine, sine = rms / math.sqrt(_WAVES) * random.standard_normal((2, _WAVES))
    process = np.zeros(len(time))
    for frequency, a, b in zip(frequencies, cosine, sine, strict=True):
        process += a * np.cos(frequency * time) + b * np.sin(frequency * time)
    return process


def true_pose(
    motion: Motion, time: np.ndarray, speed: float, seed: int, path: Trajectory | None = None
) -> Pose:
    """The true pose at times (s) since the first scan, at a speed (m/s) or along a path."""
    time = np.asarray(time, float)
    recorded = path.at(time, speed) if path else None
    offset = {axis: np.zeros(len(time)) for axis in (*PLACES, *ANGLES)}
    rate = {axis: np.zeros(len(time)) for axis in PLACES}
    for sinusoid in motion.sinusoids:
        angular = 2 * math.pi * sinusoid.frequency
        offset[sinusoid.axis] += sinusoid.amplitude * np.sin(angular * time + sinusoid.phase)
        if sinusoid.axis in rate:
            rate[sinusoid.axis] += (
                sinusoid.amplitude * angular * np.cos(angular * time + sinusoid.phase)
            )
    if motion.attitude:
        for number, axis in enumerate(ANGLES):
            # independent streams: [seed, 2] and [seed, image, 1] are used elsewhere
            random = np.random.default_rng([seed, 3, 1, number + 1])
            offset[axis] += random_process(
                time, motion.attitude.rms, motion.attitude.bandwidth, random
            )
    place, velocity = (np.stack([parts[axis] for axis in PLACES], -1) for parts in (offset, rate))
    turned = attitude(*(offset[axis] for axis in ANGLES))
    if recorded is None:
        return Pose(place, velocity, turned)
    return Pose(
        recorded.place + place,
        recorded.velocity + velocity,
        cast("Rotation", recorded.attitude * turned),
    )
