"""What an experiment file may say: every key, its unit, its default and its limits.

The air's keys are in `schema_air`, the instruments' in `lidar_mi.instrument`.
"""

import math
import re
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, PrivateAttr, field_validator, model_validator

from lidar_mi.experiment.schema_air import Scattering, Section, Wake
from lidar_mi.instrument.ccd import CCD
from lidar_mi.instrument.detector import Detector
from lidar_mi.instrument.doppler import DopplerLidar
from lidar_mi.instrument.doppler_scan import DopplerScan, PlatformErrors
from lidar_mi.instrument.etalon import Etalon
from lidar_mi.instrument.fringe_camera import FringeCamera
from lidar_mi.instrument.lidar import BackscatterLidar
from lidar_mi.instrument.scan import Scan
from lidar_mi.rendering.settings import FringeSettings, RenderSettings
from lidar_mi.retrieval.methods import ImageMethod, RingCentre, RingMethod, VolumeMethod
from lidar_mi.tables import Table, Tabular
from lidar_mi.units import Frequency, Length, Number, Speed, Time, to_si


class Platform(Section):
    """The aircraft that carries the lidar towards the wake."""

    speed: Speed = Field(150.0, ge=0)
    dt: Time = Field(0.1, gt=0)


class Retrieval(Section):
    """How winds are found in the image pair."""

    methods: tuple[ImageMethod, ...] = Field((ImageMethod.CC, ImageMethod.WS), min_length=1)
    template: int = Field(8, ge=2)
    search: int = Field(16, ge=4)
    stride: int = Field(1, ge=1)
    min_correlation: Number = Field(0.5, ge=-1, le=1)
    min_texture: Number = Field(0.01, ge=0)
    min_isotropy: Number = Field(0.2, ge=0, le=1)
    blur: Literal["beam"] | Annotated[Length, Field(ge=0)] = Field(
        0.0, description="standard deviation of what a beam averages over, undone by variational"
    )
    error_budget: bool = Field(False, description="find winds without each cause of error, too")

    @model_validator(mode="after")
    def _region_holds_template(self):
        if self.search < self.template + 2:
            raise ValueError(
                f"search: {self.search} is not allowed; expected at least template + 2 = "
                f"{self.template + 2}"
            )
        return self


def _once(key: str, values: tuple) -> None:
    twice = next((value for value in values if values.count(value) > 1), None)
    if twice is not None:
        raise ValueError(f"{key}: {twice!r} twice is not allowed; expected each once")


class RingRetrieval(Section):
    """How the wind is read from pictures of rings, and how often, to know how well."""

    methods: tuple[RingMethod, ...] = Field(
        (RingMethod.ANNULAR, RingMethod.CA, RingMethod.CA_R2, RingMethod.ML, RingMethod.SG),
        min_length=1,
    )
    centre: tuple[RingCentre, ...] = Field((RingCentre.FREE, RingCentre.KNOWN), min_length=1)
    averaged: tuple[Annotated[int, Field(ge=1, le=10_000)], ...] = Field(
        (1, 5, 20), min_length=1, description="numbers of pictures averaged before they are read"
    )
    images: int = Field(8, ge=1, le=100_000, description="averages of each kind and speed")
    slow_images: int = Field(
        3, ge=0, description="of these, read by methods other than annular, which are slow"
    )

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


