"""Errors of rings by plates that are uneven in patches, from how the rings' crests deviate.

The order's deviation over the image is taken as a Gaussian random field with a Matern correlation
(once differentiable), of a variance and a length, beside noise that is independent from sector to
sector. What a fit takes up of such a field is not in its residuals. Variance and length are
therefore estimated from the contrasts that no fitted parameter changes (restricted likelihood:
Patterson and Thompson 1971, Biometrika 58, 545), and the covariance is that of the whole field
through the fit's gain: mean over all lengths and variances with their likelihoods. Of patches that
are as wide as the image contrasts tell nothing: the field is limited to a few times what is left.
"""

from dataclasses import dataclass

import numpy as np

LENGTHS = 9  # from the shortest to the longest, in equal ratios
SHORTEST, LONGEST = 0.02, 1.0  # of the outermost crest's distance from the centre
LARGEST = 2.0  # standard deviation of the field over the crests' rms deviation after the fit
_RATIOS = np.logspace(-2, 7, 91)  # of the field's variance to the noise's
_FIRM = 1e-2  # of the median: less information of a crest is none
_NULL = 1e-9  # of the largest: eigenvalues that are 0


@dataclass(frozen=True, eq=False)
class Scores:
    """What every sector says of the parameters of a fit.

    Attributes
    ----------
    matrix, score : arrays (sectors, parameters, parameters) and (sectors, parameters)
        Information, and gradient of the log-likelihood at the fit, for noise of variance 1.
    inverse : array (parameters, parameters)
        Of the sum of ``matrix``.
    rings : array (rings,) of int
        The parameters that are deviations of rings, orders.
    x, y : arrays (sectors, rings)
        Of the crests from the centre, px.
    """

    matrix: np.ndarray
    score: np.ndarray
    inverse: np.ndarray
    rings: np.ndarray
    x: np.ndarray
    y: np.ndarray


def uneven_covariance(scores: Scores) -> np.ndarray:
    """Covariance (parameters, parameters) of a fit to rings that deviate in patches."""
    whitened, taken, gain, place = _crests(scores)
    # contrasts: orthogonal to all that parameters can change
    left, size, _ = np.linalg.svd(taken)
    contrast = left[:, int((size > 1e-6 * size[0]).sum()) :].T
    value = contrast @ whitened[:, -1]
    roots = contrast @ whitened[:, :-1]
    distance = np.sqrt(((place[:, None] - place) ** 2).sum(2))
    shift = np.linalg.pinv(whitened[:, :-1]) @ whitened[:, -1]
    most = LARGEST**2 * (shift**2).mean()
    outer = np.sqrt((place**2).sum(1).max())
    likelihood, parts = [], []
    for length in np.geomspace(SHORTEST * outer, LONGEST * outer, LENGTHS):
        scaled = np.sqrt(3) * distance / length
        field = (1 + scaled) * np.exp(-scaled)
        eigen, vector = np.linalg.eigh(roots @ field @ roots.T)
        power = (vector.T @ value) ** 2
        spread = 1 + _RATIOS[:, None] * np.maximum(eigen, 0)
        noise = (power / spread).mean(1)
        one = -(len(value) * np.log(noise) + np.log(spread).sum(1)) / 2
        likelihood.append(np.where(noise * _RATIOS < most, one, -np.inf))
        parts.append((gain @ field @ gain.T, noise))
    weight = np.exp(likelihood - np.max(likelihood))
    weight /= weight.sum()
    total = np.zeros_like(scores.inverse)
    for of_length, (by_field, noise) in zip(weight, parts, strict=True):
        total += (of_length * noise) @ _RATIOS * by_field + of_length @ noise * scores.inverse
    return total


def _crests(scores: Scores):
    """The crests that have information, one after the other.

    Returns
    -------
    whitened : array (crests, crests + 1)
        Root of the information of the crests' deviations; last column: times the deviations.
    taken : array (crests, parameters)
        Change of whitened deviations with the parameters.
    gain : array (parameters, crests)
        Change of the fitted parameters with the deviations.
    place : array (crests, 2)
    """
    rings = scores.rings
    own = scores.matrix[:, rings, rings]
    firm = own > _FIRM * np.median(own[own > 0])
    count = int(firm.sum())
    whitened = np.zeros((count, count + 1))
    taken = np.zeros((count, len(scores.inverse)))
    gain = np.zeros((len(scores.inverse), count))
    first = 0
    for matrix, score, there in zip(scores.matrix, scores.score, firm, strict=True):
        slots = rings[there]
        part = slice(first, first + len(slots))
        first = part.stop
        eigen, vector = np.linalg.eigh(matrix[np.ix_(slots, slots)])
        size = np.sqrt(np.maximum(eigen, 0))
        inverse = np.where(eigen > _NULL * eigen.max(initial=0), 1 / np.maximum(size, 1e-300), 0)
        whitened[part, part] = size[:, None] * vector.T
        unroot = inverse[:, None] * vector.T
        whitened[part, -1] = unroot @ score[slots]
        taken[part] = unroot @ matrix[slots]
        gain[:, part] = scores.inverse @ matrix[:, slots]
    return whitened, taken, gain, np.stack([scores.x[firm], scores.y[firm]], 1)
