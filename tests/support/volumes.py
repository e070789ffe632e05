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


def vortex_pair(shape, steps=8):
    """Two Lamb-Oseen vortices along x with a wavy wind along them, voxels in dt.

    Returns velocity(place) and back(place, t), where air was at mid-time, t from it in dt.
    """
    gamma, core, apart, height, width = 400.0 * DT / SPACING**2, 6.0, 34.0, *shape[1:]

    def velocity(x):
        total = np.zeros_like(x)
        total[0] = 0.2 + 0.3 * np.sin(2 * np.pi * x[2] / 40) * np.cos(2 * np.pi * x[1] / 30)
        for sign in (1, -1):
            dy = x[2] - (width - 1) / 2 - sign * apart / 2
            dz = x[1] - (height - 1) / 2
            square = np.maximum(dy**2 + dz**2, 1e-9)
            turn = sign * gamma / (2 * np.pi * square) * -np.expm1(-1.25643 * square / core**2)
            total[1] += turn * dy
            total[2] -= turn * dz
        return total

    def back(x, t):
        h = -t / steps
        for _ in range(steps):
            k1 = velocity(x)
            k2 = velocity(x + h / 2 * k1)
            k3 = velocity(x + h / 2 * k2)
            x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + velocity(x + h * k3))
        return x

    return velocity, back
