"""Maps of the noise of images: which pixels are known, and how much each weighs."""

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

    Parameters
    ----------
    stack : sequence of Tensor
        Images or volumes of one size.
    noise : float, Tensor or None
        Standard deviation, in the unit of the images.
    width : float
        Standard deviation of the Gaussian that averages the map, px.
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
