"""Defects of cameras, detectors and scenes on images of air, and what they must not do.

A defect on up to 5 % of the pixels changes no valid vector by more than three stated errors.
"""

from collections.abc import Callable

import numpy as np

from lidar_mi.retrieval.vortices.image_fit import fit_vortices
from lidar_mi.retrieval.wind.options import WindowSizes
from lidar_mi.retrieval.wind.pair import retrieve_wind
from tests.support.crosswind import DT, crosswind_pair
from tests.support.flows import axes, data_array

Pair = list[np.ndarray]
Sort = Callable[[np.random.Generator, Pair, float], Pair]

SIZE = 96, 72
"""Columns and rows."""
METHODS = "cc", "ws", "multipass", "variational", "vortex_fit"
LARGEST = 3.0
"""Of the change of a valid vector, in stated errors."""
# Of valid vectors that may change by more: of normal errors 0.3 % do, and neighbours are alike.
_RARE = 0.02
# The same of soft structure as faint as the texture, which is not found.
_SOFT = 0.1
FAINT = "dust", "smudge", "vignetting"
"""Sorts of these."""
_MOST = 0.05


def _scattered(random, shape, fraction) -> np.ndarray:
    return random.random(shape) < fraction


def _places(random, shape, number, margin=2) -> np.ndarray:
    return np.stack([random.integers(margin, n - margin, number) for n in shape], 1)


def _grid(image) -> tuple[np.ndarray, np.ndarray]:
    return tuple(np.indices(image.shape))


def _put(images, mask, value) -> Pair:
    return [np.where(mask, value, image) for image in images]


def _hot(random, images, fraction):
    level = random.choice([5.0, 20.0, 200.0, 4000.0])
    return _put(images, _scattered(random, images[0].shape, fraction), level)


def _warm(random, images, fraction):
    mask = _scattered(random, images[0].shape, fraction)
    more = mask * random.uniform(0.5, 2.0, mask.shape)
    return [image + more for image in images]


def _dead(random, images, fraction):
    return _put(images, _scattered(random, images[0].shape, fraction), 0.0)


def _stuck(random, images, fraction):
    mask = _scattered(random, images[0].shape, fraction)
    return _put(images, mask, random.uniform(0.0, 10.0, mask.shape))


def _blinking(random, images, fraction):
    """Of all that are hot, half in either image."""
    mask = _scattered(random, images[0].shape, fraction)
    level = random.choice([5.0, 20.0, 200.0])
    return [np.where(mask & _scattered(random, mask.shape, 0.5), level, i) for i in images]


def _unlike(random, images, fraction):
    """Hot pixels that differ between the images."""
    level = random.choice([5.0, 20.0, 200.0])
    return [np.where(_scattered(random, i.shape, fraction), level, i) for i in images]


def _cosmic(random, images, fraction):
    """Tracks of charged particles, in one image alone."""
    which = random.integers(2)
    mask = _lines(random, images[0].shape, fraction, 6.0)
    level = random.uniform(2.0, 100.0)
    return [i + level * mask * (n == which) for n, i in enumerate(images)]


def _lines(random, shape, fraction, length) -> np.ndarray:
    """Straight lines a pixel wide in random directions."""
    mask = np.zeros(shape)
    for _ in range(1000):
        (row, column), angle = _places(random, shape, 1)[0], random.uniform(0, np.pi)
        along = np.arange(0, random.uniform(0.5, 1.5) * length, 0.5)
        at = np.round(row + along * np.sin(angle)), np.round(column + along * np.cos(angle))
        rows, columns = (a.astype(int).clip(0, n - 1) for a, n in zip(at, shape, strict=True))
        more = mask.copy()
        more[rows, columns] = 1.0
        if more.mean() > fraction:
            break
        mask = more
    return mask


def _columns(random, images, fraction):
    return [image.T for image in _rows(random, [image.T for image in images], fraction)]


def _rows(random, images, fraction):
    rows = len(images[0])
    number = max(1, int(fraction * rows))
    mask = np.zeros_like(images[0], dtype=bool)
    mask[random.choice(rows, number, replace=False)] = True
    return _put(images, mask, random.choice([0.0, 0.5, 3.0, 50.0]))


def _part_of_column(random, images, fraction):
    """Blooming or a bad register: a column from some row on."""
    mask = np.zeros_like(images[0], dtype=bool)
    while True:
        more = mask.copy()
        more[random.integers(len(mask)) :, random.integers(mask.shape[1])] = True
        if more.mean() > fraction:
            break
        mask = more
    return _put(images, mask, random.choice([0.0, 3.0, 50.0]))


