"""The keys of the fringe-imaging Doppler lidar."""

import math
from typing import Annotated, Literal, Self

from pydantic import Field, field_validator, model_validator

from lidar_mi.instrument.ccd import CCD
from lidar_mi.instrument.doppler import DopplerLidar
from lidar_mi.instrument.etalon import Etalon
from lidar_mi.instrument.fringe_camera import FringeCamera
from lidar_mi.rendering.settings import FringeSettings
from lidar_mi.retrieval.method_names import RingCentre, RingMethod
from lidar_mi.schema.rings import Assumed, Reference, RingCalibration
from lidar_mi.schema.section import Section, each_once
from lidar_mi.units import Number, Speed, Temperature, Within, to_si


class RingRetrieval(Section):
    """How the wind is retrieved from images of rings, and from how many."""

    methods: tuple[RingMethod, ...] = Field(
        (RingMethod.ANNULAR, RingMethod.CA, RingMethod.CA_R2, RingMethod.ML, RingMethod.SG),
        min_length=1,
        description="methods of the ring analysis",
    )
    centre: tuple[RingCentre, ...] = Field(
        (RingCentre.FREE, RingCentre.KNOWN),
        min_length=1,
        description="of the rings: retrieved from each image, or known",
    )
    averaged: tuple[Annotated[int, Within(1, 10000, "100 s of pulses at 100 Hz")], ...] = Field(
        (1, 5, 20), min_length=1, description="numbers of images averaged before the retrieval"
    )
    images: Annotated[int, Within(1, 100000, "the standard deviation is then known to 0.2 %")] = (
        Field(8, description="averages of each kind and speed")
    )
    slow_images: Annotated[int, Within(0, 100000, "no more than images")] = Field(
        3,
        description="how many of these averages the methods other than annular analyse, which are "
        "slow; at most images",
    )
    aerosol_std: Annotated[Number, Within(0, 10, "a fraction that is not known at all")] = Field(
        0.5, description="uncertainty of lidar.aerosol_fraction; 0: known, not fitted"
    )
    temperature_std: Annotated[
        Temperature, Within(1e-3, 1000, "a temperature that is not known at all")
    ] = Field(10.0, description="uncertainty of the air's temperature")
    light_degree: Annotated[int, Within(0, 8, "finer light has the size of rings")] = Field(
        1, description="of the illumination's polynomial that is fitted along; 1: slopes"
    )
    background_degree: Annotated[int, Within(0, 8, "finer light has the size of rings")] = Field(
        4, description="of the background's polynomial that is fitted along; 0: even"
    )
    max_chi_square: Annotated[
        Number, Within(1, 1e9, "the expected value to any image", or_infinite=True)
    ] = Field(2.0, allow_inf_nan=True, description="images that fit worse are refused")

    @model_validator(mode="after")
    def _each_once(self) -> Self:
        for key in ("methods", "centre", "averaged"):
            each_once(key, getattr(self, key))
        if self.slow_images > self.images:
            raise ValueError(
                f"slow_images: {self.slow_images} is not allowed; expected at most images = "
                f"{self.images}"
            )
        return self


_MODES = Within(0.1, 1e15, "from a pixel that sees part of a mode to white light", or_infinite=True)


class Doppler(Section):
    """The fringe-imaging Doppler lidar and the winds along its line of sight.

    With `kind: coherent`, the keys are those of a coherent lidar on the ground.
    """

    kind: Literal["fringes", "coherent"] = Field(
        "fringes", description="an etalon's fringes on a camera, or a coherent lidar on the ground"
    )
    v_los: tuple[Annotated[Speed, Within(-12000, 12000, "escape velocity")], ...] = Field(
        (50.0, -300.0, -100.0, 0.0, 300.0),
        min_length=1,
        max_length=100,
        description="speeds along the line of sight, positive: the air approaches; figures show "
        "the first",
    )
    lidar: DopplerLidar = DopplerLidar()
    etalon: Etalon = Etalon()
    camera: FringeCamera = FringeCamera()
    ccd: CCD = CCD()
    speckle_modes: Literal["derived"] | Annotated[float, Field(allow_inf_nan=True), _MODES] = Field(
        "derived",
        description="number of speckle modes of a pixel; derived from coherence time, gate and "
        "field of view; inf: no speckle",
    )
    render: FringeSettings = FringeSettings()
    path_samples: Annotated[int, Within(0, 65536, "the standard error is then 0.4 %")] = Field(
        16,
        description="light paths per pixel of an additional image of the laser's light through a "
        "real lens; 0: no such image",
    )
    reference: Reference = Reference()
    assumed: Assumed = Assumed()
    calibration: RingCalibration | None = Field(
        None, description="of the assumed instrument; {} for 20 frames of the laser"
    )
    retrieval: RingRetrieval = RingRetrieval()

    @field_validator("speckle_modes", mode="before")
    @classmethod
    def _derived_or_number(cls, value: object) -> object:
        if value == "derived":
            return value
        try:
            number = to_si(value, "", "350")
        except ValueError:
            # without a range: both faults have one message
            number = math.nan
        if not _MODES.holds(number):
            raise ValueError(f"{value!r} is not allowed; expected derived or {_MODES.words()}")
        return number

    @model_validator(mode="after")
    def _speeds_make_sense(self) -> Self:
        each_once("v_los", self.v_los)
        if self.path_samples == 1:
            raise ValueError("path_samples: 1 is not allowed; expected 0 or 2 and more")
        return self
