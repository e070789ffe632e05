"""What an experiment file may say: every key, its unit, its default and its limits."""

import math
import re
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, PrivateAttr, field_validator, model_validator

from lidar_mi.instrument.detector import Detector
from lidar_mi.instrument.doppler import DopplerLidar
from lidar_mi.instrument.doppler_scan import DopplerScan, PlatformErrors
from lidar_mi.instrument.etalon import Etalon
from lidar_mi.instrument.fringe_camera import CCD, FringeCamera
from lidar_mi.instrument.lidar import BackscatterLidar
from lidar_mi.instrument.scan import Scan
from lidar_mi.rendering.settings import FringeSettings, RenderSettings
from lidar_mi.retrieval.methods import ImageMethod, RingCentre, RingMethod, VolumeMethod
from lidar_mi.tables import Table, Tabular
from lidar_mi.units import (
    Circulation,
    Extinction,
    Frequency,
    Length,
    Number,
    Speed,
    Time,
    quantity,
    to_si,
)


class _Section(BaseModel):
    # enumerations hold what is allowed; values are plain strings, as files and data sets hold them
    model_config = ConfigDict(
        frozen=True,
        extra="forbid",
        validate_default=True,
        allow_inf_nan=False,
        use_enum_values=True,
    )


class VortexPair(_Section):
    """An analytic vortex pair in place of a simulation."""

    model: Literal["lamb_oseen", "burnham_hallock"] = "lamb_oseen"
    circulation: Circulation = Field(458.0, gt=0)
    separation: Length = Field(47.1, gt=0)
    core_radius: Length = Field(3.0, gt=0)
    width: Length = Field(109.0, gt=0, description="extent of the domain in y")
    height: Length = Field(69.0, gt=0, description="extent of the domain in z")


class Turbine(_Section):
    """The analytic wake of a wind turbine, seen downstream from its nacelle."""

    diameter: Length = Field(50.0, gt=0, description="of the rotor")
    thrust: Number = Field(0.75, gt=0, lt=1, description="thrust coefficient")
    tip_speed_ratio: Number = Field(7.0, description="speed of the tips over that of the wind")
    wind_speed: Speed = Field(8.0, gt=0, description="of the undisturbed wind, along x")
    growth: Number = Field(0.035, gt=0, description="of the wake's width with the distance")
    hub_core: Length = Field(3.0, gt=0, description="core radius of the swirl")
    downstream: Length | None = Field(
        None, gt=0, description="distance from the rotor; default: the middle of the gates"
    )
    turbulence: Number = Field(0.06, ge=0, le=0.5, description="intensity of the undisturbed wind")
    outer_scale: Length = Field(30.0, gt=0, description="of the turbulence")
    width: Length = Field(109.0, gt=0, description="extent of the domain in y")
    height: Length = Field(69.0, gt=0, description="extent of the domain in z")


class ExtinctionMapping(_Section):
    """From tracers (or from the wind's speed) to the extinction coefficient."""

    source: Literal["tracer", "speed"] = "tracer"
    tracer: str | None = Field("tracer", description="exhaust tracer, or null for none")
    aerosol: str | None = Field("aerosol", description="background aerosol, or null for a flat one")
    background: Extinction = Field(
        quantity("0.1 / km"), ge=0, description="also of the environment"
    )
    maximum: Extinction = Field(quantity("1.8 / km"), gt=0)
    molecules: Extinction = Field(
        0.0, ge=0, description="on top of it, in slab and environment: by air, which has no texture"
    )
    stretch: Number = Field(2.0, ge=1, description="contrast of thin tracer; 1 = linear")


class Texture(_Section):
    """Sub-grid aerosol texture that a simulation's grid has lost; rms 0 switches it off."""

    rms: Number = Field(0.1, ge=0, le=2)
    outer_scale: Length = Field(10.0, gt=0)


