"""Starting points for a fit of two vortices: every pair of places on a grid is tried.

For given places and core radius the wind is linear in the circulations and the mean wind, so each
pair's best circulations and misfit follow in closed form from sums over the observations.
"""

from collections.abc import Iterator
from typing import NamedTuple

import torch

from lidar_mi.retrieval.vortices.model import Profile, swirl, wind

# Places tried for each vortex, and core radii as fractions of the shorter side of the region.
_PLACES = 700
_RADII = (0.03, 0.08)
# Observations that are looked at together: their winds at all places stay near the cache.
_AT_ONCE = 2048


class Observations(NamedTuple):
    """Observed components of the wind: value = along . wind + noise, tensors of shape (n,).

    y, z: m.
    along (2, n): the component observed, times the conversion to the value's unit.
    weight: 1 / variance, up to a factor.
    brightness (m, n): changes of the values that are no wind, of unknown amplitudes.
    """

    y: torch.Tensor
    z: torch.Tensor
    along: torch.Tensor
    value: torch.Tensor
    weight: torch.Tensor
    brightness: torch.Tensor | None = None

    @property
    def everywhere(self) -> torch.Tensor:
        """Columns (n, 2 + m) of the mean wind and of the brightness."""
        parts = [self.along] if self.brightness is None else [self.along, self.brightness]
        return torch.cat(parts).T


def starting_points(observed: Observations, count: int, profile: Profile) -> torch.Tensor:
    """Parameters (up to `count`, 10) of pairs with the least misfit, best first.

    Vortices rotate in opposite directions; their separation is at least three core radii. Of each
    neighbourhood only the best pair is taken.
    """
    low, high, step = _region(observed)
    sides = (high - low).tolist()
    axes = [
        torch.linspace(float(a), float(b), max(2, round(side / step))).to(observed.y)
        for a, b, side in zip(low, high, sides, strict=True)
    ]
    place = torch.stack(torch.meshgrid(*axes, indexing="ij"), -1).flatten(0, 1)
    separation = torch.cdist(place, place)
    # weighted once: all that follows is ordinary least squares
    root = observed.weight.sqrt()
    uniform = torch.linalg.qr(observed.everywhere * root[:, None])[0]
    value = observed.value * root
    value = value - uniform @ (uniform.T @ value)
    points = []
    for fraction in _RADII:
        radius = fraction * min(sides)
        normal, across = (
            place.new_zeros(len(place), n) for n in (len(place), uniform.shape[1] + 1)
        )
        for rows in torch.arange(len(root), device=root.device).split(_AT_ONCE):
            columns = _swirls(observed, rows, root, place, radius, profile)
            normal += columns.T @ columns
            across += columns.T @ torch.cat([uniform[rows], value[rows, None]], 1)
        # the vortices' winds without the part that a mean wind and brightness explain
        normal -= across[:, :-1] @ across[:, :-1].T
        # two vortices are two columns: their gain is in closed form for all pairs at once
        gain, first, second = _explained(normal, across[:, -1])
        gain = torch.where((first > 0) & (second < 0) & (separation > 3 * radius), gain, 0.0)
        for p, q in _peaks(gain, separation, count, 2.5 * step):
            vortices = [
                torch.cat([amplitude[p, q][None], radius_log[None], place[at]])
                for amplitude, at, radius_log in (
                    (first, p, value.new_tensor(radius).log()),
                    (second, q, value.new_tensor(radius).log()),
                )
            ]
            points.append((float(gain[p, q]), torch.cat([*vortices, value.new_zeros(2)])))
    points.sort(key=lambda pair: -pair[0])
    return (
        torch.stack(
            [_with_mean_wind(theta, observed, root, profile) for _, theta in points[:count]]
        )
        if points
        else value.new_empty(0, 10)
    )


