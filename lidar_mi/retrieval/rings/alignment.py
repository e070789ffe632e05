"""Centre and shape of rings whose pattern is not known yet: sectors against their mean.

Crests are detected in the mean over circles. Around each of them every sector is shifted
until it correlates best with the mean; the shifts give centre, ellipticity and tilt, and the mean
over the curves that follow is sharper.
"""

from collections.abc import Sequence

import numpy as np
from scipy.signal import find_peaks, peak_widths, savgol_coeffs, savgol_filter

from lidar_mi.errors import InputError
from lidar_mi.retrieval.rings.frames import inside
from lidar_mi.retrieval.rings.sectors import SECTORS, Hidden, RingCurves, Sectors

SIGNIFICANT = 8.0  # standard deviations of the smoothed average, the least height of a ring
PROMINENT = 0.1  # of the tallest ring's height, likewise
LEAST = 3  # sectors in which a ring must be detected
ALL_AROUND = 0.5  # of the sectors, in which a ring must be detected to determine its shape
CORRELATED = 0.5  # least correlation of a sector with the mean


def aligned(
    image: np.ndarray, start: RingCurves, free: bool, hidden: Hidden | None = None
) -> RingCurves:
    """The rings' geometry, to a fraction of their width.

    image (height, width)
    start: with a centre within about a third of a ring's width.
    free: whether the centre is fitted.
    hidden: rings that do not count.

    Raises InputError: fewer than two rings, or a centre outside the image.
    """
    geometry = start
    for number in range(8):
        sectors = Sectors(image, geometry, hidden)
        pieces = _pieces(sectors)
        shift, middle = _shifts(sectors, pieces)
        change = _change(shift, middle, sectors.angle, free)
        geometry = geometry.moved(change)
        inside(*geometry.centre, image.shape)
        if np.abs(change[:2]).max() < 0.1 and number:
            break
    return geometry


def crests(sectors: Sectors) -> np.ndarray:
    """Annuli of the crests of the mean over circles.

    Raises InputError: fewer than two.
    """
    mean = sectors.profile
    smooth = _smooth(mean)
    passed = np.sqrt((savgol_coeffs(_window(mean), 2) ** 2).sum())  # of white noise
    known = sectors.profile_count > 0
    noise = np.full(len(mean), np.inf)
    noise[known] = passed * np.sqrt(sectors.profile_noise[known] / sectors.profile_count[known])
    if not np.ptp(smooth) > SIGNIFICANT * np.median(noise):
        raise InputError("rings: none detected; expected at least 2")
    places, properties = find_peaks(smooth, prominence=PROMINENT * np.ptp(smooth))
    places = places[properties["prominences"] > SIGNIFICANT * noise[places]]
    if len(places) < 2:
        raise InputError(f"rings: {len(places)} detected; expected at least 2")
    return places


def _smooth(mean: np.ndarray) -> np.ndarray:
    return savgol_filter(mean, _window(mean), 2)


def _window(mean: np.ndarray) -> int:
    return 2 * max(round(len(mean) / 160), 2) + 1


def _pieces(sectors: Sectors) -> list[tuple[int, int]]:
    """First and last annulus of a piece around each crest, a width to both sides."""
    smooth, places = _smooth(sectors.profile), crests(sectors)
    widths = np.ceil(peak_widths(smooth, places, rel_height=0.5)[0]).astype(int)
    reach = np.minimum(np.maximum(widths, 4), 2 * max(np.median(widths), 4)).astype(int)
    low, high = np.maximum(places - reach, 0), np.minimum(places + reach, len(smooth) - 1)
    return list(zip(low.tolist(), high.tolist(), strict=True))


def _shifts(sectors: Sectors, pieces: Sequence[tuple[int, int]]) -> tuple[np.ndarray, np.ndarray]:
    """Shift of every piece in every sector, px^2, NaN where it is not known; the pieces' r^2."""
    value = np.stack([_filled(*pair) for pair in zip(sectors.value, sectors.used, strict=True)])
    shift = np.full((len(pieces), SECTORS), np.nan)
    for number, (first, last) in enumerate(pieces):
        size = last - first + 1
        if size < 7:
            continue
        line = np.linalg.qr(np.column_stack([np.ones(size), np.arange(size)]))[0]

        def straightened(values: np.ndarray, line: np.ndarray = line) -> np.ndarray:
            return values - (values @ line) @ line.T

        mean = straightened(sectors.profile[first : last + 1])
        reach = max(3, size // 3)
        lags = np.arange(-reach, reach + 1)
        correlation = np.full((len(lags), SECTORS), np.nan)
        for k, lag in enumerate(lags):
            if first + lag < 0 or last + lag >= value.shape[1]:
                continue
            part = straightened(value[:, first + lag : last + lag + 1])
            size2 = (part**2).sum(1) * (mean @ mean)
            correlation[k] = part @ mean / np.sqrt(np.where(size2 > 0, size2, np.nan))
        for sector in np.flatnonzero(np.isfinite(correlation).sum(0) >= 3):
            column = correlation[:, sector]
            best = int(np.nanargmax(column))
            near = column[max(best - 1, 0) : best + 2]
            if len(near) == 3 and np.isfinite(near).all() and column[best] > CORRELATED:
                low, top, high = near
                curvature = low - 2 * top + high
                vertex = (low - high) / (2 * curvature if curvature else 1.0)
                shift[number, sector] = lags[best] + vertex
    middle = np.array([sectors.r2[(a + b) // 2] for a, b in pieces])
    return shift * sectors.step, middle


def _filled(value: np.ndarray, count: np.ndarray) -> np.ndarray:
    """A sector with its empty cells interpolated; NaN beyond its last pixel."""
    place, known = np.arange(len(value)), np.flatnonzero(count)
    if not len(known):
        return np.full(len(value), np.nan)
    return np.interp(place, known, value[known], right=np.nan)


def _change(shift: np.ndarray, middle: np.ndarray, angle: np.ndarray, free: bool) -> np.ndarray:
    """Six changes of the geometry by least squares; 0 for those that are not determined."""
    known = np.isfinite(shift)
    if (known.sum(1) >= LEAST).sum() < 1:
        raise InputError("rings: none detected all around; expected at least 2")
    piece, sector = np.nonzero(known)
    value, q = shift[known], middle[piece]
    shaped = bool((known.sum(1) >= ALL_AROUND * SECTORS).sum() >= 2)
    columns = shape_columns(q, angle[sector]) * np.repeat([free, shaped], [2, 4])
    rows = np.hstack([piece[:, None] == np.arange(len(middle)), columns]).astype(float)
    scale = np.abs(rows).max(0)
    rows /= np.where(scale > 0, scale, 1)
    used = np.ones(len(value), bool)
    for _ in range(10):
        solution = np.linalg.lstsq(rows[used], value[used], rcond=1e-9)[0]
        off = value - rows @ solution
        # dust and reflections: beyond 4 standard deviations, these from the median
        used = np.abs(off) <= 4 * 1.4826 * np.median(np.abs(off[used])) + 1e-9
    change = solution[-6:] / np.where(scale > 0, scale, 1)[-6:]
    return np.where(scale[-6:] > 0, change, 0.0)


def shape_columns(r2: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """Shift of the squared radius by centre, ellipticity and tilt, (..., 6)."""
    r2, angle = np.broadcast_arrays(r2, angle)
    r = np.sqrt(r2)
    once = np.cos(angle), np.sin(angle)
    twice = np.cos(2 * angle), np.sin(2 * angle)
    return np.stack(
        [2 * r * k for k in once] + [2 * r2 * k for k in twice] + [2 * r2 * r * k for k in once], -1
    )
