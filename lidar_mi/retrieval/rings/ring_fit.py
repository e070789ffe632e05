"""All rings of a pattern at once: their radii, centre and shape, with standard errors that hold.

Least squares over the cells of `sectors.Sectors`. Every sector has a background and a height of
its own, both smooth in r: illumination, vignetting and sloping light do not enter. The standard
errors come from the residuals alone, sector by sector, so that nothing needs to be known of the
camera: the sectors' scores are summed with their neighbours' in a window as wide as their
correlation (Newey and West 1987, Econometrica 55, 703; Andrews 1991, Econometrica 59, 817), and
scaled to be exact for white noise. Where errors of neighbouring sectors correlate, as by uneven
plates, the fit absorbs much of them. Then errors follow from the change of the fit without a block
of sectors (jackknife: Bell and McCaffrey 2002, Survey Methodology 28, 169), each line of its own.
"""

import warnings
from dataclasses import dataclass, replace

import numpy as np
import torch

from lidar_mi.errors import InputError
from lidar_mi.retrieval.likelihood.scoring import inverse_of
from lidar_mi.retrieval.rings.alignment import ALL_AROUND, LEAST, shape_columns
from lidar_mi.retrieval.rings.frames import inside
from lidar_mi.retrieval.rings.pattern import Pattern, airy, blur
from lidar_mi.retrieval.rings.sectors import SECTORS, Hidden, RingCurves, Sectors

BLOCKS = 6  # of neighbouring sectors, one of which is omitted
OUTLIER = 6.0  # standard deviations of an annulus's cells
ROUNDS = 6
HIDDEN = 0.3  # of the usual ring, the height below which a ring is hidden
TWO_RINGS = 2.2  # orders, least extent of a sector whose height may change with r


@dataclass(frozen=True)
class CurveFit:
    """Rings, with the covariance of everything fitted.

    order, line (arrays (rings,) of int)
    square (rings,): squared mean radius, px^2.
    square_covariance (rings, rings)
    geometry_covariance (6, 6): of centre, ellipticity and tilt; 0 for what is not fitted.
    model_covariance (rings, rings): for white noise of variance 1, which gives the weights of the
        rings.
    roundness: rms deviation of the crests from the curves, px.
    uneven: whether deviations of neighbouring sectors' crests correlate.
    """

    geometry: RingCurves
    pattern: Pattern
    sectors: Sectors
    order: np.ndarray
    line: np.ndarray
    square: np.ndarray
    square_covariance: np.ndarray
    geometry_covariance: np.ndarray
    model_covariance: np.ndarray
    roundness: float
    uneven: bool


def fit_all(
    image: np.ndarray,
    geometry: RingCurves,
    pattern: Pattern,
    free: bool,
    hidden: Hidden | None = None,
) -> CurveFit:
    """Gauss-Newton from a geometry and a pattern that are nearly right.

    Ellipticity and tilt are fitted if two rings are in half of the sectors.

    Raises InputError: fewer than two rings, or a centre outside the image.
    """
    deviation: dict[tuple[int, int], float] = {}
    for number in range(ROUNDS):
        sectors = Sectors(image, geometry, hidden)
        system = _System(sectors, pattern, deviation, free)
        if not system.fitted[2:].any() and any((*geometry.ellipticity, *geometry.tilt)):
            # a shape of an earlier round that is no longer fitted
            geometry = RingCurves(geometry.centre)
            sectors = Sectors(image, geometry, hidden)
            system = _System(sectors, pattern, deviation, free)
        step, std = system.solved()
        change, ring_change, heights, shape = system.parts(step)
        change_std = system.parts(std)[0]
        geometry = geometry.moved(change)
        inside(*geometry.centre, image.shape)
        if number == ROUNDS - 1 or (number and (np.abs(change) <= 0.05 * change_std + 1e-9).all()):
            break
        # a ring that its noise would move off its line stays where the pattern has it
        firm = system.parts(std)[1] < 0.1 * pattern.width
        deviation = {
            key: float(deviation.get(key, 0.0) + moved) if certain else 0.0
            for key, moved, certain in zip(system.keys, ring_change, firm, strict=True)
        }
        top = np.maximum(pattern.height + heights, 0.2 * pattern.height)
        pattern = replace(
            pattern,
            height=top / top.max(),
            loss=float(np.clip(pattern.loss + shape[0], 0.5 * pattern.loss, 2 * pattern.loss)),
            spread=float(np.clip(pattern.spread + shape[1], 0.0, 2 * pattern.spread + 0.05)),
        )
    covariance = system.covariance()
    rings = system.ring_slots
    moved = ring_change + np.array([deviation.get(key, 0.0) for key in system.keys])
    slots = np.ix_(rings, rings)
    whole = np.zeros((6, 6))
    place = np.flatnonzero(system.fitted)
    whole[np.ix_(place, place)] = covariance[: len(place), : len(place)]
    return CurveFit(
        geometry=geometry,
        pattern=pattern,
        sectors=sectors,
        order=system.order,
        line=system.line,
        square=(system.order + pattern.fraction[system.line] + moved) * pattern.spacing,
        square_covariance=covariance[slots] * pattern.spacing**2,
        geometry_covariance=whole,
        model_covariance=system.inverse[slots] * pattern.spacing**2,
        roundness=system.roundness(),
        uneven=system.width > 0,
    )


