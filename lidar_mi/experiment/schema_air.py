"""What an experiment file may say of the air: its flow, its extinction, how it scatters."""

from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field, field_validator, model_validator

from lidar_mi.units import Circulation, Extinction, Length, Number, Speed, Time, quantity, to_si


class Section(BaseModel):
    """A part of an experiment file: frozen, every key known, no NaN or infinity."""

    # enumerations hold what is allowed; values are plain strings, as files and data sets hold them
    model_config = ConfigDict(
        frozen=True,
        extra="forbid",
        validate_default=True,
        allow_inf_nan=False,
        use_enum_values=True,
    )


class VortexPair(Section):
    """An analytic vortex pair in place of a simulation."""

    model: Literal["lamb_oseen", "burnham_hallock"] = "lamb_oseen"
    circulation: Circulation = Field(458.0, gt=0)
    separation: Length = Field(47.1, gt=0)
    core_radius: Length = Field(3.0, gt=0)
    width: Length = Field(109.0, gt=0, description="extent of the domain in y")
    height: Length = Field(69.0, gt=0, description="extent of the domain in z")


class Turbine(Section):
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


class ExtinctionMapping(Section):
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


class Texture(Section):
    """Sub-grid aerosol texture that a simulation's grid has lost; rms 0 switches it off."""

    rms: Number = Field(0.1, ge=0, le=2)
    outer_scale: Length = Field(10.0, gt=0)


class Wake(Section):
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


class _Scatterer(Section):
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
