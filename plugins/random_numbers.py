"""Random numbers of samples: independent generators, pairs of numbers, truncated Gaussian beams."""

import drjit as dr
import mitsuba as mi

from .variant_types import Float, Generator, Point, UInt


def generator(seed: UInt, group: UInt, number: UInt) -> Generator:
    """Independent random numbers for every seed, group (beam, pixel or pass) and number in it.

    Samples of one group have common random numbers in all that is rendered with a seed.
    """
    key, counter = mi.sample_tea_32(seed, group)
    state, stream = mi.sample_tea_32(key, counter + number)
    rng = mi.PCG32()
    rng.seed(initstate=mi.UInt64(state), initseq=mi.UInt64(stream))
    return rng


def pair(rng: Generator) -> Point:
    """Two numbers in [0, 1)."""
    return mi.Point2f(rng.next_float32(), rng.next_float32())


def beam_radius_squared(inside: Float, sample: Float) -> Float:
    """Squared radius, over the 1/e^2 radius squared, of a place in a truncated Gaussian beam.

    ``inside`` is the fraction of the whole beam that is not cut off, 1 - exp(-2 cut^2); the
    density in the plane is proportional to exp(-2 r^2). -ln(1 - x) is 2 artanh(x / (2 - x)), which
    keeps its digits for the small x of a beam that is much wider than its cut.
    """
    below = inside * sample
    return dr.atanh(below / (2 - below))
