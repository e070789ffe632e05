"""The keys of an experiment file, each with its unit, its default and its limits.

The air's keys are in `schema_air`, the instruments' in `lidar_mi.instrument`.
"""

import math
import re
from pathlib import Path
from typing import Annotated, Literal

from pydantic import AliasChoices, Field, PrivateAttr, field_validator, model_validator

from lidar_mi.experiment.schema_air import Scattering, Section, Wake
from lidar_mi.experiment.schema_encounter import Encounter
from lidar_mi.experiment.schema_rings import Assumed, Reference, RingCalibration
from lidar_mi.instrument.ccd import CCD
from lidar_mi.instrument.detector import Detector
from lidar_mi.instrument.doppler import DopplerLidar
from lidar_mi.instrument.doppler_scan import DopplerScan, PlatformErrors
from lidar_mi.instrument.etalon import Etalon
from lidar_mi.instrument.fringe_camera import FringeCamera
from lidar_mi.instrument.lidar import BackscatterLidar
from lidar_mi.instrument.motion import Motion
from lidar_mi.instrument.reported import Reported
from lidar_mi.instrument.scan import Scan
from lidar_mi.instrument.scan_timing import ScanTiming
from lidar_mi.rendering.settings import FringeSettings, RenderSettings
from lidar_mi.retrieval.method_names import ImageMethod, RingCentre, RingMethod, VolumeMethod
from lidar_mi.tables import Table, Tabular
from lidar_mi.units import (
    AS_GIVEN,
    Angle,
    Frequency,
    Length,
    Number,
    Speed,
    Temperature,
    Time,
    Within,
    to_si,
)


def _once(key: str, values: tuple) -> None:
    twice = next((value for value in values if values.count(value) > 1), None)
    if twice is not None:
        raise ValueError(f"{key}: {twice!r} twice is not allowed; expected each once")


class Platform(Section):
    """The aircraft that carries the lidar towards the wake."""

    speed: Annotated[Speed, Within(0, 12000, "from rest to escape velocity")] = 150.0
    dt: Annotated[
        Time, Within(1e-6, 10000, "from a repetition rate of 1 MHz to the life of a wake")
    ] = 0.1
    motion: Motion | None = Field(None, description="departure from straight and level flight")
    reported: Reported | None = Field(
        None, description="errors of the pose that is told; default: the true one is known"
    )


class Pointing(Section):
    """What is known of the pointing from one scan to the next."""

    offset: Literal["known", "free"] = Field(
        "known", description="free: lines of sight may estimate the wind that it feigns"
    )
    stderr: Annotated[Angle, Within(0, 0.1, "displaced by more than the image")] = Field(
        0.0, description="standard error of pitch and of yaw between the scans"
    )
    roll: Annotated[Angle, Within(0, 0.1, "displaced by more than the image")] = Field(
        0.0, description="standard error of roll between the scans"
    )

    @model_validator(mode="after")
    def _free_by_how_much(self):
        if self.offset == "free" and not self.stderr:
            raise ValueError(
                "stderr: 0 rad is not allowed with offset free; expected above 0 rad, the standard "
                "error of the pointing before"
            )
        return self


