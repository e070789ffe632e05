"""Images that users report: the wind within the stated errors, or no valid vector.

Detects valid vectors that are more than four stated errors off in images of one defect each. Those
that are known to be wrong are expected to fail, with their size.
"""

import numpy as np
import pytest
import xarray as xr
from scipy import ndimage
from scipy.special import erf

from lidar_mi.retrieval.wind.options import WindowSizes
from lidar_mi.retrieval.wind.pair import retrieve_wind

SHAPE = 96, 112
SHIFT = -0.6, 1.4
"""Along z and y, px of 0.5 m in 0.1 s."""
Z, Y = np.mgrid[: SHAPE[0], : SHAPE[1]].astype(float)


def air(seed):
    """Texture of 2 px and 30 % at both times, by Fourier: exact."""
    field = ndimage.gaussian_filter(
        np.random.default_rng(seed).standard_normal((256, 256)), 2.0, mode="wrap"
    )
    k = np.fft.fftfreq(256)
    phase = np.exp(-2j * np.pi * (k[:, None] * SHIFT[0] + k * SHIFT[1]))
    moved = np.fft.ifft2(np.fft.fft2(field) * phase).real
    cut = slice(40, 40 + SHAPE[0]), slice(40, 40 + SHAPE[1])
    return [1 + 0.3 * part[cut] / field.std() for part in (field, moved)]


def white(random, level=0.01):
    return level * random.standard_normal(SHAPE)


def columns(seed, random, level):
    """Each column has an offset that is new in each image."""
    return [
        part + white(random) + level * random.standard_normal((1, SHAPE[1])) for part in air(seed)
    ]


def correlated(seed, random, level):
    """Noise over 2 px, as of denoised frames."""
    found = []
    for part in air(seed):
        noise = ndimage.gaussian_filter(random.standard_normal(SHAPE), 2.0)
        found.append(part + level * noise / noise.std())
    return found


def borders(seed, random, level):
    """Black borders of a stabilised video."""
    first, second = (part + white(random, level) for part in air(seed))
    first[:12], second[:9] = 0, 0
    first[:, :9], second[:, :13] = 0, 0
    return [first, second]


def dots(seed, random, missing):
    """A lattice of dots, 8 px apart, of which some are missing."""
    places = [
        (8.0 * i, 8.0 * j)
        for i in range(-2, SHAPE[0] // 8 + 3)
        for j in range(-2, SHAPE[1] // 8 + 3)
    ]
    kept = np.random.default_rng(seed).random(len(places)) >= missing
    found = []
    for t in (0, 1):
        image = white(random)
        for (z, y), keep in zip(places, kept, strict=True):
            off = (Z - z - t * SHIFT[0]) ** 2 + (Y - y - t * SHIFT[1]) ** 2
            image += keep * np.exp(-off / 2 / 1.3**2)
        found.append(image)
    return found


def echoes(seed, random, growth):
    """60 radar cells, each of which grows or decays, above a threshold."""
    draw, first, second = np.random.default_rng(seed), np.zeros(SHAPE), np.zeros(SHAPE)
    for _ in range(60):
        z, y, size, top = (draw.uniform(*part) for part in ((-5, 101), (-5, 117), (2, 6), (10, 40)))
        later = 1 + growth * draw.normal()
        for t, image, height in ((0, first, top), (1, second, top * later)):
            off = (Z - z - t * SHIFT[0]) ** 2 + (Y - y - t * SHIFT[1]) ** 2
            np.maximum(image, height * np.exp(-off / 2 / size**2), out=image)
    return [np.where(part < 5, 0, part) + white(random, 0.3) for part in (first, second)]


def particles(seed, random, lost):
    """Particle images of 2.5 px, of which a part are others in image 2."""
    number = 766

    def new():
        return np.column_stack(
            [random.uniform(-10, n + 10, number) for n in SHAPE] + [random.uniform(0.3, 1, number)]
        )

    def seen(places):
        along = [
            erf((pixel + 0.5 - at[:, None]) / 0.88) - erf((pixel - 0.5 - at[:, None]) / 0.88)
            for pixel, at in zip((Z[:, 0], Y[0]), places.T[:2], strict=True)
        ]
        return np.einsum("nz,ny,n->zy", *along, 50 * places[:, 2])

    first = new()
    second = first + np.array([*SHIFT, 0])
    gone = random.random(number) < lost
    second[gone] = new()[gone]
    return [seen(part) + 10 + white(random, 3.0) for part in (first, second)]


def beyond(images, method):
    """Fraction of the valid vectors that are more than four stated errors off; 0 without any."""
    axes = {
        name: (name, 0.5 * np.arange(n), {"units": "m"})
        for name, n in zip("zy", SHAPE, strict=True)
    }
    one, two = (xr.DataArray(image, axes, ("z", "y")) for image in images)
    wind = retrieve_wind(one, two, 0.1, method, windows=WindowSizes(8, 16, 4))
    valid = wind["flag"].values == 0
    true = zip("wv", SHIFT, strict=True)
    score = [(wind[c].values - 5 * d) / wind[f"{c}_stderr"].values for c, d in true]
    far = np.abs(score).max(0) > 4
    return far[valid].mean() if valid.any() else 0.0


def missed(*case, reason):
    marks = [pytest.mark.xfail(strict=True, raises=AssertionError, reason=reason), pytest.mark.slow]
    return pytest.param(*case, marks=marks)


def slow(*case):
    return pytest.param(*case, marks=pytest.mark.slow)


@pytest.mark.parametrize(
    ("draw", "size", "seed", "method"),
    [
        missed(columns, 0.01, 100, "variational", reason="1.9 % beyond four stated errors"),
        slow(columns, 0.03, 101, "variational"),
        slow(correlated, 0.01, 101, "variational"),
        slow(correlated, 0.03, 101, "variational"),
        missed(borders, 0.01, 100, "variational", reason="5 % beyond four stated errors"),
        slow(dots, 0.05, 100, "variational"),
        slow(dots, 0.05, 101, "variational"),
        slow(dots, 0.05, 102, "variational"),
        missed(echoes, 0.1, 100, "variational", reason="17 %: the rims of cells move"),
        missed(echoes, 0.3, 100, "variational", reason="54 %: the rims of cells move"),
        slow(echoes, 0.3, 100, "multipass"),
        slow(particles, 0.6, 1, "variational"),
        slow(particles, 0.6, 0, "multipass"),
        missed(particles, 0.6, 0, "cc", reason="8 % are chance peaks"),
        missed(particles, 0.6, 1, "cc", reason="13 % are chance peaks"),
    ],
    ids=lambda value: getattr(value, "__name__", str(value)),
)
def test_errors_are_stated_or_flagged(draw, size, seed, method):
    assert beyond(draw(seed, np.random.default_rng(seed), size), method) <= 0.01
