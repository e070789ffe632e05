"""The keys of the air about a wake: turbulence, gusts, shear, a microburst."""

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from lidar_mi.schema.section import Section
from lidar_mi.units import Angle, Length, Number, Shear, Speed, Time, Within, quantity

_Place = Annotated[Length, Within(-1e5, 1e5, "an encounter")]


class Turbulence(Section):
    """Isotropic turbulence, with the rms and length of a standard or given ones."""

    spectrum: Literal["von_karman", "kolmogorov"] = Field(
        "von_karman", description="energy spectrum; both have the same rms and inertial range"
    )
    standard: Literal["mil_f_8785c", "cs_25"] = Field(
        "mil_f_8785c", description="source of rms and length; cs_25 has a length, and needs sigma"
    )
    level: Literal["light", "moderate", "severe"] = Field(
        "moderate", description="level of mil_f_8785c"
    )
    sigma: Annotated[Speed, Within(0, 30, "severe storms have 9 m/s")] | None = Field(
        None, description="rms of one component; default: that of the standard at this level"
    )
    length: Annotated[Length, Within(1, 10000, "to the depth of the troposphere")] | None = Field(
        None, description="length scale; default: that of the standard"
    )
    shortest: Annotated[Length, Within(0.1, 1000, "a tenth of the length at most")] = Field(
        2.0, description="shortest wavelength that is simulated"
    )
    evolution: Literal["frozen", "turnover", "sweeping"] = Field(
        "frozen",
        description="change in the frame of the mean wind: frozen: none; turnover: eddies turn "
        "over; sweeping: large eddies sweep small ones",
    )
    seed: Annotated[int, Within(0, 2**31 - 1, "as of the experiment's seed")] | None = Field(
        None, description="seed of the turbulence; default: that of the experiment"
    )

    @model_validator(mode="after")
    def _has_an_rms(self) -> Self:
        if self.standard == "cs_25" and self.sigma is None:
            raise ValueError(
                "sigma: missing; CS 25.341 has a length, but limits of loads in place of an rms; "
                "expected sigma, or standard: mil_f_8785c"
            )
        if self.length is not None and self.shortest > self.length / 10:
            raise ValueError(
                f"shortest: {self.shortest:g} m is not allowed; expected at most a tenth of the "
                f"length, {self.length / 10:g} m"
            )
        return self


class Gust(Section):
    """A discrete 1-cosine gust of CS 25.341."""

    direction: Literal["up", "down", "left", "right"] = Field(
        "up", description="direction in which the gust blows"
    )
    gradient: Annotated[Length, Within(1, 1000, "CS 25.341 has 9 to 107 m")] = Field(
        50.0, description="gradient distance, half of the length of the gust"
    )
    start: _Place = Field(200.0, description="start of the gust, from that of the path")
    speed: Annotated[Speed, Within(0.01, 50, "CS 25.341 has 17 m/s at most")] | None = Field(
        None,
        description="largest true speed of the gust; default: the design speed of CS 25.341 at "
        "the altitude of the path's start",
    )
    alleviation: Annotated[Number, Within(0, 1, "a fraction", "(]")] | None = Field(
        None,
        description="flight profile alleviation factor F_g of the design speed; default: from "
        "maximum_altitude, else 1",
    )
    maximum_altitude: Annotated[Length, Within(1, 20000, "of operation")] | None = Field(
        None,
        description="maximum operating altitude Z_mo, from which F_g follows; excludes speed and "
        "alleviation",
    )
    landing_weight: Annotated[Number, Within(0, 1, "of that at take-off", "(]")] = Field(
        1.0, description="maximum landing weight over maximum take-off weight, R_1"
    )
    zero_fuel_weight: Annotated[Number, Within(0, 1, "of that at take-off", "(]")] = Field(
        1.0, description="maximum zero fuel weight over maximum take-off weight, R_2"
    )

    @model_validator(mode="after")
    def _one_source_of_the_speed(self) -> Self:
        keys = [
            name
            for name in ("speed", "alleviation", "maximum_altitude")
            if getattr(self, name) is not None
        ]
        if len(keys) > 1:
            raise ValueError(f"{keys[1]}: has no effect beside {keys[0]}; expected one of them")
        # the regulation's range, rounded to metres
        if self.speed is None and not 9 <= self.gradient <= 107:
            raise ValueError(
                f"gradient: {self.gradient:g} m is not allowed without a speed; expected the 9 to "
                "107 m of CS 25.341, or speed"
            )
        return self


