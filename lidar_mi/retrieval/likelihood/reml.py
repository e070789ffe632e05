"""Variance components: which multiples of known variances make observed squares most likely."""

import numpy as np
from scipy.optimize import lsq_linear

# Rounds of the weighted least squares, halvings of a step, change of the misfit that ends them.
_ROUNDS, _HALVINGS, _CONVERGED = 30, 12, 1e-3


def most_likely(
    squares: np.ndarray,
    terms: np.ndarray,
    limits: np.ndarray,
    number: np.ndarray | float,
    fixed: np.ndarray | float = 0.0,
    floor: float = 1e-9,
) -> tuple[float, np.ndarray]:
    """Factors a, from 0 to their limits, of variances `fixed` + sum a_k terms_k of mean squares.

    A mean square of n normal numbers has a gamma distribution: its negative log-likelihood is
    n / 2 (r - 1 - ln r), with r the square over its variance, but for a constant. Least squares
    weighted by the inverse variances of the squares, anew in each round, are Fisher's scoring for
    the largest likelihood (McCullagh & Nelder 1989, Generalized Linear Models, ch. 2 and 8); of the
    fractions of each step the likeliest is taken. Squares below `fixed` count as equal to it in
    these steps: beside a fixed variance absent terms come out positive, by up to 6 % of it.

    squares (squares,): above 0 somewhere.
    terms (terms, squares)
    limits (terms,): above 0; may be infinite.
    number: n / 2, of each square or of all: of complex numbers, how many.
    fixed: variance that is known.
    floor: least square and least variance, over the mean of the squares.

    Returns
    -------
    misfit : float
        Negative log-likelihood of these factors; 0 of squares that are equal to the variances.
    factors : np.ndarray, shape (terms,)
    """
    mean = squares.mean()
    # terms scaled to one size for the solver
    sizes = np.maximum(terms.mean(1), np.finfo(float).tiny)
    scaled, most = terms / sizes[:, None], limits * (sizes / mean)
    observed, known = np.maximum(squares / mean, floor), fixed / mean

    def variances(factors: np.ndarray) -> np.ndarray:
        return np.maximum(factors @ scaled + known, floor)

    def misfit(factors: np.ndarray) -> float:
        ratio = observed / variances(factors)
        return float((number * (ratio - 1 - np.log(ratio))).sum())

    factors = np.minimum(0.5, most)
    reached = misfit(factors)
    for _ in range(_ROUNDS):
        weight = np.sqrt(number) / variances(factors)
        wanted = np.maximum(observed - known, 0.0) * weight
        step = lsq_linear((scaled * weight).T, wanted, (0.0, most), method="bvls").x - factors
        # a full step may overshoot, to variances near 0
        tried = [factors + 0.5**n * step for n in range(_HALVINGS)]
        after = [misfit(trial) for trial in tried]
        best = int(np.argmin(after))
        if after[best] >= reached - _CONVERGED:
            break
        factors, reached = tried[best], after[best]
    return reached, factors * mean / sizes
