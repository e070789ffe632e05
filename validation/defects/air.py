"""Air of exactly known motion as images and volumes see it: pixels and displacements in dt."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import expm

from lidar_mi.atmosphere.vortices.vortex import velocity, vortex_pair
from tests.support.flows import origin

WAVES = 300
IMAGE, VOLUME = (96, 112), (28, 28, 28)
SPACING, DT = 0.5, 0.1

Field = Callable[[np.ndarray], np.ndarray]
"""Of places (axes, ...), px."""
Back = Callable[[np.ndarray, float], np.ndarray]
"""Where the air at places (axes, ...) was a time (in dt) ago, px."""


@dataclass(frozen=True)
class Air:
    """A texture in a steady flow.

    Attributes
    ----------
    shape : tuple of int
        Of what is seen, px.
    texture : callable
        Of rms 1, at the time 0.
    contrast : float
        Rms over the mean, which is 1.
    noise : float
        Standard deviation of the white noise of an image.
    motion : callable
        Displacement in dt, px.
    back : callable
    """

    shape: tuple[int, ...]
    texture: Field
    contrast: float
    noise: float
    motion: Field
    back: Back

    @property
    def places(self) -> np.ndarray:
        return np.stack(np.meshgrid(*map(np.arange, self.shape), indexing="ij")).astype(float)

    def at(self, time: float, places: np.ndarray | None = None) -> np.ndarray:
        """Brightness without noise at a time (in dt), at places or at all pixels."""
        where = self.places if places is None else places
        return 1 + self.contrast * self.texture(self.back(where, time))

    def noisy(self, random: np.random.Generator, *images: np.ndarray) -> list[np.ndarray]:
        return [image + self.noise * random.standard_normal(image.shape) for image in images]


def waves(random: np.random.Generator, length: float, dims: int) -> Field:
    """A texture of rms 1 with the autocorrelation exp(-(r / length)^2), length in px."""
    k = random.standard_normal((WAVES, dims)) * np.sqrt(2) / length
    # an image holds no wave shorter than 2 px
    k = k[np.linalg.norm(k, axis=1) < np.pi].astype(np.float32)
    phase = random.uniform(0, 2 * np.pi, len(k)).astype(np.float32)

    def texture(places: np.ndarray) -> np.ndarray:
        flat = places.reshape(dims, -1).T.astype(np.float32)
        total = np.concatenate(
            [
                np.cos(part @ k.T + phase).sum(1)
                for part in np.array_split(flat, 1 + len(flat) // 2048)
            ]
        )
        return total.reshape(places.shape[1:]).astype(float) * np.sqrt(2 / len(k))

    return texture


def drawn(random: np.random.Generator, shape: Sequence[int], vortices: bool = False) -> Air:
    """Air of textures of 2.5 to 5 px, 15 to 35 %, noise of .3 to 3 %, in a linear or vortex flow.

    Displacements are 1 to 2 px with gradients of 0.01 px per px, or those of a pair of vortices.
    """
    dims = len(shape)
    texture = waves(random, random.uniform(2.5, 5.0), dims)
    contrast, noise = random.uniform(0.15, 0.35), 10 ** random.uniform(-2.5, -1.5)
    motion, back = (_pair if vortices else _linear)(random, shape)
    return Air(tuple(shape), texture, contrast, noise, motion, back)


def _linear(random: np.random.Generator, shape: Sequence[int]) -> tuple[Field, Back]:
    dims = len(shape)
    direction = random.standard_normal(dims)
    mean = direction / np.linalg.norm(direction) * random.uniform(1.0, 2.0)
    gradient = 0.01 * random.standard_normal((dims, dims))
    # homogeneous coordinates: one matrix exponential is the exact path
    rate = np.zeros((dims + 1, dims + 1))
    rate[:dims, :dims], rate[:dims, dims] = gradient, mean - gradient @ (np.array(shape) / 2)

    def motion(places):
        return np.tensordot(rate[:dims, :dims], places, 1) + _column(rate[:dims, dims], places)

    def back(places, time):
        path = expm(-time * rate)
        return np.tensordot(path[:dims, :dims], places, 1) + _column(path[:dims, dims], places)

    return motion, back


def _column(vector: np.ndarray, like: np.ndarray) -> np.ndarray:
    return vector.reshape(-1, *[1] * (like.ndim - 1))


def _pair(random: np.random.Generator, shape: Sequence[int]) -> tuple[Field, Back]:
    middle = np.array(shape) / 2 + random.uniform(-4, 4, 2)
    vortices = vortex_pair(
        random.uniform(80, 140) * DT / SPACING**2, random.uniform(40, 52), 5.0, *middle[::-1]
    )

    def wind(y, z):
        return velocity(vortices, y, z)

    def back(places, time):
        return origin(wind, places[1], places[0], time)[::-1] if time else places

    return lambda places: np.stack(wind(places[1], places[0])[::-1]), back
