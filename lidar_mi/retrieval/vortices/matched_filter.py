"""Matched filters for pairs of vortices: a likelihood ratio and the likeliest pair, in some ms.

Blurred images differ by I2 - I1 = -dt u . grad I + noise, which is linear in the circulations of
vortices at given places. With a normal prior of the circulations the likelihood of every pair of
places is in closed form (Bayesian linear regression: Bishop 2006, Pattern Recognition and Machine
Learning, eq. 3.86), and so is its ratio to that without vortices.
"""

import math
from functools import lru_cache
from typing import NamedTuple

import torch

from lidar_mi.retrieval.vortices.model import Profile, swirl

# Observations, and the standard deviation of their blur over their distance: all pixels count.
_OBSERVATIONS, _BLUR = 1000, 1 / 3
# Places of vortices in the image, and the fraction of its sides by which they reach beyond it.
_PLACES, _BEYOND = 420, 0.2
# Core radius over the shorter side of the image.
_RADIUS = 0.05
# Standard deviation of circulations before the images, m^2/s: of aircraft from 20 t to 500 t. That
# of a wake's vortices are opposite, but for a tenth after unlike decay.
_CIRCULATION, _CORRELATION = 350.0, -0.95
# Displacement (px) by which the flow departs from a pair and a smooth wind.
_MODEL_ERROR = 0.25


class Likelihoods(NamedTuple):
    """What the filters say of two images.

    log_ratio: natural logarithm of the likelihood of any pair of opposite sense over that of a
        smooth wind, if residuals are white.
    pair (10,): parameters of the likeliest pair, of no mean wind; m from the first pixel. None
        where no pair lowers the misfit.
    """

    log_ratio: float
    pair: torch.Tensor | None


class _Lattice(NamedTuple):
    """Observations and places of vortices of images of one size, and what links them.

    stride: distance of the observations, px.
    blur, slope: of rows (observations, rows) and of columns: weights of the pixels in blurred
        values, and in their slopes, per px.
    place (places, 2): y and z, m from the first pixel.
    swirl (2, places, observations): v and w of vortices of unit circulation.
    linear, quadratic (torch.Tensor, shapes (3, observations) and (6, observations)): polynomials of
        y and z, which are from -1 to 1.
    allowed (places, places): pairs three core radii or more apart, at least one vortex in the
        image.
    radius: m.
    """

    stride: int
    blur: tuple[torch.Tensor, torch.Tensor]
    slope: tuple[torch.Tensor, torch.Tensor]
    place: torch.Tensor
    swirl: torch.Tensor
    linear: torch.Tensor
    quadratic: torch.Tensor
    allowed: torch.Tensor
    radius: float


def matched_filter(
    pair: torch.Tensor, spacing: tuple[float, float], dt: float, noise: float, profile: Profile
) -> Likelihoods:
    """Filters for pairs of opposite sense at all places in two images and somewhat beyond.

    Mean wind, its first and second derivatives and changes of brightness are fitted with every
    pair and without one.

    pair (2, z, y): finite, with normalised intensity.
    spacing: along y and z, m.
    dt: s.
    noise: standard deviation of the white noise of each image, in their unit.
    profile {"lamb_oseen", "burnham_hallock"}
    """
    lattice = _lattice(tuple(pair.shape[1:]), spacing, profile)
    along, value = _observations(pair.cpu().float(), lattice, spacing, dt, noise)
    filters = lattice.swirl[0] * along[0] + lattice.swirl[1] * along[1]
    basis = _smooth(along, value, lattice)
    difference = value[0] - basis @ (basis.T @ value[0])
    common = filters @ basis
    normal = filters @ filters.T - common @ common.T
    force = filters @ difference
    gain, *_ = _explained(normal, force)
    freedom = len(difference) - basis.shape[1] - 2
    variance = (difference.square().sum() - (gain * lattice.allowed).max()) / freedom
    # the blur correlates neighbours
    variance = (4 * math.pi * _BLUR**2) * variance.clamp(min=1e-6)
    spread = _CIRCULATION**2 * (1 - _CORRELATION**2)
    gain, upper, lower, determinant = _explained(
        normal / variance, force / variance, (1 / spread, -_CORRELATION / spread)
    )
    # relative to the determinant of the prior's inverse covariance
    score = (gain - (determinant * _CIRCULATION**2 * spread).log()) / 2
    score = torch.where(lattice.allowed & (upper > 0) & (lower < 0), score, -torch.inf)
    # of the prior's pairs, these have vortices of opposite and right sense
    right = 1 / 4 + math.asin(-_CORRELATION) / (2 * math.pi)
    ratio = score.flatten().logsumexp(0) - math.log(right * int(lattice.allowed.sum()))
    p, q = divmod(int(score.argmax()), len(score))
    if not bool(torch.isfinite(score[p, q])):
        return Likelihoods(float(ratio), None)
    radius = math.log(lattice.radius)
    port, starboard = (
        [float(circulation[p, q]), radius, *lattice.place[at].tolist()]
        for circulation, at in ((upper, p), (lower, q))
    )
    pair = torch.tensor([*port, *starboard, 0.0, 0.0], dtype=torch.float64)
    return Likelihoods(float(ratio), pair)


