"""Families of defects and noises, one half to build tests on, one to judge them.

A family that judges takes part in no choice of a test, threshold or default, as `flows.families`.
Air, noise and the defect's strength, size and place are drawn anew for every seed. A family breaks
an assumption that all retrievals make of their images: both show nothing but the air at one time
each, sampled independently, with white noise.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal
from zlib import crc32

import numpy as np
from scipy import fft, ndimage

from .air import IMAGE, VOLUME, Air, drawn, waves

Purpose = Literal["build", "judge"]
Images = list[np.ndarray]
Defect = Callable[[np.random.Generator, Air], tuple[Air, Images]]
"""The air that images show, and the images."""


@dataclass(frozen=True)
class Family:
    """Image pairs with a defect.

    Attributes
    ----------
    kind, name, what : str
    purpose : {"build", "judge"}
    defect : callable
    shape : tuple of int
    """

    kind: str
    name: str
    what: str
    purpose: Purpose
    defect: Defect
    shape: tuple[int, ...] = IMAGE

    def pair(self, seed: int, vortices: bool = False) -> tuple[Air, Images]:
        """Air and images of a seed; ``vortices``: in the flow of a pair of vortices."""
        random = np.random.default_rng([crc32(self.name.encode()), seed])
        return self.defect(random, drawn(random, self.shape, vortices))


def of_images(change: Callable[[np.random.Generator, Air, Images], Images]) -> Defect:
    """A defect of finished images, with their noise."""

    def defect(random, air):
        return air, change(random, air, air.noisy(random, air.at(0), air.at(1)))

    return defect


def clean(random, air, images):
    return images


# --- what was there before


def lag(random, air, images):
    part = 10 ** random.uniform(-2, -0.5)
    return [images[0], (1 - part) * images[1] + part * images[0]]


def afterglow(random, air, images):
    """Each image holds a part of the one before, as that did."""
    part = 10 ** random.uniform(-2, -0.5)
    (before,) = air.noisy(random, air.at(-1))
    first = (1 - part) * images[0] + part * before
    return [first, (1 - part) * images[1] + part * first]


def blended(random, air, images):
    """Both are means of two frames, as where a rate of frames is converted."""
    part = random.uniform(0.05, 0.45)
    (after,) = air.noisy(random, air.at(2))
    return [(1 - part) * a + part * b for a, b in ((images[0], images[1]), (images[1], after))]


def denoised(random, air, images):
    """A temporal filter that weakens where images differ."""
    limit, strength = random.uniform(1, 3) * air.contrast, random.uniform(0.1, 0.5)
    off = images[1] - images[0]
    return [images[0], images[1] - strength * off * np.exp(-((off / limit) ** 2))]


# --- sampling


def _enlarged(air: Air, random, factors, order: int | Literal["lanczos"]):
    """What fewer pixels see, enlarged: the air's places and motion are those of the new pixels."""
    small = [-(-n // f) for n, f in zip(air.shape, factors, strict=True)]
    places = np.meshgrid(
        *(f * np.arange(n) for n, f in zip(small, factors, strict=True)), indexing="ij"
    )
    # the middle of the pixels that repeat one
    middle = [(f - 1) / 2 for f in factors]
    places = np.stack(places).astype(float) + np.reshape(middle, (-1, *[1] * len(small)))
    images = air.noisy(random, air.at(0, places), air.at(1, places))
    at = [(np.arange(n) - m) / f for n, m, f in zip(air.shape, middle, factors, strict=True)]
    if order == "lanczos":
        down, across = (_lanczos(a, n) for a, n in zip(at, small, strict=True))
        return [down @ image @ across.T for image in images]
    if order == 0:
        grid = np.meshgrid(*(np.rint(a).astype(int) for a in at), indexing="ij")
        return [image[tuple(grid)] for image in images]
    grid = np.meshgrid(*at, indexing="ij")
    return [ndimage.map_coordinates(i, grid, order=order, mode="nearest") for i in images]


def _lanczos(at: np.ndarray, number: int) -> np.ndarray:
    """Weights (places, samples) of a kernel of 6 samples."""
    off = at[:, None] - np.arange(number)
    weights = np.where(np.abs(off) < 3, np.sinc(off) * np.sinc(off / 3), 0.0)
    return weights / weights.sum(1, keepdims=True)


def repeated(random, air):
    air = _coarse(random, air)
    return air, _enlarged(air, random, [int(random.integers(2, 5))] * len(air.shape), 0)


def repeated_rows(random, air):
    air = _coarse(random, air)
    return air, _enlarged(air, random, (int(random.integers(2, 4)), 1), 0)


def interpolated(random, air):
    air = _coarse(random, air)
    return air, _enlarged(air, random, [random.uniform(1.5, 3.0)] * 2, int(random.choice([1, 3])))


def windowed(random, air):
    """Other kernels and factors than `interpolated`, and other ones by axis."""
    air = _coarse(random, air)
    return air, _enlarged(air, random, random.uniform(1.2, 3.5, 2), "lanczos")


def _coarse(random, air: Air) -> Air:
    """With a texture of 5 to 9 px, which fewer pixels resolve."""
    return replace(air, texture=waves(random, random.uniform(5.0, 9.0), len(air.shape)))


def interlaced(random, air):
    """Odd rows are seen half the time between images later."""
    images = []
    for time in (0.0, 1.0):
        image, later = air.at(time), air.at(time + 0.5)
        image[1::2] = later[1::2]
        images.append(image)
    return air, air.noisy(random, *images)


def nearest_gates(random, air):
    """Gates of a scan by azimuth and range on a grid, each pixel with the nearest one's value."""
    air = _coarse(random, air)
    rows, columns = air.shape
    apex = np.array([-random.uniform(30, 80), random.uniform(0, columns)])
    step, angle = random.uniform(1.5, 3.0), random.uniform(1.0, 2.0) / (rows - apex[0])
    off = air.places - apex.reshape(2, 1, 1)
    gate, beam = np.rint(np.hypot(*off) / step), np.rint(np.arctan2(off[1], off[0]) / angle)
    places = apex.reshape(2, 1, 1) + gate * step * np.stack(
        [np.cos(beam * angle), np.sin(beam * angle)]
    )
    _, number = np.unique(np.stack([gate, beam]).reshape(2, -1), axis=1, return_inverse=True)
    number = number.reshape(air.shape)
    return air, [
        air.at(t, places) + air.noise * random.standard_normal(number.max() + 1)[number]
        for t in (0.0, 1.0)
    ]


def mosaic(random, air, images):
    """Pixels of two by two of unlike gains."""
    gain = 1 + random.uniform(0.02, 0.2) * random.standard_normal((2, 2))
    return [image * np.tile(gain, np.array(air.shape) // 2) for image in images]


# --- compression


def _in_blocks(image: np.ndarray, side: int) -> np.ndarray:
    """View (rows, columns, side, side)."""
    rows, columns = (n // side for n in image.shape)
    return image.reshape(rows, side, columns, side).swapaxes(1, 2)


def copied(random, air, images):
    """Blocks that change least are those of image 1; values are whole numbers."""
    side, part = int(random.choice([8, 16])), random.uniform(0.05, 0.5)
    level = random.uniform(80, 160)
    first, second = (np.round(level * image) for image in images)
    change = np.abs(_in_blocks(second, side) - _in_blocks(first, side)).mean((2, 3))
    same = change <= np.quantile(change, part)
    _in_blocks(second, side)[same] = _in_blocks(first, side)[same]
    return [first, second]


def copied_and_encoded(random, air, images):
    first, second = copied(random, air, images)
    return _quantised([first, second], random.uniform(2, 8))


def quantised(random, air, images):
    return _quantised([100 * image for image in images], random.uniform(5, 40))


def other_blocks(random, air, images):
    side = int(random.choice([4, 16]))
    return _quantised([100 * image for image in images], random.uniform(5, 40), side)


def _quantised(images: Images, step: float, side: int = 8) -> Images:
    """Cosine transforms of blocks, in steps that grow with the wave number."""
    steps = step * (1 + 2 / side * np.add.outer(np.arange(side), np.arange(side)))
    for image in images:
        blocks = _in_blocks(image, side)
        waves = fft.dctn(blocks, axes=(2, 3), norm="ortho")
        blocks[:] = np.round(fft.idctn(steps * np.round(waves / steps), axes=(2, 3), norm="ortho"))
    return images


# --- noise


def _with_noise(random, air, make) -> tuple[Air, Images]:
    """1 to 6 % of noise, of rms 1 as it is made."""
    level = random.uniform(0.01, 0.06)
    images = []
    for time in (0, 1):
        noise = make()
        images.append(air.at(time) + level * noise / noise.std())
    return air, images


def correlated(random, air):
    width = random.uniform(0.6, 1.8)
    return _with_noise(
        random,
        air,
        lambda: ndimage.gaussian_filter(random.standard_normal(air.shape), width, mode="wrap"),
    )


def along(random, air):
    """Correlated along one axis alone, over 1 to 4 px."""
    width, axis = random.uniform(0.8, 4.0), int(random.integers(len(air.shape)))
    return _with_noise(
        random,
        air,
        lambda: ndimage.gaussian_filter1d(
            random.standard_normal(air.shape), width, axis, mode="wrap"
        ),
    )


def lines(axis: int) -> Defect:
    """Each row or column has one value in addition to white noise."""

    def defect(random, air):
        part = random.uniform(0.3, 1.0)
        size = [1, 1]
        size[axis] = air.shape[axis]
        return _with_noise(
            random,
            air,
            lambda: (
                part * random.standard_normal(size) + (1 - part) * random.standard_normal(air.shape)
            ),
        )

    return defect


def demosaiced(random, air):
    """Noise of every other pixel, interpolated."""

    def make():
        noise = random.standard_normal(air.shape)
        kept = np.add.outer(*map(np.arange, air.shape)) % 2 == 0
        around = ndimage.convolve(noise * kept, np.array([[0, 1, 0], [1, 0, 1], [0, 1, 0]]) / 4)
        return np.where(kept, noise, around)

    return _with_noise(random, air, make)


# --- light


def borders(random, air, images):
    """Black borders of up to 14 px that differ, as of frames that are stabilised."""
    for image in images:
        rows, columns = random.integers(3, 15, 2)
        image[slice(rows) if random.random() < 0.5 else slice(-rows, None)] = 0
        image[:, slice(columns) if random.random() < 0.5 else slice(-columns, None)] = 0
    return images


def zeroed(random, air, images):
    """A moving disc set to 0, as by a mask that follows a body."""
    radius, middle = random.uniform(8, 16), random.uniform(0.3, 0.7, 2) * air.shape
    for n, image in enumerate(images):
        off = air.places - (middle + n * random.uniform(-4, 4, 2)).reshape(2, 1, 1)
        image[np.hypot(*off) < radius] = 0
    return images


def lit(random, air, images):
    """A smooth profile of light at rest."""
    profile = 1 + random.uniform(0.1, 0.4) * waves(random, random.uniform(20, 60), 2)(air.places)
    return [np.maximum(profile, 0.1) * image for image in images]


def bands(random, air, images):
    """Rows are lit by a lamp that flickers while they are read out."""
    depth, rows = random.uniform(0.03, 0.2), np.arange(air.shape[0])[:, None]
    period = random.uniform(20, 80)
    return [
        image * (1 + depth * np.cos(2 * np.pi * rows / period + random.uniform(0, 2 * np.pi)))
        for image in images
    ]


# --- the air changes


def growth(random, air):
    """Brightness grows and decays by place, 10 to 30 %."""
    change = random.uniform(0.1, 0.3) * waves(random, random.uniform(12, 40), 2)(air.places)
    first, second = air.at(0), air.at(1)
    return air, air.noisy(random, first, second * (1 + change))


def evaporation(random, air):
    """A part of the texture fades and another takes its place."""
    part = random.uniform(0.1, 0.5)
    other = replace(air, texture=waves(random, 3.5, 2))
    second = 1 + np.sqrt(1 - part) * (air.at(1) - 1) + np.sqrt(part) * (other.at(1) - 1)
    return air, air.noisy(random, air.at(0), second)


def _dots(random, air: Air, bases: np.ndarray, missing: float) -> Air:
    """A lattice of dots with these basis vectors (2, 2), px, at the time 0."""
    reach = np.arange(-40, 41)
    numbers = np.stack(np.meshgrid(reach, reach)).reshape(2, -1)
    places = bases.T @ numbers + np.array(air.shape).reshape(2, 1) / 2
    near = ((places > -20) & (places < np.reshape(air.shape, (2, 1)) + 20)).all(0)
    places = places[:, near][:, random.random(near.sum()) >= missing]
    # Gaussians of 5 nodes: the spline through them is exact to 1e-4
    fine = np.zeros([4 * (n + 40) for n in air.shape])
    index = np.rint(4 * (places + 20)).astype(int)
    fine[tuple(np.clip(index, 0, np.reshape(fine.shape, (2, 1)) - 1))] = 1
    fine = ndimage.gaussian_filter(fine, 4 * 1.3)
    fine = (fine - fine.mean()) / fine.std()
    spline = ndimage.spline_filter(fine)

    def texture(where):
        return ndimage.map_coordinates(spline, 4 * (where + 20), prefilter=False, mode="nearest")

    return replace(air, texture=texture)


def _uniform(random, air: Air, largest: float) -> Air:
    """The same in a uniform flow."""
    angle, size = random.uniform(0, 2 * np.pi), random.uniform(1, largest)
    d = (size * np.array([np.sin(angle), np.cos(angle)])).reshape(2, 1, 1)
    return replace(air, motion=lambda places: d + 0 * places, back=lambda places, t: places - t * d)


def square_lattice(random, air):
    period = random.uniform(6, 10)
    air = _dots(random, _uniform(random, air, 5.5), period * np.eye(2), random.uniform(0.02, 0.1))
    return air, air.noisy(random, air.at(0), air.at(1))


def hexagonal_lattice(random, air):
    period, angle = random.uniform(6, 10), random.uniform(0, np.pi / 3)
    bases = np.array([[np.cos(a), np.sin(a)] for a in (angle, angle + np.pi / 3)]) * period
    air = _dots(random, _uniform(random, air, 5.0), bases, random.uniform(0.02, 0.1))
    return air, air.noisy(random, air.at(0), air.at(1))


def lost(random, air):
    """30 to 70 % of the particles are others in image 2."""
    number = int(0.05 * np.prod([n + 20 for n in air.shape]))

    def new():
        places = [random.uniform(-10, n + 10, number) for n in air.shape]
        return np.stack([*places, random.uniform(0.3, 1.0, number)])

    first, other = new(), new()
    second = np.concatenate([air.back(first[:2], -1.0), first[2:]])
    gone = random.random(number) < random.uniform(0.3, 0.7)
    second[:, gone] = other[:, gone]
    return air, [_particles(random, air.shape, p) for p in (first, second)]


def _particles(random, shape, particles: np.ndarray) -> np.ndarray:
    image = np.zeros(shape)
    reach = np.arange(-4, 5)
    for z, y, height in particles.T:
        rows, columns = int(np.rint(z)) + reach, int(np.rint(y)) + reach
        rows, columns = (i[(i >= 0) & (i < n)] for i, n in zip((rows, columns), shape, strict=True))
        spot = np.multiply.outer(
            *(np.exp(-((i - c) ** 2) / 2 / 0.7**2) for i, c in ((rows, z), (columns, y)))
        )
        image[np.ix_(rows, columns)] += height * spot
    return 0.1 + image + 0.02 * random.standard_normal(shape)


# --- layers


def layer(moving: bool) -> Defect:
    """A second, fainter texture over the air's, at rest or with a motion of its own."""

    def defect(random, air):
        over = replace(air, texture=waves(random, random.uniform(2.5, 8.0), 2))
        over = (
            _uniform(random, over, 3.0) if moving else replace(over, back=lambda places, t: places)
        )
        part = random.uniform(0.05, 0.35)
        return air, air.noisy(random, *(air.at(t) + part * (over.at(t) - 1) for t in (0, 1)))

    return defect


# --- voxels


def hot(random, air, images):
    excess = random.uniform(2, 20) * (random.random(air.shape) < 10 ** random.uniform(-3.3, -2))
    return [image + excess for image in images]


def dead(random, air, images):
    mask = random.random(air.shape) < 10 ** random.uniform(-3, -1.7)
    return [np.where(mask, 0.0, image) for image in images]


def hard_targets(random, air, images):
    """Clusters of two by two by two voxels as bright as each other in both volumes."""
    seeds = random.random(air.shape) < 10 ** random.uniform(-4, -2.7)
    excess = random.uniform(3, 20) * ndimage.maximum_filter(seeds, 2)
    return [image + excess for image in images]


FAMILIES = (
    Family("none", "clean", "no defect", "build", of_images(clean)),
    Family("none", "clean volumes", "no defect", "build", of_images(clean), VOLUME),
    Family("persistence", "lag", "1 to 30 % of image 1 in image 2", "build", of_images(lag)),
    Family(
        "persistence",
        "afterglow",
        "1 to 30 %, of the image before as well",
        "judge",
        of_images(afterglow),
    ),
    Family(
        "blending", "blended", "5 to 45 % of the next frame in each", "build", of_images(blended)
    ),
    Family(
        "blending",
        "denoised",
        "a temporal filter where images are alike",
        "judge",
        of_images(denoised),
    ),
    Family("sampling", "repeated pixels", "enlarged by 2 to 4", "build", repeated),
    Family("sampling", "repeated rows", "enlarged by 2 or 3 along z", "build", repeated_rows),
    Family(
        "sampling",
        "mosaic",
        "gains of 2 x 2 px that differ by 2 to 20 %",
        "build",
        of_images(mosaic),
    ),
    Family("sampling", "interlaced", "odd rows dt/2 later", "judge", interlaced),
    Family(
        "sampling", "interpolated", "enlarged by 1.5 to 3, linear or cubic", "judge", interpolated
    ),
    Family("sampling", "windowed", "enlarged by 1.2 to 3.5, Lanczos", "judge", windowed),
    Family("sampling", "nearest gates", "gates of a scan on a grid", "judge", nearest_gates),
    Family(
        "compression",
        "copied blocks",
        "5 to 50 % of the blocks of 8 or 16 px",
        "build",
        of_images(copied),
    ),
    Family(
        "compression",
        "quantised",
        "cosines of blocks of 8 px in steps",
        "judge",
        of_images(quantised),
    ),
    Family(
        "compression",
        "other blocks",
        "cosines of blocks of 4 or 16 px in steps",
        "judge",
        of_images(other_blocks),
    ),
    Family("compression", "copied and encoded", "both", "judge", of_images(copied_and_encoded)),
    Family("noise", "correlated", "1 to 6 %, Gaussian of 0.6 to 1.8 px", "build", correlated),
    Family("noise", "rows", "1 to 6 %, 30 to 100 % of it by row", "build", lines(0)),
    Family("noise", "columns", "1 to 6 %, 30 to 100 % of it by column", "judge", lines(1)),
    Family("noise", "one direction", "1 to 6 %, over 0.8 to 4 px along an axis", "judge", along),
    Family("noise", "interpolated noise", "1 to 6 %, of every other pixel", "judge", demosaiced),
    Family(
        "borders",
        "black borders",
        "3 to 14 px, other ones in each image",
        "build",
        of_images(borders),
    ),
    Family("borders", "zeroed disc", "a mask of 8 to 16 px that moves", "judge", of_images(zeroed)),
    Family(
        "illumination",
        "light at rest",
        "a profile of 20 to 60 px, 10 to 40 %",
        "build",
        of_images(lit),
    ),
    Family("illumination", "flicker", "bands of 20 to 80 px, 3 to 20 %", "judge", of_images(bands)),
    Family("growth", "growth and decay", "10 to 30 % over 12 to 40 px", "build", growth),
    Family("growth", "evaporation", "10 to 50 % of the texture is replaced", "judge", evaporation),
    Family(
        "lattices",
        "square lattice",
        "dots 6 to 10 px apart, 2 to 10 % missing",
        "build",
        square_lattice,
    ),
    Family("lattices", "hexagonal lattice", "the same, turned", "judge", hexagonal_lattice),
    Family("lost pairs", "lost particles", "30 to 70 % are others in image 2", "build", lost),
    Family("layers", "layer at rest", "5 to 35 % of the texture", "build", layer(False)),
    Family("layers", "moving layer", "5 to 35 % of the texture, 1 to 3 px", "judge", layer(True)),
    Family(
        "voxels",
        "hot voxels",
        "0.05 to 1 %, 2 to 20 times the air",
        "build",
        of_images(hot),
        VOLUME,
    ),
    Family("voxels", "dead voxels", "0.1 to 2 % at 0", "judge", of_images(dead), VOLUME),
    Family(
        "voxels",
        "hard targets",
        "clusters of 8, 3 to 20 times the air",
        "judge",
        of_images(hard_targets),
        VOLUME,
    ),
    Family("voxels", "repeated voxels", "enlarged by 2 to 4", "judge", repeated, VOLUME),
    Family(
        "voxels",
        "lag of volumes",
        "1 to 30 % of volume 1 in volume 2",
        "judge",
        of_images(lag),
        VOLUME,
    ),
)

BY_NAME = {family.name: family for family in FAMILIES}


def chosen(purpose: Purpose | None = None) -> tuple[Family, ...]:
    """Families of a purpose, or all."""
    return tuple(family for family in FAMILIES if purpose in (None, family.purpose))
