"""Frames of an etalon's rings as cameras record them, without the program.

Airy's formula at 2 x 2 points of every pixel, for lines of any number; a camera that is tilted or
has oblong pixels, a background that slopes, vignetting, plates that are not even, photons, a gain,
read noise and rounding.
"""

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter


@dataclass(frozen=True)
class Frame:
    """A frame's truth; lengths in px. ``height`` and ``fraction`` are those of the lines."""

    shape: tuple[int, int] = (400, 500)
    centre: tuple[float, float] = (240.3, 205.7)
    spacing: float = 15000.0
    fraction: tuple[float, ...] = (0.62,)
    height: tuple[float, ...] = (1.0,)
    ratio: tuple[float, ...] = ()  # of the lines' wavelengths to the first's; () is 1
    finesse: float = 15.0  # orders per full width
    ellipticity: float = 0.0
    tilt: float = 0.0
    slope: tuple[float, float] = (0.0, 0.0)  # background's relative change over the frame
    background: float = 0.1  # of the highest line
    vignetting: float = 0.0  # loss of light at the farthest corner
    plates: float = 0.0  # standard deviation of the order by uneven plates
    patch: float = 60.0  # px, over which they are uneven

    def mean(self, defects=None):
        """Light on every pixel, in units of the highest crest."""
        height, width = self.shape
        coefficient = (2 * self.finesse / np.pi) ** 2
        total = np.zeros(self.shape)
        for u in (-0.2887, 0.2887):
            for w in (-0.2887, 0.2887):
                x = np.arange(width) - self.centre[0] + u
                y = (np.arange(height) - self.centre[1] + w)[:, None]
                x, y = (
                    x * (1 + self.ellipticity) / (1 + self.tilt * x),
                    y * (1 - self.ellipticity) / (1 + self.tilt * x),
                )
                order = (x**2 + y**2) / self.spacing
                if defects is not None:
                    order = order + self.plates * defects
                ratio = self.ratio or (1.0,) * len(self.fraction)
                for f, h, r in zip(self.fraction, self.height, ratio, strict=True):
                    total += h / (1 + coefficient * np.sin(np.pi * (order / r - f)) ** 2) / 4
        x, y = np.linspace(-1, 1, width), np.linspace(-1, 1, height)[:, None]
        total *= 1 - self.vignetting * (x**2 + y**2) / 2
        return total + self.background * (1 + self.slope[0] * x + self.slope[1] * y)

    def defects(self, rng):
        """Unevenness of the plates as the camera sees it: standard deviation 1 in patches."""
        field = gaussian_filter(rng.standard_normal(self.shape), self.patch / 2, mode="wrap")
        return field / field.std()

    def exposure(self, rng, photons=200.0, gain=1.0, read_noise=3.0, offset=100.0):
        """Counts: photons of the highest crest's pixel, counts per electron, electrons, counts."""
        mean = self.mean(self.defects(rng) if self.plates else None) * photons
        electrons = rng.poisson(mean) + read_noise * rng.standard_normal(self.shape)
        return np.round(offset + gain * electrons)
