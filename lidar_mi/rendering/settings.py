"""How the light transport is run."""

from typing import Literal

from pydantic import BaseModel, ConfigDict, Field

from lidar_mi.units import Length

VARIANTS = tuple(
    f"{backend}_ad_{colour}"
    for backend in ("llvm", "cuda")
    for colour in ("mono_polarized", "mono", "rgb", "spectral_polarized", "spectral")
)


class RenderSettings(BaseModel):
    """How the light transport is run."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    variant: Literal[VARIANTS] = "llvm_ad_mono_polarized"
    samples_per_beam: int = Field(64, ge=2, lt=2**31)
    max_order: int = Field(4, ge=1, le=64, description="scattering orders; 1 = single scattering")
    estimator: Literal["gated", "analog"] = "gated"
    samples_per_pass: int = Field(1 << 22, ge=1024, description="photons in flight: the memory")


class FringeSettings(BaseModel):
    """How the rings of a fringe camera are rendered."""

    model_config = ConfigDict(frozen=True, extra="forbid", validate_default=True)

    variant: Literal[VARIANTS] = "llvm_ad_mono_polarized"
    samples_per_pixel: int = Field(16, ge=2, lt=2**20, description="light paths, on the average")
    estimator: Literal["camera", "forward", "analog"] = Field(
        "camera", description="from the pixels out; plane waves forward; photons that pass or not"
    )
    line_shape: Literal["folded", "sampled"] = Field(
        "folded", description="the line's mean in closed form; a frequency for every path"
    )
    lens: Literal["ideal", "singlet"] = "ideal"
    stop_radius: Length = Field(5e-3, gt=0, description="of the light into the lens")
    samples_per_pass: int = Field(1 << 22, ge=1024, description="light paths at once: the memory")
