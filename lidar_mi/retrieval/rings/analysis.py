"""Rings in any image: centre, radii, orders, and their deviation from equal steps of r^2.

The instrument need not be known. Rings are detected in the average over circles, measured in
sectors, and one centre is fitted to all of them; then r^2 must increase by one step from order to
order, r_p^2 = (p + e) spacing with p = 0, 1, ... from the centre outwards and e the fractional
order at the centre, for each line of the light (a split line has two or three).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.stats import chi2

from lidar_mi.arguments import checked_arguments
from lidar_mi.errors import InputError
from lidar_mi.retrieval.rings.alignment import aligned, crests
from lidar_mi.retrieval.rings.centre import ring_centre
from lidar_mi.retrieval.rings.frames import checked, few_levels, inside
from lidar_mi.retrieval.rings.pattern import (
    Pattern,
    Profile,
    find_pattern,
    lines_at,
    repeats,
    strongest_period,
)
from lidar_mi.retrieval.rings.ring_fit import CurveFit, fit_all, hidden_rings
from lidar_mi.retrieval.rings.sectors import RingCurves, Sectors
from lidar_mi.retrieval.threads import threads_for
from lidar_mi.tables import Table, Tabular, with_error

LAW = 0.02  # orders, largest rms deviation from equal steps of an etalon's pattern
UNEXPLAINED = 0.2  # of the pattern's power, the largest residual beyond that of noise

_UNEVEN = (
    "deviations of neighbouring parts correlate; errors hold for patches of up to 1/10 of the image"
)

CREST = 0.3  # of the highest crest, the least height of one that no line may leave unexplained


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
    fraction_covariance : array (lines, lines)
        Of the errors, which are in part common to the lines.
    height : array (lines,)
        Of the components, relative to the highest.
    misfit : float
        Rms deviation of r^2 from equal steps, in orders; NaN where two rings leave none.
    roundness : float
        Rms deviation of the crests from the fitted curves: circles, ellipses, tilted circles.
    uneven : bool
        Whether deviations of neighbouring parts of rings are correlated, as by uneven plates.
        Standard errors are then from a jackknife over six parts of the image and uncertain by a
        third. Patches wider than a tenth of the image are taken for another centre or spacing;
        their errors may be larger than stated.
    ellipticity : (float, float)
        Cosine and sine part, over twice the angle, of a ring's radius over its mean; the size is
        half the relative difference of its diameters.
    tilt : (float, float)
        Shift of a ring's middle from the centre over its squared radius, 1/px; its size is
        tan(tilt of the camera) over the focal length. 0, as the ellipticity, where the
        detected rings do not determine it.
    doubt : str
        Why another spacing is possible, or the lines may not be those of the light; empty: neither.
    r2, profile : arrays
        Common part of all sectors, mean over circles, for the image; without their backgrounds.
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
    fraction_covariance: np.ndarray
    height: np.ndarray
    misfit: float
    roundness: float
    uneven: bool
    ellipticity: tuple[float, float]
    tilt: tuple[float, float]
    doubt: str
    r2: np.ndarray
    profile: np.ndarray

    @property
    def splitting(self) -> np.ndarray:
        """r^2 from the first to the other components in every order that has both, px^2.

        Shape (orders, lines - 1); NaN where an order lacks one.
        """
        lines = len(self.fraction)
        table = np.full((self.order.max() + 2, lines), np.nan)
        # a component that passes the centre first belongs to the next order
        table[self.order, self.line] = self.radius**2
        split = table[:, 1:] - table[:, :1]
        return split[np.isfinite(split).any(1)]

    def curve(self, radius: np.ndarray | float, angle: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Points (x, y) of a ring of that mean radius, at angles from x toward y."""
        return RingCurves(self.centre, self.ellipticity, self.tilt).curve(radius, angle)

    def _shape(self) -> str:
        if not any((*self.ellipticity, *self.tilt)):
            return "not determined by the visible part of the rings: taken for circles"
        return f"{math.hypot(*self.ellipticity):.2g}, {math.hypot(*self.tilt):.2g} / px"

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
        if self.doubt:
            whole.append(("doubtful", self.doubt))
        whole += [
            ("rms deviation from equal steps", steps),
            ("rms deviation of crests from the rings", f"{self.roundness:.2g} px"),
            *([("uneven", _UNEVEN)] if self.uneven else []),
            ("ellipticity, tilt", self._shape()),
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
    image: Any,
    centre: tuple[float, float] | None = None,
    saturation: float | None = None,
    spacing: float | None = None,
) -> Rings:
    """Find and measure the rings of an etalon in any image.

    Parameters
    ----------
    image : array or tensor, shape (height, width)
        Any scale; the background may be sloped or curved, and parts of the rings may be hidden.
    centre : (float, float), optional
        (x, y) of the rings where it is known, px; fitted if not given.
    saturation : float, optional
        Value from which a pixel is saturated.
    spacing : float, optional
        Step of r^2 from order to order, px^2, to 2 %, where it is known, as from another image of
        the same instrument. Without it, lines at equal distances are taken for one line of a
        shorter step: an image does not distinguish them.

    Returns
    -------
    Rings
        Standard errors are from the residuals, and hold for plates that are uneven in patches;
        see ``uneven``.

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
    if spacing is not None and not 0 < spacing < math.inf:
        raise InputError(f"spacing: {spacing:g} px^2 is not allowed; expected above 0")
    images = checked(image, saturation)
    if len(images) != 1:
        raise InputError(f"image: {len(images)} images are not allowed; expected one")
    values = images[0].double().cpu().numpy()
    free = centre is None
    place = ring_centre(values) if centre is None else _pair(centre)
    inside(*place, values.shape)
    geometry = aligned(values, RingCurves(place), free)
    sectors = Sectors(values, geometry)
    hidden = hidden_rings(sectors, _rings_alone(sectors, spacing))
    if hidden is not None:
        geometry = aligned(values, RingCurves(geometry.centre), free, hidden)
        sectors = Sectors(values, geometry, hidden)
    pattern, doubt = _pattern(sectors, spacing)
    fit = fit_all(values, geometry, pattern, free, hidden)
    if spacing is None and repeats(fit.pattern):
        # with a background and a height of every sector the lines are one, of a shorter spacing
        pattern, doubt = _pattern(sectors, fit.pattern.spacing / len(fit.pattern.fraction))
        fit = fit_all(values, geometry, pattern, free, hidden)
    law = _law(fit)
    return Rings(
        shape=values.shape,
        centre=fit.geometry.centre if free else place,
        centre_std=_pair(np.sqrt(np.diag(fit.geometry_covariance))[:2]),
        radius=np.sqrt(fit.square),
        radius_std=np.sqrt(np.diag(fit.square_covariance)) / (2 * np.sqrt(fit.square)),
        order=fit.order + law.passed[fit.line],
        line=fit.line,
        spacing=law.spacing,
        spacing_std=law.spacing_std,
        fraction=law.fraction,
        fraction_std=np.sqrt(np.diag(law.fraction_covariance)),
        fraction_covariance=law.fraction_covariance,
        height=fit.pattern.height,
        misfit=law.misfit,
        roundness=fit.roundness,
        uneven=fit.uneven,
        ellipticity=fit.geometry.ellipticity,
        tilt=fit.geometry.tilt,
        doubt="; ".join(reason for reason in (doubt, few_levels(values)) if reason),
        r2=fit.sectors.r2,
        profile=fit.sectors.profile,
    )


def _pair(values: Sequence[float] | np.ndarray) -> tuple[float, float]:
    return float(values[0]), float(values[1])


def _pattern(sectors: Sectors, spacing: float | None) -> tuple[Pattern, str]:
    """Lines of the mean over circles; refused unless they explain every crest that it has."""
    places = crests(sectors)
    high = sectors.profile[places] - sectors.profile.min()
    places = sectors.r2[places[high > CREST * high.max()]]
    pattern, doubt, noise = _best_pattern(sectors, spacing)
    radii = ", ".join(f"{math.sqrt(place):.0f}" for place in places)
    wrong = InputError(
        f"rings: radii of {radii} px are not allowed; expected squares that rise by equal "
        "steps from the centre on"
    )
    if pattern is None:
        raise wrong
    if not _explains(pattern, noise):
        raise wrong
    off = np.abs((pattern.phase(places) + 0.5) % 1 - 0.5).min(0)
    if (off > max(0.5 * pattern.width, 2 * LAW)).any():
        raise wrong
    return pattern, doubt


def _explains(pattern: Pattern, noise: float) -> bool:
    """Whether the pattern explains the profile to its noise."""
    return pattern.unexplained - 2 * noise * pattern.freedom <= UNEXPLAINED * pattern.power


def _rings_alone(sectors: Sectors, spacing: float | None) -> Pattern | None:
    """Lines of the strongest period where they explain the profile, of a longer one where not.

    None where neither does: without rings nothing is hidden.
    """
    profile, noise = _profile(sectors)
    if spacing is None:
        with threads_for(len(profile.r2)):
            pattern = lines_at(profile, strongest_period(profile), noise, most=1)
        if pattern is not None and pattern.unexplained < UNEXPLAINED * pattern.power:
            return pattern
    pattern, _, noise = _best_pattern(sectors, spacing)
    return pattern if pattern is not None and _explains(pattern, noise) else None


def _profile(sectors: Sectors) -> tuple[Profile, float]:
    """Mean over circles, weighted by its errors, and the variance that goes with the weights."""
    weight = sectors.profile_count / sectors.profile_noise
    profile = Profile(sectors.profile_r2, sectors.profile, weight, sectors.step)
    return profile, float(1 / weight[weight > 0].mean())


def _best_pattern(sectors: Sectors, spacing: float | None) -> tuple[Pattern | None, str, float]:
    """Pattern of the profile, what is doubtful about it, and the noise of its annuli."""
    profile, noise = _profile(sectors)
    with threads_for(len(profile.r2)):
        pattern = find_pattern(profile, noise, spacing)
    return (None, "", noise) if pattern is None else (*pattern, noise)


@dataclass(frozen=True)
class _Law:
    """Equal steps: spacing and fractions, and by how many orders each line's rings are renamed."""

    spacing: float
    spacing_std: float
    fraction: np.ndarray
    fraction_covariance: np.ndarray
    passed: np.ndarray
    misfit: float