def condensed(observed: Observations) -> Observations:
    """Two observations in place of all of a block, whose sides are the distance of the places.

    Of a wind u that is uniform over a block, observations a . u = d with weights w have the
    information of two of L^T u = L^-1 sum w a d, where L L^T = sum w a a^T (sufficient statistics
    of weighted least squares). Brightness is fitted and subtracted before.
    """
    low, high, step = _region(observed)
    root = observed.weight.sqrt()
    value, along = observed.value * root, observed.along * root
    if observed.brightness is not None:
        columns = (observed.brightness * root).T
        value = value - columns @ torch.linalg.lstsq(columns, value[:, None]).solution[:, 0]
    number = ((high - low) / step).floor().long() + 1
    place = torch.stack([observed.y, observed.z])
    column, row = torch.minimum(((place - low[:, None]) / step).long(), number[:, None] - 1)
    strength = along.square().sum(0)
    parts = torch.stack(
        [strength, along[0] ** 2, along[0] * along[1], *(along * value), *(strength * place)]
    )
    sums = parts.new_zeros(len(parts), int(number.prod()))
    sums.index_add_(1, row * number[0] + column, parts)
    sums = sums[:, sums[0] > 1e-6 * sums[0].max()]
    total, first, mixed = sums[:3]
    # a little stronger along y and z, as the observations of a block may all be along one line
    little = 1e-6 * total
    upper = (first + little).sqrt()
    mixed_root = mixed / upper
    lower = (total - first + little - mixed_root**2).clamp(min=0).sqrt().clamp(min=little.sqrt())
    one = sums[3] / upper
    two = (sums[4] - mixed_root * one) / lower
    y, z = (torch.cat([part, part]) for part in sums[5:] / total)
    return Observations(
        y,
        z,
        torch.stack([torch.cat([upper, torch.zeros_like(upper)]), torch.cat([mixed_root, lower])]),
        torch.cat([one, two]),
        torch.ones_like(y),
    )


def _region(observed: Observations) -> tuple[torch.Tensor, torch.Tensor, float]:
    """Least and largest y and z, and the distance between places."""
    low, high = torch.stack([observed.y, observed.z]).aminmax(dim=1)
    return low, high, float((high - low).prod() / _PLACES) ** 0.5


def _swirls(
    observed: Observations,
    rows: torch.Tensor,
    root: torch.Tensor,
    place: torch.Tensor,
    radius: float,
    profile: Profile,
) -> torch.Tensor:
    """Some weighted observations of vortices of unit circulation at each place, (n, places)."""
    dy, dz = observed.y[rows, None] - place[:, 0], observed.z[rows, None] - place[:, 1]
    value = swirl((dy**2 + dz**2) / radius**2, profile)
    scale = root[rows] / (2 * torch.pi * radius**2)
    along_y, along_z = observed.along[:, rows] * scale
    return (dy.mul_(along_z[:, None]) - dz.mul_(along_y[:, None])).mul_(value)


def _explained(
    normal: torch.Tensor, wanted: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Reduction of the misfit by every pair of columns, and the amplitudes of both."""
    power = normal.diagonal()
    determinant = power[:, None] * power - normal**2
    determinant = torch.where(determinant > 1e-6 * power[:, None] * power, determinant, torch.inf)
    first = (wanted[:, None] * power - wanted * normal) / determinant
    second = first.T
    return first * wanted[:, None] + second * wanted, first, second


def _peaks(
    gain: torch.Tensor, separation: torch.Tensor, count: int, distance: float
) -> Iterator[tuple[int, int]]:
    """The best pairs, none with both places within a distance of a better one's."""
    for _ in range(count):
        p, q = divmod(int(gain.argmax()), gain.shape[1])
        if not gain[p, q] > 0:
            return
        yield p, q
        gain = gain.masked_fill(
            (separation[p] < distance)[:, None] & (separation[q] < distance), 0.0
        )


def _with_mean_wind(
    theta: torch.Tensor, observed: Observations, root: torch.Tensor, profile: Profile
) -> torch.Tensor:
    """The parameters with the mean wind that fits the residual best."""
    swirl = (observed.along * wind(theta, observed.y, observed.z, profile)).sum(0)
    residual = observed.value - swirl
    free = torch.linalg.lstsq(observed.everywhere * root[:, None], (residual * root)[:, None])
    return torch.cat([theta[:8], free.solution[:2, 0]])
