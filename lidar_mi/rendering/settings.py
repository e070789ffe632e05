"""Settings of the light transport."""

import math
from typing import Annotated, Literal, Self, get_args

from pydantic import Field, model_validator

from lidar_mi.description import Description
from lidar_mi.units import Length, Memory, Number, Within

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


_PerPass = Annotated[int, Within(1024, 2**31 - 1, "fewer waste the processor; counted in 31 bits")]
_CEILING = Within(1e8, 1e15, "from a small scene to the largest machine")


SAMPLES_PER_GATE = 64
"""Monte Carlo samples of a beam and gate where no detector has noise to compare theirs with."""


class RenderSettings(Description):
    """Settings of the light transport."""

    variant: Variant = Field(
        "llvm_ad_mono_polarized", description="Mitsuba variant: device and what a ray carries"
    )
    samples_per_beam: (
        Literal["auto"]
        | Annotated[int, Within(2, 2**31 - 1, "a standard error needs two; counted in 31 bits")]
    ) = Field(
        "auto",
        description="Monte Carlo samples per beam, over all its gates: chosen by the detector's "
        "noise, or this number",
    )
    monte_carlo_fraction: Annotated[
        Number, Within(1e-4, 100, "from a hundredth of the detector's noise to ten times it")
    ] = Field(
        0.1,
        description="variance of the simulation's noise over that of the detector's, mean over "
        "the beams: the target of auto",
    )
    max_samples: Annotated[Number, Within(1e3, 1e15, "from a small image to a year of them")] = (
        Field(
            3e7,
            description="samples of all beams of an image that auto takes at most: about half a "
            "minute on two cores",
        )
    )
    max_order: Annotated[int, Within(1, 64, "higher orders are below single precision")] = Field(
        4, description="scattering orders; 1 = single scattering"
    )
    estimator: Literal["gated", "analog"] = Field(
        "gated",
        description="forced collisions in the gates, or analog sampling, which needs a thousand "
        "times as many samples or more for the same noise",
    )
    random_numbers: Literal["auto", "independent", "common"] = Field(
        "auto",
        description="of beams, gates and scans: their own, or the same in all, whose errors winds "
        "hardly see; auto: common for winds from the images of an experiment, independent in "
        "flights, where photons are counted, and with analog sampling",
    )
    candidates: Annotated[int, Within(1, 1024, "more cost time and hardly lower the noise")] = (
        Field(
            1,
            description="light paths, of which the single scattering of a sample takes one by its "
            "contribution; 16 for long pulses in bright slabs",
        )
    )
    samples_per_pass: _PerPass = Field(
        1 << 22,
        description="traced at once, fewer if memory does not hold them; by default on a GPU as "
        "many as it holds",
    )
    memory: Annotated[Memory, _CEILING] | None = Field(
        None,
        description="that a run may take, else it is refused before it starts; default: half of "
        "the machine's (or container's)",
    )

    @property
    def given_per_pass(self) -> int | None:
        """Samples of a pass, if they are given."""
        return _given_per_pass(self)

    @model_validator(mode="after")
    def _gated_alone(self) -> Self:
        if self.random_numbers == "common" and self.estimator == "analog":
            raise ValueError(
                "random_numbers: common is not allowed with estimator analog; expected independent"
            )
        return self

    def for_winds(self) -> "RenderSettings":
        """Settings of images that winds are retrieved from: auto is common, if sampling is gated.

        Elsewhere auto is independent: errors that all beams share do not average out in counts.
        """
        if self.random_numbers == "auto" and self.estimator == "gated":
            return self.model_copy(update={"random_numbers": "common"})
        return self

    @property
    def common(self) -> bool:
        """Whether all beams, gates and scans have the same random numbers."""
        return self.random_numbers == "common"

    def scan_seed(self, seed: int, scan: int) -> int:
        """Seed of a scan's light: common numbers need one seed, independent ones one each.

        Common numbers of two seeds would be errors that all beams of an image share but images do
        not, which look like motion in image velocimetry.
        """
        return seed if self.common else seed + (scan << 16)

    def without_detector(self, gates: int) -> int:
        """Samples per beam as given, or `SAMPLES_PER_GATE` of every gate."""
        asked = self.samples_per_beam
        return SAMPLES_PER_GATE * gates if asked == "auto" else asked

    def most_samples(self, beams: int, gates: int) -> int:
        """Samples per beam as given, or as many as may be chosen for so many beams."""
        asked = self.samples_per_beam
        if asked != "auto":
            return asked
        each = min(math.floor(self.max_samples / (beams * gates)), (2**31 - 1) // gates)
        return gates * max(2, each)


class FringeSettings(Description):
    """Settings of the rendering of a fringe camera's rings."""

    variant: Variant = Field(
        "llvm_ad_mono_polarized", description="Mitsuba variant: device and what a ray carries"
    )
    samples_per_pixel: Annotated[
        int, Within(2, 2**20 - 1, "a standard error needs two; it is then 0.1 %")
    ] = Field(16, description="light paths, on average")
    estimator: Literal["camera", "forward", "analog"] = Field(
        "camera",
        description="paths traced from the pixels; plane waves through the lens to the CCD; or "
        "these with each photon transmitted or rejected",
    )
    line_shape: Literal["folded", "sampled"] = Field(
        "folded",
        description="transmission averaged over the line in closed form, or a frequency sampled "
        "for each path",
    )
    lens: Literal["ideal", "singlet"] = Field(
        "ideal", description="ideal, or a singlet of two surfaces with its aberrations"
    )
    stop_radius: Annotated[Length, Within(1e-6, 1, "from a pinhole to the largest lens")] = Field(
        5e-3, description="of the light into the lens"
    )
    samples_per_pass: _PerPass = Field(
        1 << 22,
        description="traced at once, fewer if memory does not hold them; by default on a GPU as "
        "many as it holds",
    )
    memory: Annotated[Memory, _CEILING] | None = Field(
        None, description="that a run may take; default: half of the machine's"
    )

    @property
    def given_per_pass(self) -> int | None:
        """Samples of a pass, if they are given."""
        return _given_per_pass(self)


def _given_per_pass(settings: RenderSettings | FringeSettings) -> int | None:
    given = "samples_per_pass" in settings.model_fields_set
    return settings.samples_per_pass if given else None