def hidden_rings(sectors: Sectors, pattern: Pattern | None) -> Hidden | None:
    """Where the rings of a pattern are lower than `HIDDEN` of the usual ring, for certain.

    The height of a ring in a sector is a least-squares fit over one order about it, with a level
    and a slope.
    """
    if pattern is None:
        return None
    first = int(pattern.height.argmax())
    fraction, q = float(pattern.fraction[first]), sectors.r2
    waves = [
        airy(of_line, pattern.loss, pattern.spread + blur(q, sectors.step, pattern.spacing))[0]
        for of_line in pattern.phase(q)
    ]
    rings = pattern.height @ np.stack(waves)
    number = np.floor(q / pattern.spacing - fraction + 1.5).astype(int)
    height, std = np.full((2, SECTORS, number[-1] + 1), np.nan)
    for k in range(number[-1] + 1):
        inside = number == k
        if inside.sum() < 4:
            continue
        part = np.stack([np.ones(inside.sum()), q[inside] / q[-1], rings[inside]], -1)
        count, value = sectors.count[:, inside], sectors.value[:, inside]
        matrix = np.einsum("sq,qk,ql->skl", count, part, part)
        firm = np.linalg.cond(matrix) < 1e10
        inverse = np.linalg.inv(matrix[firm])
        height[firm, k] = np.einsum("sl,sq,ql,sq->s", inverse[:, 2], count[firm], part, value[firm])
        std[firm, k] = np.sqrt(inverse[:, 2, 2] * sectors.profile_noise[inside].mean())
    firm = height > 5 * std
    if not firm.any():
        return None
    usual = np.quantile(height[firm], 0.8)
    which = height + 3 * std < HIDDEN * usual
    # the obstacle's edge runs through the neighbours
    which |= np.roll(which, 1, 0) | np.roll(which, -1, 0)
    return Hidden(pattern.spacing, fraction, which) if which.any() else None


