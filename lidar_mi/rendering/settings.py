"""How the light transport is run."""

from typing import Literal

from pydantic import BaseModel, ConfigDict, Field

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
