"""The keys of a coherent Doppler lidar on the ground, and of the wake that passes it."""

import math
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator
from scipy.constants import speed_of_light

from lidar_mi.schema.air import LogarithmicShear, Turbulence
from lidar_mi.schema.section import Section
from lidar_mi.units import (
    Angle,
    AngularRate,
    DissipationRate,
    Frequency,
    Length,
    Number,
    Speed,
    Time,
    Within,
    quantity,
)

_Elevation = Annotated[Angle, Within(0, math.pi, "from the horizon over the top")]
_Azimuth = Annotated[Angle, Within(-4 * math.pi, 4 * math.pi, "two turns")]
_Place = Annotated[Length, Within(-1e5, 1e5, "the range of a lidar")]


class CoherentLaser(Section):
    """The pulses of a coherent lidar and its gates, in which velocities are estimated."""

    wavelength: Annotated[Length, Within(1e-7, 2e-5, "from ultraviolet to far infrared")] = Field(
        quantity("1543 nm"), description="of the laser"
    )
    pulse_length: Annotated[Length, Within(1, 1000, "from 7 ns to 7 us")] = Field(
        30.0, description="full width at half maximum of the pulse in range, c tau / 2"
    )
    gate_length: Annotated[Length, Within(1, 1000, "as of the pulse")] = Field(
        30.0, description="of the window of an estimate in range"
    )
    gate_spacing: Annotated[Length, Within(0.5, 1000, "gates that overlap or do not")] = Field(
        10.0, description="from one gate to the next"
    )
    first_gate: Annotated[Length, Within(1, 1e5, "farther than lidars of winds see")] = Field(
        400.0, description="distance of the first gate's middle"
    )
    gates: Annotated[int, Within(1, 10000, "100 km of gates that are 10 m apart")] = Field(
        70, description="of a line"
    )
    pulse_rate: Annotated[Frequency, Within(1, 1e6, "fibre lasers have 10 to 50 kHz")] = Field(
        quantity("20 kHz"), description="pulses per second"
    )
    bandwidth: Annotated[Frequency, Within(1e5, 1e10, "50 MHz is 39 m/s at 1.5 um")] = Field(
        quantity("100 MHz"), description="of the receiver, and its rate of independent samples"
    )

    @model_validator(mode="after")
    def _first_gate_is_ahead(self) -> Self:
        if self.first_gate <= self.gate_length / 2:
            raise ValueError(
                f"first_gate: {self.first_gate:g} m is not allowed with gates of "
                f"{self.gate_length:g} m; expected more than half of them"
            )
        return self

    @model_validator(mode="after")
    def _echoes_return_before_the_next_pulse(self) -> Self:
        last = self.first_gate + (self.gates - 1) * self.gate_spacing
        farthest = speed_of_light / (2 * self.pulse_rate)
        if last > farthest:
            raise ValueError(
                f"gates: the last at {last:g} m is not allowed; expected at most {farthest:.4g} m, "
                "from where echoes return before the next pulse (pulse_rate)"
            )
        return self


class CoherentScan(Section):
    """Where the beam looks, and when.

    rhi: vertical slices, up and down in turn, whose lines have vortices. ppi: cones, dbs: beams to
    the north, east, south, west and up, which have winds. stare: one direction.
    """

    kind: Literal["rhi", "ppi", "dbs", "stare"] = Field(
        "rhi", description="vertical slices, cones, five beams or one direction"
    )
    azimuth: _Azimuth = Field(
        quantity("90 deg"), description="of rhi and stare, clockwise from north"
    )
    elevation: Annotated[Angle, Within(0, math.pi / 2, "from the horizon to the zenith")] = Field(
        quantity("60 deg"), description="of ppi, dbs and stare"
    )
    elevations: tuple[_Elevation, _Elevation] = Field(
        (quantity("0 deg"), quantity("20 deg")), description="of rhi, first and last"
    )
    azimuths: tuple[_Azimuth, _Azimuth] = Field(
        (quantity("0 deg"), quantity("360 deg")), description="of ppi, first and last"
    )
    rate: Annotated[AngularRate, Within(1e-4, 20, "a turn in a third of a second")] = Field(
        quantity("5 deg/s"), description="angular speed of rhi and ppi"
    )
    accumulation: Annotated[Time, Within(1e-4, 3600, "from a pulse to an hour")] = Field(
        0.1, description="of a line"
    )
    move: Annotated[Time, Within(0, 3600, "an hour")] = Field(
        1.0, description="of dbs, from one beam to the next"
    )
    repeat: Annotated[Time, Within(1e-3, 1e5, "a day of scans")] | None = Field(
        quantity("5 s"), description="from one scan's start to the next; null: without a break"
    )
    count: Annotated[int, Within(1, 10000, "half a day of scans of 5 s")] = Field(
        12, description="scans; of stare, lines"
    )

    @property
    def duration(self) -> float:
        """Duration of one scan, s."""
        if self.kind == "dbs":
            return 5 * (self.accumulation + self.move)
        if self.kind == "stare":
            return self.accumulation
        first, last = self.elevations if self.kind == "rhi" else self.azimuths
        lines = math.floor(abs(last - first) / (self.rate * self.accumulation) + 1e-9)
        return lines * self.accumulation

    @model_validator(mode="after")
    def _scans_have_lines_and_time(self) -> Self:
        duration = self.duration
        if duration == 0:
            key = "elevations" if self.kind == "rhi" else "azimuths"
            step = math.degrees(self.rate * self.accumulation)
            raise ValueError(
                f"{key}: less than the {step:.3g} deg of one line is not allowed; expected more "
                "(or a lower rate, a shorter accumulation)"
            )
        if self.repeat is not None and duration > self.repeat * (1 + 1e-9):
            raise ValueError(
                f"repeat: {self.repeat:g} s is not allowed with scans of {duration:.3g} s; "
                "expected at least that, or null"
            )
        return self