def _observations(
    pair: torch.Tensor, lattice: _Lattice, spacing: tuple[float, float], dt: float, noise: float
) -> tuple[torch.Tensor, torch.Tensor]:
    """-dt times the slopes (2, n), per m, and difference, mean and 1 (3, n), of unit variance."""
    (rows, columns), (row_slopes, column_slopes) = lattice.blur, lattice.slope
    mean, difference = pair.mean(0), pair[1] - pair[0]
    slope = torch.stack(
        [
            (rows @ mean @ column_slopes.T).flatten() / spacing[0],
            (row_slopes @ mean @ columns.T).flatten() / spacing[1],
        ]
    )
    blurred = [(rows @ image @ columns.T).flatten() for image in (difference, mean)]
    values = torch.stack([*blurred, torch.ones_like(blurred[0])])
    passed = 1 / (4 * math.pi * (_BLUR * lattice.stride) ** 2)
    by_flow = _MODEL_ERROR**2 * spacing[0] * spacing[1] * slope.square().sum(0)
    # some noise at least: images without any have slopes that are 0 somewhere
    little = 1e-6 * blurred[0].square().mean() + 1e-12
    root = (2 * noise**2 * passed + by_flow + little).rsqrt()
    return -dt * slope * root, values * root


def _smooth(along: torch.Tensor, value: torch.Tensor, lattice: _Lattice) -> torch.Tensor:
    """Orthonormal columns (n, 18) of smooth winds and changes of brightness."""
    wind = along[:, None] * lattice.quadratic
    brightness = value[1:, None] * lattice.linear
    return torch.linalg.qr(torch.cat([*wind, *brightness]).T)[0]


def _explained(
    normal: torch.Tensor, force: torch.Tensor, prior: tuple[float, float] = (0.0, 0.0)
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
    """Reduction of the misfit by every pair of columns, the amplitudes of both, the determinant.

    `prior` is the inverse covariance of the amplitudes: on and off its diagonal.
    """
    power, common = normal.diagonal() + prior[0], normal + prior[1]
    determinant = power[:, None] * power - common**2
    # two vortices in one place are none
    determinant = torch.where(determinant > 1e-5 * power[:, None] * power, determinant, torch.inf)
    first = (force[:, None] * power - force * common) / determinant
    second = first.T
    return first * force[:, None] + second * force, first, second, determinant


@lru_cache(maxsize=4)
def _lattice(shape: tuple[int, int], spacing: tuple[float, float], profile: Profile) -> _Lattice:
    """That of images of so many rows and columns; slabs of a flight have few sizes."""
    stride = max(2, round((shape[0] * shape[1] / _OBSERVATIONS) ** 0.5))
    kernels = [_kernels(number, stride) for number in shape]
    sides = torch.tensor([(shape[1] - 1) * spacing[0], (shape[0] - 1) * spacing[1]])
    place, inside = _places(sides)
    z, y = (at * step for (at, _, _), step in zip(kernels, spacing[::-1], strict=True))
    z, y = (part.flatten() for part in torch.meshgrid(z, y, indexing="ij"))
    radius = _RADIUS * float(sides.min())
    dy, dz = y - place[:, :1], z - place[:, 1:]
    omega = swirl((dy**2 + dz**2) / radius**2, profile) / (2 * math.pi * radius**2)
    one, y, z = torch.ones_like(y), 2 * y / sides[0] - 1, 2 * z / sides[1] - 1
    separation = torch.cdist(place, place)
    return _Lattice(
        stride,
        (kernels[0][1], kernels[1][1]),
        (kernels[0][2], kernels[1][2]),
        place,
        torch.stack([-dz * omega, dy * omega]),
        torch.stack([one, y, z]),
        torch.stack([one, y, z, y * y, y * z, z * z]),
        (separation > 3 * radius) & (inside[:, None] | inside),
        radius,
    )


def _places(sides: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Places (n, 2) of vortices, m, half as dense along each axis beyond the image; which are in.

    Sides along y and z, m.
    """
    step = float(sides.prod() / _PLACES) ** 0.5
    axes, even = [], []
    for side in sides.tolist():
        number = max(2, round(side / step))
        index = torch.arange(-round(_BEYOND * number), number + round(_BEYOND * number))
        axes.append((index + 0.5) * side / number)
        even.append(index % 2 == 0)
    place = torch.stack(torch.meshgrid(*axes, indexing="ij"), -1).flatten(0, 1)
    sparse = (even[0][:, None] & even[1]).flatten()
    inside = ((place > 0) & (place < sides)).all(1)
    some = inside | sparse
    return place[some], inside[some]


def _kernels(number: int, stride: int) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Places (px) of observations along an axis, and weights of its pixels in value and slope.

    Weights of a Gaussian over the pixels that there are, and their derivatives by the place.
    """
    blur = _BLUR * stride
    count = max(1, int((number - 1 - 2 * blur) // stride) + 1)
    at = torch.arange(count) * float(stride) + (number - 1 - (count - 1) * stride) / 2
    away = torch.arange(number) - at[:, None]
    kernel = torch.exp(-(away**2) / (2 * blur**2))
    turned = kernel * away / blur**2
    total = kernel.sum(1, keepdim=True)
    weights = kernel / total
    return at, weights, (turned - weights * turned.sum(1, keepdim=True)) / total
