"""The keys of both lidars as one sensor."""

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from lidar_mi.instrument.doppler_scan import DopplerScan, PlatformErrors
from lidar_mi.instrument.scan_timing import ScanTiming
from lidar_mi.retrieval.method_names import ImageMethod
from lidar_mi.schema.section import Section
from lidar_mi.units import Frequency, Speed, Time, Within


class Sensor(Section):
    """Both lidars as one sensor: the Doppler lidar scans the slab of the backscatter lidar."""

    directions: DopplerScan = DopplerScan()
    timing: ScanTiming | None = Field(
        None,
        description="when each line is measured, with the keys of scan.timing; default: all at "
        "once",
    )
    pulses: Annotated[int, Within(1, 10000, "100 s of pulses at 100 Hz")] = Field(
        20, description="averaged per direction of a slab"
    )
    slabs_per_second: Annotated[
        Frequency, Within(1e-6, 1e6, "from one a week to one for every echo from 150 m")
    ] = Field(
        10.0, description="rate of measured slabs, from which the required pulse rates follow"
    )
    method: ImageMethod = Field(
        ImageMethod.VARIATIONAL, description="method of retrieval.methods that provides v and w"
    )
    crossflow_std: (
        Annotated[Speed, Within(1e-9, 1000, "from rounding errors to the fastest wind")] | None
    ) = Field(
        None, description="standard error of v and w; default: as stated by the method (not ws)"
    )
    drift: Literal["none", "estimated"] = Field(
        "none",
        description="of the wind's pattern, by which vectors and lines are advected to mid-time; "
        "estimated: from the images' wind",
    )
    errors: PlatformErrors = PlatformErrors()
    requirements: str | None = Field(
        None,
        description="requirement table; default: that of the paper for flight control, none for a "
        "lidar at rest",
    )
    exposure: Annotated[
        Time, Within(0, 30000, "exposure limits are defined up to 30 000 s", "(]")
    ] = Field(10.0, description="time of exposure to the beams")

    @model_validator(mode="after")
    def _pulses_of_a_line(self) -> Self:
        if self.timing and self.timing.pulses_per_beam != 1:
            raise ValueError(
                f"timing.pulses_per_beam: {self.timing.pulses_per_beam} is not allowed with "
                "sensor; expected 1, sensor.pulses are those of a line"
            )
        return self