class CoherentSignal(Section):
    """How strong the echo is; the noise of the velocity follows from it."""

    cnr: Annotated[Number, Within(-60, 60, "dB; below -25 dB nothing is found")] = Field(
        -5.0, description="carrier-to-noise ratio at the range, dB"
    )
    range: Annotated[Length, Within(1, 1e5, "farther than lidars of winds see")] = Field(
        700.0, description="at which that is the ratio, in the background's extinction"
    )
    profile: Literal["lidar_equation", "constant"] = Field(
        "lidar_equation",
        description="with range: lidar_equation falls with its square and with the transmittance "
        "of the extinction, and is that of the air within each gate",
    )


class Passage(Section):
    """The wake as it passes the lidar: where it begins, and how it changes.

    The pair sinks by its own induction, drifts with the wind and decays. Its images below the
    ground make it spread.
    """

    heading: _Azimuth = Field(
        0.0, description="in which the aircraft flies, clockwise from north; 90 deg: to the east"
    )
    height: Annotated[Length, Within(0.1, 20000, "to the stratosphere")] = Field(
        50.0, description="of the wake at age 0 above the ground"
    )
    age: Annotated[Time, Within(0, 1e5, "a wake's life")] = Field(
        0.0, description="of the wake at the first line"
    )
    decay_time: Annotated[Time, Within(1, 1e9, "a wake's life")] | None = Field(
        None, description="in which circulation falls to 1/e; default: it stays"
    )
    dissipation_rate: (
        Annotated[DissipationRate, Within(0, 1, "from calm air to a thunderstorm")] | None
    ) = Field(None, description="of turbulence, in which circulation decays (Sarpkaya 2000)")
    ground: bool = Field(True, description="no air through the ground: images of the vortices")

    @model_validator(mode="after")
    def _one_decay(self) -> Self:
        if self.decay_time is not None and self.dissipation_rate is not None:
            raise ValueError("expected one of decay_time and dissipation_rate")
        return self


class AirAtTheGround(Section):
    """The air about the wake; the wake drifts with its mean."""

    wind: tuple[
        Annotated[Speed, Within(-100, 100, "a hurricane")],
        Annotated[Speed, Within(-100, 100, "a hurricane")],
    ] = Field(
        (0.0, 0.0), description="along passage.heading (0: north) and to its left, at all heights"
    )
    logarithmic_shear: LogarithmicShear | None = None
    turbulence: Turbulence | None = None


class CoherentDoppler(Section):
    """A pulsed coherent Doppler lidar on the ground that scans a wake or the wind.

    It needs no backscatter lidar: the wake is `wake.vortex_pair` or a plane of `wake.file`.
    """

    kind: Literal["fringes", "coherent"] = Field("coherent", description="of the Doppler lidar")
    laser: CoherentLaser = CoherentLaser()
    scan: CoherentScan = CoherentScan()
    signal: CoherentSignal = CoherentSignal()
    bias: Annotated[Speed, Within(-10, 10, "a frequency that is not known")] = Field(
        0.0, description="of all velocities"
    )
    position: tuple[_Place, _Place, _Place] = Field(
        (0.0, 700.0, 2.0),
        description="of the lidar: along passage.heading and to its left, from where the wake "
        "begins, and above the ground",
    )
    interval: Annotated[Time, Within(1, 1e6, "a week")] | None = Field(
        None, description="of a profile of winds; default: one for every scan"
    )
    passage: Passage = Passage()
    air: AirAtTheGround = AirAtTheGround()

    @model_validator(mode="after")
    def _above_the_ground(self) -> Self:
        if self.position[2] < 0:
            raise ValueError(
                f"position: {self.position[2]:g} m above the ground is not allowed; expected 0 m "
                "or more"
            )
        return self
