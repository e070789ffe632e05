"""The paper's retrieval of the wind: radius of the innermost ring, emitted and received.

Profiles come from circular averaging (CA), from crests along midpoint lines (ML) or, as the
baseline, from 360 radial cuts after a Savitzky-Golay filter; a Gaussian fitted by
Levenberg-Marquardt gives the peak, its radius the wavelength. The paper names these steps and
leaves their detail to Hirschberger & Ehret 2011 (Appl. Phys. B 103, 207-222); details missing
there are chosen here and documented.

A line that is broadened symmetrically in frequency is symmetric in order, hence in r^2, not in r:
in r its outer flank is steeper. A Gaussian fitted in r turns the skew into a shift, by -10 to
-40 m/s for air at 233 K, depending on the width of the fitted piece. Fitted in r^2 the same chain
has no such shift. ``coordinate`` selects one of them.
"""

import numpy as np
from scipy.constants import speed_of_light
from scipy.ndimage import map_coordinates
from scipy.signal import savgol_filter

from lidar_mi.errors import InputError
from lidar_mi.retrieval.rings.centre import (
    circular_average,
    circular_centre,
    gradient_centre,
    midpoint_line_centre,
    midpoint_points,
)
from lidar_mi.retrieval.rings.frames import inside
from lidar_mi.retrieval.rings.peak_fit import peak

METHODS = ("ca", "ml", "sg")
COORDINATES = ("r", "r2")

PIECE = 0.35  # of the ring's radius, fitted to both sides: about half way to the minimum


def radial_cuts(image: np.ndarray, centre: tuple[float, float], cuts: int = 360) -> np.ndarray:
    """Values along rays from the centre, (cuts, radii), 1 px apart, linear between pixels.

    Out to the farthest corner; NaN outside the image.
    """
    height, width = image.shape
    far = np.hypot(*(max(c, size - 1 - c) for c, size in zip(centre, (width, height), strict=True)))
    angle = 2 * np.pi * np.arange(cuts)[:, None] / cuts
    r = np.arange(int(far) + 1)
    place = (centre[1] + r * np.sin(angle), centre[0] + r * np.cos(angle))
    return map_coordinates(np.asarray(image, float), place, order=1, cval=np.nan)


def savitzky_golay(cuts: np.ndarray, window: int = 31, degree: int = 2) -> np.ndarray:
    """Each cut smoothed along r by local polynomials: the paper's baseline (its figure 4)."""
    return savgol_filter(cuts, window, degree, axis=-1, mode="nearest")


def find_centre(
    image: np.ndarray, method: str = "ca", radius: float | None = None
) -> tuple[float, float]:
    """Centre of the rings by the paper's circular averaging or midpoint lines.

    Both start from `lidar_mi.retrieval.rings.centre.gradient_centre`; ``radius`` is that of the
    innermost ring (px), which midpoint lines need.

    Raises InputError: no rings, or a centre outside the image.
    """
    start = gradient_centre(image)
    inside(*start, image.shape)
    if method == "ca":
        return circular_centre(image, start)
    if method == "ml":
        radius = radius or innermost(circular_average(image, start))
        return midpoint_line_centre(image, start, radius, PIECE * radius)
    raise InputError(f"centre: {method!r} is not one of ca, ml")


def innermost(average: tuple[np.ndarray, np.ndarray, np.ndarray]) -> float:
    """Radius of the innermost ring, px, to a few pixels: first crest of the smoothed average.

    ``average`` is what `lidar_mi.retrieval.rings.centre.circular_average` returns.
    """
    r, mean, weight = average
    # circles next to the centre average too few pixels
    mean, r = mean[weight > 30], r[weight > 30]
    smooth = savgol_filter(mean, max(5, len(mean) // 20 * 2 + 1), 2)
    crest = 1 + np.flatnonzero((smooth[1:-1] > smooth[:-2]) & (smooth[1:-1] >= smooth[2:]))
    high = crest[smooth[crest] > smooth.min() + 0.5 * np.ptp(smooth)]
    if not high.size:
        raise InputError("rings: no crest about the centre; expected a ring")
    return float(r[high[0]])


def ring_radius(
    image: np.ndarray,
    centre: tuple[float, float],
    method: str = "ca",
    coordinate: str = "r",
    radius: float | None = None,
    piece: float = PIECE,
    average: tuple[np.ndarray, np.ndarray, np.ndarray] | None = None,
) -> float:
    """Radius of the innermost ring, px.

    image (height, width)
    centre: (x, y), px.
    method {"ca", "ml", "sg"}: circular average; mean distance of crests along midpoint lines; mean
        of radial cuts after a Savitzky-Golay filter.
    coordinate {"r", "r2"}: coordinate of the Gaussian; ``ml`` fits along lines across the ring, in
        r only.
    radius: approximate radius of the ring, px; detected if not given.
    piece: half width of the fitted piece of the profile, in radii; for r2, of nearly the same
        piece, symmetric in r^2.
    average: the image's `lidar_mi.retrieval.rings.centre.circular_average` about the centre, where
        it is known already.

    Raises InputError: no ring, or an unknown method.
    """
    if method not in METHODS:
        raise InputError(f"method: {method!r} is not one of {', '.join(METHODS)}")
    if coordinate not in COORDINATES:
        raise InputError(f"coordinate: {coordinate!r} is not one of {', '.join(COORDINATES)}")
    if method == "ml" and coordinate != "r":
        raise InputError(f"coordinate: {coordinate!r} is not allowed with ml; expected r")
    inside(*centre, image.shape)
    if method == "ca" or not radius:
        average = average or circular_average(image, centre)
        r, mean, _ = average
        radius = radius or innermost(average)
    if method == "ml":
        points = midpoint_points(image, centre, radius, piece * radius).reshape(-1, 2)
        distance = np.hypot(*(points - centre).T)
        if not np.isfinite(distance).any():
            raise InputError("rings: no crest on any midpoint line; expected a ring")
        return float(np.nanmean(distance))
    if method == "sg":
        cuts = savitzky_golay(radial_cuts(image, centre))
        reached = np.isfinite(cuts).any(0)
        r, mean = np.flatnonzero(reached).astype(float), np.nanmean(cuts[:, reached], 0)
    if coordinate == "r":
        return peak(r, mean, radius, piece * radius)
    return float(np.sqrt(peak(r**2, mean, radius**2, 2 * piece * radius**2)))


def velocity_from_radii(
    received: float, emitted: float, focal_length: float, pixel: float
) -> float:
    """v_LOS, m/s, from one ring's radii (px) in the received and the emitted image.

    The ring keeps its order: nu cos(theta) is the same, so 1 + 2 v / c is the ratio of the
    cosines. Exact, as tan(theta) = r / f is.
    """
    square = [(r * pixel / focal_length) ** 2 for r in (received, emitted)]
    return speed_of_light / 2 * (np.sqrt((1 + square[0]) / (1 + square[1])) - 1)
