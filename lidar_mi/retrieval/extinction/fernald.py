"""Fernald's inversion: particles among molecules that are known."""

import numpy as np
import scipy
from numpy.typing import ArrayLike
from scipy.integrate import cumulative_trapezoid

from lidar_mi.errors import InputError
from lidar_mi.retrieval.extinction.klett import over
from lidar_mi.retrieval.extinction.profile import (
    along,
    check_index,
    checked_profile,
    positive_number,
)

MOLECULAR_LIDAR_RATIO = 8 * scipy.constants.pi / 3
"""Extinction over backscatter of Rayleigh scattering without depolarisation, sr."""


def fernald(
    signal: ArrayLike,
    ranges: ArrayLike,
    molecular_backscatter: ArrayLike,
    lidar_ratio: float,
    reference_backscatter: float = 0.0,
    reference: int = -1,
    molecular_lidar_ratio: float = MOLECULAR_LIDAR_RATIO,
) -> np.ndarray:
    """Extinction of particles along a beam by the solution of Fernald (1984).

    With the lidar ratios S_p of particles and S_m of molecules, and the molecular backscatter b_m,
    the lidar equation of single scattering for the sum b of both backscatter coefficients is
    solved from its value b_c at a reference range r_c:

        b(r) = Z / (Z_c / b_c + 2 S_p int_r^r_c Z dr'),
        Z = r^2 P exp(2 (S_p - S_m) int_r^r_c b_m dr').

    signal (ranges,): signal P of each range with background subtracted and corrected for overlap,
        above 0, in any unit.
    ranges (ranges,): m, ascending.
    molecular_backscatter (ranges,): b_m, m^-1 sr^-1, 0 or more.
    lidar_ratio: S_p, sr.
    reference_backscatter: backscatter of particles at the reference range, m^-1 sr^-1; 0: molecules
        alone.
    reference: index of the reference range; default: the farthest, from which the solution is
        stable.
    molecular_lidar_ratio: S_m, sr.

    Raises InputError: ranges that do not ascend, signal or lidar ratios not above 0, backscatter
    below 0, or none at the reference range, an index out of range.

    Returns
    -------
    (ranges,) array
        Extinction S_p (b - b_m) of particles, m^-1: noise may make it negative. Infinite beyond the
        range at which an outward solution diverges.

    Notes
    -----
    Source: Fernald 1984, Appl. Opt. 23, 652, whose steps from range to range the
    trapezoid's integrals sum.
    """
    signal, ranges = checked_profile(signal, ranges)
    molecular = along("molecular_backscatter", molecular_backscatter, ranges)
    if not (molecular >= 0).all():
        raise InputError(
            f"molecular_backscatter: {molecular.min():g} is not allowed; expected 0 or more"
        )
    ratio = positive_number("lidar_ratio", lidar_ratio, "sr")
    molecular_ratio = positive_number("molecular_lidar_ratio", molecular_lidar_ratio, "sr")
    check_index(reference, ranges)
    known = positive_number(
        "reference_backscatter", reference_backscatter + molecular[reference], "m^-1 sr^-1"
    )
    between = cumulative_trapezoid(molecular, ranges, initial=0)
    corrected = signal * ranges**2 / (signal[reference] * ranges[reference] ** 2)
    corrected = corrected * np.exp(2 * (ratio - molecular_ratio) * (between[reference] - between))
    before = cumulative_trapezoid(corrected, ranges, initial=0)
    backscatter = over(corrected, 1 / known + 2 * ratio * (before[reference] - before))
    return ratio * (backscatter - molecular)
