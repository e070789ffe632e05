"""Settings of the light transport."""

from typing import Annotated, Literal, get_args

from pydantic import Field

from lidar_mi.description import Description
from lidar_mi.units import Length, Memory, Within

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


_CEILING = Within(1e8, 1e15, "from a small scene to the largest machine")


class RenderSettings(Description):
    """Settings of the light transport."""

    variant: Variant = "llvm_ad_mono_polarized"
    samples_per_beam: Annotated[
        int, Within(2, 2**31 - 1, "a standard error needs two; counted in 31 bits")
    ] = 64
    max_order: Annotated[int, Within(1, 64, "higher orders are below single precision")] = Field(
        4, description="scattering orders; 1 = single scattering"
    )
    estimator: Literal["gated", "analog"] = "gated"
    samples_per_pass: Annotated[
        int, Within(1024, 2**31 - 1, "fewer waste the processor; counted in 31 bits")
    ] = Field(1 << 22, description="traced at once, fewer if memory does not hold them")
    memory: Annotated[Memory, _CEILING] | None = Field(
        None, description="that a run may take; default: half of the machine's"
    )


class FringeSettings(Description):
    """Settings of the rendering of a fringe camera's rings."""

    variant: Variant = "llvm_ad_mono_polarized"
    samples_per_pixel: Annotated[
        int, Within(2, 2**20 - 1, "a standard error needs two; it is then 0.1 %")
    ] = Field(16, description="light paths, on average")
    estimator: Literal["camera", "forward", "analog"] = Field(
        "camera", description="from the pixels; plane waves forward; paths transmitted or rejected"
    )
    line_shape: Literal["folded", "sampled"] = Field(
        "folded", description="mean over the line in closed form; a frequency for every path"
    )
    lens: Literal["ideal", "singlet"] = "ideal"
    stop_radius: Annotated[Length, Within(1e-6, 1, "from a pinhole to the largest lens")] = Field(
        5e-3, description="of the light into the lens"
    )
    samples_per_pass: Annotated[
        int, Within(1024, 2**31 - 1, "fewer waste the processor; counted in 31 bits")
    ] = Field(1 << 22, description="traced at once, fewer if memory does not hold them")
    memory: Annotated[Memory, _CEILING] | None = Field(
        None, description="that a run may take; default: half of the machine's"
    )