class Retrieval(Section):
    """How winds are retrieved from the image pair."""

    methods: tuple[ImageMethod, ...] = Field(
        (ImageMethod.VARIATIONAL, ImageMethod.CC), min_length=1
    )
    template: Annotated[int, Within(2, 4096, "wider than any image")] = 8
    search: Annotated[int, Within(4, 8192, "wider than any image")] = 16
    stride: Annotated[int, Within(1, 8192, "wider than any image")] = 1
    min_correlation: Annotated[Number, Within(-1, 1, "definition of a correlation")] = 0.5
    min_texture: Annotated[Number, Within(0, 1000, "noise without signal has about 1")] = 0.01
    min_isotropy: Annotated[Number, Within(0, 1, "definition of a ratio")] = 0.2
    blur: Literal["beam"] | Annotated[Length, Within(0, 1000, "the widest beam")] = Field(
        0.0, description="standard deviation of the beam's blur, corrected by variational"
    )
    pointing: Pointing = Pointing()
    error_budget: bool = Field(False, description="also retrieve winds without each cause of error")
    sources: Literal["all", "measured"] = Field(
        "all",
        description="also from ideal images of the truth, for comparison, or from measured ones "
        "alone",
    )

    @model_validator(mode="after")
    def _budget_compares(self):
        if self.error_budget and self.sources != "all":
            raise ValueError(
                "sources: 'measured' is not allowed with error_budget; expected all, or "
                "retrieval.error_budget=false"
            )
        return self

    @model_validator(mode="after")
    def _each_once(self):
        _once("methods", self.methods)
        return self

    @model_validator(mode="after")
    def _region_holds_template(self):
        if self.search < self.template + 2:
            raise ValueError(
                f"search: {self.search} is not allowed; expected at least template + 2 = "
                f"{self.template + 2}"
            )
        return self


