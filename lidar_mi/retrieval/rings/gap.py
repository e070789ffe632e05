"""Gap of an etalon from lines of known wavelength: the method of exact fractions.

The order at the centre is 2 n gap / wavelength = N + e, with N a whole number that a frame does not
determine and e the fractional order that it does. Each N of the first line gives a gap; the other
lines allow only those whose fractions come out as measured (Benoit 1898, J. Phys. Theor. Appl. 7,
57; Born & Wolf 1999, Principles of Optics, 7th ed., section 7.6.3).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.stats import chi2

from lidar_mi.arguments import checked_arguments
from lidar_mi.errors import InputError
from lidar_mi.retrieval.rings.analysis import Rings
from lidar_mi.tables import Table, Tabular, with_error

LARGEST = 0.1  # m, of the gaps that are tried where none is expected
AGREES = 0.997  # probability that the true gap is among the candidates
LISTED = 12


@dataclass(frozen=True, eq=False, repr=False)
class Gap(Tabular):
    """The gaps that agree with measured fractional orders; lengths in m.

    Attributes
    ----------
    gap, gap_std : float
        Mean and standard deviation over the candidates, each with its likelihood: they hold the
        uncertainty of the whole order. NaN where the candidates form more than one group.
    group, group_std : arrays (groups,)
        The same of every group: candidates of neighbouring orders.
    candidate, candidate_std : arrays (candidates,)
        Every gap that agrees, ascending, and its standard error if its orders are the true ones.
    order : array (candidates, lines) of int
        Whole number N of each line at the centre.
    chi_square : array (candidates,)
        Of the fractions, with one degree of freedom less than there are lines.
    wavelength, fraction, fraction_std : arrays (lines,)
        What they were determined from.
    """

    gap: float
    gap_std: float
    group: np.ndarray
    group_std: np.ndarray
    candidate: np.ndarray
    candidate_std: np.ndarray
    order: np.ndarray
    chi_square: np.ndarray
    wavelength: np.ndarray
    fraction: np.ndarray
    fraction_std: np.ndarray

    def tables(self) -> list[Table]:
        """The gap or the groups that it may be in, and the candidates."""
        if len(self.group) == 1:
            rows = [("gap", with_error(1e3 * self.gap, 1e3 * self.gap_std, "mm"))]
        else:
            rows = [
                (f"gap, {k} of {len(self.group)}", with_error(1e3 * value, 1e3 * std, "mm"))
                for k, (value, std) in enumerate(
                    zip(self.group[:LISTED], self.group_std[:LISTED], strict=True), 1
                )
            ]
        # the best ones, in the order of their gaps
        best = np.sort(np.argsort(self.chi_square, kind="stable")[:LISTED])
        single = [
            (
                with_error(1e3 * self.candidate[k], 1e3 * self.candidate_std[k], "mm"),
                ", ".join(map(str, self.order[k])),
                f"{self.chi_square[k]:.2g}",
            )
            for k in best
        ]
        more = len(self.candidate) - len(single)
        note = f"{more} more agree less well" if more else ""
        heads = ("gap", "orders at the centre", "chi-square")
        return [Table("etalon", rows), Table("candidates", single, heads, note)]


@checked_arguments
def gap_from_fractions(
    fraction: Sequence[float] | np.ndarray,
    fraction_std: Sequence[float] | np.ndarray,
    wavelength: Sequence[float] | np.ndarray,
    nominal: float | None = None,
    tolerance: float | None = None,
    refractive_index: float = 1.0,
) -> Gap:
    """Gap of an etalon from the fractional orders at the centre of two or more lines.

    Two lines of the difference D of wavenumbers determine the gap but for multiples of 1 / (2 n D),
    the whole difference of their orders, and within one of these to std / (2 n D). A nominal gap
    selects the multiple.

    Parameters
    ----------
    fraction, fraction_std : arrays (lines,)
        Orders, 0 to 1, and their standard errors; errors of different lines are independent.
    wavelength : array (lines,)
        In vacuum if ``refractive_index`` is that of the gap, in air if it is 1 and the gap holds
        air; m.
    nominal, tolerance : float, optional
        The gap lies within ``tolerance`` of ``nominal``, m. Without them: any up to 0.1 m.
    refractive_index : float
        Between the plates, of all lines.

    Returns
    -------
    Gap

    Raises
    ------
    InputError
        Fewer than two lines, lines of one wavelength, values out of range, or no gap that agrees.

    Examples
    --------
    A gap of 0.885 mm, and lines 0.113 nm apart measured to 0.001 orders:

    >>> import lidar_mi as lm
    >>> lines = 487.986e-9, 487.873e-9
    >>> fraction = [2 * 0.885e-3 / line % 1 for line in lines]
    >>> found = lm.gap_from_fractions(fraction, [1e-3, 1e-3], lines, 0.9e-3, 0.1e-3)
    >>> f"{1e3 * found.gap:.3f} +- {1e3 * found.gap_std:.3f} mm"
    '0.885 +- 0.001 mm'
    """
    lines = {"fraction": fraction, "fraction_std": fraction_std, "wavelength": wavelength}
    for name, values in lines.items():
        if np.ndim(values) != 1:
            raise InputError(f"{name}: {np.ndim(values)} dimensions are not allowed; expected one")
    std = np.array(fraction_std, float)
    return gap_of_covariance(
        fraction, np.diag(std**2), wavelength, nominal, tolerance, refractive_index
    )


def gap_of_covariance(
    fraction: Sequence[float] | np.ndarray,
    covariance: np.ndarray,
    wavelength: Sequence[float] | np.ndarray,
    nominal: float | None,
    tolerance: float | None,
    refractive_index: float = 1.0,
) -> Gap:
    """As `gap_from_fractions`, of fractions whose errors have a covariance."""
    e, length = np.array(fraction, float), np.array(wavelength, float)
    std = np.sqrt(np.diag(covariance))
    _check(e, std, length, nominal, tolerance, refractive_index)
    if nominal is None or tolerance is None:
        low, high = 0.0, LARGEST
    else:
        low, high = max(nominal - tolerance, 0.0), nominal + tolerance
    # orders per m of gap
    per_gap = 2 * refractive_index / length
    # a gap at either end may come from fractions that err
    reach = 5 * std[0] / per_gap[0]
    first = np.arange(
        max(math.ceil((low - reach) * per_gap[0] - e[0]), 0),
        math.floor((high + reach) * per_gap[0] - e[0]) + 1,
    )
    coarse = (first + e[0]) / per_gap[0]
    # whole orders of the other lines that are nearest at this gap
    order = np.round(coarse[:, None] * per_gap - e)
    order[:, 0] = first
    weight = np.linalg.inv(covariance)
    # generalised least squares of the one unknown, the gap
    spread = 1 / math.sqrt(float(per_gap @ weight @ per_gap))
    gap = (order + e) @ weight @ per_gap * spread**2
    off = gap[:, None] * per_gap - order - e
    misfit = np.einsum("gi,ij,gj->g", off, weight, off)
    inside = (gap >= low) & (gap <= high) & (order >= 0).all(1)
    # the gap is fitted: one degree of freedom less than lines
    agrees = inside & (misfit <= chi2.ppf(AGREES, len(length) - 1))
    if not agrees.any():
        best = gap[inside][misfit[inside].argmin()] if inside.any() else None
        nearest = f"; {1e3 * best:.6g} mm agrees best" if best is not None else ""
        raise InputError(
            f"gap: none from {1e3 * low:.6g} to {1e3 * high:.6g} mm agrees with the fractional "
            f"orders{nearest}; expected another range, or other wavelengths"
        )
    gap, order, misfit = gap[agrees], order[agrees].astype(int), misfit[agrees]
    groups = np.split(np.arange(len(gap)), 1 + np.flatnonzero(np.diff(order[:, 0]) > 1))
    means = np.array([_mean(gap[g], misfit[g], spread) for g in groups])
    single = len(groups) == 1
    return Gap(
        gap=float(means[0, 0]) if single else math.nan,
        gap_std=float(means[0, 1]) if single else math.nan,
        group=means[:, 0],
        group_std=means[:, 1],
        candidate=gap,
        candidate_std=np.full(len(gap), spread),
        order=order,
        chi_square=misfit,
        wavelength=length,
        fraction=e,
        fraction_std=std,
    )


def _mean(gap: np.ndarray, misfit: np.ndarray, spread: float) -> tuple[float, float]:
    """Mean and standard deviation of gaps that are as likely as their misfit allows."""
    weight = np.exp(-(misfit - misfit.min()) / 2)
    weight /= weight.sum()
    mean = weight @ gap
    # variance between the candidates and that of each
    return mean, math.sqrt(weight @ (gap - mean) ** 2 + spread**2)


def _check(
    e: np.ndarray,
    std: np.ndarray,
    length: np.ndarray,
    nominal: float | None,
    tolerance: float | None,
    refractive_index: float,
) -> None:
    if not len(e) == len(std) == len(length) >= 2:
        raise InputError(
            f"wavelength: {len(length)} for {len(e)} fractions are not allowed; expected one for "
            "each, of two lines or more"
        )
    for name, values, good, expected in (
        ("fraction", e, (e >= 0) & (e <= 1), "0 to 1"),
        ("fraction_std", std, (std > 0) & (std < 0.5), "above 0 and below 0.5"),
        ("wavelength", length, (length > 1e-8) & (length < 1e-3), "1e-08 to 0.001 m"),
    ):
        if not good.all():
            raise InputError(f"{name}: {values[~good][0]:g} is not allowed; expected {expected}")
    if np.ptp(length) < 1e-9 * length.max():
        raise InputError(f"wavelength: {length[0]:g} m twice; expected different lines")
    if nominal is None or tolerance is None:
        if nominal is not tolerance:
            raise InputError("nominal: one of nominal and tolerance alone; expected both")
    elif not (0 < nominal <= LARGEST and 0 < tolerance <= LARGEST):
        raise InputError(
            f"nominal: {nominal:g} m within {tolerance:g} m is not allowed; expected both above 0 "
            f"and up to {LARGEST:g} m"
        )
    if not 1 <= refractive_index <= 5:
        raise InputError(f"refractive_index: {refractive_index:g}; expected 1 to 5")


@checked_arguments
def gap_from_lines(
    rings: Rings, wavelength: Any, nominal: float | None = None, tolerance: float | None = None
) -> Gap:
    """Gap of an etalon from rings of two or three lines of known wavelength.

    Parameters
    ----------
    rings : Rings
        With one component for each wavelength.
    wavelength : array (lines,)
        The highest line's first, m. Lines whose heights differ by less than 20 % are tried in both
        orders.
    nominal, tolerance : float, optional
        As of `gap_from_fractions`.

    Returns
    -------
    Gap

    Raises
    ------
    InputError
        Another number of lines than of wavelengths, lines of about one height that would give gaps
        in either order of the wavelengths, and as `gap_from_fractions`.

    Examples
    --------
    Rings of two lines, the second a third as high as the first:

    >>> import lidar_mi as lm
    >>> import numpy as np
    >>> y, x = np.mgrid[:200, :300]
    >>> r2 = (x - 150.5) ** 2 + (y - 99.0) ** 2
    >>> lines = np.array([487.986e-9, 487.873e-9])
    >>> order = r2[..., None] / (5000 * lines / lines[0]) - 2 * 0.885e-3 / lines
    >>> image = 1 / (1 + 60 * np.sin(np.pi * order) ** 2) @ [3, 1]
    >>> found = lm.gap_from_lines(lm.analyse_rings(image), lines, 0.9e-3, 0.1e-3)
    >>> f"{1e3 * found.gap:.3f} mm"
    '0.885 mm'
    """
    lines = len(rings.fraction)
    if len(wavelength) != lines:
        raise InputError(
            f"wavelength: {len(wavelength)} for {lines} line(s) in the rings are not allowed; "
            "expected one for each, the brightest line's first"
        )
    by_height = np.argsort(-rings.height)
    sorted_heights = rings.height[by_height]
    orders = [by_height]
    if (sorted_heights[1:] > 0.8 * sorted_heights[:-1]).any():
        # lines of about one height may be either way round
        orders.append(by_height[::-1])
    gaps, refused = [], None
    for order in orders:
        try:
            e = fractions_of(rings, np.asarray(wavelength, float), order)
            covariance = rings.fraction_covariance[np.ix_(order, order)]
            gaps.append(gap_of_covariance(e, covariance, wavelength, nominal, tolerance))
        except InputError as error:
            refused = error
    if not gaps:
        raise refused or InputError("wavelength: no line")
    if len(gaps) > 1:
        raise InputError(
            "wavelength: lines of about one height agree with a gap in either order of the "
            "wavelengths; expected a nominal gap that excludes one, or lines of different height"
        )
    return gaps[0]


def fractions_of(rings: Rings, wavelength: np.ndarray, line: np.ndarray) -> np.ndarray:
    """Fractional orders of lines at the centre, spacings being in proportion to the wavelengths.

    `Rings` has one spacing for all lines. A wavelength longer by d widens its spacing by d, which
    over some orders changes the fraction by d times their mean number.

    Returns
    -------
    array (lines,)
        Of ``line``, in this order; their covariance is that of `Rings`.
    """
    column = np.argsort(line)[rings.line]
    ratio = (wavelength / wavelength[0])[column]
    rows = np.column_stack([rings.order, column[:, None] == np.arange(len(line))])
    # the error of r^2 is 2 r times that of r
    weight = 1 / (2 * rings.radius * rings.radius_std)
    # r^2 / ratio = spacing * order + spacing * fraction, linear in both products
    known = np.linalg.lstsq(rows * (ratio * weight)[:, None], rings.radius**2 * weight, rcond=None)[
        0
    ]
    return known[1:] / known[0] % 1
