"""Images of smoke in rings, which moves otherwise than the texture on it."""

import numpy as np
import torch
from scipy.ndimage import gaussian_filter

from tests.support.flows import plane_waves, texture

SHAPE = 100, 130
Z, Y = np.meshgrid(*(np.arange(n, dtype=float) for n in SHAPE), indexing="ij")


def smoke(z, y):
    """Two rings with rims some pixels wide."""
    rings = ((50, 40, 22, 4.0), (48, 92, 18, 5.0))
    return 1 + sum(
        3 * np.exp(-(((np.hypot(z - z0, y - y0) - radius) / width) ** 2))
        for z0, y0, radius, width in rings
    )


def displacement(seed, rms):
    """A smooth random displacement along z and y, px, which varies over 8 px."""
    random = np.random.default_rng(seed)
    fields = [gaussian_filter(random.standard_normal(SHAPE), 8.0, mode="wrap") for _ in "zy"]
    return [rms / np.sqrt(2) * field / field.std() for field in fields]


def pair(seed, rms, fine=0.05, noise=0.0, flow=(0.0, 0.0)):
    """Texture that moves by `flow`, on smoke that moves by a random displacement besides it."""
    waves = plane_waves(seed, 3.0)
    random = np.random.default_rng([seed, 1])
    extra = displacement(seed, rms)
    images = []
    for t in (-0.5, 0.5):
        z, y = Z - t * flow[0], Y - t * flow[1]
        bright = smoke(*(a - t * e for a, e in zip((z, y), extra, strict=True)))
        image = bright * (1 + fine * (texture(waves, y, z, contrast=1.0) - 1))
        images.append(torch.as_tensor(image + noise * random.standard_normal(SHAPE)))
    return images
