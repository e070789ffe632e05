"""Images of the same air without what does not move with it."""

from collections.abc import Sequence
from typing import NamedTuple

import torch

from lidar_mi.retrieval.defects.illumination import described, illumination
from lidar_mi.retrieval.defects.rest import AtRest, all_at_rest, nothing_at_rest
from lidar_mi.retrieval.images.windows import Windows, working


class CleanImages(NamedTuple):
    """Two or more images, as they are and without their defects; tensors (z, y).

    defects: pixels and gains that do not move with the air.
    gains: illumination of each image over that of the first.
    filled: at the illumination of the first, smooth values in place of defects.
    """

    raw: list[torch.Tensor]
    defects: AtRest
    gains: list[torch.Tensor]
    filled: list[torch.Tensor]

    def masked(self) -> list[torch.Tensor]:
        """At the illumination of the first, NaN in place of defects."""
        return _normalised_illumination(self.defects.masked(self.raw), self.gains)

    @property
    def change_of_illumination(self) -> str:
        """From the first image to the last, in words; empty where no image differs."""
        return described(self.gains[-1]) if any(map(described, self.gains)) else ""


def without_defects(images: Sequence[torch.Tensor], windows: Windows) -> CleanImages:
    """Find and remove what does not move with the air, then changes of illumination."""
    defects = all_at_rest(images, windows)
    filled = defects.filled(images)
    gains = [torch.ones(1, 1), *(illumination(filled[0], image) for image in filled[1:])]
    return CleanImages(list(images), defects, gains, _normalised_illumination(filled, gains))


def as_they_are(images: Sequence[torch.Tensor], _: Windows) -> CleanImages:
    """Images that are known to be free of defects."""
    gains = [torch.ones(1, 1)] * len(images)
    return CleanImages(list(images), nothing_at_rest(images), gains, list(images))


def _normalised_illumination(
    images: Sequence[torch.Tensor], gains: Sequence[torch.Tensor]
) -> list[torch.Tensor]:
    pairs = zip(images, gains, strict=True)
    return [working(image) / gain if described(gain) else image for image, gain in pairs]
