"""Images with exactly known motion: sums of plane waves, evaluated wherever the flow comes from."""

import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import xarray as xr

# benchmarks.cases makes the image pairs that errors are quoted for; last, so that an installed
# lidar_mi is the one that is tested
sys.path.append(str(Path(__file__).resolve().parents[2]))


def waves(seed, length, number=600):
    """Plane waves of a random texture with autocorrelation exp(-(r / length)^2).

    The spectrum is normal with standard deviation sqrt(2) / length; its tail beyond pi (a wave of
    2 px, if `length` is in px) is cut off, so the texture is band-limited.
    """
    rng = np.random.default_rng(seed)
    vector = rng.standard_normal((number, 2)) * np.sqrt(2) / length
    return vector, rng.uniform(0, 2 * np.pi, number)


def texture(y, z, seed, length, contrast):
    """1 + texture of rms `contrast` at the points (y, z); exact anywhere, no interpolation."""
    vectors, phases = waves(seed, length)
    total = np.zeros(np.broadcast(y, z).shape)
    for (a, b), phase in zip(vectors, phases):
        total += np.cos(a * y + b * z + phase)
    return 1 + contrast * np.sqrt(2 / len(vectors)) * total


def lamb_oseen(y, z, circulation, radius, centre=(0.0, 0.0)):
    """Wind (v, w) of a vortex, positive = from y toward z; radius of the peak swirl."""
    dy, dz = y - centre[0], z - centre[1]
    r2 = dy**2 + dz**2 + 1e-12
    swirl = circulation / (2 * np.pi * r2) * (1 - np.exp(-1.2564 * r2 / radius**2))
    return -swirl * dz, swirl * dy


def origin(wind, y, z, dt, steps=8):
    """Where air now at (y, z) was dt ago: Runge-Kutta, 4th order, exact to 1e-6 m here."""
    here = np.array([y, z], dtype=float)
    step = -dt / steps
    for _ in range(steps):
        k1 = np.array(wind(*here))
        k2 = np.array(wind(*(here + step / 2 * k1)))
        k3 = np.array(wind(*(here + step / 2 * k2)))
        k4 = np.array(wind(*(here + step * k3)))
        here = here + step / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    return here


def data_array(values, y, z):
    coords = {
        "z": ("z", np.asarray(z, dtype=float), {"units": "m"}),
        "y": ("y", np.asarray(y, dtype=float), {"units": "m"}),
    }
    return xr.DataArray(values, coords, ("z", "y"))


def axes(columns, rows, spacing=0.5):
    return [(np.arange(n) - (n - 1) / 2) * spacing for n in (columns, rows)]


@pytest.fixture(scope="session")
def synthetic():
    return SimpleNamespace(
        texture=texture, lamb_oseen=lamb_oseen, origin=origin, data_array=data_array, axes=axes
    )
