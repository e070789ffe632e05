"""Scans of moving air in which every pixel has its own time: images of exactly known motion."""

import numpy as np

from lidar_mi.atmosphere.vortices.vortex import velocity
from tests.support.flows import axes, data_array, origin, plane_waves, texture

DT, DURATION = 0.1, 0.1


def scan_times(pattern, rows, columns, duration=DURATION):
    """Of the pixels (z, y) from the middle of the scan, s; rows one after the other, upwards.

    A raster begins every row at the same side, a serpentine where the row before ended.
    """
    order = np.arange(rows * columns, dtype=float).reshape(rows, columns)
    if pattern == "serpentine":
        order[1::2] = order[1::2, ::-1]
    elif pattern == "photograph":
        order[:] = order.mean()
    return duration * (order / (rows * columns - 1) - 0.5)


def timed_pair(waves, wind, moving, tau, y, z, contrast=0.2):
    """Two images with times `tau` (z, y), DT apart, and the times as a retrieval takes them.

    The flow `wind`(y, z) -> (v, w) is steady in the frame that moves with `moving` (v, w) and has
    its origin in the middle of the image half way between the reference times.
    """
    grid = np.stack(np.meshgrid(y, z))
    images = []
    for reference in (-DT / 2, DT / 2):
        time = reference + tau
        within = grid - time * np.reshape(moving, (2, 1, 1))
        images.append(texture(waves, *origin(wind, *within, time), contrast))
    when = data_array(tau, y, z)
    return [data_array(image, y, z) for image in images], [when, when]


def uniform_wind(pattern, v, w, size=(90, 70), length=4.0, seed=1, duration=DURATION):
    """Two scans of air in a uniform wind, and their times."""
    y, z = axes(*size)
    tau = scan_times(pattern, *size[::-1], duration)
    waves = plane_waves(seed, length, 0.5)
    return timed_pair(waves, lambda y, z: (0 * y, 0 * z), (v, w), tau, y, z)


def moving_vortices(pattern, vortices, mean, size=(130, 90), seed=1, noise=0.0, duration=DURATION):
    """Two scans of a pair that drifts with the mean wind and its mutual induction, their times."""
    y, z = axes(*size)
    tau = scan_times(pattern, *size[::-1], duration)
    waves = plane_waves(seed, 3.0, 0.5)
    induced = np.mean([velocity(vortices, o.y, o.z) for o in vortices], axis=0)

    def wind(y, z):
        return [part - rest for part, rest in zip(velocity(vortices, y, z), induced, strict=True)]

    images, times = timed_pair(waves, wind, np.add(mean, induced), tau, y, z)
    random = np.random.default_rng([seed, 1])
    return [image + noise * random.standard_normal(image.shape) for image in images], times
