"""What a method finds: one displacement per window, in pixels."""

from collections.abc import Mapping
from types import MappingProxyType
from typing import NamedTuple

import torch

from lidar_mi.retrieval.quantity import Quantity
from lidar_mi.retrieval.velocimetry.windows import Windows


class Displacement(NamedTuple):
    """Displacements of all windows from image 1 to image 2, tensors of shape `windows.count`.

    Attributes
    ----------
    dz, dy : torch.Tensor
        Pixels, positive toward higher indices; NaN where no displacement was found.
    score : torch.Tensor
        How well the windows match: correlation or mismatch, as the method says.
    flag : torch.Tensor of uint8
        `quality.Flag` bits.
    covariance : torch.Tensor of shape (3, *windows.count), optional
        Variances of dz and of dy and their covariance, px^2, of methods that tell.
    quantities : mapping, optional
        Numbers with standard errors that describe the whole, by name (`quantity.Quantity`).
    attributes : mapping, optional
        What else a method says about its result.
    """

    dz: torch.Tensor
    dy: torch.Tensor
    score: torch.Tensor
    flag: torch.Tensor
    covariance: torch.Tensor | None = None
    quantities: Mapping[str, Quantity] = MappingProxyType({})
    attributes: Mapping[str, str] = MappingProxyType({})

    @classmethod
    def empty(cls, windows: Windows, like: torch.Tensor) -> "Displacement":
        """Room for the result, to be filled tile by tile."""
        values = [like.new_empty(windows.count) for _ in range(3)]
        return cls(*values, like.new_empty(windows.count, dtype=torch.uint8))
