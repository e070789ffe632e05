"""Random numbers of samples: independent generators, and pairs of numbers."""

import mitsuba as mi


def generator(seed, group, number):
    """Independent random numbers for every seed, group (beam, pixel or pass) and number in it."""
    key, counter = mi.sample_tea_32(seed, group)
    state, stream = mi.sample_tea_32(key, counter + number)
    rng = mi.PCG32()
    rng.seed(initstate=mi.UInt64(state), initseq=mi.UInt64(stream))
    return rng


def pair(rng):
    """Two numbers in [0, 1)."""
    return mi.Point2f(rng.next_float32(), rng.next_float32())
