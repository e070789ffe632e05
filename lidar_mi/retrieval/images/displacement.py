"""What a method retrieves: one displacement per window, in pixels."""

from collections.abc import Mapping
from types import MappingProxyType
from typing import NamedTuple

import torch
from torch.nn.functional import pad

from lidar_mi.retrieval.images.windows import Windows
from lidar_mi.retrieval.quantity import Quantity


class Displacement(NamedTuple):
    """Displacements of all windows from image 1 to image 2, tensors of shape `windows.count`.

    d (components, *windows.count): pixels along the axes, (z, y) of images and (x, z, y) of
        volumes, positive toward higher indices; NaN where no displacement was found.
    score: how well the windows match: correlation or mismatch, depending on the method.
    flag (torch.Tensor of int16): `flags.Flag` bits.
    covariance (components, components, *windows.count): of the components' errors, px^2, from
        methods that give it.
    quantities: scalar quantities with standard errors, by name (`quantity.Quantity`).
    attributes: further attributes of a method's result.
    """

    d: torch.Tensor
    score: torch.Tensor
    flag: torch.Tensor
    covariance: torch.Tensor | None = None
    quantities: Mapping[str, Quantity] = MappingProxyType({})
    attributes: Mapping[str, str | float] = MappingProxyType({})

    @property
    def dz(self) -> torch.Tensor:
        """Displacement along z."""
        return self.d[-2]

    @property
    def dy(self) -> torch.Tensor:
        """Displacement along y."""
        return self.d[-1]

    def medians(self) -> "Displacement":
        """Medians of 3 vectors along each axis; NaN where no vector is known."""
        dims = len(self.d)
        around = pad(self.d, (1, 1) * dims, value=torch.nan)
        for axis in range(1, dims + 1):
            around = around.unfold(axis, 3, 1)
        return self._replace(d=around.flatten(-dims).nanmedian(-1).values)

    @classmethod
    def empty(cls, windows: Windows, like: torch.Tensor) -> "Displacement":
        """An uninitialised result, to be filled tile by tile."""
        flag = like.new_empty(windows.count, dtype=torch.int16)
        return cls(
            like.new_empty(windows.dims, *windows.count), like.new_empty(windows.count), flag
        )

    def fill(self, part: "Displacement", vectors: tuple[slice, ...]) -> None:
        """Put the displacements, scores and flags of some windows of a tile."""
        self.d[:, *vectors] = part.d
        self.score[vectors], self.flag[vectors] = part.score, part.flag
