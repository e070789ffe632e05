"""Rings in any image: centre, radii, orders, and their deviation from equal steps of r^2.

The instrument need not be known. Rings are detected in the average over circles, measured in
sectors, and one centre is fitted to all of them; then r^2 must increase by one step from order to
order, r_p^2 = (p + e) spacing with p = 0, 1, ... from the centre outwards and e the fractional
order at the centre, for each line of the light (a split line has two or three).
"""

import itertools
import math
from dataclasses import dataclass

import numpy as np
from scipy.signal import find_peaks, peak_widths, savgol_filter

from lidar_mi.arguments import checked_arguments
from lidar_mi.errors import InputError
from lidar_mi.retrieval.rings.centre import gradient_centre
from lidar_mi.retrieval.rings.frames import checked, inside
from lidar_mi.retrieval.rings.peak_fit import peaks
from lidar_mi.tables import Table, Tabular, with_error

STEPS = 1200  # annuli out to the farthest corner
SECTORS = 48
SIGNIFICANT = 8.0  # standard deviations of the smoothed average, the least height of a ring
PROMINENT = 0.1  # of the tallest ring's height, likewise
LEAST = 3  # sectors in which a ring must be detected
ALL_AROUND = 0.5  # of the sectors, in which a ring must be detected to determine its shape
LINES = 3  # largest number of components of a line
LAW = 0.02  # orders, largest rms deviation from equal steps of an etalon's pattern


