"""The keys of the observed air: flow, extinction, texture."""

from typing import Annotated, Literal, Self

from pydantic import Field, field_validator, model_validator

from lidar_mi.atmosphere.vortices.aircraft_wake import TYPES, aircraft_type, wake_of
from lidar_mi.schema.section import Section
from lidar_mi.units import (
    Circulation,
    Extinction,
    Given,
    Length,
    Mass,
    Number,
    Speed,
    Time,
    Within,
    quantity,
    to_si,
)

_Extent = Annotated[
    Length, Within(0.1, 100000, "from models in a tunnel to the boundary layer of a region")
]
_Place = Annotated[Length, Within(-1e6, 1e6, "models of a region")]
_Moment = Annotated[Time, Within(-1e10, 1e10, "three centuries about any epoch")]


class VortexPair(Section):
    """An analytic vortex pair in place of a simulation; that of an aircraft from its lift."""

    model: Literal["lamb_oseen", "burnham_hallock"] = Field(
        "lamb_oseen", description="swirl profile"
    )
    aircraft: str | None = Field(
        None,
        description="ICAO type that left the pair, such as A343: circulation, separation and core "
        "radius follow where they are not given",
    )
    mass: Annotated[Mass, Within(1, 2e6, "aircraft")] | None = Field(
        None, description="of that aircraft; default: its largest at landing"
    )
    speed: Annotated[Speed, Within(10, 350, "from a glider to the speed of sound")] = Field(
        75.0, description="true airspeed of that aircraft"
    )
    altitude: Annotated[Length, Within(0, 20000, "aircraft")] = Field(
        300.0, description="of that aircraft above sea level, for the density of the air"
    )
    circulation: Annotated[
        Circulation, Within(1e-6, 10000, "the largest aircraft have 1000 m^2/s")
    ] = Field(458.0, description="of each vortex")
    separation: Annotated[
        Length, Within(0.01, 1000, "from models in a tunnel to ten times the widest wing")
    ] = Field(47.1, description="distance between the vortices")
    core_radius: Annotated[
        Length, Within(0.001, 100, "from models in a tunnel to wider than any wake's core")
    ] = Field(3.0, description="radius of the largest tangential speed")
    width: _Extent = Field(109.0, description="extent of the domain in y")
    height: _Extent = Field(69.0, description="extent of the domain in z")

    @field_validator("aircraft")
    @classmethod
    def _check_aircraft(cls, value: str | None) -> str | None:
        if value is not None and value not in TYPES:
            raise ValueError(f"{value!r} is not allowed; expected one of {', '.join(TYPES)}")
        return value

    @model_validator(mode="after")
    def _of_the_aircraft(self) -> Self:
        if self.aircraft is None:
            for name in ("mass", "speed", "altitude"):
                # a saved description has all defaults
                if getattr(self, name) != type(self).model_fields[name].default:
                    raise ValueError(f"{name}: not allowed without aircraft")
            return self
        # loaded only where it is needed
        from lidar_mi.atmosphere.air.standard_atmosphere import standard_atmosphere

        kind = aircraft_type(self.aircraft)
        mass = kind.landing_mass if self.mass is None else self.mass
        density = standard_atmosphere(self.altitude).density
        for name, value in wake_of(kind.span, mass, self.speed, density)._asdict().items():
            if name not in self.model_fields_set:
                # the section is frozen from here on
                object.__setattr__(self, name, value)
        return self


class Turbine(Section):
    """The analytic wake of a wind turbine, viewed downstream from its nacelle."""

    diameter: Annotated[
        Length, Within(0.1, 1000, "from models in a tunnel to four times the largest rotor")
    ] = Field(50.0, description="of the rotor")
    thrust: Annotated[
        Number, Within(0, 1, "in momentum theory 0 leaves no wake, 1 no wind", "()")
    ] = Field(0.75, description="thrust coefficient")
    tip_speed_ratio: Annotated[Number, Within(-100, 100, "fast rotors have 15")] = Field(
        7.0,
        description="speed of the blade tips over that of the wind; negative: the wake rotates "
        "from +z towards +y",
    )
    wind_speed: Annotated[Speed, Within(0.01, 200, "from a calm to a tornado")] = Field(
        8.0, description="of the undisturbed wind, along x"
    )
    growth: Annotated[Number, Within(0.0001, 1, "wakes are measured to have 0.02 to 0.08")] = Field(
        0.035,
        description="growth rate of the wake's width with the distance: 0.02 (calm) to 0.06 "
        "(turbulent)",
    )
    hub_core: Annotated[
        Length, Within(0.001, 100, "from models in a tunnel to the largest rotor")
    ] = Field(3.0, description="core radius of the swirl")
    downstream: (
        Annotated[
            Length, Within(0.01, 100000, "from models in a tunnel to farms beyond the horizon")
        ]
        | None
    ) = Field(None, description="distance from the rotor; default: the middle of the gates")
    turbulence: Annotated[Number, Within(0, 0.5, "turbulence is frozen only below")] = Field(
        0.06,
        description="turbulence intensity of the undisturbed wind; 0: none, not even that added "
        "by the rotor",
    )
    outer_scale: Annotated[
        Length, Within(0.01, 10000, "from a wind tunnel to the depth of the troposphere")
    ] = Field(30.0, description="of the turbulence")
    width: _Extent = Field(109.0, description="extent of the domain in y")
    height: _Extent = Field(69.0, description="extent of the domain in z")


