"""Air that advects a texture: images of exactly known motion.

A texture is a sum of plane waves, evaluated wherever the air of a pixel came from. Nothing is
interpolated, so all error in what is retrieved is the method's.
"""

import numpy as np
import torch
import xarray as xr

WAVES = 600


def plane_waves(seed, length, spacing=1.0):
    """Wave vectors (waves, 2) along y and z, rad m^-1, and phases of a random texture.

    Its autocorrelation is exp(-(r / length)^2) with `length` in pixels of `spacing` metres.
    """
    random = np.random.default_rng(seed)
    vectors = random.standard_normal((WAVES, 2)) * np.sqrt(2) / length
    phases = random.uniform(0, 2 * np.pi, WAVES)
    resolved = np.hypot(*vectors.T) < np.pi  # an image holds no wave shorter than 2 px
    return vectors[resolved] / spacing, phases[resolved]


def texture(waves, y, z, contrast=0.2):
    """1 + texture of rms `contrast` at the points (y, z)."""
    vectors, phases = (torch.as_tensor(a) for a in waves)
    shape = np.broadcast(y, z).shape
    points = torch.as_tensor(np.stack([np.broadcast_to(a, shape).ravel() for a in (y, z)], 1))
    total = torch.zeros(len(points), dtype=torch.float64)
    for part, places in zip(total.split(256), points.double().split(256), strict=True):
        part += torch.addmm(phases, places, vectors.T).cos_().sum(1)  # what a cache holds
    return 1 + contrast * np.sqrt(2 / len(phases)) * total.numpy().reshape(shape)


def origin(wind, y, z, dt, steps=8):
    """Where air now at (y, z) was dt ago in a steady wind(y, z) -> (v, w).

    Runge-Kutta of 4th order; with 8 steps exact to 1e-6 m for a vortex of 400 m^2/s and 3 m.
    """
    here = np.array([y, z], dtype=float)
    step = -dt / steps
    for _ in range(steps):
        k1 = np.array(wind(*here))
        k2 = np.array(wind(*(here + step / 2 * k1)))
        k3 = np.array(wind(*(here + step / 2 * k2)))
        k4 = np.array(wind(*(here + step * k3)))
        here = here + step / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    return here


def axes(columns, rows, spacing=0.5):
    """y and z of an image whose middle is the origin, m."""
    return [(np.arange(n) - (n - 1) / 2) * spacing for n in (columns, rows)]


def data_array(values, y, z):
    """An image as retrievals take it: dims (z, y), axes in metres."""
    coordinates = {
        name: (name, np.asarray(axis, dtype=float), {"units": "m"})
        for name, axis in (("z", z), ("y", y))
    }
    return xr.DataArray(values, coordinates, ("z", "y"))
