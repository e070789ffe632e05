"""Variance components: which multiples of known variances make observed squares most likely."""

import numpy as np
from scipy.optimize import lsq_linear

# Rounds of the weighted least squares.
_ROUNDS = 30


def most_likely(
    squares: np.ndarray,
    terms: np.ndarray,
    limits: np.ndarray,
    number: np.ndarray | float,
    held: np.ndarray | float = 0.0,
    floor: float = 1e-9,
) -> tuple[float, np.ndarray]:
    """Factors a, from 0 to their limits, of variances `held` + sum a_k terms_k of mean squares.

    A mean square of n normal numbers has a gamma distribution: its negative log-likelihood is
    n / 2 (r - 1 - ln r), with r the square over its variance, but for a constant. Least squares
    weighted by the inverse variances of the squares, anew in each round, have the factors of the
    largest likelihood as their fixed point (McCullagh & Nelder 1989, Generalized Linear Models,
    ch. 2 and 8).

    Parameters
    ----------
    squares : np.ndarray, shape (squares,)
        Above 0 somewhere.
    terms : np.ndarray, shape (terms, squares)
    limits : np.ndarray, shape (terms,)
        Above 0; may be infinite.
    number : np.ndarray or float
        n / 2, of each square or of all: of complex numbers, how many.
    held : np.ndarray or float
        Variance that is known.
    floor : float
        Least square and least variance, over the mean of the squares.

    Returns
    -------
    misfit : float
        Negative log-likelihood of these factors; 0 of squares that are equal to the variances.
    factors : np.ndarray, shape (terms,)
    """
    mean = squares.mean()
    # terms of one size, as the solver wants them
    sizes = np.maximum(terms.mean(1), np.finfo(float).tiny)
    scaled, most = terms / sizes[:, None], limits * (sizes / mean)
    observed, known = squares / mean, held / mean
    factors = np.minimum(0.5, most)
    for _ in range(_ROUNDS):
        weight = np.sqrt(number) / np.maximum(factors @ scaled + known, floor)
        wanted = np.maximum(observed - known, 0.0) * weight
        factors = lsq_linear((scaled * weight).T, wanted, (0.0, most), method="bvls").x
    ratio = np.maximum(observed, floor) / np.maximum(factors @ scaled + known, floor)
    misfit = float((number * (ratio - 1 - np.log(ratio))).sum())
    return misfit, factors * mean / sizes
