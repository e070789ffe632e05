"""The keys of an encounter: a flight into the wake, the aircraft, its control."""

import math
from typing import Annotated, Literal

from pydantic import Field, field_validator, model_validator

from lidar_mi.schema.aerodynamics import Aerodynamics
from lidar_mi.schema.air import Air
from lidar_mi.schema.heave import HeaveKeys
from lidar_mi.schema.section import Section
from lidar_mi.units import (
    Angle,
    AngularRate,
    Area,
    DissipationRate,
    Frequency,
    Inertia,
    Length,
    Number,
    Speed,
    Time,
    Within,
    quantity,
)

_Slope = Annotated[Angle, Within(-0.35, 0.35, "20 degrees")]


class Miss(Section):
    """Where the middle between the vortices is, from the path, when the aircraft arrives."""

    y: Annotated[Length, Within(-1000, 1000, "an encounter")] = Field(
        0.0, description="distance of the middle between the vortices to the left of the path"
    )
    z: Annotated[Length, Within(-1000, 1000, "an encounter")] = Field(
        0.0, description="distance of the middle between the vortices above the path"
    )


class Path(Section):
    """The straight nominal flight path, and where it meets the wake."""

    speed: Annotated[Speed, Within(10, 350, "from a glider to the speed of sound")] = Field(
        75.0, description="true airspeed"
    )
    crossing_angle: Annotated[Angle, Within(0, 1.5708, "0 to 90 degrees")] = Field(
        quantity("10 deg"), description="horizontal angle between the path and the axis of the wake"
    )
    climb_angle: _Slope = Field(
        quantity("-3 deg"), description="angle of the path to the horizontal; the wake is level"
    )
    miss: Miss = Miss()
    altitude: Annotated[Length, Within(1, 15000, "the lower atmosphere")] = Field(
        300.0,
        description="height above the ground (sea level) at the start; a path into the ground is "
        "refused",
    )
    start: Annotated[Length, Within(1, 20000, "an encounter")] = Field(
        600.0, description="distance from the centre of the wake at the start"
    )
    beyond: Annotated[Length, Within(0, 20000, "an encounter")] = Field(
        300.0, description="distance flown beyond the centre of the wake"
    )

    @model_validator(mode="after")
    def _above_the_ground(self) -> "Path":
        # a path that climbs is lowest at its start
        lowest = self.altitude + (self.start + self.beyond) * math.sin(min(self.climb_angle, 0.0))
        if lowest <= 0:
            raise ValueError(
                f"altitude {self.altitude:g} m: the path ends {-lowest:.0f} m below the ground; "
                f"expected above {self.altitude - lowest:.0f} m, or a flatter or shorter path"
            )
        return self


class Crow(Section):
    """Sinusoidal deformation of both vortices (Crow 1970)."""

    model: Literal["tangents", "filaments"] = Field(
        "tangents",
        description="tangents: the flow of straight vortices tangent to the bent ones, constant in "
        "time; filaments: law of Biot and Savart, waves that grow with the age and link to rings",
    )
    amplitude: Annotated[Length, Within(0, 1000, "less than the separation")] = Field(
        0.0, description="amplitude of the deformation; with filaments that at age 0"
    )
    wavelength: Annotated[Length, Within(1, 100000, "8.6 separations")] | None = Field(
        None, description="wavelength of the deformation; default: 8.6 separations"
    )
    phase: Annotated[Angle, Within(-6.2832, 6.2832, "one wave")] = Field(
        0.0, description="phase of the deformation at the centre of the wake"
    )


class WakeInTime(Section):
    """How the wake changes in time and along its axis, in addition to its drift."""

    age: Annotated[Time, Within(0, 1e5, "a wake's life")] = Field(
        0.0, description="age of the wake at the start of the flight"
    )
    decay_time: Annotated[Time, Within(1, 1e9, "a wake's life")] | None = Field(
        None, description="time in which the circulation falls to 1/e; default: no decay"
    )
    dissipation_rate: (
        Annotated[DissipationRate, Within(0, 1, "from calm air to a thunderstorm")] | None
    ) = Field(
        None,
        description="dissipation rate of the turbulence by which the circulation decays "
        "(Sarpkaya 2000); instead of decay_time",
    )
    crow: Crow = Crow()
    ends: Literal["mirror", "blend", "refuse"] = Field(
        "mirror",
        description="what follows a simulated volume that is not periodic: mirror: its mirror "
        "image; blend: the volume again, its ends blended into each other; refuse: it is refused",
    )
    ends_length: Annotated[Length, Within(0.1, 10000, "part of a volume")] = Field(
        5.0, description="length over which ends are blended, or u falls to 0 at a mirror"
    )

    @model_validator(mode="after")
    def _one_decay(self) -> "WakeInTime":
        if self.decay_time is not None and self.dissipation_rate is not None:
            raise ValueError("expected one of decay_time and dissipation_rate")
        return self


