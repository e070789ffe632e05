"""How the light transport is run."""

from typing import Literal, get_args

from pydantic import BaseModel, ConfigDict, Field

from lidar_mi.units import Length

Variant = Literal[
    "llvm_ad_mono_polarized",
    "llvm_ad_mono",
    "llvm_ad_rgb",
    "llvm_ad_spectral_polarized",
    "llvm_ad_spectral",
    "cuda_ad_mono_polarized",
    "cuda_ad_mono",
    "cuda_ad_rgb",
    "cuda_ad_spectral_polarized",
    "cuda_ad_spectral",
]
VARIANTS: tuple[str, ...] = get_args(Variant)


class RenderSettings(BaseModel):
    """How the light transport is run."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    variant: Variant = "llvm_ad_mono_polarized"
    samples_per_beam: int = Field(64, ge=2, lt=2**31)
    max_order: int = Field(4, ge=1, le=64, description="scattering orders; 1 = single scattering")
    estimator: Literal["gated", "analog"] = "gated"
    samples_per_pass: int = Field(1 << 22, ge=1024, description="traced at once; limits the memory")


class FringeSettings(BaseModel):
    """How the rings of a fringe camera are rendered."""

    model_config = ConfigDict(frozen=True, extra="forbid", validate_default=True)

    variant: Variant = "llvm_ad_mono_polarized"
    samples_per_pixel: int = Field(16, ge=2, lt=2**20, description="light paths, on average")
    estimator: Literal["camera", "forward", "analog"] = Field(
        "camera",
        description="from the pixels; plane waves forward; photons transmitted or rejected",
    )
    line_shape: Literal["folded", "sampled"] = Field(
        "folded", description="mean over the line in closed form; a frequency for every path"
    )
    lens: Literal["ideal", "singlet"] = "ideal"
    stop_radius: Length = Field(5e-3, gt=0, description="of the light into the lens")
    samples_per_pass: int = Field(1 << 22, ge=1024, description="traced at once; limits the memory")