class Wake(_Section):
    """The flow and what drifts in it."""

    file: str | None = Field(None, description="NetCDF file; beside the experiment or shipped")
    vortex_pair: VortexPair | None = None
    turbine: Turbine | None = None
    time: Time | None = Field(None, description="needed when the file holds several")
    second: Literal["advect"] | Time = Field("advect", description="t2: advected, or a time")
    x: Length | None = Field(None, description="plane put in the middle of the gates")
    depth: Literal["plane", "volume"] = Field(
        "plane", description="one plane extruded over the gates, or all planes of the file"
    )
    centre: tuple[Length, Length] | None = Field(
        None, description="(y, z) of the wake put on the beam axis; default: the domain's middle"
    )
    spacing: Length = Field(0.5, gt=0)
    names: dict[str, str] = Field({}, description="our dimension or variable names: the file's")
    extinction: ExtinctionMapping = ExtinctionMapping()
    texture: Texture = Texture()

    @field_validator("second", mode="before")
    @classmethod
    def _advect_or_time(cls, value: object) -> object:
        if value == "advect":
            return value
        try:
            return to_si(value, "s", "40.1 s")
        except ValueError:
            raise ValueError(
                f"{value!r} is not allowed; expected advect or a time such as '40.1 s'"
            ) from None

    @model_validator(mode="after")
    def _one_source(self):
        sources = [name for name in ("file", "vortex_pair", "turbine") if getattr(self, name)]
        if len(sources) != 1:
            raise ValueError("expected one of file, vortex_pair and turbine")
        if sources == ["file"]:
            return self
        if self.second != "advect":
            raise ValueError(f"second: {self.second!r} is not allowed with {sources[0]}")
        if self.depth == "volume":
            raise ValueError(f"depth: 'volume' is not allowed with {sources[0]}")
        for key in ("time", "x", "centre", "names"):
            if getattr(self, key):
                raise ValueError(f"{key}: {getattr(self, key)!r} is not allowed with {sources[0]}")
        return self


class Platform(_Section):
    """The aircraft that carries the lidar towards the wake."""

    speed: Speed = Field(150.0, ge=0)
    dt: Time = Field(0.1, gt=0)


class _Scatterer(_Section):
    """What any kind of scatterer may be asked."""

    aerosol: str | None = Field(None, description="name of an aerosol, with phase: aerosol")
    band: Literal["cabannes", "rayleigh"] = Field(
        "cabannes", description="of molecules: the line a narrow filter lets through, or all"
    )
    depolarization: Number = Field(0.0, ge=0, lt=0.5, description="of Rayleigh, natural light")
    table: str | None = Field(None, description="scattering-matrix file, see the mueller plugin")

    @model_validator(mode="after")
    def _named_what_it_needs(self: Any) -> Any:  # kinds of scatterers have a phase
        for name in ("table", "aerosol"):
            value = getattr(self, name)
            if (self.phase == name) != (value is not None):
                raise ValueError(f"{name}: {value!r} is not allowed with phase {self.phase}")
        return self


class Part(_Scatterer):
    """One kind of scatterer in a mixture."""

    phase: Literal["rayleigh", "molecules", "aerosol", "table"]
    share: Number = Field(gt=0, description="of the extinction, relative to the other parts")


class Scattering(_Scatterer):
    """How the air scatters, in the slab and around it."""

    phase: Literal[
        "rayleigh", "molecules", "isotropic", "henyey_greenstein", "aerosol", "table", "mixture"
    ] = "rayleigh"
    asymmetry: Number = Field(0.0, gt=-1, lt=1, description="of Henyey-Greenstein")
    parts: tuple[Part, ...] | None = Field(None, min_length=1, description="of a mixture")
    albedo: Number | None = Field(
        None, ge=0, le=1, description="scattered share of the extinction; default: the scatterers'"
    )

    @model_validator(mode="after")
    def _parts_of_a_mixture(self):
        if (self.phase == "mixture") != (self.parts is not None):
            value = None if self.parts is None else f"{len(self.parts)} parts"
            raise ValueError(f"parts: {value} is not allowed with phase {self.phase}")
        return self


class Retrieval(_Section):
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


class RingRetrieval(_Section):
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


class Doppler(_Section):
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


class Sensor(_Section):
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


class Volume(_Section):
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


class Experiment(Tabular, _Section):
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