class Aircraft(Section):
    """The aircraft that flies into the wake.

    Defaults are the Boeing 737 of JSBSim: its dimensions, inertia with fuel, control power and,
    with the finite-span slope of an elliptic wing, its lift slope of 4.35 per rad. The rate of the
    ailerons is usual for transport aircraft. The numbers are for the models roll and heave. An
    aircraft of JSBSim has its own, except for the lift slope and the rate of the controls.
    """

    model: str = Field(
        "roll",
        description="roll: rolls only; heave: also pitches and moves vertically; otherwise an "
        "aircraft of JSBSim, such as 737 (pip install 'lidar-mi[flight]')",
    )
    span: Annotated[Length, Within(1, 200, "aircraft")] = Field(28.9, description="wing span")
    wing_area: Annotated[Area, Within(0.1, 2000, "aircraft")] = Field(
        108.8, description="reference area of the wing"
    )
    roll_inertia: Annotated[Inertia, Within(0.1, 1e9, "aircraft")] = Field(
        8.0e5, description="moment of inertia about the roll axis"
    )
    lift_slope: Annotated[Number, Within(1, 6.2832, "thin wings, per rad")] = Field(
        5.3, description="lift slope of the wing's sections, per rad"
    )
    largest_aileron: Annotated[Angle, Within(0.001, 1, "aircraft")] = Field(
        quantity("20 deg"), description="largest deflection of the ailerons"
    )
    aileron_rate: Annotated[AngularRate, Within(0.001, 100, "actuators")] = Field(
        quantity("50 deg/s"), description="largest rate of deflection of every control"
    )
    aileron_power: Annotated[Number, Within(1e-3, 1, "aircraft")] = Field(
        0.1, description="rolling moment coefficient per rad of aileron"
    )
    heave: HeaveKeys = HeaveKeys()
    aerodynamics: Aerodynamics = Aerodynamics()

    @field_validator("model", mode="before")
    @classmethod
    def _name(cls, value: object) -> object:
        """YAML reads 737 as a number."""
        return str(value) if isinstance(value, int) and not isinstance(value, bool) else value


class Control(Section):
    """The controller and what it knows of the wake."""

    mode: Literal["off", "feedforward", "perfect"] = Field(
        "feedforward",
        description="off: a pilot levels the wings; feedforward: the lidar gives the preview; "
        "perfect: the true wind gives it",
    )
    preview: Literal["pair", "wind"] = Field(
        "pair",
        description="pair: the loads of the tracked vortices; wind: those of the vortices and of "
        "the air about them, from the wind vectors",
    )
    latency: Annotated[Time, Within(0, 10, "seconds")] | None = Field(
        None,
        description="time from the second scan of a slab to the delivery of its estimate, whatever "
        "was computed; default: the processor time that the computation took, on two cores, with "
        "waiting",
    )
    computing_factor: Annotated[Number, Within(0.001, 1000, "computers")] = Field(
        1.0,
        description="computing time of the aircraft's computer over that of this machine, where "
        "the latency is not given",
    )
    levelling_time: Annotated[Time, Within(0.1, 1000, "a pilot")] | None = Field(
        3.0,
        description="time constant with which a pilot levels the wings in the mode off; null: no "
        "pilot",
    )

    @field_validator("mode", mode="before")
    @classmethod
    def _off_is_a_word(cls, value: object) -> object:
        """YAML reads a bare off as false."""
        return "off" if value is False else value


class Window(Section):
    """Direction of the backscatter lidar's scan."""

    follow: bool = Field(
        False, description="true: the scan follows the vortex pair; false: it is straight ahead"
    )
    reach: Annotated[Angle, Within(0, 0.8, "a scanner")] = Field(
        quantity("20 deg"), description="largest angle of its middle from straight ahead"
    )


class Encounter(Section):
    """A flight through the wake of the experiment."""

    aircraft: Aircraft = Aircraft()
    path: Path = Path()
    wake: WakeInTime = WakeInTime()
    air: Air | None = Field(
        None, description="air in addition to the wake, or instead of it; default: air at rest"
    )
    rate: Annotated[Frequency, Within(0.1, 1000, "slabs a second")] = Field(
        10.0, description="scans per second; each completes one slab"
    )
    look_ahead: Annotated[Length, Within(5, 20000, "a lidar's range")] = Field(
        150.0, description="range at which the farther slab of a scan begins"
    )
    window: Window = Window()
    control: Control = Control()

    @property
    def fixed_latency(self) -> float:
        """The latency of every slab, 0 if it is that of the computation, s."""
        return 0.0 if self.control.latency is None else self.control.latency

    @property
    def usual_latency(self) -> float:
        """The fixed latency, or a period, within which a slab is to be computed, s."""
        return 1 / self.rate if self.control.latency is None else self.control.latency