class ExtinctionMapping(Section):
    """From tracers (or from the wind's speed) to the extinction coefficient."""

    source: Literal["tracer", "speed"] = Field(
        "tracer", description="extinction from tracer and aerosol, or from (v^2 + w^2)^(1/2)"
    )
    tracer: str | None = Field("tracer", description="exhaust tracer, or null for none")
    aerosol: str | None = Field("aerosol", description="background aerosol, or null for a flat one")
    background: Annotated[Extinction, Within(0, 10, "visibility is 0.3 m in the densest smoke")] = (
        Field(
            quantity("0.1 / km"),
            description="extinction by aerosol without exhaust, also of the environment; 3.9 over "
            "the visibility at green wavelengths",
        )
    )
    maximum: Annotated[
        Extinction, Within(1e-12, 10, "from the thermosphere to the densest smoke")
    ] = Field(
        quantity("1.8 / km"),
        description="in all, at the largest tracer concentration (or speed); above background",
    )
    molecules: (
        Literal["auto"]
        | Annotated[Extinction, Within(0, 0.1, "air at the ground has 0.03 / m at 100 nm")]
    ) = Field(
        "auto",
        description="extinction by clear air, added in slab and environment; it has no texture "
        "and scatters in scattering.band. auto: that of the site at the laser's wavelength, or 0 "
        "where scattering.phase is no aerosol or table, or has molecules as a part; 0: none",
    )
    stretch: Annotated[Number, Within(1, 100, "1 is linear; 100 is a step")] = Field(
        2.0, description="contrast of thin tracer; 1 = linear"
    )

    @model_validator(mode="after")
    def _above_the_background(self) -> Self:
        if self.maximum > self.background:
            return self
        name, bound = "maximum", "background"
        # a number without a unit is per metre
        slip = not isinstance(self.background, Given) and 1e-3 * self.background < self.maximum
        if slip or "maximum" not in self.model_fields_set:
            name, bound = bound, name
        value, limit = 1e3 * getattr(self, name), 1e3 * getattr(self, bound)
        side = "more" if name == "maximum" else "less"
        hint = f": is {1e-3 * value:g} / km meant?" if slip else ""
        raise ValueError(
            f"{name}: {value:g} / km is not allowed; expected {side} than {bound}, {limit:g} / km"
            f"{hint}"
        )


class Texture(Section):
    """Sub-grid aerosol texture, not resolved by a simulation's grid; rms 0: none."""

    rms: Annotated[Number, Within(0, 2, "a log-normal field of 2 consists of few peaks")] = Field(
        0.1, description="of the relative texture of the extinction; 0: none"
    )
    outer_scale: Annotated[
        Length, Within(0.001, 10000, "from the smallest eddies to the depth of the troposphere")
    ] = Field(10.0, description="largest scale of the texture; at least two cells")


class Wake(Section):
    """The flow and the tracers in it."""

    file: str | None = Field(
        None,
        description="NetCDF file: in the experiment's folder, with an absolute path, or shipped; "
        "one of file, vortex_pair and turbine is needed",
    )
    vortex_pair: VortexPair | None = None
    turbine: Turbine | None = None
    time: _Moment | None = Field(
        None, description="of the first image; needed when the file holds several"
    )
    second: Literal["advect", "advect_3d"] | _Moment = Field(
        "advect",
        description="state at the second image: advected by v and w, by u, v and w of a volume, "
        "or stored at another time of the file",
    )
    x: _Place | None = Field(
        None,
        description="plane (depth: plane) or point that is placed in the middle of the gates; "
        "needed when the file holds several planes",
    )
    depth: Literal["plane", "volume"] = Field(
        "plane",
        description="one plane extruded over the gates (with second: advect_3d the mean of the "
        "planes in them), or all planes of the file",
    )
    centre: tuple[_Place, _Place] | None = Field(
        None, description="(y, z) of the wake placed on the beam axis; default: the domain's middle"
    )
    spacing: Annotated[
        Length, Within(0.001, 1000, "from the smallest eddies to models of a region")
    ] = Field(0.5, description="of the nodes in y and z; also in x where air moves along x")
    names: dict[str, str] = Field(
        {},
        description="our names of dimensions and variables: those in the file; a minus sign "
        "before one changes the sign",
    )
    extinction: ExtinctionMapping = ExtinctionMapping()
    texture: Texture = Texture()

    @field_validator("second", mode="before")
    @classmethod
    def _advect_or_time(cls, value: object) -> object:
        if value in ("advect", "advect_3d"):
            return value
        try:
            return to_si(value, "s", "40.1 s")
        except ValueError:
            raise ValueError(
                f"{value!r} is not allowed; expected advect, advect_3d or a time such as '40.1 s'"
            ) from None

    @property
    def stored(self) -> float | None:
        """Time of the file whose state is that at t2, s; None: that of t1 is advected."""
        return None if isinstance(self.second, str) else self.second

    @model_validator(mode="after")
    def _one_source(self) -> Self:
        sources = [name for name in ("file", "vortex_pair", "turbine") if getattr(self, name)]
        if len(sources) != 1:
            raise ValueError("expected one of file, vortex_pair and turbine")
        if sources == ["file"]:
            self._check_tracers()
            return self
        if self.second != "advect":
            raise ValueError(
                f"second: {self.second!r} is not allowed with {sources[0]}; expected advect"
            )
        if self.depth == "volume":
            raise ValueError(f"depth: 'volume' is not allowed with {sources[0]}")
        for key in ("time", "x", "centre", "names"):
            if getattr(self, key):
                raise ValueError(f"{key}: {getattr(self, key)!r} is not allowed with {sources[0]}")
        return self

    def _check_tracers(self) -> None:
        """Refuse a plane of extinction by speed that is advected: it is a state of its tracers."""
        if (
            self.second == "advect_3d"
            and self.depth == "plane"
            and self.extinction.source == "speed"
        ):
            raise ValueError(
                "second: 'advect_3d' is not allowed with depth: plane and extinction.source: "
                "speed; expected extinction.source: tracer, or depth: volume"
            )