def _discs(random, shape, fraction, least, most) -> np.ndarray:
    """Distance to the rim of the nearest of some discs, px, positive inside."""
    z, y = np.indices(shape)
    inside = np.full(shape, -np.inf)
    for _ in range(1000):
        radius = random.uniform(least, most)
        row, column = _places(random, shape, 1)[0]
        more = np.maximum(inside, radius - np.hypot(z - row, y - column))
        if np.mean(more > 0) > fraction:
            break
        inside = more
    return inside


def _clusters(random, images, fraction):
    mask = _discs(random, images[0].shape, fraction, 1.0, 2.5) > 0
    return _put(images, mask, random.choice([0.0, 4.0, 100.0]))


def _block(random, images, fraction):
    shape = images[0].shape
    side = max(1, int(np.sqrt(fraction * images[0].size)))
    row, column = (random.integers(0, n - side) for n in shape)
    mask = np.zeros(shape, bool)
    mask[row : row + side, column : column + side] = True
    return _put(images, mask, random.choice([0.0, 2.0, 30.0]))


def _scratches(random, images, fraction):
    mask = _lines(random, images[0].shape, fraction, 30.0)
    gain = random.choice([0.2, 3.0])
    return [image * np.where(mask > 0, gain, 1.0) for image in images]


def _smudge(random, images, fraction):
    """Dirt on the window out of focus."""
    inside = _discs(random, images[0].shape, fraction, 3.0, 8.0)
    gain = 1 - random.uniform(0.3, 0.9) * np.clip(inside / 2, 0, 1)
    return [image * gain for image in images]


def _dust(random, images, fraction):
    """Rings: shadows of grains in front of the detector."""
    inside = _discs(random, images[0].shape, fraction, 2.0, 6.0)
    gain = 1 - random.uniform(0.2, 0.6) * np.exp(-((inside - 1.0) ** 2)) * (inside > 0)
    return [image * gain for image in images]


def _vignette(random, images, fraction):
    z, y = (2 * g / (n - 1) - 1 for g, n in zip(_grid(images[0]), images[0].shape, strict=True))
    gain = 1 / (1 + np.exp((z**2 + y**2 - random.uniform(1.2, 1.7)) / 0.05))
    return [image * gain for image in images]


