"""A vortex whose middle turns by 0.3 rad between two images, seen in particles or in texture."""

from functools import partial

import numpy as np

from tests.support.flows import axes, data_array, origin, plane_waves, texture

SIZE = 200
NOISE = 0.01
# the fastest air, at 46 px, moves by 7.9 px
WHOLE_TURN, RADIUS = 0.3, 46.0


def displacement(y, z):
    """Of a Lamb-Oseen vortex, px in the time between the images."""
    s = 1.2564 * (y**2 + z**2) / RADIUS**2
    angle = WHOLE_TURN * np.where(s < 1e-9, 1.0, -np.expm1(-s) / np.maximum(s, 1e-9))
    return -angle * z, angle * y


def turning_pair(kind, seed):
    """Images half the time before and after, 1 m and 1 s per pixel and displacement."""
    y, z = axes(SIZE, SIZE, 1.0)
    images = {"particles": _particles, "texture": _texture}[kind](seed, y, z)
    random = np.random.default_rng([seed, 1])
    return [
        data_array(image + NOISE * random.standard_normal(image.shape), y, z) for image in images
    ]


def _texture(seed, y, z):
    waves = plane_waves(seed, 3.0)
    for time in (-0.5, 0.5):
        yield texture(waves, *origin(displacement, *np.meshgrid(y, z), time))


def _particles(seed, y, z, per_pixel=0.03, diameter=2.5):
    """Gaussian particles of a 1/e^2 diameter in px, brightness 0.3 to 1."""
    random = np.random.default_rng(seed)
    side = SIZE + 60
    here = random.uniform(-side / 2, side / 2, (2, int(per_pixel * side**2)))
    brightness = random.uniform(0.3, 1, here.shape[1])
    for time in (-0.5, 0.5):
        image = np.zeros((SIZE, SIZE))
        for (a, b), value in zip(origin(displacement, *here, -time).T, brightness, strict=True):
            part = [np.searchsorted(axis, [p - 5, p + 5]) for axis, p in ((z, b), (y, a))]
            rows, columns = (slice(*ends) for ends in part)
            bell = partial(_bell, diameter=diameter)
            image[rows, columns] += value * np.outer(bell(z[rows] - b), bell(y[columns] - a))
        yield image


def _bell(distance, diameter):
    return np.exp(-8 * (distance / diameter) ** 2)