class Doppler(Section):
    """The fringe-imaging Doppler lidar and the winds along its line of sight."""

    v_los: tuple[Speed, ...] = Field(
        (50.0, -300.0, -100.0, 0.0, 300.0),
        min_length=1,
        max_length=100,
        description="positive: the air approaches; figures show the first",
    )
    lidar: DopplerLidar = DopplerLidar()
    etalon: Etalon = Etalon()
    camera: FringeCamera = FringeCamera()
    ccd: CCD = CCD()
    speckle_modes: Literal["derived"] | Annotated[float, Field(allow_inf_nan=True)] = Field(
        "derived", description="degrees of freedom of the speckle in a pixel; inf: no speckle"
    )
    render: FringeSettings = FringeSettings()
    photon_samples: int = Field(
        16, ge=0, le=2**16, description="light paths a pixel, photon by photon through a real lens"
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
        if not number > 0:
            raise ValueError(f"{value!r} is not allowed; expected derived or a number above 0")
        return number

    @model_validator(mode="after")
    def _speeds_make_sense(self):
        _once("v_los", self.v_los)
        if self.photon_samples == 1:
            raise ValueError("photon_samples: 1 is not allowed; expected 0 or 2 and more")
        return self


class Sensor(Section):
    """Both lidars as one sensor: the Doppler lidar scans the slab of the backscatter lidar."""

    directions: DopplerScan = DopplerScan()
    pulses: int = Field(20, ge=1, le=10_000, description="averaged in a direction of a slab")
    slabs_per_second: Frequency = Field(10.0, gt=0, description="that are measured")
    method: ImageMethod = Field(
        ImageMethod.VARIATIONAL, description="that the cross-flow wind is taken from"
    )
    crossflow_std: Speed | None = Field(
        None, gt=0, description="standard error of v and w; default: as the method says"
    )
    errors: PlatformErrors = PlatformErrors()
    requirements: str | None = Field(None, description="requirement table; default: the paper's")
    exposure: Time = Field(10.0, gt=0, le=30_000, description="time of looking into the beams")


class Volume(Section):
    """Wind in three dimensions, from all gates of both scans as two volumes."""

    methods: tuple[VolumeMethod, ...] = Field(
        (VolumeMethod.CORRELATION, VolumeMethod.VARIATIONAL), min_length=1
    )
    template: int = Field(8, ge=4, description="voxels along each side of a window")
    search: int = Field(16, ge=6)
    stride: int = Field(4, ge=1)
    min_correlation: Number = Field(0.5, ge=-1, le=1)

    @model_validator(mode="after")
    def _each_once(self):
        _once("methods", self.methods)
        return self


# keys of the backscatter lidar, which looks at a wake
BACKSCATTER = ("platform", "lidar", "detector", "scan", "scattering", "render", "retrieval")


NAME = "[A-Za-z0-9][A-Za-z0-9_.-]*"
"""What an experiment or a variant may be called: both name folders."""


class Experiment(Tabular, Section):
    """One experiment, start to end: a wake for the backscatter lidar, a Doppler lidar, or both."""

    name: str = Field(pattern=f"^{NAME}$")
    seed: int = Field(1, ge=0, lt=2**31)
    wake: Wake | None = Field(None, description="seen by the backscatter lidar")
    doppler: Doppler | None = Field(None, description="the Doppler lidar; {} for the paper's")
    platform: Platform = Platform()
    lidar: BackscatterLidar = BackscatterLidar()
    detector: Detector | None = Field(None, description="adds a noisy picture and its winds")
    scan: Scan = Scan()
    scattering: Scattering = Scattering()
    render: RenderSettings = RenderSettings()
    retrieval: Retrieval = Retrieval()
    sensor: Sensor | None = Field(None, description="both lidars combined; {} for all defaults")
    volume: Volume | None = Field(
        None, description="u, v, w from all gates, in place of retrieval; {} for all defaults"
    )
    _folder: Path = PrivateAttr(Path())

    @property
    def folder(self) -> Path:
        """Where it was read from: files that it names are looked for there first."""
        return self._folder

    def tables(self) -> list[Table]:
        """Keys that are not left to their defaults, in SI units."""
        given = self.model_dump(mode="json", exclude_defaults=True, exclude={"name"})
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
            raise ValueError(f"{key}: not allowed with volume, which finds the wind in its stead")
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
        if method in (ImageMethod.CC, ImageMethod.WS) and self.sensor.crossflow_std is None:
            raise ValueError(
                f"sensor.crossflow_std: missing; expected a speed, as method {method} knows no "
                "errors"
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
                "knows no polarisation; expected 0"
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