class RingRetrieval(Section):
    """How the wind is retrieved from images of rings, and from how many."""

    methods: tuple[RingMethod, ...] = Field(
        (RingMethod.ANNULAR, RingMethod.CA, RingMethod.CA_R2, RingMethod.ML, RingMethod.SG),
        min_length=1,
    )
    centre: tuple[RingCentre, ...] = Field((RingCentre.FREE, RingCentre.KNOWN), min_length=1)
    averaged: tuple[Annotated[int, Within(1, 10000, "100 s of pulses at 100 Hz")], ...] = Field(
        (1, 5, 20), min_length=1, description="numbers of images averaged before the retrieval"
    )
    images: Annotated[int, Within(1, 100000, "the standard deviation is then known to 0.2 %")] = (
        Field(8, description="averages of each kind and speed")
    )
    slow_images: Annotated[int, Within(0, 100000, "no more than images")] = Field(
        3, description="of these, for methods other than annular, which are slow"
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
    def _each_once(self):
        for key in ("methods", "centre", "averaged"):
            _once(key, getattr(self, key))
        if self.slow_images > self.images:
            raise ValueError(
                f"slow_images: {self.slow_images} is not allowed; expected at most images = "
                f"{self.images}"
            )
        return self


_MODES = Within(0.1, 1e15, "from a pixel that sees part of a mode to white light", or_infinite=True)


class Doppler(Section):
    """The fringe-imaging Doppler lidar and the winds along its line of sight."""

    v_los: tuple[Annotated[Speed, Within(-12000, 12000, "escape velocity")], ...] = Field(
        (50.0, -300.0, -100.0, 0.0, 300.0),
        min_length=1,
        max_length=100,
        description="positive: the air approaches; figures show the first",
    )
    lidar: DopplerLidar = DopplerLidar()
    etalon: Etalon = Etalon()
    camera: FringeCamera = FringeCamera()
    ccd: CCD = CCD()
    speckle_modes: Literal["derived"] | Annotated[float, Field(allow_inf_nan=True), _MODES] = Field(
        "derived", description="degrees of freedom of the speckle in a pixel; inf: no speckle"
    )
    render: FringeSettings = FringeSettings()
    path_samples: Annotated[int, Within(0, 65536, "the standard error is then 0.4 %")] = Field(
        16,
        description="light paths per pixel, each traced through a real lens",
        validation_alias=AliasChoices("path_samples", "photon_samples"),  # its former name
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
            number = math.nan
        if not _MODES.holds(number):
            raise ValueError(f"{value!r} is not allowed; expected derived or {_MODES.words()}")
        return number

    @model_validator(mode="after")
    def _speeds_make_sense(self):
        _once("v_los", self.v_los)
        if self.path_samples == 1:
            raise ValueError("path_samples: 1 is not allowed; expected 0 or 2 and more")
        return self


class Sensor(Section):
    """Both lidars as one sensor: the Doppler lidar scans the slab of the backscatter lidar."""

    directions: DopplerScan = DopplerScan()
    timing: ScanTiming | None = Field(
        None, description="when each line is measured; default: all at once"
    )
    pulses: Annotated[int, Within(1, 10000, "100 s of pulses at 100 Hz")] = Field(
        20, description="averaged per direction of a slab"
    )
    slabs_per_second: Annotated[
        Frequency, Within(1e-6, 1e6, "from one a week to one for every echo from 150 m")
    ] = Field(10.0, description="that are measured")
    method: ImageMethod = Field(ImageMethod.VARIATIONAL, description="of the cross-flow wind")
    crossflow_std: (
        Annotated[Speed, Within(1e-9, 1000, "from rounding errors to the fastest wind")] | None
    ) = Field(None, description="standard error of v and w; default: that of the method")
    drift: Literal["none", "estimated"] = Field(
        "none",
        description="of the wind's pattern, by which vectors and lines are brought to mid-time",
    )
    errors: PlatformErrors = PlatformErrors()
    requirements: str | None = Field(None, description="requirement table; default: the paper's")
    exposure: Annotated[
        Time, Within(0, 30000, "exposure limits are defined up to 30 000 s", "(]")
    ] = Field(10.0, description="time of exposure to the beams")

    @model_validator(mode="after")
    def _pulses_of_a_line(self):
        if self.timing and self.timing.pulses_per_beam != 1:
            raise ValueError(
                f"timing.pulses_per_beam: {self.timing.pulses_per_beam} is not allowed with "
                "sensor; expected 1, sensor.pulses are those of a line"
            )
        return self


class Volume(Section):
    """Wind in three dimensions, from all gates of both scans as two volumes."""

    methods: tuple[VolumeMethod, ...] = Field(
        (VolumeMethod.CORRELATION, VolumeMethod.VARIATIONAL), min_length=1
    )
    template: Annotated[int, Within(4, 1024, "wider than any volume")] = Field(
        8, description="voxels along each side of a window"
    )
    search: Annotated[int, Within(6, 2048, "wider than any volume")] = 16
    stride: Annotated[int, Within(1, 2048, "wider than any volume")] = 4
    min_correlation: Annotated[Number, Within(-1, 1, "definition of a correlation")] = 0.5

    @model_validator(mode="after")
    def _each_once(self):
        _once("methods", self.methods)
        return self


# keys of the backscatter lidar, which observes a wake
BACKSCATTER = ("platform", "lidar", "detector", "scan", "scattering", "render", "retrieval")


NAME = "[A-Za-z0-9][A-Za-z0-9_.-]{0,99}"
"""Allowed names of experiments and variants, which are names of folders."""


class Experiment(Tabular, Section):
    """One experiment: a wake for the backscatter lidar, a Doppler lidar, or both."""

    name: str = Field(pattern=f"^{NAME}$")
    seed: Annotated[int, Within(0, 2**31 - 1, "integers of an image header")] = 1
    wake: Wake | None = Field(None, description="observed by the backscatter lidar")
    doppler: Doppler | None = Field(None, description="the Doppler lidar; {} for the paper's")
    platform: Platform = Platform()
    lidar: BackscatterLidar = BackscatterLidar()
    detector: Detector | None = Field(None, description="adds a noisy image and its winds")
    scan: Scan = Scan()
    scattering: Scattering = Scattering()
    render: RenderSettings = RenderSettings()
    retrieval: Retrieval = Retrieval()
    sensor: Sensor | None = Field(None, description="both lidars combined; {} for all defaults")
    volume: Volume | None = Field(
        None, description="u, v, w from all gates, in place of retrieval; {} for all defaults"
    )
    encounter: Encounter | None = Field(
        None, description="a flight through the wake, by fly; {} for all defaults"
    )
    _folder: Path = PrivateAttr(Path())

    @property
    def folder(self) -> Path:
        """The folder of its file, in which files that it names are searched first."""
        return self._folder

    def tables(self) -> list[Table]:
        """Keys that differ from their defaults, as they were given."""
        given = self.model_dump(
            mode="json", exclude_defaults=True, exclude={"name"}, context=AS_GIVEN
        )
        return [Table(f"experiment {self.name}; keys without their default", _rows(given))]

    def read_from(self, folder: str | Path) -> "Experiment":
        """The same experiment, with another folder for the files that it names."""
        copy = self.model_copy()
        copy._folder = Path(folder)
        return copy

    @model_validator(mode="after")
    def _gates_that_make_a_volume(self):
        if self.volume is None:
            return self
        wake, scan = self.wake, self.scan
        if wake is None or (wake.depth != "volume" and wake.turbine is None):
            raise ValueError(
                "volume: not allowed without a wake in three dimensions; expected "
                "wake.depth: volume"
            )
        if wake.second != "advect":
            raise ValueError(
                f"wake.second: {wake.second:g} s is not allowed with volume; expected advect"
            )
        if self.sensor or self.retrieval != Retrieval():
            key = "sensor" if self.sensor else "retrieval"
            raise ValueError(
                f"{key}: not allowed with volume, which retrieves the wind in its stead"
            )
        for key, given in (
            ("scan.timing", scan.timing),
            ("platform.motion", self.platform.motion),
            ("platform.reported", self.platform.reported),
        ):
            if given is not None:
                raise ValueError(
                    f"{key}: not allowed with volume, whose scans are instantaneous; expected none"
                )
        if scan.gates != "planar":
            raise ValueError(
                f"scan.gates: {scan.gates} is not allowed with volume; expected planar"
            )
        if scan.gate_count < self.volume.template:
            raise ValueError(
                f"scan.gate_count: {scan.gate_count} is not allowed with volume; expected at least "
                f"volume.template = {self.volume.template}"
            )
        return self

    @model_validator(mode="after")
    def _both_lidars_for_the_sensor(self):
        if self.sensor is None:
            return self
        if self.wake is None or self.doppler is None:
            raise ValueError("sensor: not allowed without wake and doppler; expected both")
        method = self.sensor.method
        if method not in self.retrieval.methods:
            raise ValueError(
                f"sensor.method: {method!r} is not allowed; expected one of retrieval.methods, "
                f"{', '.join(self.retrieval.methods)}"
            )
        if method == ImageMethod.WS and self.sensor.crossflow_std is None:
            raise ValueError(
                f"sensor.crossflow_std: missing; expected a speed, as method {method} knows the "
                "standard errors of few vectors"
            )
        return self

    @model_validator(mode="after")
    def _molecules_beside_particles(self):
        phase = self.scattering.phase
        if (
            self.wake
            and self.wake.extinction.molecules
            and phase in ("isotropic", "henyey_greenstein")
        ):
            raise ValueError(
                f"wake.extinction.molecules: not allowed with scattering.phase {phase}, which "
                "is unpolarised; expected 0"
            )
        return self

    @model_validator(mode="after")
    def _something_to_do(self):
        if self.wake is None and self.doppler is None:
            raise ValueError("expected wake, doppler or both")
        for key in BACKSCATTER:
            unused = getattr(self, key) != type(self).model_fields[key].default
            if self.wake is None and unused:
                raise ValueError(f"{key}: not allowed without wake; expected it under doppler")
        return self

    @model_validator(mode="after")
    def _telescope_stays_before_the_slab(self):
        flown = (self.platform.speed - self.scan.follow) * self.platform.dt
        if flown >= self.scan.range:
            raise ValueError(
                f"scan.range: {self.scan.range:g} m is not allowed; expected more than the "
                f"{flown:g} m flown in platform.dt"
            )
        return self


def _rows(section: dict, above: str = "") -> list[tuple[str, str]]:
    """Dotted keys of a section and their values, numbers to four digits."""
    rows = []
    for key, value in section.items():
        if isinstance(value, dict) and value:
            rows += _rows(value, f"{above}{key}.")
        else:
            text = ", ".join(map(str, value)) if isinstance(value, list) else str(value)
            shown = re.sub(r"\d+\.\d+(e-?\d+)?", lambda number: f"{float(number[0]):.4g}", text)
            rows.append((f"{above}{key}", shown))
    return rows
