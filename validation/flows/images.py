"""Image pairs of families of flows: textures, smoke, noise, replaced texture and blur.

What an image shows is a function of position, evaluated wherever the air of a pixel came from:
nothing is interpolated.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
import xarray as xr
from scipy.ndimage import gaussian_filter

from tests.support.flows import WAVES, axes, data_array, origin, plane_waves, texture

from .families import FAMILIES, Family
from .turbulence import Wind

COLUMNS, ROWS, SPACING, DT = 219, 139, 0.5, 0.1
CONTRAST = 0.2
"""Rms of a texture over its mean."""
MARGIN = 4
"""Pixels around an image that is blurred: more than five standard deviations of the blur."""
FLOOR = 0.3
"""Brightness between patches of smoke over that within."""
RIM = 0.05
"""Width of a rim in units of the field that makes the patches, whose rms is 1: about 1 px."""

Air = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""Brightness at positions y, z (m)."""
Texture = Literal["fine", "coarse", "power law", "smoke", "smoke without texture"]
Noise = Literal["none", "known", "unknown", "map"]


@dataclass(frozen=True)
class Condition:
    """What is seen of a flow, and what the retrieval knows of it.

    Attributes
    ----------
    name : str
    noise : float
        Standard deviation of the white noise of each image; images have the mean 1, smoke its
        brightness within.
    told : {"none", "known", "unknown", "map"}
        Whether there is noise and whether the retrieval is given its standard deviation; "map":
        it grows from a fifth of ``noise`` to all of it across the image, and a map is given.
    replaced : float
        Fraction of the texture's variance that is of other air in image 2.
    blur : float
        Standard deviation of the instrument's Gaussian blur, px; the retrieval is given it.
    texture : str
        See `air`.
    """

    name: str
    noise: float = 0.0
    told: Noise = "none"
    replaced: float = 0.0
    blur: float = 0.0
    texture: Texture = "fine"


NOISE_KNOWN = Condition("1 % known", 0.01, "known")
BASE = (
    Condition("no noise"),
    NOISE_KNOWN,
    Condition("3 % unknown", 0.03, "unknown"),
    Condition("10 % replaced", 0.01, "known", replaced=0.1),
)
"""Of every family."""
FURTHER = (
    Condition("1 to 5 %, map", 0.05, "map"),
    Condition("30 % replaced", 0.01, "known", replaced=0.3),
    Condition("blur of 0.7 px", 0.01, "known", blur=0.7),
)
"""Of every third family in turn."""
TEXTURES = (
    Condition("coarse texture", 0.01, "known", texture="coarse"),
    Condition("power-law texture", 0.01, "known", texture="power law"),
    Condition("smoke with edges", 0.01, "known", texture="smoke"),
    Condition("smoke without texture", texture="smoke without texture"),
)
"""Of some families of each half."""
TEXTURED = (
    "turbulence 60 to 4 m",
    "wide pair in turbulence",
    "simulated wake, x = 11 to 15 m",
    "planar turbulence 40 to 3 m",
    "jet",
    "simulated wake, x = 25 to 30 m",
    "wake of a light aircraft, strong turbulence",
    "wake of a medium aircraft, strong turbulence",
    "wake of a medium aircraft, weak turbulence",
    "wake of a heavy aircraft, stratified air",
)
"""Families that are seen with all textures."""


@dataclass(frozen=True)
class ImagePair:
    """Two images `DT` apart, dims (z, y), the wind, and what the retrieval is given.

    Attributes
    ----------
    first, second : xarray.DataArray
    wind : callable
        v, w (m s^-1) at positions y, z (m): the truth at both times.
    noise : None, float or xarray.DataArray
        Given to the retrieval; None: nothing.
    blur : float
        Given to the retrieval, m.
    """

    first: xr.DataArray
    second: xr.DataArray
    wind: Wind
    noise: float | xr.DataArray | None
    blur: float


