"""Plane turbulence about a vortex pair, as a wake file."""

from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from lidar_mi.atmosphere.vortices.vortex import velocity, vortex_pair

SPACING = 0.5
OUTER = 20.0
SHORTEST = 2.0


def turbulence(shape: tuple[int, int], rms: float, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Periodic v and w without divergence, of the energy spectrum k^(-5/3), m/s.

    Waves of 20 m to 2 m, four nodes. Random phases; each component has the rms.
    """
    random = np.random.default_rng(seed)
    kz, ky = (2 * np.pi * np.fft.fftfreq(n, SPACING) for n in shape)
    kz, ky = np.meshgrid(kz, ky, indexing="ij")
    k = np.hypot(kz, ky)
    band = (k >= 2 * np.pi / OUTER) & (k <= 2 * np.pi / SHORTEST)
    # E(k) dk is spread over a ring of 2 pi k; the stream function has 1 / k of the velocity
    amplitude = np.zeros(shape)
    amplitude[band] = k[band] ** (-(5 / 3 + 1) / 2 - 1)
    stream = amplitude * np.fft.fft2(random.normal(size=shape))
    v, w = (np.fft.ifft2(1j * factor * stream).real for factor in (kz, -ky))
    scale = rms / np.sqrt((np.mean(v**2) + np.mean(w**2)) / 2)
    return scale * v, scale * w


def write(path: Path, pair: dict[str, Any], rms: float, seed: int) -> None:
    """The flow of a vortex pair with turbulence, and a little smoke in the cores."""
    y, z = np.arange(-60.0, 60.1, SPACING), np.arange(-40.0, 40.1, SPACING)
    # as the experiment file has them: "350 m^2/s", "30 m"
    numbers = [float(pair[key].split()[0]) for key in ("circulation", "separation", "core_radius")]
    vortices = vortex_pair(*numbers)
    v, w = velocity(vortices, y[None, :], z[:, None])
    gusts = turbulence((z.size, y.size), rms, seed)
    smoke = sum(np.exp(-np.hypot(y[None, :] - o.y, z[:, None] - o.z) / 6) for o in vortices)
    on = ("z", "y")
    air = {
        "v": (on, v + gusts[0], {"units": "m s-1"}),
        "w": (on, w + gusts[1], {"units": "m s-1"}),
        "tracer": (on, smoke),
    }
    coords = {"z": ("z", z, {"units": "m"}), "y": ("y", y, {"units": "m"})}
    xr.Dataset(air, coords).to_netcdf(path, engine="h5netcdf")
