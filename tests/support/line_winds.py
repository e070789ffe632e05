"""Scans of known wind: lines of sight as data sets, and the wind that they are to give."""

from collections.abc import Callable

import numpy as np
import xarray as xr

from lidar_mi.atmosphere.air.turbulence import turbulence

Wind = Callable[[np.ndarray], np.ndarray]
"""Wind (n, 3), m/s, at places (n, 3), m, in the frame of the mean wind."""

MEAN = np.array([6.0, -4.0, 0.1])


def directions(azimuth, elevation):
    a, e = np.deg2rad(azimuth), np.deg2rad(elevation)
    return np.stack([np.sin(a) * np.cos(e), np.cos(a) * np.cos(e), np.sin(e)], -1)


def scan(wind: Wind, azimuth, elevation, ranges, seconds, noise=0.1, seed=0):
    """Lines of sight in a wind MEAN + wind, and the truth (gates, 3).

    The truth is the average along the straight path from gate to gate in the air, each line at its
    own time.
    """
    azimuth, elevation = np.broadcast_arrays(np.asarray(azimuth, float), elevation)
    line = directions(azimuth, elevation)
    moved = np.outer(seconds - np.mean(seconds), [MEAN[0], MEAN[1], 0.0])
    places = line[:, None] * np.asarray(ranges)[None, :, None] - moved[:, None]
    part = ((np.arange(12) + 0.5) / 12)[:, None, None]
    path = places[:-1, None] + part * (places[1:, None] - places[:-1, None])
    at = wind(np.concatenate([places.reshape(-1, 3), path.reshape(-1, 3)])) + MEAN
    here = at[: places.shape[0] * places.shape[1]].reshape(places.shape)
    truth = at[places.shape[0] * places.shape[1] :].reshape(-1, len(ranges), 3).mean(0)
    velocity = np.einsum("lgc,lc->lg", here, line)
    velocity += noise * np.random.default_rng(seed).standard_normal(velocity.shape)
    start = np.datetime64("2021-06-24T17:00:00", "ns")
    lines = xr.Dataset(
        {
            "radial_velocity": (("time", "range"), velocity),
            "flag": (("time", "range"), np.zeros(velocity.shape, np.uint16)),
        },
        {
            "time": ("time", start + np.round(np.asarray(seconds) * 1e9).astype("timedelta64[ns]")),
            "range": ("range", np.asarray(ranges, float)),
            "azimuth": ("time", azimuth),
            "elevation": ("time", elevation),
        },
        {"gate_length": 30.0},
    )
    return lines, truth


def calm(places):
    """No wind besides the mean."""
    return np.zeros_like(places)


def sheared(places):
    """3 m/s of u in 100 m of height, curved."""
    found = np.zeros_like(places)
    found[:, 0] = 3e-2 * places[:, 2] + 2e-5 * places[:, 2] ** 2
    return found


def turbulent(seed, sigma=0.8, length=120.0, spectrum="von_karman"):
    """Isotropic turbulence, frozen."""
    air = turbulence(sigma, length, seed, spectrum=spectrum)
    return lambda places: np.stack(air.velocity(*places.T, 0.0), -1)