class _System:
    """Normal equations of one round, sector by sector."""

    def __init__(
        self,
        sectors: Sectors,
        pattern: Pattern,
        deviation: dict[tuple[int, int], float],
        free: bool,
    ) -> None:
        self.sectors, self.pattern = sectors, pattern
        self.order, self.line, shared = _visible(sectors, pattern)
        shaped = bool((shared >= ALL_AROUND * SECTORS).sum() >= 2)
        self.fitted = np.repeat([free, shaped], [2, 4])
        self.keys = list(zip(self.order.tolist(), self.line.tolist(), strict=True))
        self.geometry_slots = int(self.fitted.sum())
        lines = len(pattern.fraction)
        q = sectors.r2
        shift = self._ring_shifts(q)
        known = np.array([deviation.get(key, 0.0) for key in self.keys])
        phase = pattern.phase(q)
        for j in range(lines):
            phase[j] -= known[self.line == j] @ shift[self.line == j]
        spread = pattern.spread + blur(q, sectors.step, pattern.spacing)
        wave, slope, by_loss, by_spread = np.stack(
            [airy(of_line, pattern.loss, spread) for of_line in phase], 1
        )
        height = pattern.height[:, None]
        along_q = (height * slope / pattern.spacing).sum(0)
        total = (height * wave).sum(0)
        # shared by all sectors: rings, further lines' heights, shape
        # the height of the highest line is that of the sectors, so it is not free a second time
        low = int(pattern.height.argmax())
        others = [j for j in range(lines) if j != low]
        shared = np.vstack(
            [
                -(height * slope)[self.line] * shift,
                wave[others],
                (height * by_loss).sum(0)[None],
                (height * by_spread).sum(0)[None],
            ]
        )
        self.others = others
        moved = -shape_columns(q, sectors.angle[:, None])[..., self.fitted] * along_q[:, None]
        q1 = q / q[-1]
        smooth = np.stack([np.ones_like(q), np.sqrt(q1), q1, total, q1 * total], -1)
        smooth = np.repeat(smooth[None], SECTORS, 0)
        # for a single ring a height gradient is hardly different from a shift
        extent = np.where(sectors.used > 0, q, 0).max(1)
        smooth[extent < TWO_RINGS * pattern.spacing, :, 4] = 0
        root = np.sqrt(sectors.used)
        keep = np.ones_like(root)
        # dust is only visible after a first fit without its mask
        for _ in range(2):
            weight = root * keep
            nuisance = smooth * weight[..., None]
            basis, triangle = np.linalg.qr(nuisance)
            # where a sector has too few cells, its columns are dependent
            firm = np.abs(np.diagonal(triangle, axis1=1, axis2=2))
            basis = basis * (firm > 1e-6 * firm.max(1, keepdims=True))[:, None, :]
            value = sectors.value * weight
            linear = np.stack(
                [np.linalg.lstsq(a, b, rcond=1e-8)[0] for a, b in zip(nuisance, value, strict=True)]
            )
            # height of the rings in the sector, by which its shifts change the values
            local = linear[:, 3, None] + linear[:, 4, None] * q1
            residual = sectors.value - np.einsum("sqk,sk->sq", smooth, linear)
            residual = residual - local * along_q * sectors.offset
            keep = keep * _undisturbed(residual, weight)
        columns = np.concatenate([moved, np.broadcast_to(shared.T, (SECTORS, *shared.T.shape))], -1)
        columns = columns * (local * root * keep)[..., None]
        residual = residual * root * keep
        self.columns = columns - basis @ (basis.transpose(0, 2, 1) @ columns)
        # background and height of each sector are eliminated: what is orthogonal to them remains
        absorbed = basis @ (basis.transpose(0, 2, 1) @ residual[..., None])
        residual = residual - absorbed[..., 0]
        self.ring_slots = self.geometry_slots + np.arange(len(self.order))
        turned = self.columns.transpose(0, 2, 1)
        self.matrix, self.score = turned @ self.columns, (turned @ residual[..., None])[..., 0]
        whole = self.matrix.sum(0)
        self.inverse = inverse_of(torch.from_numpy(whole), 1e-10).numpy()
        used = keep * root > 0
        cells = used.sum() - 5 * used.any(1).sum() - len(whole)
        self.variance = float((residual**2).sum() / max(cells, 1))
        self.width = self._width()

    def _ring_shifts(self, q: np.ndarray) -> np.ndarray:
        """Change of a line's order at every annulus per deviation of each ring, linear between."""
        shift = np.zeros((len(self.order), len(q)))
        for j in range(len(self.pattern.fraction)):
            of_line = np.flatnonzero(self.line == j)
            if not len(of_line):
                continue
            place = (self.order[of_line] + self.pattern.fraction[j]) * self.pattern.spacing
            for k, ring in enumerate(of_line):
                shift[ring] = np.interp(q, place, np.eye(len(of_line))[k])
        return shift

    def solved(self) -> tuple[np.ndarray, np.ndarray]:
        """Step of Gauss and Newton, and its standard errors for white noise."""
        return self.inverse @ self.score.sum(0), np.sqrt(self.variance * np.diag(self.inverse))

    def parts(self, vector: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Six of the geometry, one of each ring, of each line's height, two of the shape."""
        first, rings = self.geometry_slots, len(self.order)
        geometry = np.zeros(6)
        geometry[self.fitted] = vector[:first]
        heights = np.zeros(len(self.pattern.fraction))
        heights[self.others] = vector[first + rings : len(vector) - 2]
        return geometry, vector[first : first + rings], heights, vector[-2:]

    def covariance(self) -> np.ndarray:
        """Of all parameters, from the sectors' scores and their neighbours'."""
        return self._of_blocks() if self.width else self._of_neighbours()

    def _of_neighbours(self) -> np.ndarray:
        lag = np.abs(np.arange(SECTORS)[:, None] - np.arange(SECTORS))
        lag = np.minimum(lag, SECTORS - lag)
        # Bartlett's window: positive semidefinite, so that no variance is negative
        window = np.maximum(1 - lag / (1 + self.width), 0.0)
        meat = self.score.T @ window @ self.score
        # expectation for white noise of variance 1, less the part that the fit absorbs
        leverage = self.matrix @ self.inverse
        white = np.einsum("ss,sab->ab", window, self.matrix)
        white = white - np.einsum("st,sab,tcb->ac", window, leverage, self.matrix)
        expected = np.diag(self.inverse @ white @ self.inverse)
        scale = np.sqrt(np.diag(self.inverse) / np.maximum(expected, 1e-3 * np.diag(self.inverse)))
        return self.inverse @ meat @ self.inverse * np.outer(scale, scale)

    def _of_blocks(self) -> np.ndarray:
        """Squared changes of the fit without each block; mean over the offsets of the blocks."""
        whole = self.matrix.sum(0)
        size = np.sqrt(np.maximum(np.diag(whole), 1e-300))
        outer = np.outer(size, size)
        total = np.zeros_like(whole)
        length = SECTORS // BLOCKS
        for first in range(length):
            # the result must not depend on where the first block begins
            block = (np.arange(SECTORS) + first) // length % BLOCKS
            for number in range(BLOCKS):
                matrix = whole - self.matrix[block == number].sum(0)
                inverse = np.linalg.pinv(matrix / outer, 1e-8, hermitian=True) / outer
                change = inverse @ self.score[block == number].sum(0)
                total += np.outer(change, change) / length
        return total

    def _shifts(self) -> tuple[np.ndarray, np.ndarray]:
        """Shift of every ring in every sector, orders, NaN where it has none; its information."""
        slots = self.ring_slots
        information = self.matrix[:, slots, slots].T
        # where a sector has little of a ring, its shift would be noise
        least = 1e-2 * np.median(information[information > 0])
        shift = np.where(information > least, self.score[:, slots].T, np.nan)
        return shift / np.maximum(information, least), information

    def _width(self) -> float:
        """Sectors over which errors are correlated: Andrews' rule for an autoregression."""
        shift, information = self._shifts()
        reduced = np.nan_to_num(shift * np.sqrt(information))
        pairs = (reduced != 0) & (np.roll(reduced, 1, 1) != 0)
        product = (reduced * np.roll(reduced, 1, 1))[pairs].sum()
        power = (reduced**2)[pairs].sum()
        if not power > 0:
            return 0.0
        # the harmonics that the geometry takes make neighbours of white noise anticorrelated
        correlation = product / power + (1 + self.geometry_slots) / SECTORS
        # of white noise the estimate scatters by one over the root of the number of pairs
        if correlation < 2.5 / np.sqrt(pairs.sum()):
            return 0.0
        rho = min(correlation, 0.9)
        return min(1.1447 * (4 * rho**2 / (1 - rho**2) ** 2 * SECTORS) ** (1 / 3), SECTORS / 5)

    def roundness(self) -> float:
        """Rms deviation of the highest line's crests from the curves, px."""
        shift = self._shifts()[0]
        radius = np.sqrt((self.order + self.pattern.fraction[self.line]) * self.pattern.spacing)
        high = self.line == int(self.pattern.height.argmax())
        pixels = (shift * self.pattern.spacing / (2 * radius[:, None]))[high]
        return float(np.sqrt(np.nanmean(pixels**2)))


def _visible(sectors: Sectors, pattern: Pattern) -> np.ndarray:
    """Order, line and number of sectors of the rings in enough of them, by their radius."""
    rings = []
    present = (sectors.used > 0).sum(0)
    half = 0.5 * pattern.width * pattern.spacing
    for line, fraction in enumerate(pattern.fraction):
        for order in range(int(sectors.r2[-1] / pattern.spacing) + 1):
            place = (order + fraction) * pattern.spacing
            last = int((place + half) / sectors.step)
            if place > 2 * half and last < len(present) and present[last] >= LEAST:
                rings.append((place, order, line, present[last]))
    if len(rings) < 2:
        raise InputError(f"rings: {len(rings)} detected; expected at least 2")
    rings.sort()
    return np.array([f[1:] for f in rings]).T


def _undisturbed(residual: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Cells that are no dust and no reflection: near the median of their annulus."""
    reduced = np.where(weight > 0, residual * weight, np.nan)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # an annulus without cells
        off = reduced - np.nanmedian(reduced, 0)
        scale = 1.4826 * np.nanmedian(np.abs(off), 0)
    scale = np.nan_to_num(scale)
    kernel = np.ones(25) / 25
    smooth = np.convolve(np.pad(scale, 12, mode="edge"), kernel, "valid")
    limit = OUTLIER * np.maximum(smooth, scale)
    return np.where(np.isfinite(off), np.abs(off) <= limit + 1e-12, 0.0)
