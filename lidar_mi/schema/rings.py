"""The keys of a fringe-imaging lidar's reference shot, calibration and assumed instrument."""

from typing import Annotated, Self, TypeVar

from pydantic import Field, model_validator

from lidar_mi.description import Description
from lidar_mi.schema.section import Section
from lidar_mi.units import Angle, Frequency, Length, Number, Temperature, Within

_Tilt = Annotated[Angle, Within(-0.5, 0.5, "as of the camera")]
_Part = TypeVar("_Part", bound=Description)
_Fraction = Annotated[Number, Within(0, 1, "definition of a fraction")]


class Reference(Section):
    """The frame of the laser's own light: the zero of the speeds until the next one."""

    photons: Annotated[Number, Within(1, 1e15, "a photon to the whole pulse")] | None = Field(
        None,
        description="detected in the laser frame that every pulse has; default: as many as of the "
        "echo",
    )
    every: Annotated[int, Within(1, 100000, "a quarter of an hour of pulses at 100 Hz")] = Field(
        1,
        description="pulses from one laser frame to the next; averages are of a multiple or a "
        "divisor of it",
    )
    laser_drift: Annotated[Frequency, Within(0, 1e12, "hundreds of orders of an etalon")] = Field(
        0.0,
        description="rms step of the laser's frequency from pulse to pulse, a random walk that "
        "every laser frame begins anew",
    )
    etalon_drift: Annotated[Temperature, Within(0, 100, "no laboratory changes faster")] = Field(
        0.0, description="rms step of the etalon's temperature from pulse to pulse, a random walk"
    )
    expansion: Annotated[Number, Within(0, 1e-3, "beyond that of any spacer")] = Field(
        5e-7, description="relative, of the etalon's gap per K; fused silica"
    )
    laser_pupil: Annotated[Number, Within(1e-6, 1, "from a point to the whole pupil")] = Field(
        1.0,
        description="radius of the laser's light in the etalon over that of the echo; with "
        "etalon.bow an error that no image shows",
    )
    echo_shift: Annotated[Number, Within(-1, 1, "by the radius of the pupil")] = Field(
        0.0, description="of the echo's light along the wedge, over the pupil's radius"
    )
    wedge: Annotated[Length, Within(0, 1e-6, "a wavelength leaves no rings")] = Field(
        0.0, description="rms deviation of the gap by plates that are not parallel"
    )
    scrambling: _Fraction = Field(
        0.0, description="fraction of both lights that a scrambler spreads evenly over the pupil"
    )


class Assumed(Section):
    """Values that the retrieval assumes for the instrument in place of the true ones."""

    focal_length: Annotated[Length, Within(0.001, 100, "as of the camera")] | None = Field(
        None, description="taken by the retrieval in place of the true one; default: the true one"
    )
    reflectivity: Annotated[Number, Within(1e-9, 0.999999, "as of the etalon")] | None = Field(
        None, description="taken by the retrieval in place of the true one; default: the true one"
    )
    surface_rms: Annotated[Length, Within(0, 1e-6, "as of the etalon")] | None = Field(
        None, description="taken by the retrieval in place of the true one; default: the true one"
    )
    order_fraction: Annotated[Number, Within(0, 1, "as of the etalon", "[)")] | None = Field(
        None, description="taken by the retrieval in place of the true one; default: the true one"
    )
    bow: Annotated[Length, Within(0, 1e-4, "as of the etalon")] | None = Field(
        None, description="taken by the retrieval in place of the true one; default: the true one"
    )
    illumination_radius: Annotated[Length, Within(1e-6, 1000, "1000 m is even light")] | None = (
        Field(
            None,
            description="taken by the retrieval in place of the true one; default: the true one",
        )
    )
    tilt: tuple[_Tilt, _Tilt] | None = Field(
        None, description="taken by the retrieval in place of the true one; default: the true one"
    )
    distortion: Annotated[Number, Within(-0.05, 0.05, "as of the camera")] | None = Field(
        None, description="taken by the retrieval in place of the true one; default: the true one"
    )
    defocus: Annotated[Length, Within(0, 0.01, "as of the camera")] | None = Field(
        None, description="taken by the retrieval in place of the true one; default: the true one"
    )

    def of(self, part: _Part) -> _Part:
        """A part of the instrument with the assumed values in place of its own."""
        assumed = self.model_dump(exclude_none=True)
        # etalon and camera each have some of the assumed values
        update = {name: value for name, value in assumed.items() if name in type(part).model_fields}
        return part.model_copy(update=update)


class RingCalibration(Section):
    """Frames of the laser from which the instrument is calibrated before winds are retrieved."""

    frames: Annotated[int, Within(2, 1000, "two determine the drift")] = Field(
        20,
        description="simulated laser frames, with noise and drift, from which the assumed "
        "instrument is calibrated",
    )
    file: str | None = Field(
        None, description="calibration by lidar-mi calibrate, in place of simulated frames"
    )
    light_degree: Annotated[int, Within(0, 8, "finer light has the size of rings")] = Field(
        2, description="of the illumination's polynomial"
    )

    @model_validator(mode="after")
    def _one_origin(self) -> Self:
        if self.file is not None and "frames" in self.model_fields_set:
            raise ValueError(
                "frames: not allowed with file; expected one of them: simulated frames, or a file"
            )
        return self
