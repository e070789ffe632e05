"""The keys of an aircraft that rises and pitches."""

from typing import Annotated

from pydantic import Field, model_validator

from lidar_mi.experiment.schema.section import Section
from lidar_mi.units import Angle, Area, Inertia, Length, Mass, Number, Within, quantity


class HeaveKeys(Section):
    """Mass, tail and elevator of the model heave, and how the ailerons lift and the wing bends.

    Defaults are the Boeing 737 of JSBSim: its mass with fuel, pitch inertia, tail, elevator power,
    and the ratio of its slopes of pitching moment, about the centre of gravity, and lift. Of an
    aircraft of JSBSim only the wing's part of the mass counts.
    """

    mass: Annotated[Mass, Within(1, 1e6, "aircraft")] = Field(48500.0, description="in flight")
    pitch_inertia: Annotated[Inertia, Within(0.1, 1e9, "aircraft")] = Field(
        2.1e6, description="moment of inertia about the pitch axis"
    )
    static_margin: Annotated[Number, Within(0.01, 1, "stable aircraft")] = Field(
        0.23,
        description="from the centre of gravity to the neutral point, in chords (wing area / span)",
    )
    tail_area: Annotated[Area, Within(0.01, 1000, "aircraft")] = Field(
        32.3, description="of the horizontal tail"
    )
    tail_arm: Annotated[Length, Within(0.1, 100, "aircraft")] = Field(
        14.64, description="from the centre of gravity to the horizontal tail"
    )
    elevator_power: Annotated[Number, Within(1e-3, 5, "aircraft")] = Field(
        1.2, description="pitching moment coefficient, with the chord wing area / span, per rad"
    )
    largest_elevator: Annotated[Angle, Within(0, 1, "aircraft")] = Field(
        quantity("20 deg"), description="largest deflection from trim; 0: it is fixed"
    )
    largest_symmetric_aileron: Annotated[Angle, Within(0, 1, "aircraft")] = Field(
        quantity("10 deg"),
        description="largest deflection of both ailerons to one side; 0: they only roll",
    )
    aileron_inner: Annotated[Number, Within(0, 1, "of half the span")] = Field(
        0.7, description="inner end of the ailerons, over half the span"
    )
    aileron_outer: Annotated[Number, Within(0, 1, "of half the span")] = Field(
        0.95, description="outer end of the ailerons, over half the span"
    )
    wing_mass: Annotated[Number, Within(0, 0.9, "of the aircraft's mass")] = Field(
        0.17,
        description="fraction of the mass that is wing, with engines and fuel; of JSBSim's "
        "aircraft, too",
    )

    @model_validator(mode="after")
    def _has_ailerons(self) -> "HeaveKeys":
        if self.aileron_outer <= self.aileron_inner:
            raise ValueError(
                f"aileron_outer {self.aileron_outer:g} is not allowed; expected more than "
                f"aileron_inner, {self.aileron_inner:g}"
            )
        return self
