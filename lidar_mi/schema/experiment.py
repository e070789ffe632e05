"""The keys of an experiment file, each with its unit, its default and its limits.

Each section has a file; those of the instruments are in `lidar_mi.instrument`.
"""

import re
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import Discriminator, Field, PrivateAttr, Tag, model_validator

from lidar_mi.instrument.detector import Detector
from lidar_mi.instrument.lidar import BackscatterLidar
from lidar_mi.instrument.scan import Scan
from lidar_mi.rendering.settings import RenderSettings
from lidar_mi.retrieval.method_names import ImageMethod
from lidar_mi.schema.coherent import CoherentDoppler
from lidar_mi.schema.doppler import Doppler
from lidar_mi.schema.encounter import Encounter
from lidar_mi.schema.platform import Platform
from lidar_mi.schema.retrieval import Retrieval
from lidar_mi.schema.scattering import Scattering
from lidar_mi.schema.section import Section
from lidar_mi.schema.sensor import Sensor
from lidar_mi.schema.site import Site
from lidar_mi.schema.volume import Volume
from lidar_mi.schema.wake import Wake
from lidar_mi.tables import Table, Tabular
from lidar_mi.units import AS_GIVEN, Within

# keys of the backscatter lidar, which observes a wake
BACKSCATTER = ("platform", "lidar", "detector", "scan", "scattering", "render", "retrieval")


NAME = "[A-Za-z0-9][A-Za-z0-9_.-]{0,99}"
"""Allowed names of experiments and variants, which are names of folders."""


def _kind_of(doppler: object) -> str:
    """The kind of a Doppler lidar; the section of the default kind refuses an unknown one."""
    kind = doppler.get("kind") if isinstance(doppler, dict) else getattr(doppler, "kind", None)
    return "coherent" if kind == "coherent" else "fringes"


AnyDoppler = Annotated[
    Annotated[Doppler, Tag("fringes")] | Annotated[CoherentDoppler, Tag("coherent")],
    Discriminator(_kind_of),
]
"""A Doppler lidar of either kind."""


