"""Ranges of light that is received in a gate: the gate's own, blurred by the pulse."""

import drjit as dr
import mitsuba as mi

from .variant_types import Float

INV_SQRT_TWO = 0.7071067811865476
# Scale of the logistic distribution over the standard deviation of a Gaussian one nearly like it.
LOGISTIC = 0.64
# Largest width of a gate over that scale.
SHARPEST = 100.0


def pulse_in_gate(part: Float, low: Float, high: Float, sigma: Float | None) -> tuple[Float, Float]:
    """A uniform number from ``low`` to ``high`` plus a Gaussian one, from one, and its weight.

    Drawn with a logistic number for the Gaussian one, as that distribution has an inverse: with
    the scale b and k = (high - low) / b, the fraction u lies b ln[sinh(u k / 2) /
    sinh((1 - u) k / 2)] from the middle. Its tails are heavier: the weight, the ratio of both
    densities, is at most 1.09; near the ends of a gate that is much longer than the pulse, 2.

    Parameters
    ----------
    part : Float
        u, 0 to 1.
    low, high : Float
    sigma : Float, optional
        Standard deviation of the Gaussian number; None: there is none.
    """
    width, middle = high - low, 0.5 * (low + high)
    if sigma is None:
        return dr.lerp(low, high, part), mi.Float(1)
    # hyperbolic sines do not overflow
    scale = dr.maximum(LOGISTIC * sigma, width / SHARPEST)
    half = 0.5 * width / scale
    # never 0 or 1, where the logarithm ends
    u = dr.clip(part, 1e-7, 1 - 1e-7)
    off = scale * dr.log(dr.sinh(u * half) / dr.sinh((1 - u) * half))
    before, behind = off + 0.5 * width, off - 0.5 * width
    per_sigma = INV_SQRT_TWO / sigma
    gaussian = dr.erf(before * per_sigma) - dr.erf(behind * per_sigma)
    # a difference of hyperbolic tangents, without cancellation
    logistic = dr.sinh(half) / (dr.cosh(0.5 * before / scale) * dr.cosh(0.5 * behind / scale))
    return middle + off, gaussian / logistic
