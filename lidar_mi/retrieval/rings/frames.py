"""Checks of images before their analysis: finite and not saturated."""

import math

import numpy as np
import torch
from scipy.ndimage import rank_filter

from lidar_mi.errors import InputError
from lidar_mi.retrieval.rings.model import PixelNoise
from lidar_mi.retrieval.threads import mapped

# The highest value is the end of the scale if it has more than this fraction of the pixels, and
# this factor more than the next lower value. Of a smooth crest, rounded to integers, the top value
# has at most 2.4 times as many pixels as the one below it, as the area above a level grows with the
# square root of the depth.
PLATEAU = 1e-3
EXCESS = 4.0
MOST_SPOTS = 0.02  # of the pixels may be hot, dead or in bright patches
MOST_LEVELS = 64  # of an image that may be quantised: above, a ring's slope has ten or more
SPOT = 6.0  # standard deviations
# Of the pixels those in every seventh run of so many are looked at first: whole lines of the cache,
# and a prime, so that it follows no column.
RUN, STRIDE = 16, 7


def checked(
    images: torch.Tensor,
    saturation: float | None = None,
    used: torch.Tensor | None = None,
    what: str = "images",
    shape: tuple[int, int] | None = None,
) -> torch.Tensor:
    """The images as a batch (images, height, width) of floats.

    Pixels that are not ``used`` (height, width) may have any value; they become the least one.
    ``what`` names them in messages, ``shape`` (height, width) is that of their model.

    Raises InputError: other shapes, images below 16 px or not as large as the model, NaN or
    infinity, saturated pixels.
    """
    if not isinstance(images, torch.Tensor):
        images = np.array(images)
        if images.dtype.kind not in "fiub":
            raise InputError(f"{what}: {images.dtype} is not allowed; expected real numbers")
        images = torch.as_tensor(images)
    if images.ndim not in (2, 3) or min(images.shape) < 1 or min(images.shape[-2:]) < 16:
        raise InputError(
            f"{what}: shape {tuple(images.shape)} is not allowed; expected (height, width) or "
            "(images, height, width) of 16 px or more each way"
        )
    if images.ndim == 2:
        images = images[None]
    if not images.is_floating_point():
        images = images.float()
    if used is not None and used.shape == images.shape[-2:]:
        images = torch.where(used, images, images[:, used].nan_to_num().min())
    if shape is not None and tuple(images.shape[-2:]) != tuple(shape):
        sizes = " and ".join(f"{h} x {w}" for h, w in (images.shape[-2:], shape))
        raise InputError(f"{what}: sizes {sizes} px (height x width) of {what} and model differ")
    mapped(
        lambda number: _check(images[number], f"{what}[{number}]", saturation), range(len(images))
    )
    return images


def _check(image: torch.Tensor, name: str, saturation: float | None) -> None:
    low, top = torch.aminmax(image)  # NaN where there is one
    if not torch.isfinite(top - low):
        number_bad = int((~torch.isfinite(image)).sum())
        raise InputError(
            f"{name}: {number_bad} pixel(s) of NaN or infinity; expected finite values"
        )
    if saturation is not None and top >= saturation:
        number_full = int((image >= saturation).sum())
        raise InputError(
            f"{name}: saturated, {number_full} pixel(s) at or above {saturation:g}; "
            "expected all below"
        )
    # most images have their highest value once: a seventh of the pixels would hold 100 of a plateau
    every = image.flatten()
    some = every[: every.numel() // RUN * RUN].view(-1, RUN)[::STRIDE]
    if every.numel() * PLATEAU > 100 * STRIDE and not (some == top).any():
        return
    full = image == top
    count = int(full.sum())
    if PLATEAU * image.numel() < count < image.numel():
        below = int((image == image[~full].max()).sum())
        if count > EXCESS * below:
            raise InputError(
                f"{name}: saturated, {count} pixels share the highest value "
                f"{float(top):g}; expected an exposure within the camera's range"
            )


def few_levels(image: np.ndarray) -> str:
    """Why an image is quantised too coarsely to measure rings; empty: it is not.

    Rounding to steps q is like uniform noise of variance q^2 / 12 where the noise before it has a
    standard deviation of q / 2 or more: then all moments of the sum are those of independent
    numbers to 1 % (Widrow & Kollar 2008, Quantization Noise, chapter 4). Below, crests are flat and
    slopes are steps, which is structure. Counts of single photons have coarser steps, with their
    own variance: their mean times q.
    """
    values = np.unique(image)
    if values.size > MOST_LEVELS:
        return ""
    step = float(np.diff(values).min()) if values.size > 1 else 0.0
    # of neighbours along rows and columns, by second differences: slopes of rings cancel
    square = [np.diff(image, 2, axis).clip(-1e6 * step, 1e6 * step) ** 2 / 6 for axis in (0, 1)]
    noise = float(np.mean([along.mean() for along in square]))
    counted = step * float((image - values[0]).mean())
    if noise >= min((step / 2) ** 2, 0.5 * counted):
        return ""
    return (
        f"{values.size} grey levels, {step:g} apart, with noise of {math.sqrt(noise) / step:.2f} "
        "steps: flat crests are taken for lines"
    )


def spots(image: torch.Tensor, noise: PixelNoise, count: int = 1) -> torch.Tensor:
    """Pixels far above or below all but two of their neighbours: hot and dead ones, dust.

    In electrons of the mean of ``count`` images.
    """
    around = np.ones((5, 5), bool)
    around[2, 2] = False
    # all but two of the neighbours: a ring as narrow as a pixel has four more of its pixels there
    high, low = (
        torch.from_numpy(rank_filter(image.cpu().numpy(), rank, footprint=around)).to(image)
        for rank in (-3, 2)
    )
    high, low = high.clamp(min=0), low.clamp(min=0)
    std = [SPOT * (noise.variance(near, near) / count).sqrt() for near in (high, low)]
    return (image > 1.5 * high + std[0]) | (image < 0.5 * low - std[1])


def patches(image: torch.Tensor) -> torch.Tensor:
    """Pixels of bright patches, as of a reflection, and those within 2 px of one.

    They exceed the crests, taken as the brightest percent, by half of the crests' height above the
    median. Where these are more than `MOST_SPOTS` of the pixels, none is a patch.
    """
    low, high = np.quantile(image.cpu().numpy(), [0.5, 0.99])
    bright = (image > high + 0.5 * (high - low)).float()[None, None]
    wide = torch.nn.functional.max_pool2d(bright, 5, 1, 2)[0, 0] > 0
    return wide & (wide.float().mean() < MOST_SPOTS)


def inside(x: float, y: float, shape: tuple[int, int], name: str = "centre") -> None:
    """Raise InputError unless (x, y) lies in an image of (height, width)."""
    height, width = shape
    if not (-0.5 <= x <= width - 0.5 and -0.5 <= y <= height - 0.5):
        raise InputError(
            f"{name}: ({x:.1f}, {y:.1f}) px is not allowed; expected inside the image of "
            f"{width} x {height} px"
        )
