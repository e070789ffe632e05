"""The keys of what scatters the light."""

from typing import Annotated, Any, Literal, Self

from pydantic import Field, model_validator

from lidar_mi.schema.section import Section
from lidar_mi.units import Number, Within


class _Scatterer(Section):
    """The keys common to all kinds of scatterers."""

    aerosol: str | None = Field(
        None,
        description="with phase: aerosol: spheroids (default), spheres, continental, sea_salt, "
        "dust, droplets or soot",
    )
    band: Literal["cabannes", "rayleigh"] = Field(
        "cabannes",
        description="with phase: molecules: the Cabannes line alone, as through a filter narrower "
        "than about 0.3 nm, or all Rayleigh scattering",
    )
    depolarization: Annotated[
        Number, Within(0, 0.5, "anisotropy of molecules allows no more", "[)")
    ] = Field(
        0.0,
        description="depolarisation factor of Rayleigh scattering, of natural light at 90 degrees",
    )
    table: str | None = Field(
        None,
        description="with phase: table: file of a scattering matrix, in the experiment's folder "
        "or shipped; see the mueller plugin",
    )

    @model_validator(mode="after")
    def _check_phase(self: Any) -> Any:  # kinds of scatterers have a phase
        for name in ("table", "aerosol"):
            value = getattr(self, name)
            if (self.phase == name) != (value is not None):
                raise ValueError(f"{name}: {value!r} is not allowed with phase {self.phase}")
        if self.depolarization and self.phase != "rayleigh":
            raise ValueError(
                f"depolarization: {self.depolarization:g} is not allowed with phase {self.phase}; "
                "expected phase: rayleigh"
            )
        return self


class Part(_Scatterer):
    """One kind of scatterer in a mixture."""

    phase: Literal["rayleigh", "molecules", "aerosol", "table"] = Field(
        description="kind of scatterer"
    )
    fraction: Annotated[Number, Within(1e-9, 1e9, "only ratios count")] = Field(
        description="of the extinction, relative to the other parts"
    )


class Scattering(_Scatterer):
    """Scattering by the air, in the slab and around it."""

    phase: Literal[
        "rayleigh", "molecules", "isotropic", "henyey_greenstein", "aerosol", "table", "mixture"
    ] = Field("aerosol", description="phase function of slab and environment")
    asymmetry: Annotated[
        Number, Within(-0.999, 0.999, "at 0.999 the forward peak is 0.06 degrees wide")
    ] = Field(0.0, description="asymmetry parameter of the Henyey-Greenstein phase function")
    parts: tuple[Part, ...] | None = Field(
        None, min_length=1, description="components of phase: mixture"
    )
    albedo: Annotated[Number, Within(0, 1, "definition of an albedo")] | None = Field(
        None,
        description="single-scattering albedo, above 0; default: that of the scatterers, 1 for a "
        "table without one",
    )

    @model_validator(mode="before")
    @classmethod
    def _aerosol_unless_stated(cls, data: Any) -> Any:
        if isinstance(data, dict) and data.get("phase", "aerosol") == "aerosol":
            return data | {"aerosol": data.get("aerosol") or "spheroids"}
        return data

    @model_validator(mode="after")
    def _parts_of_a_mixture(self) -> Self:
        if (self.phase == "mixture") != (self.parts is not None):
            value = None if self.parts is None else f"{len(self.parts)} parts"
            raise ValueError(f"parts: {value} is not allowed with phase {self.phase}")
        if self.asymmetry and self.phase != "henyey_greenstein":
            raise ValueError(
                f"asymmetry: {self.asymmetry:g} is not allowed with phase {self.phase}; expected "
                "phase: henyey_greenstein"
            )
        return self
