"""Maps of the noise of images: which pixels are known, and how much each weighs.

What is left over by a match has the noise's variance only where noise is all that differs.
"""

from collections.abc import Sequence

import torch

from lidar_mi.retrieval.images.intensity import rms
from lidar_mi.retrieval.images.quality import informative
from lidar_mi.retrieval.images.windows import averaged, stored

MAP_WIDTH = 3.0
"""Standard deviation of the Gaussian that averages a map of the noise, px."""


def known_and_weight(
    stack: Sequence[torch.Tensor], noise: float | torch.Tensor | None, width: float = MAP_WIDTH
) -> tuple[torch.Tensor, torch.Tensor]:
    """Pixels of known value and noise, and their weights by a map of the noise.

    stack: images or volumes of one size.
    noise: standard deviation, in the unit of the images.
    width: standard deviation of the Gaussian that averages the map, px.
    """
    known_at = informative(stack)
    weight = torch.ones_like(stored(stack[0]))
    if isinstance(noise, torch.Tensor) and noise.ndim:
        known = torch.isfinite(noise)
        known_at = known_at & informative([noise])
        # a level that few photons determine is lowest where an image is too dark by chance
        square = averaged(stored(noise).nan_to_num(0.0).square(), known, width)
        weight = torch.where(square > 0, rms(noise) ** 2 / square, weight)
        # no pixel may outweigh a window of others
        weight = weight.clamp(max=100.0)
    return known_at, weight


def variance_of_residual(
    residual: torch.Tensor,
    relative: torch.Tensor,
    use: torch.Tensor,
    noise: float | torch.Tensor | None,
) -> torch.Tensor:
    """Variance of the difference of two matched images by place, over its mean.

    s q + 1 - s: a fraction s of the residual's mean square is noise and varies as it does, with the
    relative variance q. The rest, such as motion that a match does not resolve, does not follow the
    map. s is twice the noise's mean square, that of two images, over the residual's, at most 1.

    residual: of the images' unit.
    relative (torch.Tensor, same shape): q, with the mean 1.
    use (torch.Tensor of bool, same shape): where the residual is known.
    noise: standard deviation of an image's noise, in the same unit.
    """
    if noise is None or not bool(use.any()):
        return relative
    whole = float(residual[use].square().mean())
    fraction = min(1.0, 2 * rms(noise) ** 2 / whole) if whole > 0 else 1.0
    return fraction * relative + 1 - fraction
