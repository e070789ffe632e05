"""The keys of the lift of an aircraft's strips."""

from typing import Annotated, Literal

from pydantic import Field

from lidar_mi.schema.section import Section
from lidar_mi.units import Number, Within


class Aerodynamics(Section):
    """How the lift of wing and tail follows the wind and the motion of the aircraft."""

    lift: Literal["quasi_steady", "unsteady"] = Field(
        "quasi_steady",
        description="quasi_steady: lift follows at once; unsteady: as the functions of Wagner "
        "(motion) and Kuessner (wind)",
    )
    largest_lift_coefficient: Annotated[Number, Within(0.1, 5, "of sections")] | None = Field(
        None,
        description="lift coefficient at which the lift of a strip stops growing, upwards and "
        "downwards; null: it does not stall",
    )
    wind_along: bool = Field(
        False, description="true: wind along the body changes the dynamic pressure of each strip"
    )
