"""Klett's inversion: one kind of scatterer, backscatter a power of extinction."""

import numpy as np
from numpy.typing import ArrayLike
from scipy.integrate import cumulative_trapezoid

from lidar_mi.retrieval.extinction.profile import check_index, checked_profile, positive_number


def klett(
    signal: ArrayLike,
    ranges: ArrayLike,
    reference_extinction: float,
    reference: int = -1,
    exponent: float = 1.0,
) -> np.ndarray:
    """Extinction along a beam by the solution of Klett (1981).

    With backscatter proportional to extinction^k, the lidar equation of single scattering is a
    Bernoulli equation for the extinction. Its solution from a reference range r_m inwards,

        s(r) = X^(1/k) / (X_m^(1/k) / s_m + 2/k int_r^r_m X^(1/k) dr'),   X = r^2 P,

    is stable: an error of s_m decays with the optical depth. Outwards from r_m the integral is
    subtracted, and the error grows.

    Parameters
    ----------
    signal : (ranges,) array
        Signal P of each range with background subtracted and corrected for overlap, above 0, in any
        unit.
    ranges : (ranges,) array
        m, ascending.
    reference_extinction : float
        Extinction s_m at the reference range, m^-1.
    reference : int
        Index of the reference range; default: the farthest.
    exponent : float
        k, which is 1 where the kind of particle does not change along the beam.

    Returns
    -------
    (ranges,) array
        Extinction, m^-1. Infinite beyond the range at which an outward solution diverges.

    Raises
    ------
    InputError
        Ranges that do not ascend, an index out of range; other numbers not above 0.

    Notes
    -----
    Source: Klett 1981, Appl. Opt. 20, 211. The integral is the trapezoid's.
    """
    signal, ranges = checked_profile(signal, ranges)
    extinction = positive_number("reference_extinction", reference_extinction, "m^-1")
    k = positive_number("exponent", exponent)
    check_index(reference, ranges)
    corrected = (signal * ranges**2 / (signal[reference] * ranges[reference] ** 2)) ** (1 / k)
    before = cumulative_trapezoid(corrected, ranges, initial=0)
    inwards = before[reference] - before
    return over(corrected, 1 / extinction + 2 / k * inwards)


def over(numerator: np.ndarray, denominator: np.ndarray) -> np.ndarray:
    """Quotient; infinite where the denominator of a diverged solution is not above 0."""
    quotient = np.full_like(numerator, np.inf)
    return np.divide(numerator, denominator, out=quotient, where=denominator > 0)
