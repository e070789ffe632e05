"""Image pairs of air with and without vortices, drawn from a stated prior.

The probability of `lidar_mi.retrieval.vortices.detection` is calibrated on them, and tested on
others. Half of the air has a wake with at least one core in the image. A third of the rest is
uniform wind, shear, and von Karman turbulence. A tenth of all images have no texture.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch
import xarray as xr
from scipy.ndimage import map_coordinates, spline_filter

from lidar_mi.atmosphere.air.turbulence import turbulence
from lidar_mi.atmosphere.texture import gaussian_field
from lidar_mi.atmosphere.vortices.vortex import Vortex, velocity
from lidar_mi.retrieval.vortices.detection import RATIO_NODES, likelihoods
from lidar_mi.retrieval.vortices.image_builder import Acquisition, builder_of
from tests.support.flows import axes, data_array, origin

DT = 0.1
CALIBRATION = range(1_000_000, 1_004_000)
"""Seeds of the draws that the probability is calibrated on."""
KINDS = ("uniform", "shear", "turbulence")
"""Of air without a wake."""
NO_TEXTURE = 0.1
"""Fraction of all images whose air has no texture: they show nothing."""

# Distance of the nodes between which turbulence is interpolated, m.
_COARSE = 3.0
# By which the texture's period is longer than the image, m.
_BEYOND = 55.0


class Draw(NamedTuple):
    """Two images and what they show.

    Attributes
    ----------
    first, second : DataArray, dims (z, y)
    noise : float
        Standard deviation of the white noise of each.
    kind : str
        "pair", or one of `KINDS`.
    texture : bool
        Whether there is any.
    vortices : tuple of Vortex
        Half way between the images.
    mean_wind : (float, float)
        m/s.
    """

    first: xr.DataArray
    second: xr.DataArray
    noise: float
    kind: str
    texture: bool
    vortices: tuple[Vortex, ...]
    mean_wind: tuple[float, float]


def draw(
    seed: int, kind: str | None = None, *, columns: int = 121, rows: int = 81, spacing: float = 1.0
) -> Draw:
    """Images from the prior, or of one kind, 0.1 s apart.

    Circulations of 100 to 600 m^2/s that differ by 5 %, core radii of 2 to 5 m, separations of 20
    to 60 m, tilts of 0.1 rad, at least one core in the image. Texture of 3 to 30 % with outer
    scales of 5 to 30 m, noise of 0.05 to 1 times the texture. Mean wind of 3 m/s along y and 1 m/s
    along z; turbulence of up to 0.5 m/s about a pair and of 0.3 to 2 m/s without one, 30 to 150 m
    long; shear of up to 0.2 1/s.
    """
    random = np.random.default_rng([seed, 48])
    chosen = "pair" if random.random() < 0.5 else KINDS[random.integers(len(KINDS))]
    kind, textured = kind or chosen, bool(random.random() >= NO_TEXTURE)
    y, z = axes(columns, rows, spacing)
    vortices = _pair(random, y[-1], z[-1]) if kind == "pair" else ()
    mean = random.normal(0, 3.0), random.normal(0, 1.0)
    rms = random.uniform(0.3, 2.0) if kind == "turbulence" else random.uniform(0, 0.5)
    rms *= kind in ("pair", "turbulence")
    gradient = random.uniform(-0.2, 0.2, (2, 2)) if kind == "shear" else np.zeros((2, 2))
    gradient[1, 1] = -gradient[0, 0]
    lateral, vertical = np.meshgrid(y, z)
    # hardly changes over a displacement
    eddies = _turbulence(random, rms, y, z)
    partners = (vortices, vortices[::-1]) if vortices else ()
    mutual = [velocity([a], b.y, b.z) for a, b in partners] or [np.zeros(2)]
    drift = np.mean(mutual, axis=0) + np.array(mean)

    def wind(at_y, at_z):
        v, w = eddies
        if vortices:
            own = velocity(vortices, at_y, at_z)
            v, w = v + own[0], w + own[1]
        v = v + mean[0] - drift[0] + gradient[0, 0] * at_y + gradient[0, 1] * at_z
        w = w + mean[1] - drift[1] + gradient[1, 0] * at_y + gradient[1, 1] * at_z
        return v, w

    strength = np.exp(random.uniform(np.log(0.03), np.log(0.3)))
    noise = strength * np.exp(random.uniform(np.log(0.05), 0.0))
    air = _texture(random, strength * textured, y, z)
    images = []
    for time in (-DT / 2, DT / 2):
        place = origin(wind, lateral - drift[0] * time, vertical - drift[1] * time, time, 3)
        image = air(*place) + noise * random.standard_normal(lateral.shape)
        images.append(data_array(image, y, z))
    return Draw(images[0], images[1], float(noise), kind, textured, vortices, mean)


def inside(vortices: tuple[Vortex, ...], image: xr.DataArray) -> int:
    """How many of the vortices are in the image."""
    half = {name: float(image[name][-1]) for name in "yz"}
    return sum(bool(abs(o.y) <= half["y"] and abs(o.z) <= half["z"]) for o in vortices)


def _pair(random: np.random.Generator, half_y: float, half_z: float) -> tuple[Vortex, ...]:
    while True:
        circulation = random.uniform(100, 600) * np.exp(random.normal(0, 0.05, 2))
        radius = random.uniform(2, 5) * np.exp(random.normal(0, 0.05, 2))
        separation, tilt = random.uniform(20, 60), random.normal(0, 0.1)
        centre = random.uniform(-1, 1, 2) * (half_y + 30, half_z + 5)
        offset = separation / 2 * np.array([np.cos(tilt), np.sin(tilt)])
        found = tuple(
            Vortex(side * circulation[k], radius[k], *(centre + side * offset))
            for k, side in enumerate((1, -1))
        )
        if any(abs(o.y) <= half_y and abs(o.z) <= half_z for o in found):
            return found


def _texture(random: np.random.Generator, rms: float, *extent: np.ndarray) -> Callable:
    """1 + texture: a plane of a volume, from wholly averaged over its depth to not at all."""
    scale, depth = np.exp(random.uniform(np.log(5), np.log(30))), int(random.integers(1, 9))
    step = float(extent[0][1] - extent[0][0])
    nodes = (depth, *(len(axis) + round(_BEYOND / step) for axis in extent))
    field = gaussian_field(nodes, (2.5, step, step), scale, int(random.integers(2**31)))[0]
    waves = spline_filter(rms / field.std() * (field - field.mean()), 3, mode="grid-wrap")

    def texture(y, z):
        place = [(y - extent[0][0]) / step, (z - extent[1][0]) / step]
        return 1 + map_coordinates(waves, place, order=3, mode="grid-wrap", prefilter=False)

    return texture


def _turbulence(random: np.random.Generator, rms: float, *extent: np.ndarray) -> list[np.ndarray]:
    """v and w (z, y), m/s."""
    length, seed = random.uniform(30, 150), int(random.integers(2**31))
    y, z = (np.arange(axis[0], axis[-1] + _COARSE, _COARSE) for axis in extent)
    _, *coarse = turbulence(rms, length, seed, shortest=3.0).velocity(0.0, y, z[:, None], 0.0)
    vertical, lateral = np.meshgrid(extent[1], extent[0], indexing="ij")
    place = [(vertical - z[0]) / _COARSE, (lateral - y[0]) / _COARSE]
    return [map_coordinates(part, place, order=3, mode="nearest") for part in coarse]


def log_ratios(seeds: range) -> tuple[np.ndarray, np.ndarray]:
    """Logarithms of the likelihood ratio of draws, and whether a core is in their image."""
    found = []
    for seed in seeds:
        drawn = draw(seed)
        images = [torch.as_tensor(image.values) for image in (drawn.first, drawn.second)]
        z, y = (drawn.first[name].values for name in "zy")
        make = builder_of(images, Acquisition(z, y, DT, drawn.noise, "lamb_oseen"))
        found.append((likelihoods(make).log_ratio, bool(drawn.vortices)))
    ratio, there = np.array(found).T
    return ratio, there > 0


def calibrated(ratio: np.ndarray, there: np.ndarray) -> np.ndarray:
    """Log odds at the nodes of the detection, of the greatest likelihood (logistic regression).

    Where they would fall with the likelihood ratio they stay.
    """
    nodes = np.array(RATIO_NODES)
    at = np.clip(np.arcsinh(ratio), nodes[0], nodes[-1])
    columns = np.stack([np.interp(at, nodes, unit) for unit in np.eye(len(nodes))], 1)
    odds = np.zeros(len(nodes))
    for _ in range(50):
        probability = 1 / (1 + np.exp(-columns @ odds))
        weight = probability * (1 - probability)
        # odds of a node without draws of one sort would be infinite: a prior of 5 at each
        normal = (columns * weight[:, None]).T @ columns + np.eye(len(nodes)) / 25
        odds += np.linalg.solve(normal, columns.T @ (there - probability) - odds / 25)
    return np.maximum.accumulate(odds)


if __name__ == "__main__":
    print(calibrated(*log_ratios(CALIBRATION)).round(2).tolist())
