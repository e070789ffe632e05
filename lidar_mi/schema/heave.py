"""The keys of an aircraft that pitches and moves vertically."""

from typing import Annotated

from pydantic import Field, model_validator

from lidar_mi.schema.section import Section
from lidar_mi.units import Angle, Area, Inertia, Length, Mass, Number, Within, quantity


class HeaveKeys(Section):
    """Mass, tail, elevator and symmetric ailerons of the model heave, and the mass of its wing.

    Defaults are the Boeing 737 of JSBSim: its mass with fuel, pitch inertia, tail, elevator power,
    and the static margin from its slopes of pitching moment and lift. For an aircraft of JSBSim
    only wing_mass is used.
    """

    mass: Annotated[Mass, Within(1, 1e6, "aircraft")] = Field(48500.0, description="mass in flight")
    pitch_inertia: Annotated[Inertia, Within(0.1, 1e9, "aircraft")] = Field(
        2.1e6, description="moment of inertia about the pitch axis"
    )
    static_margin: Annotated[Number, Within(0.01, 1, "stable aircraft")] = Field(
        0.23,
        description="distance from the centre of gravity back to the neutral point, in mean chords "
        "(wing area / span)",
    )
    tail_area: Annotated[Area, Within(0.01, 1000, "aircraft")] = Field(
        32.3, description="area of the horizontal tail"
    )
    tail_arm: Annotated[Length, Within(0.1, 100, "aircraft")] = Field(
        14.64, description="distance from the centre of gravity back to the horizontal tail"
    )
    elevator_power: Annotated[Number, Within(1e-3, 5, "aircraft")] = Field(
        1.2, description="pitching moment coefficient per rad of elevator, with the mean chord"
    )
    largest_elevator: Annotated[Angle, Within(0, 1, "aircraft")] = Field(
        quantity("20 deg"), description="largest deflection of the elevator from trim; 0: fixed"
    )
    largest_symmetric_aileron: Annotated[Angle, Within(0, 1, "aircraft")] = Field(
        quantity("10 deg"),
        description="largest symmetric deflection of both ailerons; 0: they only roll",
    )
    aileron_inner: Annotated[Number, Within(0, 1, "of half the span")] = Field(
        0.7, description="inner end of the ailerons, fraction of the half span"
    )
    aileron_outer: Annotated[Number, Within(0, 1, "of half the span")] = Field(
        0.95, description="outer end of the ailerons, fraction of the half span"
    )
    wing_mass: Annotated[Number, Within(0, 0.9, "of the aircraft's mass")] = Field(
        0.17,
        description="mass of the wing with engines and fuel, fraction of the mass; also used for "
        "aircraft of JSBSim",
    )

    @model_validator(mode="after")
    def _has_ailerons(self) -> "HeaveKeys":
        if self.aileron_outer <= self.aileron_inner:
            raise ValueError(
                f"aileron_outer {self.aileron_outer:g} is not allowed; expected more than "
                f"aileron_inner, {self.aileron_inner:g}"
            )
        return self
