"""Where the pixels of a camera lie in an ideal image of the rings.

An ideal lens images the angle theta to its axis at the distance F tan(theta) in a plane
perpendicular to the axis, F the focal length in pixels. A real camera is tilted against that plane,
and a real lens distorts. `straightened` undoes both: rings that are round in the ideal image are
fitted as such, whatever the camera made of them.
"""

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

from lidar_mi.errors import InputError

if TYPE_CHECKING:
    import torch


# Steps of a fixed-point iteration; each gains the factor of the distortion itself (0.1 % to 5 %).
_STEPS = 12


@dataclass(frozen=True)
class Geometry:
    """Tilt of the camera and radial distortion of the lens.

    focal_pixels: focal length over pixel pitch.
    axis: (x, y) where the lens's axis meets the camera: pixels from the top left pixel's centre.
    half_diagonal: of the image, pixels.
    tilt: rotations of the camera about its y and x axis, rad: the sides of larger x, of larger y
        lie farther from the lens where they are positive. A normal of the etalon that is not along
        the lens's axis has the same effect on rings, to first order.
    distortion: k of r = r_ideal (1 + k (r_ideal / half_diagonal)^2); above 0 is a pincushion.

    Raises InputError: a tilt of 30 degrees or more, a distortion that folds the image.
    """

    focal_pixels: float
    axis: tuple[float, float]
    half_diagonal: float
    tilt: tuple[float, float] = (0.0, 0.0)
    distortion: float = 0.0

    def __post_init__(self) -> None:
        if not all(abs(angle) < math.pi / 6 for angle in self.tilt):
            raise InputError(f"tilt: {self.tilt} rad is not allowed; expected less than 30 degrees")
        if not abs(self.distortion) < 0.1:
            raise InputError(
                f"distortion: {self.distortion!r} is not allowed; expected less than 0.1 each way"
            )

    @property
    def ideal(self) -> bool:
        """Whether the pixels already lie as in an ideal image."""
        return self.tilt == (0.0, 0.0) and self.distortion == 0


def straightened(
    geometry: Geometry, x: "torch.Tensor", y: "torch.Tensor"
) -> "tuple[torch.Tensor, torch.Tensor]":
    """Places in the ideal image of places (x, y) on the camera; pixels from the top left one.

    The axis stays where it is.
    """
    import torch

    if geometry.ideal:
        return x, y
    left, top = geometry.axis
    u, v = x - left, y - top
    # the camera's plane, turned about its y axis, then about its x axis
    (cos_x, sin_x), (cos_y, sin_y) = ((math.cos(t), math.sin(t)) for t in geometry.tilt)
    depth = 1 + (u * sin_x * cos_y + v * sin_y) / geometry.focal_pixels
    u, v = u * cos_x / depth, (v * cos_y - u * sin_x * sin_y) / depth
    radius2 = (u**2 + v**2) / geometry.half_diagonal**2
    shrink = torch.ones_like(radius2)
    for _ in range(_STEPS):
        shrink = 1 / (1 + geometry.distortion * radius2 * shrink**2)
    return left + u * shrink, top + v * shrink


def by_tilt_and_distortion(
    geometry: Geometry, centre: tuple[float, float], x: "torch.Tensor", y: "torch.Tensor"
) -> "tuple[torch.Tensor, torch.Tensor, torch.Tensor]":
    """Derivatives of r^2 by both tilts and the distortion, px^2.

    r is the distance from ``centre`` in the ideal image, at its places (x, y), which are from that
    centre, too. To first order in tilt and distortion.
    """
    u, v = x + centre[0] - geometry.axis[0], y + centre[1] - geometry.axis[1]
    toward = x * u + y * v
    tilting = -2 * toward / geometry.focal_pixels
    return tilting * u, tilting * v, -2 * toward * (u**2 + v**2) / geometry.half_diagonal**2
