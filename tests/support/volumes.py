"""Volumes of random waves, advected by flows in closed form: exact anywhere, no interpolation."""

import numpy as np
import xarray as xr

SPACING, DT = 0.5, 0.1
CONTRAST, LENGTH = 0.1, 3.0


def random_waves(seed=0, number=300, length=LENGTH):
    """Texture of rms 1 with a Gaussian correlation exp(-(r / length)^2 / 2), as texture(place)."""
    rng = np.random.default_rng(seed)
    k = rng.standard_normal((number, 3)).astype(np.float32) / length
    phase = rng.uniform(0, 2 * np.pi, number).astype(np.float32)

    def texture(place):
        flat = place.reshape(3, -1).astype(np.float32)
        total = np.zeros(flat.shape[1], np.float32)
        for wave, start in zip(k, phase, strict=True):
            total += np.cos(wave @ flat + start)
        return total.reshape(place.shape[1:]) * np.sqrt(2 / number)

    return texture


def nodes(shape):
    """Places (3, x, z, y) of all voxels."""
    return np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij")).astype(float)


def volume(values):
    """Values (x, z, y) as a volume with voxels of 0.5 m."""
    axes = {
        name: (name, SPACING * np.arange(n), {"units": "m"})
        for name, n in zip("xzy", values.shape, strict=True)
    }
    return xr.DataArray(values, axes, ("x", "z", "y"))


def advected(shape, back, noise, seed=0, length=LENGTH, times=(-0.5, 0.5)):
    """Volumes dt apart; back(place, t) is where air was at mid-time, t from it in dt."""
    texture, rng = random_waves(seed, length=length), np.random.default_rng(seed + 1)
    return [
        volume(1 + CONTRAST * texture(back(nodes(shape), t)) + noise * rng.standard_normal(shape))
        for t in times
    ]


def shifted(shape, shift, noise, seed=0, length=LENGTH, times=(-0.5, 0.5)):
    """Volumes of one rigid motion, voxels in dt along x, z, y."""
    shift = np.asarray(shift, float)[:, None, None, None]
    return advected(shape, lambda x, t: x - t * shift, noise, seed, length, times)
