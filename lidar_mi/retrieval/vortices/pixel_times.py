"""Air followed to the time at which its pixel was measured, which depends on its place then."""

from typing import NamedTuple

import torch

from lidar_mi.retrieval.vortices.model import Profile, advected, wind

# Times a path is followed, each to the time of the place where the one before ended. From a start
# along a straight line, two leave 1e-4 m of a path of 1.5 m in a scan of 0.1 s over 70 m.
_ROUNDS = 2


class PixelTimes(NamedTuple):
    """Times of the pixels of two images, s from mid-time, (2, z, y) on a grid in m."""

    values: torch.Tensor
    first: tuple[float, float]
    spacing: tuple[float, float]

    def at(
        self, number: int, y: torch.Tensor, z: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Time (...) and its derivatives (2, ...) along y and z, s/m, linear between pixels."""
        values = self.values[number]
        parts = []
        for axis, (place, n) in enumerate(zip((y, z), reversed(values.shape), strict=True)):
            pixel = (place - self.first[axis]) / self.spacing[axis]
            low = pixel.floor().clamp(0, n - 2)
            parts.append((low.long(), pixel - low))
        (column, right), (row, up) = parts
        corner = [[values[row + i, column + j] for j in (0, 1)] for i in (0, 1)]
        below, above = (left + right * (other - left) for left, other in corner)
        along_y = (1 - up) * (corner[0][1] - corner[0][0]) + up * (corner[1][1] - corner[1][0])
        slope = torch.stack([along_y / self.spacing[0], (above - below) / self.spacing[1]])
        return below + up * (above - below), slope


class ImagedAir(NamedTuple):
    """Air as one image shows it.

    `middle` of its path (2, ...) in the frame of the pair, `place` (2, ...) in the image, `time`
    (...) from mid-time. `along` maps slopes (2, ...) of the image to those by which it changes with
    the end of a path of fixed time.
    """

    middle: torch.Tensor
    place: torch.Tensor
    time: torch.Tensor
    speed: torch.Tensor
    gradient: torch.Tensor

    def along(self, slope: torch.Tensor) -> torch.Tensor:
        """Slope of the image for a path of fixed time.

        A place that changes by a at a fixed time is measured g . a' later, g the gradient of the
        times, and is advected by the wind u meanwhile: a' = a + u (g . a'), so that
        slope . a' = (slope + g (slope . u) / (1 - g . u)) . a .
        """
        turned = (slope * self.speed).sum(0) / (1 - (self.gradient * self.speed).sum(0))
        return slope + self.gradient * turned


def imaged_air(
    times: PixelTimes,
    number: int,
    steady: torch.Tensor,
    moving: torch.Tensor,
    y: torch.Tensor,
    z: torch.Tensor,
    profile: Profile,
) -> ImagedAir:
    """Where and when image 0 or 1 shows the air that is at places (...) at mid-time.

    steady (10,): the flow in the frame that moves with the pair.
    moving (2,): velocity of that frame, m/s.
    """
    began = wind(steady, y, z, profile)
    speed = began + moving[:, None, None]
    time, _ = times.at(number, y, z)
    time, _ = times.at(number, y + time * speed[0], z + time * speed[1])
    for _ in range(_ROUNDS):
        used = time
        middle, within = advected(steady, y, z, used, profile, began)
        place = within + moving[:, None, None] * used
        time, gradient = times.at(number, *place)
    within_y, within_z = within
    speed = wind(steady, within_y, within_z, profile) + moving[:, None, None]
    return ImagedAir(middle, place, used, speed, gradient)
