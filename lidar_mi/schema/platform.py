"""The keys of the aircraft that carries the lidars."""

from typing import Annotated

from pydantic import Field

from lidar_mi.instrument.motion import Motion
from lidar_mi.instrument.reported import Reported
from lidar_mi.schema.section import Section
from lidar_mi.units import Speed, Time, Within


class Platform(Section):
    """The aircraft that carries the lidar towards the wake."""

    speed: Annotated[Speed, Within(0, 12000, "from rest to escape velocity")] = Field(
        150.0, description="of the aircraft, along x; it must not reach the slab"
    )
    dt: Annotated[
        Time, Within(1e-6, 10000, "from a repetition rate of 1 MHz to the life of a wake")
    ] = Field(
        0.1,
        description="time between the two images; where wake.second is a time: the difference of "
        "both",
    )
    motion: Motion | None = Field(None, description="departure from straight and level flight")
    reported: Reported | None = Field(
        None, description="errors of the reported pose; default: the true one is known"
    )
