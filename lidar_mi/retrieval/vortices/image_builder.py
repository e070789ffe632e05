"""The images that a pair is fitted to: of normalised intensity, with noise and masked pixels."""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch

from lidar_mi.retrieval.images.band_limit import best_filter
from lidar_mi.retrieval.images.inpainting import filled_in
from lidar_mi.retrieval.images.intensity import normalised
from lidar_mi.retrieval.images.quality import filled
from lidar_mi.retrieval.images.settings import FilterSettings
from lidar_mi.retrieval.vortices.images import Builder, spectrum_of
from lidar_mi.retrieval.vortices.model import Profile
from lidar_mi.retrieval.vortices.pixel_times import PixelTimes


class Acquisition(NamedTuple):
    """How two images were acquired, and the model that is fitted to them.

    z, y: of the pixels, m.
    dt: s.
    noise: standard deviation of all pixels or of each (z, y).
    profile {"lamb_oseen", "burnham_hallock"}
    frozen: whether the vortices are at rest during dt.
    times (z, y): from `lidar_mi.retrieval.images.beam_times.checked_times`.
    telescope: x, y, z, m.
    """

    z: np.ndarray
    y: np.ndarray
    dt: float
    noise: float | torch.Tensor | None
    profile: Profile
    frozen: bool = False
    times: Sequence[np.ndarray] | None = None
    telescope: tuple[float, float, float] | None = None


def builder_of(stack: Sequence[torch.Tensor], taken: Acquisition) -> Builder | str:
    """Of both images or of the first one; or the reason for which there is no fit."""
    finite = torch.stack([torch.isfinite(image) for image in stack]).all(0)
    if float(finite.double().mean()) < 0.5:
        return f"{float(finite.double().mean()):.0%} of the pixels are finite"
    # in units of image 1's own structure, so that no constant depends on the images' unit
    images = torch.stack([filled_in(i) for i in normalised([image.double() for image in stack])])
    contrast = images[0][finite].std()
    scale = filled(stack[0].double()).abs().max()
    if not bool(contrast > 1e-9 * scale) or not bool(images[-1][finite].std() > 0):
        return "an image is constant"
    images = images / contrast
    noise = taken.noise
    if isinstance(noise, torch.Tensor) and not bool((noise > 0).any()):
        noise = None  # no pixel's noise is known: a fit with noise 0 would hardly converge
    if isinstance(noise, torch.Tensor):
        noise = noise.double() * _understated(noise / contrast, images)
    level = _typical(noise, images[0].square())
    if level is not None:
        level /= float(contrast)
    make = Builder(
        images,
        near_to(~finite),
        taken.z,
        taken.y,
        taken.dt,
        level,
        noise if isinstance(noise, torch.Tensor) else None,
        float(contrast),
        taken.profile,
        taken.frozen,
        taken.telescope,
    )
    return make if taken.times is None else replace(make, times=_from_mid_time(taken.times, make))


def near_to(bad: torch.Tensor) -> torch.Tensor:
    """Pixels that are two or less away from others."""
    if not bool(bad.any()):
        return bad
    return torch.nn.functional.max_pool2d(bad[None].double(), 5, 1, 2)[0] > 0


def _from_mid_time(times: Sequence[np.ndarray], make: Builder) -> PixelTimes:
    """Times of the pixels of both images from half way between their reference times."""
    first, second = (torch.as_tensor(part, device=make.pair.device) for part in times)
    values = torch.stack([first - make.dt / 2, second + make.dt / 2])
    return PixelTimes(values, (float(make.y[0]), float(make.z[0])), make.spacing)


def _understated(noise: torch.Tensor, pair: torch.Tensor) -> float:
    """Factor by which the images vary more from pixel to pixel than a map states, at least 1.

    Errors estimated from a few Monte Carlo samples miss the rare bright ones. With too low a noise
    the filter mistakes the excess for texture and passes all of it. Texture down to single pixels
    counts as noise here, with little effect: in images 150 m ahead the noise is overestimated by
    1.5 and chi2 is 0.4, with the errors of the parameters unchanged.
    """
    stated = float(noise[torch.isfinite(noise)].double().square().mean().sqrt())
    observed = best_filter(spectrum_of(pair), FilterSettings()).level
    return max(1.0, observed / stated) if stated > 0 else 1.0


def _typical(noise: float | torch.Tensor | None, contrast: torch.Tensor) -> float | None:
    """One standard deviation for the filter: of a noise map the rms weighted by image contrast.

    That of most pixels is not enough: where bright air is noisiest the filter would pass too
    much noise, and circulations would be up to 10 % too large.
    """
    if not isinstance(noise, torch.Tensor):
        return noise
    known = torch.isfinite(noise)
    variance = noise[known].double().square()
    return float(((variance * contrast[known]).sum() / contrast[known].sum()).sqrt())