def _text(random, images, fraction):
    """A time stamp: characters of 3 x 5 px."""
    shape = images[0].shape
    mask = np.zeros(shape, bool)
    number = min(int(fraction * mask.size / 8), (shape[1] - 4) // 4)
    row = random.choice([3, shape[0] - 9, random.integers(3, shape[0] - 9)])
    for k in range(number):
        mask[row : row + 5, 3 + 4 * k : 6 + 4 * k] = random.random((5, 3)) < 0.6
    return _put(images, mask, random.choice([0.0, 5.0, 255.0]))


def _border(random, images, fraction):
    rows, columns = images[0].shape
    wide = max(1, int(fraction * rows * columns / (2 * (rows + columns))))
    mask = np.ones((rows, columns), bool)
    mask[wide : rows - wide, wide : columns - wide] = False
    return _put(images, mask, random.choice([0.0, 3.0, 255.0]))


def _mast(random, images, fraction):
    z, y = _grid(images[0])
    rows, columns = images[0].shape
    slope, place = random.uniform(-0.3, 0.3), random.uniform(0.2, 0.8) * columns
    wide = fraction * columns
    mask = np.abs(y - place - slope * (z - rows / 2)) < wide / 2
    value = random.choice([0.1, 3.0, 20.0])
    return _put(images, mask, value * (1 + 0.1 * random.standard_normal(mask.shape)))


def _wing(random, images, fraction):
    """A corner behind a straight edge."""
    z, y = _grid(images[0])
    rows, columns = images[0].shape
    part = np.sqrt(2 * fraction)
    mask = z / (part * rows) + y / (part * columns) < 1
    mask = mask[:: random.choice([1, -1]), :: random.choice([1, -1])]
    return _put(images, mask, random.choice([0.0, 3.0, 20.0]))


def _ramp(random, images, fraction):
    z, y = _grid(images[0])
    slope, angle = random.uniform(0.1, 1.0) * fraction, random.uniform(0, 2 * np.pi)
    more = slope * (np.sin(angle) * z + np.cos(angle) * y)
    return [image + more - more.min() for image in images]


def _interline(random, images, fraction):
    """Every other row a little brighter."""
    gain = 1 + random.uniform(0.2, 1.0) * fraction * (np.arange(len(images[0])) % 2)[:, None]
    return [image * gain for image in images]


def _saturated(random, images, fraction):
    """Glints with halos, cut off at the limit."""
    inside = _discs(random, images[0].shape, fraction / 2, 2.0, 5.0)
    more = 30.0 * np.exp(np.minimum(2 * inside, 0.0))
    return [np.minimum(image + more, 10.0) for image in images]


def _missing(random, images, fraction):
    return _put(images, _discs(random, images[0].shape, fraction, 1.0, 5.0) > 0, np.nan)


def _quantised(random, images, fraction):
    step = random.uniform(0.2, 1.0) * 2 * fraction
    return [step * np.round(image / step) for image in images]


def _speckle(random, images, fraction):
    """Bright grains that move with the platform, of 2 px."""
    inside = _discs(random, images[0].shape, fraction, 0.8, 1.6)
    bright = random.uniform(0.5, 5.0, inside.shape)
    more = np.where(inside > 0, bright, 0.0)
    return [image + more for image in images]


SORTS: dict[str, Sort] = {
    "hot pixels": _hot,
    "warm pixels": _warm,
    "dead pixels": _dead,
    "stuck pixels": _stuck,
    "blinking pixels": _blinking,
    "pixels hot in one image": _unlike,
    "cosmic rays": _cosmic,
    "rows": _rows,
    "columns": _columns,
    "parts of columns": _part_of_column,
    "clusters": _clusters,
    "block": _block,
    "scratches": _scratches,
    "smudge": _smudge,
    "dust": _dust,
    "vignetting": _vignette,
    "time stamp": _text,
    "border": _border,
    "mast": _mast,
    "wing": _wing,
    "gradient": _ramp,
    "interline": _interline,
    "saturated blobs": _saturated,
    "missing areas": _missing,
    "quantisation": _quantised,
    "speckle": _speckle,
}
"""Sorts of defects: generator, two images and a fraction of their pixels to the images with it."""


def air(random: np.random.Generator, vortices: bool) -> Pair:
    """Two images of air that moves by up to 3 px, with some noise."""
    speed, angle = random.uniform(0.0, 15.0), random.uniform(0, 2 * np.pi)
    return crosswind_pair(
        int(random.integers(2**31)),
        random.uniform(2.0, 4.5),
        random.choice([0.0, 0.01, 0.03]),
        size=SIZE,
        mean=(speed * np.cos(angle), speed * np.sin(angle)),
        circulation=random.uniform(50.0, 150.0) if vortices else 1e-6,
        separation=24.0,
    )[0]


def changes(clean: Pair, spoiled: Pair, method: str) -> tuple[np.ndarray, np.ndarray]:
    """Of valid vectors (or parameters) in stated errors of both; and which vectors are valid.

    Two retrievals differ by the errors of both: without noise those of clean images, which the rim
    of an image decides, are up to three times those of images with something left out.

    Valid: without a flag in the clean images, and in the spoiled ones, (2, ...).
    """
    y, z = axes(*SIZE)
    images = [[data_array(i, y, z) for i in images] for images in (clean, spoiled)]
    if method == "vortex_fit":
        both = [fit_vortices(*pair, DT) for pair in images]
        good = np.array([fit.success for fit in both])
        if not good.all():
            return np.zeros(0), good
        off = both[1].parameters - both[0].parameters
        return off / np.sqrt(sum(np.diag(fit.covariance) for fit in both)), good
    both = [retrieve_wind(*pair, DT, method, windows=WindowSizes(stride=3)) for pair in images]
    good = np.stack([(wind.flag == 0).values for wind in both])
    use = good.all(0)
    off = [
        ((both[1][n] - both[0][n]) / np.hypot(*(wind[f"{n}_stderr"] for wind in both))).values[use]
        for n in "vw"
    ]
    return np.concatenate(off), good


def check(
    seed: int, sort: str | None = None, method: str | None = None, methods=METHODS
) -> str | None:
    """None if a defect changes nothing that is valid, else one line that says what broke."""
    random = np.random.default_rng([seed, 45])
    chosen = random.choice(sorted(SORTS)), random.choice(methods)
    sort, method = sort or str(chosen[0]), method or str(chosen[1])
    clean = air(random, method == "vortex_fit" or random.random() < 0.5)
    fraction = random.uniform(0.002, _MOST)
    spoiled = SORTS[sort](random, clean, fraction)
    off, good = changes(clean, spoiled, method)
    beyond = np.abs(off) > LARGEST
    if not off.size or beyond.mean() <= (_SOFT if sort in FAINT else _RARE):
        return None
    return (
        f"seed {seed}: {sort} on {fraction:.1%} of the pixels, {method}: {beyond.mean():.0%} of "
        f"{good[-1].mean():.0%} valid vectors change by more than {LARGEST:g} stated errors, up to "
        f"{np.abs(off).max():.1f}"
    )