class Experiment(Tabular, Section):
    """One experiment: a wake for the backscatter lidar, a Doppler lidar, or both."""

    name: str = Field(pattern=f"^{NAME}$", description="of the run and of its folder")
    seed: Annotated[int, Within(0, 2**31 - 1, "integers of an image header")] = Field(
        1, description="of the texture and of the Monte Carlo samples"
    )
    device: Literal["auto", "cpu", "cuda"] | None = Field(
        None,
        description="where images are rendered and winds retrieved; default: rendering as "
        "render.variant says, retrieval on the processor",
    )
    wake: Wake | None = Field(
        None, description="observed by the backscatter lidar, or by a coherent Doppler lidar"
    )
    doppler: AnyDoppler | None = Field(
        None,
        description="the Doppler lidar; {} for the paper's, kind: coherent for one on the ground",
    )
    platform: Platform = Platform()
    site: Site = Site()
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

    @property
    def fringes(self) -> Doppler | None:
        """The Doppler lidar, if it images fringes."""
        return self.doppler if isinstance(self.doppler, Doppler) else None

    @property
    def coherent(self) -> CoherentDoppler | None:
        """The Doppler lidar, if it is a coherent one on the ground."""
        return self.doppler if isinstance(self.doppler, CoherentDoppler) else None

    @property
    def imaged_wake(self) -> Wake | None:
        """The wake, if a backscatter lidar observes it."""
        return None if self.coherent else self.wake

    def tables(self) -> list[Table]:
        """Keys that differ from their defaults, as they were given."""
        settings = self.model_dump(
            mode="json", exclude_defaults=True, exclude={"name"}, context=AS_GIVEN
        )
        return [Table(f"experiment {self.name}; keys without their default", _rows(settings))]

    def read_from(self, folder: str | Path) -> "Experiment":
        """The same experiment, with another folder for the files that it names."""
        copy = self.model_copy()
        copy._folder = Path(folder)
        return copy

    @model_validator(mode="after")
    def _coherent_lidar_alone(self) -> Self:
        if self.coherent is None:
            return self
        for key in ("sensor", "volume", "encounter"):
            if getattr(self, key) is not None:
                raise ValueError(
                    f"{key}: not allowed with doppler.kind coherent, a lidar on the ground; "
                    "expected doppler.kind: fringes"
                )
        wake = self.wake
        if wake is not None and wake.turbine is not None:
            raise ValueError(
                "wake.turbine: not allowed with doppler.kind coherent; expected vortex_pair or file"
            )
        if wake is not None and (wake.depth == "volume" or wake.second != "advect"):
            key = "depth" if wake.depth == "volume" else "second"
            raise ValueError(
                f"wake.{key}: {getattr(wake, key)} is not allowed with doppler.kind coherent, "
                "which observes a plane as it drifts; expected the default"
            )
        if wake is None and self.coherent.scan.kind == "rhi":
            raise ValueError(
                "wake: missing; doppler.scan.kind rhi expects one (ppi and dbs measure the wind)"
            )
        return self

    @model_validator(mode="after")
    def _gates_that_make_a_volume(self) -> Self:
        if self.volume is None:
            return self
        wake, scan = self.wake, self.scan
        if wake is None or (wake.depth != "volume" and wake.turbine is None):
            raise ValueError(
                "volume: not allowed without a wake in three dimensions; expected "
                "wake.depth: volume"
            )
        if wake.stored is not None:
            raise ValueError(
                f"wake.second: {wake.stored:g} s is not allowed with volume; expected advect or "
                "advect_3d"
            )
        if self.sensor or self.retrieval != Retrieval():
            key = "sensor" if self.sensor else "retrieval"
            raise ValueError(
                f"{key}: not allowed with volume, which retrieves the wind in its stead"
            )
        for key, setting in (
            ("scan.timing", scan.timing),
            ("platform.motion", self.platform.motion),
            ("platform.reported", self.platform.reported),
        ):
            if setting is not None:
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
    def _both_lidars_for_the_sensor(self) -> Self:
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
    def _molecules_with_polarised_particles(self) -> Self:
        phase = self.scattering.phase
        if (
            self.imaged_wake
            and self.imaged_wake.extinction.molecules not in ("auto", 0)
            and phase in ("isotropic", "henyey_greenstein")
        ):
            raise ValueError(
                f"wake.extinction.molecules: not allowed with scattering.phase {phase}, which "
                "is unpolarised; expected auto or 0"
            )
        return self

    @model_validator(mode="after")
    def _site_has_molecules_that_are_seen(self) -> Self:
        if self.fringes is None and self.imaged_wake is None and self.site != Site():
            raise ValueError(
                "site: not allowed with doppler.kind coherent, whose echo is that of aerosol "
                "and as strong as doppler.signal says; expected no site, or doppler.kind: "
                "fringes"
            )
        return self

    @model_validator(mode="after")
    def _something_to_do(self) -> Self:
        if self.wake is None and self.doppler is None:
            raise ValueError("expected wake, doppler or both")
        for key in BACKSCATTER:
            unused = getattr(self, key) != type(self).model_fields[key].default
            if self.imaged_wake is None and unused:
                without = "with doppler.kind coherent" if self.coherent else "without wake"
                raise ValueError(f"{key}: not allowed {without}; expected it under doppler")
        return self

    @model_validator(mode="after")
    def _telescope_stays_before_the_slab(self) -> Self:
        advance = (self.platform.speed - self.scan.follow) * self.platform.dt
        if advance >= self.scan.range:
            raise ValueError(
                f"scan.range: {self.scan.range:g} m is not allowed; expected more than the "
                f"{advance:g} m flown in platform.dt"
            )
        return self


def _rows(section: dict[str, Any], above: str = "") -> list[tuple[str, str]]:
    """Dotted keys of a section and their values, numbers to four digits."""
    rows = []
    for key, value in section.items():
        if isinstance(value, dict) and value:
            rows += _rows(value, f"{above}{key}.")
        else:
            text = ", ".join(map(str, value)) if isinstance(value, list) else str(value)
            rounded = re.sub(r"\d+\.\d+(e-?\d+)?", lambda number: f"{float(number[0]):.4g}", text)
            rows.append((f"{above}{key}", rounded))
    return rows