class LinearShear(Section):
    """A horizontal wind that grows linearly with the height."""

    du_dz: Annotated[Shear, Within(-1, 1, "a jet at the ground has 0.1 / s")] = Field(
        0.0, description="vertical gradient of the wind along the path"
    )
    dv_dz: Annotated[Shear, Within(-1, 1, "a jet at the ground has 0.1 / s")] = Field(
        0.0, description="vertical gradient of the wind to the left"
    )


class LogarithmicShear(Section):
    """The logarithmic wind profile of the neutral surface layer."""

    speed: Annotated[Speed, Within(0, 100, "a hurricane")] = Field(
        quantity("10 m/s"), description="wind speed at the height reference"
    )
    reference: Annotated[Length, Within(0.1, 1000, "a mast")] = Field(
        quantity("20 ft"), description="height of speed above the ground"
    )
    roughness: Annotated[Length, Within(1e-6, 10, "from ice to a town")] = Field(
        quantity("0.15 ft"), description="roughness length of the ground"
    )
    towards: Annotated[Angle, Within(-6.3, 6.3, "a turn")] = Field(
        quantity("180 deg"),
        description="direction to which the wind blows; 0: tail wind, 90 deg: to the left",
    )

    @model_validator(mode="after")
    def _ground_below_the_reference(self) -> Self:
        if self.roughness >= self.reference:
            raise ValueError(
                f"roughness: {self.roughness:g} m is not allowed; expected below the "
                f"{self.reference:g} m of the reference"
            )
        return self


class Microburst(Section):
    """The downdraft of Oseguera and Bowles (1988)."""

    outflow: Annotated[Speed, Within(0.1, 100, "the largest was 67 m/s")] = Field(
        15.0, description="largest speed of the outflow"
    )
    radius: Annotated[Length, Within(10, 10000, "a microburst")] = Field(
        600.0, description="radius of the downdraft; the outflow is largest at 1.12 radii"
    )
    outflow_height: Annotated[Length, Within(1, 1000, "near the ground")] = Field(
        60.0, description="height of the largest outflow"
    )
    x: _Place = Field(400.0, description="distance of its axis from the start of the path")
    y: _Place = Field(0.0, description="distance of its axis to the left of the path")


_Step = Annotated[Length, Within(0.01, 1000, "from wind tunnels to models of weather")]


_Nodes = Annotated[int, Within(4, 65536, "cubic splines need 4, memory ends below")]


class MannBox(Section):
    """What the files of a Mann box do not say."""

    nodes: tuple[_Nodes, _Nodes, _Nodes] = Field(description="along x, y and z")
    spacing: tuple[_Step, _Step, _Step] = Field(description="of the nodes along x, y and z")
    base: Annotated[Length, Within(0, 20000, "above the ground")] = Field(
        description="height of the lowest nodes above the ground"
    )


class AirVolume(Section):
    """Air of a simulation in its mean wind: one instant, frozen, or a series of states."""

    file: str = Field(
        description="NetCDF file with u, v, w on (x, y, z), z above the ground; or a full field of "
        "TurbSim (.bts); or u of a Mann box of HAWC2 (.bin), beside v and w"
    )
    time: Annotated[Time, Within(-1e10, 1e10, "three centuries about any epoch")] | None = Field(
        None, description="time in the file as the path starts; required if it has several"
    )
    series: bool = Field(
        False, description="true: the air goes on through the states after `time`; false: frozen"
    )
    mann: MannBox | None = Field(None, description="with a Mann box")
    largest_divergence: Annotated[Number, Within(0, 1, "0.577 is noise")] = Field(
        0.2,
        description="rms of the divergence over that of the velocity gradient up to which air is "
        "accepted; fields of TurbSim have 0.5 to 0.6",
    )
    names: dict[str, str] = Field(
        {}, description="names in the file, of variables or dimensions with other names there"
    )
    start: Annotated[Length, Within(-1e6, 1e6, "models of a region")] | None = Field(
        None, description="x of the file at which the path starts; default: its first plane"
    )
    centre: Annotated[Length, Within(-1e6, 1e6, "models of a region")] | None = Field(
        None, description="y of the file at which the path lies; default: the middle"
    )


class Air(Section):
    """The air about the wake, or instead of it."""

    wake: bool = Field(
        True,
        description="false: there is no wake; its section still gives the size, texture and "
        "extinction of the images",
    )
    turbulence: Turbulence | None = None
    volume: AirVolume | None = None
    gusts: tuple[Gust, ...] = ()
    linear_shear: LinearShear | None = None
    logarithmic_shear: LogarithmicShear | None = None
    microburst: Microburst | None = None
