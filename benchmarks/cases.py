"""The image pair that velocity retrievals are measured on: exact images of an exactly known wind.

Two Lamb-Oseen vortices carry a band-limited texture, a sum of plane waves that is evaluated where
the air of every pixel came from: no interpolation, so all error is the method's.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import xarray as xr

from lidar_mi.atmosphere.vortex import Vortex, velocity, vortex_pair

SPACING, DT = 0.5, 0.1
CIRCULATION, SEPARATION, CORE_RADIUS = 400.0, 47.1, 3.0
CORRELATION_LENGTH, CONTRAST, WAVES = 3.0, 0.2, 600


@dataclass(frozen=True)
class Pair:
    """Two images dt apart and the flow between them.

    Attributes
    ----------
    first, second : xarray.DataArray, dims (z, y)
        Mean 1, `noise` times that of white noise in each.
    v, w : xarray.DataArray, dims (z, y)
        The true wind at the pixels' centres, m s^-1; it does not change in dt.
    vortices : tuple of Vortex
        Port, starboard: their `y` and `z` are the cores' positions, m.
    noise : float
    """

    first: xr.DataArray
    second: xr.DataArray
    v: xr.DataArray
    w: xr.DataArray
    vortices: tuple[Vortex, ...]
    noise: float = 0.0

    def beyond_cores(self, radii: float = 2.0) -> np.ndarray:
        """Which pixels (z, y) lie further than so many core radii from both cores."""
        z, y = np.meshgrid(self.v["z"], self.v["y"], indexing="ij")
        distance = [np.hypot(y - o.y, z - o.z) / o.core_radius for o in self.vortices]
        return np.min(distance, axis=0) > radii


def vortex_pair_images(
    noise: float = 0.0,
    seed: int = 1,
    columns: int = 219,
    rows: int = 139,
    circulation: float = CIRCULATION,
    contrast: float = CONTRAST,
    correlation_length: float = CORRELATION_LENGTH,
    vortices: Sequence[Vortex] | None = None,
) -> Pair:
    """The pair: image 2 shows at every pixel the texture the air there had at time 0.

    Parameters
    ----------
    noise : float
        Standard deviation of the white noise of each image, as a fraction of its mean.
    seed : int
        Of texture and noise; the same texture at every noise level.
    columns, rows : int
        Pixels along y and z, 0.5 m each.
    circulation : float
        Of the two vortices, m^2 s^-1.
    contrast : float
        Rms of the texture over its mean.
    correlation_length : float
        The texture's autocorrelation is exp(-(r / length)^2); px.
    vortices : sequence of Vortex, optional
        In place of the pair of 47.1 m separation and 3 m core radius in the image's middle.
    """
    y, z = ((np.arange(n) - (n - 1) / 2) * SPACING for n in (columns, rows))
    vertical, lateral = np.meshgrid(z, y, indexing="ij")
    if vortices is None:
        vortices = vortex_pair(circulation, SEPARATION, CORE_RADIUS)
    waves = plane_waves(seed, correlation_length)
    images = [
        texture(waves, lateral, vertical, contrast),
        texture(waves, *origin(vortices, lateral, vertical, DT), contrast),
    ]
    random = np.random.default_rng([seed, 1])
    images = [image + noise * random.standard_normal(image.shape) for image in images]
    fields = [data_array(a, y, z) for a in (*images, *velocity(vortices, lateral, vertical))]
    return Pair(*fields, tuple(vortices), noise)


def plane_waves(seed: int, correlation_length: float) -> tuple[np.ndarray, np.ndarray]:
    """Wave vectors (rad m^-1) and phases of a texture that correlates over so many pixels."""
    random = np.random.default_rng(seed)
    vectors = random.standard_normal((WAVES, 2)) * np.sqrt(2) / correlation_length
    phases = random.uniform(0, 2 * np.pi, WAVES)
    seen = np.hypot(*vectors.T) < np.pi  # the image can hold no wave shorter than 2 px
    return vectors[seen] / SPACING, phases[seen]


def texture(waves, y: np.ndarray, z: np.ndarray, contrast: float = CONTRAST) -> np.ndarray:
    """1 + texture of rms `contrast` at the points (y, z)."""
    vectors, phases = waves
    total = np.zeros(np.shape(y))
    for (a, b), phase in zip(vectors, phases, strict=True):
        total += np.cos(a * y + b * z + phase)
    return 1 + contrast * np.sqrt(2 / len(phases)) * total


def origin(vortices, y: np.ndarray, z: np.ndarray, dt: float, steps: int = 8) -> np.ndarray:
    """Where air now at (y, z) was dt ago (Runge-Kutta, 4th order)."""
    here = np.array([y, z], float)
    h = -dt / steps

    def wind(place):
        return np.array(velocity(vortices, *place))

    for _ in range(steps):
        k1 = wind(here)
        k2 = wind(here + h / 2 * k1)
        k3 = wind(here + h / 2 * k2)
        k4 = wind(here + h * k3)
        here = here + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    return here


def data_array(values: np.ndarray, y: np.ndarray, z: np.ndarray) -> xr.DataArray:
    """An image as retrievals take it: dims (z, y), axes in metres."""
    coordinates = {"z": ("z", z, {"units": "m"}), "y": ("y", y, {"units": "m"})}
    return xr.DataArray(values, coordinates, ("z", "y"))