def _law(fit: CurveFit) -> _Law:
    """Least squares of square = (order + fraction) spacing, weighted as for white noise.

    Standard errors follow from those of the rings; where the rings deviate more, at the
    significance of 1 %, they are scaled to the deviation.
    """
    lines = len(fit.pattern.fraction)
    rows = np.column_stack([fit.order, fit.line[:, None] == np.arange(lines)]).astype(float)
    weight = np.linalg.pinv(fit.model_covariance, hermitian=True)
    gain = np.linalg.solve(rows.T @ weight @ rows, rows.T @ weight)
    coefficients = gain @ fit.square
    off = fit.square - rows @ coefficients
    spacing, first = coefficients[0], coefficients[1:]
    freedom = len(fit.square) - 1 - lines
    covariance = gain @ fit.square_covariance @ gain.T
    misfit = math.nan
    usual = 1 / np.diag(fit.model_covariance)
    if freedom > 0:
        misfit = math.sqrt(usual @ off**2 / usual.sum() * len(off) / freedom) / spacing
        residual_of = np.eye(len(off)) - rows @ gain
        expected = np.trace(weight @ residual_of @ fit.square_covariance @ residual_of.T)
        excess = float(off @ weight @ off / expected)
        if excess > chi2.ppf(0.99, freedom) / freedom:
            covariance = covariance * excess
    by = np.column_stack([-first / spacing**2, np.eye(lines) / spacing])
    fraction = first / spacing
    passed = np.floor(fraction).astype(int)
    radii = ", ".join(f"{math.sqrt(s):.0f}" for s in fit.square)
    if not spacing > 0 or misfit > LAW + 2 * math.sqrt(1 / usual.sum()) / spacing:
        raise InputError(
            f"rings: radii of {radii} px are not allowed; expected squares that rise by equal "
            "steps from the centre on"
        )
    return _Law(
        spacing=float(spacing),
        spacing_std=float(np.sqrt(covariance[0, 0])),
        fraction=fraction - passed,
        fraction_covariance=by @ covariance @ by.T,
        passed=passed,
        misfit=misfit,
    )
