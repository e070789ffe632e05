"""Averages over sectors of annuli about rings that a camera distorts.

Coordinates are pixels, x to the right and y down. A ring of mean radius a is seen at

    r = a (1 + ellipticity . u2) + a^2 tilt . u,  u = (cos, sin) of the angle, u2 of twice the angle

about the centre: circles distorted by a tilted camera, to first order in the tilt (each ring's
shift is proportional to its area), and by anamorphic pixels or lenses.
"""

from dataclasses import dataclass

import numpy as np

from lidar_mi.retrieval.rings.light import common_light

STEPS = 1200  # annuli out to the farthest corner, at most
PIXELS = 2  # least mean number of pixels of a sector of an annulus
SECTORS = 48


@dataclass(frozen=True)
class RingCurves:
    """Where rings lie: centre (x, y) in px, ellipticity, tilt in 1/px; (cosine, sine) parts."""

    centre: tuple[float, float]
    ellipticity: tuple[float, float] = (0.0, 0.0)
    tilt: tuple[float, float] = (0.0, 0.0)

    def moved(self, by: np.ndarray) -> "RingCurves":
        """With six changes added: of centre, ellipticity and tilt."""
        whole = np.array([*self.centre, *self.ellipticity, *self.tilt]) + by
        x, y, cosine, sine, right, down = map(float, whole)
        return RingCurves((x, y), (cosine, sine), (right, down))

    def curve(self, radius: np.ndarray | float, angle: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Points (x, y) of rings of these mean radii, at angles from x toward y."""
        cosine, sine = np.cos(angle), np.sin(angle)
        r = radius * (
            1 + self.ellipticity[0] * np.cos(2 * angle) + self.ellipticity[1] * np.sin(2 * angle)
        )
        r = r + radius**2 * (self.tilt[0] * cosine + self.tilt[1] * sine)
        return self.centre[0] + r * cosine, self.centre[1] + r * sine

    def squared_radius(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Squared mean radius of the ring through each point; x, y from the centre."""
        r2 = x**2 + y**2
        if not (any(self.ellipticity) or any(self.tilt)):
            return r2
        r = np.sqrt(r2)
        safe = np.maximum(r2, 1e-12)
        linear = 1 + (self.ellipticity[0] * (x**2 - y**2) + self.ellipticity[1] * 2 * x * y) / safe
        # root of tilt . u a^2 + linear a = r, the one that stays without a tilt
        along = self.tilt[0] * x + self.tilt[1] * y
        return (2 * r / (linear + np.sqrt(np.maximum(linear**2 + 4 * along, 0)))) ** 2


@dataclass(frozen=True, eq=False)
class Hidden:
    """Rings that something hides in some of the sectors.

    spacing, fraction: of the intervals of r^2 from half an order before to half an order behind
        each ring.
    which (array (SECTORS, intervals) of bool)
    """

    spacing: float
    fraction: float
    which: np.ndarray

    def cells(self, r2: np.ndarray) -> np.ndarray:
        """Whether annuli are hidden, (SECTORS, annuli)."""
        number = np.floor(r2 / self.spacing - self.fraction + 1.5).astype(int)
        return self.which[:, number.clip(0, self.which.shape[1] - 1)]


class Sectors:
    """Averages over sectors of annuli of equal steps in squared mean radius.

    They extend to where the last sector leaves the image. Sectors cut by the edge have no pixels,
    as they would average another part of the image.

    angle (SECTORS,)
    step: px^2.
    r2 (annuli,): the annuli's middles.
    count, value, offset (SECTORS, annuli): number of pixels; their mean; mean of their squared
        radius less the annulus's middle.
    used (SECTORS, annuli): number of pixels of cells that show rings and are no outliers.
    profile, profile_r2 (annuli,): common part of all sectors (`light.common_light`), and the mean
        squared radius; interpolated where no pixel is.
    profile_count, profile_noise (annuli,): effective number of pixels of the profile, and the
        variance of one.
    """

    def __init__(self, image: np.ndarray, geometry: RingCurves, hidden: Hidden | None = None):
        height, width = image.shape
        centre = geometry.centre
        x, y = np.arange(width) - centre[0], np.arange(height)[:, None] - centre[1]
        r2 = geometry.squared_radius(x, y)
        steps = min(STEPS, height * width // (SECTORS * PIXELS))
        self.step = float(r2.max()) / steps
        sector = np.arctan2(y, x) * (SECTORS / (2 * np.pi)) % SECTORS
        label = np.minimum(sector, SECTORS - 1).astype(int) * steps
        label += np.minimum(r2 / self.step, steps - 1).astype(int)
        count, total, total_r2 = (
            np.bincount(label.ravel(), weight, steps * SECTORS).reshape(SECTORS, steps)
            for weight in (None, image.ravel(), r2.ravel())
        )
        self.angle = (np.arange(SECTORS) + 0.5) * (2 * np.pi / SECTORS)
        outer = np.sqrt((np.arange(steps) + 1) * self.step)[None, :, None]
        around = (np.arange(SECTORS)[:, None] + np.linspace(0, 1, 5)) * (2 * np.pi / SECTORS)
        x, y = geometry.curve(outer, around[:, None, :])
        full = ((x > -0.5) & (x < width - 0.5) & (y > -0.5) & (y < height - 0.5)).all(2)
        last = int(np.flatnonzero((full & (count > 0)).any(0))[-1]) + 1
        full = full[:, :last]
        self.r2 = (np.arange(last) + 0.5) * self.step
        self.count = np.where(full, count[:, :last], 0).astype(float)
        divisor = np.maximum(self.count, 1)
        self.value = np.where(full, total[:, :last], 0) / divisor
        self.offset = np.where(self.count > 0, total_r2[:, :last] / divisor - self.r2, 0.0)
        if hidden is not None:
            self.count = np.where(hidden.cells(self.r2), 0.0, self.count)
        light = common_light(self.r2, self.value, self.count)
        self.profile, self.profile_count, self.profile_noise = (
            light.profile,
            light.weight,
            light.noise,
        )
        self.used = self.count * light.used
        total = self.used.sum(0)
        known = np.flatnonzero(total)
        mean_r2 = (self.used * (self.r2 + self.offset)).sum(0)[known] / total[known]
        self.profile_r2 = np.interp(self.r2, self.r2[known], mean_r2)