def pair(family: Family, condition: Condition, seed: int) -> ImagePair:
    """Images of a flow of the family, with texture and noise of the same seed."""
    wind = family.flow(seed)
    margin = MARGIN if condition.blur else 0
    grid = np.meshgrid(*axes(COLUMNS + 2 * margin, ROWS + 2 * margin, SPACING))
    here, there = air(condition.texture, seed), air(condition.texture, seed, condition.replaced)
    images = [here(*grid), there(*origin(wind, *grid, DT))]
    if condition.blur:
        inside = slice(margin, -margin)
        images = [
            gaussian_filter(image, condition.blur, truncate=MARGIN / condition.blur)[inside, inside]
            for image in images
        ]
    y, z = axes(COLUMNS, ROWS, SPACING)
    level = np.full((ROWS, COLUMNS), condition.noise)
    if condition.told == "map":
        level = level * np.linspace(0.2, 1.0, COLUMNS)
    random = np.random.default_rng([seed, 1])
    images = [image + level * random.standard_normal(image.shape) for image in images]
    known = {"known": condition.noise, "map": data_array(level, y, z)}
    first, second = (data_array(image, y, z) for image in images)
    return ImagePair(first, second, wind, known.get(condition.told), condition.blur * SPACING)


def air(kind: Texture, seed: int, replaced: float = 0.0) -> Air:
    """Brightness of the air.

    "fine" and "coarse" have the autocorrelation exp(-(r / length)^2) of 3 and 6 px, "power law" has
    waves of 1.5 to 40 m with a spectrum ~ k^-5/3, "smoke" is fine texture in patches with rims of a
    pixel, "smoke without texture" the patches alone.

    Parameters
    ----------
    replaced : float
        This fraction of the texture's variance is unlike that of the same seed without.
    """
    patches = smoke(seed) if kind.startswith("smoke") else None
    parts = [(np.sqrt(1 - replaced), waves(kind, seed, 0))]
    if replaced:
        parts.append((np.sqrt(replaced), waves(kind, seed, 1)))

    def brightness(y, z):
        image = np.ones(np.shape(y))
        if kind != "smoke without texture":
            image += sum(part * (texture(one, y, z, CONTRAST) - 1) for part, one in parts)
        return image if patches is None else image * patches(y, z)

    return brightness


def waves(kind: Texture, seed: int, stream: int) -> tuple[np.ndarray, np.ndarray]:
    """Wave vectors and phases of equal waves, see `tests.support.flows.plane_waves`."""
    if kind != "power law":
        return plane_waves([seed, stream], 6.0 if kind == "coarse" else 3.0, SPACING)
    random = np.random.default_rng([seed, stream])
    low, high = (2 * np.pi / length for length in (40.0, 1.5))
    # the fraction of waves below k is that of the integral of k^-5/3
    fraction = random.uniform(size=WAVES)
    k = (low ** (-2 / 3) * (1 - fraction) + high ** (-2 / 3) * fraction) ** -1.5
    angle, phases = random.uniform(0, 2 * np.pi, (2, WAVES))
    return np.stack([k * np.cos(angle), k * np.sin(angle)], 1), phases


def smoke(seed: int) -> Air:
    """1 in isolated patches and `FLOOR` between them, where a sum of 16 waves exceeds 0.3."""
    random = np.random.default_rng([seed, 2])
    k = 2 * np.pi / random.uniform(12, 35, 16)
    angle, phases = random.uniform(0, 2 * np.pi, (2, 16))

    def brightness(y, z):
        field = sum(
            np.cos(a * np.cos(b) * y + a * np.sin(b) * z + c)
            for a, b, c in zip(k, angle, phases, strict=True)
        ) / np.sqrt(8)
        return FLOOR + (1 - FLOOR) / 2 * (1 + np.tanh((field - 0.3) / RIM))

    return brightness


def conditions_of(family: Family) -> tuple[Condition, ...]:
    """The conditions in which a family is seen."""
    turn = FAMILIES.index(family) % len(FURTHER)
    return (*BASE, FURTHER[turn], *(TEXTURES if family.name in TEXTURED else ()))