@dataclass(frozen=True, eq=False, repr=False)
class Rings(Tabular):
    """The rings of an image; lengths in pixels, errors are standard deviations.

    Attributes
    ----------
    shape : (int, int)
        Height and width.
    centre, centre_std : (float, float)
        (x, y), x to the right and y down from the top left pixel's centre; 0 for a given centre.
    radius, radius_std : array (rings,)
        From the centre outwards.
    order : array (rings,) of int
        Orders of interference of each ring below the centre's, integer part.
    line : array (rings,) of int
        Which of the split line's components, 0 the innermost.
    spacing, spacing_std : float
        Step of r^2 from order to order, px^2.
    fraction, fraction_std : array (lines,)
        Fractional order at the centre of each component, 0 to 1 (r^2 over spacing of its
        ring of order 0).
    misfit : float
        Rms deviation of r^2 from equal steps, in orders; NaN where two rings leave none.
    roundness : float
        Rms deviation of the crests from the curves fitted: circles, ellipses, tilted circles.
    ellipticity : (float, float)
        Cosine and sine part, over twice the angle, of a ring's radius over its mean; the size is
        half the relative difference of its diameters.
    tilt : (float, float)
        Shift of a ring's middle from the centre over its squared radius, 1/px; its size is
        tan(tilt of the camera) over the focal length. 0, as the ellipticity, where the
        detected rings do not determine it.
    r2, profile : arrays
        Mean over circles, for the image.
    """

    shape: tuple[int, int]
    centre: tuple[float, float]
    centre_std: tuple[float, float]
    radius: np.ndarray
    radius_std: np.ndarray
    order: np.ndarray
    line: np.ndarray
    spacing: float
    spacing_std: float
    fraction: np.ndarray
    fraction_std: np.ndarray
    misfit: float
    roundness: float
    ellipticity: tuple[float, float]
    tilt: tuple[float, float]
    r2: np.ndarray
    profile: np.ndarray

    @property
    def splitting(self) -> np.ndarray:
        """r^2 from the first to the other components in every order that has both, px^2.

        Shape (orders, lines - 1); NaN where an order lacks one.
        """
        lines = len(self.fraction)
        table = np.full((self.order.max() + 2, lines), np.nan)
        # a component that passes the centre first belongs to the order outside
        table[self.order, self.line] = self.radius**2
        split = table[:, 1:] - table[:, :1]
        return split[np.isfinite(split).any(1)]

    def curve(self, radius: float, angle: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Points (x, y) of a ring of that mean radius, at angles from x toward y."""
        cosine, sine = np.cos(angle), np.sin(angle)
        r = radius * (
            1 + self.ellipticity[0] * np.cos(2 * angle) + self.ellipticity[1] * np.sin(2 * angle)
        )
        r = r + radius**2 * (self.tilt[0] * cosine + self.tilt[1] * sine)
        return self.centre[0] + r * cosine, self.centre[1] + r * sine

    def tables(self) -> list[Table]:
        """Pattern and rings, with standard errors."""
        (x, y), (x_std, y_std) = self.centre, self.centre_std
        given = "" if any(self.centre_std) else " (given)"
        whole = [
            ("centre x, y", f"{with_error(x, x_std)}, {with_error(y, y_std)} px{given}"),
            ("r^2 from order to order", with_error(self.spacing, self.spacing_std, "px^2")),
        ]
        for line, (value, std) in enumerate(zip(self.fraction, self.fraction_std, strict=True)):
            of = f", line {line}" if len(self.fraction) > 1 else ""
            whole.append((f"fractional order at the centre{of}", with_error(value, std)))
        for split in self.splitting:
            for line, value in enumerate(split, 1):
                whole.append(
                    (
                        f"splitting, line {line} from 0",
                        (f"{value:.6g} px^2, {value / self.spacing:.4f} orders"),
                    )
                )
        steps = "too few rings to test" if math.isnan(self.misfit) else f"{self.misfit:.2g} orders"
        whole += [
            ("rms deviation from equal steps", steps),
            ("rms deviation of crests from the rings", f"{self.roundness:.2g} px"),
            (
                "ellipticity, tilt",
                (f"{math.hypot(*self.ellipticity):.2g}, {math.hypot(*self.tilt):.2g} / px"),
            ),
        ]
        single = [
            (str(order), str(line), with_error(radius, std, "px"))
            for order, line, radius, std in zip(
                self.order, self.line, self.radius, self.radius_std, strict=True
            )
        ]
        return [Table("pattern", whole), Table("rings", single, ("order", "line", "radius"))]


@checked_arguments
def analyse_rings(
    image, centre: tuple[float, float] | None = None, saturation: float | None = None
) -> Rings:
    """Find and measure the rings of an etalon in any image.

    Parameters
    ----------
    image : array or tensor, shape (height, width)
        Any scale; the background may have a slope.
    centre : (float, float), optional
        (x, y) of the rings where it is known, px; fitted if not given.
    saturation : float, optional
        Value from which a pixel is saturated.

    Returns
    -------
    Rings

    Raises
    ------
    InputError
        An image that is not finite or saturated, has fewer than two rings or its centre outside, or
        rings that are not equally spaced in r^2.

    Examples
    --------
    Rings of equal steps of 4000 px^2, with order 0 a quarter of a step from the centre:

    >>> import lidar_mi as lm
    >>> import numpy as np
    >>> y, x = np.mgrid[:200, :300]
    >>> order = ((x - 150.5) ** 2 + (y - 99.0) ** 2) / 4000
    >>> rings = lm.analyse_rings(1 / (1 + 60 * np.sin(np.pi * (order - 0.25)) ** 2))
    >>> print("{:.1f} {:.1f}".format(*rings.centre), f"{rings.spacing:.0f}")
    150.5 99.0 4000
    """
    image = checked(image, saturation)
    if len(image) != 1:
        raise InputError(f"image: {len(image)} images are not allowed; expected one")
    image = image[0].double().cpu().numpy()
    free = centre is None
    centre = gradient_centre(image) if free else tuple(map(float, centre))
    inside(*centre, image.shape)
    for _ in range(8 if free else 1):
        sectors = _Sectors(image, centre)
        radius, error, distortion, moved_std, rms = _circles(*_crests(sectors), free)
        if free:
            centre = tuple(float(c + m) for c, m in zip(centre, distortion[:2], strict=True))
            inside(*centre, image.shape)
        if np.abs(distortion[:2]).max() < 0.02:
            break
    order, line, spacing, spacing_std, fraction, fraction_std, misfit = _law(
        radius**2, 2 * radius * error
    )
    return Rings(
        shape=image.shape,
        centre=centre,
        centre_std=tuple(map(float, moved_std)) if free else (0.0, 0.0),
        radius=radius,
        radius_std=error,
        order=order,
        line=line,
        spacing=spacing,
        spacing_std=spacing_std,
        fraction=fraction,
        fraction_std=fraction_std,
        misfit=misfit,
        roundness=rms,
        ellipticity=tuple(map(float, distortion[2:4])),
        tilt=tuple(map(float, distortion[4:])),
        r2=sectors.r2,
        profile=sectors.mean,
    )


class _Sectors:
    """Averages over sectors of annuli of equal steps in r^2.

    Out to where the last sector leaves the image: `parts` (SECTORS, annuli) with NaN where a
    sector is not all inside, `mean` over those that are, `r2` the annuli's middles, `angle` the
    sectors'.
    """

    def __init__(self, image: np.ndarray, centre: tuple[float, float]):
        height, width = image.shape
        x, y = np.arange(width) - centre[0], np.arange(height)[:, None] - centre[1]
        r2 = x**2 + y**2
        self.step = r2.max() / STEPS
        sector = np.arctan2(y, x) * (SECTORS / (2 * np.pi)) % SECTORS
        label = np.minimum(r2 / self.step, STEPS - 1).astype(int) * SECTORS
        label += np.minimum(sector, SECTORS - 1).astype(int)
        size = STEPS * SECTORS
        count = np.bincount(label.ravel(), minlength=size).reshape(STEPS, SECTORS)
        total = np.bincount(label.ravel(), image.ravel(), size).reshape(STEPS, SECTORS)
        self.angle = (np.arange(SECTORS) + 0.5) * (2 * np.pi / SECTORS)
        # a sector cut by the edge would average another part of the image
        r = np.sqrt((np.arange(STEPS) + 1) * self.step)[:, None, None]
        around = (np.arange(SECTORS)[:, None] + np.linspace(0, 1, 5)) * (2 * np.pi / SECTORS)
        x, y = centre[0] + r * np.cos(around), centre[1] + r * np.sin(around)
        full = ((x > -0.5) & (x < width - 0.5) & (y > -0.5) & (y < height - 0.5)).all(2)
        full &= count > 0
        last = int(np.flatnonzero(full.any(1))[-1]) + 1
        self.parts = np.where(full, total / np.maximum(count, 1), np.nan)[:last].T
        count, total = np.where(full, count, 0).sum(1), np.where(full, total, 0).sum(1)
        self.r2 = (np.arange(last) + 0.5) * self.step
        known = np.flatnonzero(count[:last])
        self.mean = np.interp(self.r2, self.r2[known], total[known] / count[known])


def _crests(sectors: _Sectors) -> tuple[np.ndarray, np.ndarray]:
    """r^2 of every ring, (rings, SECTORS), NaN where it is not detected; the sectors' angles."""
    mean = sectors.mean
    smooth = savgol_filter(mean, 15, 2)
    # smoothing over 15 steps reduces white noise to 0.4
    noise = 0.4 * 1.4826 * np.median(np.abs(mean - smooth - np.median(mean - smooth)))
    height = max(SIGNIFICANT * noise, PROMINENT * np.ptp(smooth))
    if not np.ptp(smooth) > SIGNIFICANT * noise:
        raise InputError("rings: none detected; expected at least 2")
    places, _ = find_peaks(smooth, prominence=height)
    if len(places) < 2:
        raise InputError(f"rings: {len(places)} detected; expected at least 2")
    width = peak_widths(smooth, places, rel_height=0.5)[0] * sectors.step
    crests = np.full((len(places), SECTORS), np.nan)
    for group in np.split(np.arange(len(places)), _gaps(smooth, places)):
        starts = sectors.r2[places[group]]
        reach = max(1.05 * width[group].max(), 4 * sectors.step)
        for sector, part in enumerate(sectors.parts):
            # where a sector's last rings lie outside, the first may still be inside
            for many in range(len(group), 0, -1):
                if np.isfinite(np.interp(starts[many - 1] + reach, sectors.r2, part)):
                    break
            try:
                crests[group[:many], sector] = peaks(sectors.r2, part, starts[:many], reach, True)
            except InputError:
                continue
    detected = np.logical_and.accumulate(np.isfinite(crests).sum(1) >= LEAST)
    if detected.sum() < 2:
        raise InputError(f"rings: {detected.sum()} detected; expected at least 2")
    return crests[detected], sectors.angle


def _gaps(smooth: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Which crests begin a new group: between groups the profile falls to 0.2 or below."""
    valleys = [smooth[a:b].min() for a, b in itertools.pairwise(places)]
    lower = np.minimum(smooth[places[:-1]], smooth[places[1:]]) - smooth.min()
    return 1 + np.flatnonzero(valleys - smooth.min() < 0.2 * lower)


def _circles(crests: np.ndarray, angle: np.ndarray, free: bool):
    """One centre for all rings, and how far they are from circles about it.

    Least squares of r = a + shift . u + a ellipticity . u2 + a^2 tilt . u with u = (cos, sin) of
    the angle and u2 of twice the angle. These are the distortions of circles by a tilted camera,
    to first order in the tilt (each ring's shift is proportional to its area), and by anamorphic
    pixels or lenses. Where fewer than two rings are detected all around, only the shift is fitted.
    """
    rings = len(crests)
    radius = np.sqrt(np.nanmedian(crests, 1))
    ring, sector = np.nonzero(np.isfinite(crests))
    size, turn = radius[ring], angle[sector]
    once, twice = (np.column_stack([np.cos(k * turn), np.sin(k * turn)]) for k in (1, 2))
    # a given centre leaves the shift's columns empty, and the shift 0
    columns = [ring[:, None] == np.arange(rings), once * free]
    if (np.isfinite(crests).sum(1) >= ALL_AROUND * SECTORS).sum() >= 2:
        columns += [twice * size[:, None], once * size[:, None] ** 2]
    rows = np.hstack(columns).astype(float)
    scale = np.abs(rows).max(0)
    rows /= np.where(scale > 0, scale, 1)
    value = np.sqrt(crests[ring, sector])
    kept = np.ones(len(value), bool)
    for _ in range(10):
        found = np.linalg.lstsq(rows[kept], value[kept], rcond=None)[0]
        off = value - rows @ found
        # dust and reflections: beyond 4 standard deviations, these from the median
        kept = np.abs(off) <= 4 * 1.4826 * np.median(np.abs(off[kept])) + 1e-9
    freedom = max(kept.sum() - np.linalg.matrix_rank(rows[kept]), 1)
    rms = float(np.sqrt((off[kept] ** 2).sum() / freedom))
    inverse = np.linalg.pinv(rows[kept].T @ rows[kept], hermitian=True)
    std = np.sqrt(np.diag(inverse)) * rms
    shape = np.zeros(6)
    shape[: len(found) - rings] = (found / np.where(scale > 0, scale, 1))[rings:]
    # rings beyond a lost one could not be counted
    kept_rings = np.logical_and.accumulate(np.bincount(ring[kept], minlength=rings) >= LEAST)
    if kept_rings.sum() < 2:
        raise InputError(f"rings: {kept_rings.sum()} detected; expected at least 2")
    return found[:rings][kept_rings], std[:rings][kept_rings], shape, std[rings : rings + 2], rms


def _law(square: np.ndarray, error: np.ndarray):
    """Orders, components, spacing, fractions and misfit: the fewest components that fit."""
    rings = len(square)
    for lines in range(1, LINES + 1):
        if rings < lines + 1:
            break
        order, line = np.divmod(np.arange(rings), lines)
        rows = np.column_stack([order, line[:, None] == np.arange(lines)]).astype(float)
        weight = 1 / np.hypot(error, 0.002 * square[-1] / rings)
        found = np.linalg.lstsq(rows * weight[:, None], square * weight, rcond=None)[0]
        spacing, first = found[0], found[1:]
        freedom = rings - lines - 1
        off = square - rows @ found
        misfit = math.sqrt((off**2).sum() / freedom) / spacing if freedom else math.nan
        # with nothing left to test, the rings must at least reach in to the centre
        whole = math.floor(first[0] / spacing + 0.1)
        if spacing > 0 and (misfit < LAW if freedom else lines == 1) and whole <= 1:
            break
    else:
        lines = 0
    if not lines or rings < lines + 1 or not whole <= 1 or not (misfit < LAW or freedom == 0):
        radii = ", ".join(f"{math.sqrt(s):.0f}" for s in square)
        raise InputError(
            f"rings: radii of {radii} px are not allowed; expected squares that rise by equal "
            "steps from the centre on"
        )
    scale = max(1.0, misfit * spacing / np.median(error)) if freedom else 1.0
    covariance = np.linalg.inv((rows.T / error**2) @ rows) * scale**2
    fraction = first / spacing
    by = np.column_stack([-first / spacing**2, np.eye(lines) / spacing])
    fraction_std = np.sqrt(np.diag(by @ covariance @ by.T))
    passed = np.floor(fraction).astype(int)
    return (
        order + passed[line],
        line,
        float(spacing),
        float(np.sqrt(covariance[0, 0])),
        fraction - passed,
        fraction_std,
        misfit,
    )
