"""The periodic pattern of an etalon's rings in their mean over circles: spacing and lines.

The transmission is Airy's, of a gap that scatters by a Gaussian, periodic in order (Born & Wolf
1999, section 7.6; Vaughan 1989, The Fabry-Perot interferometer, chapter 3):

    P(m) = 1 + 2 sum_n exp(-n loss - n^2 spread) cos(2 pi n m),  loss = -ln R

and over the squared radius q a line of fractional order f at the centre gives P(q / spacing - f).
"""

import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.optimize import least_squares

LINES = 3  # largest number of lines
MULTIPLES = 6  # the strongest period may be this harmonic of the order
FAINT = 0.02  # of the strongest line, the least height of a line
SIGNIFICANT = 5.0  # standard errors, likewise
FLANK = 0.2  # likewise, of a line within 1.2 widths of another
CREST = 0.5  # of a line's height, its least crest: a line twice as broad has as much
DISTINCT = 0.8  # full widths, the least distance of lines
MATERIAL = 2e-3  # of the pattern's power, the least that a longer spacing must explain in addition
DOUBTFUL = 4.0  # factor from MATERIAL within which the choice of the spacing is doubtful
HARMONICS = 15  # of the strongest wave, that a period may have
ORDERS = 1.6  # least number of orders in the image
MOST_HARMONICS = 400  # of a line's shape


@dataclass(frozen=True)
class Pattern:
    """Lines of an etalon over the squared radius.

    spacing: px^2 per order.
    fraction (lines,): fractional order at the centre, 0 to 1, ascending.
    height (lines,): relative to the highest.
    loss, spread: of Airy's formula, see above.
    unexplained: weighted sum of squared residuals.
    power: weighted sum of squares of the pattern, less its background.
    freedom: annuli less parameters.
    """

    spacing: float
    fraction: np.ndarray
    height: np.ndarray
    loss: float
    spread: float
    unexplained: float = math.inf
    power: float = 0.0
    freedom: int = 1

    @property
    def width(self) -> float:
        """Full width of a line at half of its height over its lowest value, orders."""
        phase = np.linspace(0, 0.5, 513)
        shape = _sums(_harmonics(phase, self.loss, np.full(513, self.spread)), np.zeros(1))[0]
        middle = (shape[0] + shape[-1]) / 2
        return 2 * float(np.interp(-middle, -shape, phase))

    def phase(self, r2: np.ndarray) -> np.ndarray:
        """Order from each line's ring of order 0, (lines, annuli)."""
        return r2 / self.spacing - self.fraction[:, None]


def airy(phase: np.ndarray, loss: float, spread: np.ndarray) -> np.ndarray:
    """P of the module's formula and its derivatives by phase, loss and spread, (4, annuli)."""
    return _derivatives(_harmonics(phase, loss, spread), np.zeros(1))[:, 0]


def _harmonics(phase: np.ndarray, loss: float, spread: np.ndarray) -> np.ndarray:
    """exp(-n loss - n^2 spread + 2 pi i n phase) from n = 1 on, complex, (n, annuli)."""
    n = np.arange(1, MOST_HARMONICS + 1)
    weight = np.exp(-n * loss - n**2 * spread.min())
    # harmonics that neither P nor a derivative needs
    small = np.flatnonzero((weight < 1e-5) & (n * weight < 1e-4))
    waves = np.empty((small[0] + 1 if small.size else len(n), len(phase)), complex)
    # recursion: exp(-n^2 spread) falls by exp(-(2 n - 1) spread)
    factor = np.exp(2j * np.pi * phase - loss - spread)
    fall = np.exp(-2 * spread)
    before = np.ones(1)
    for wave in waves:
        np.multiply(before, factor, out=wave)
        factor *= fall
        before = wave
    return waves


def _sums(waves: np.ndarray, fraction: np.ndarray) -> np.ndarray:
    """P of lines at these fractional orders, (lines, annuli)."""
    n = np.arange(1, len(waves) + 1)
    return 1 + 2 * _product(np.exp(-2j * np.pi * n * fraction[:, None]), waves).real


def _derivatives(waves: np.ndarray, fraction: np.ndarray) -> np.ndarray:
    """P, its derivatives by phase, loss and spread, (4, lines, annuli)."""
    n = np.arange(1, len(waves) + 1)
    by = 2 * np.stack([np.ones(len(n)), 2j * np.pi * n, -n, -(n**2)])
    turned = by[:, None] * np.exp(-2j * np.pi * n * fraction[:, None])
    derivatives = _product(turned.reshape(-1, len(n)), waves).real.reshape(4, len(fraction), -1)
    derivatives[0] += 1
    return derivatives


def _product(left: np.ndarray, right: np.ndarray) -> np.ndarray:
    # by torch, on its number of threads: those of numpy wait for each other on a busy machine
    return (torch.from_numpy(left) @ torch.from_numpy(right)).numpy()


def blur(r2: np.ndarray, step: float, spacing: float) -> np.ndarray:
    """Increase of the spread by averages over a pixel and an annulus: their variances in order."""
    return 2 * np.pi**2 * (r2 / 3 + step**2 / 12) / spacing**2


class Profile:
    """A mean over circles that patterns are fitted to, its annuli weighted."""

    def __init__(self, r2: np.ndarray, value: np.ndarray, weight: np.ndarray, step: float):
        known = weight > 0
        self.r2, self.value, self.step = r2[known], value[known], step
        self.root = np.sqrt(weight[known] / weight[known].mean())
        self.last = float(self.r2[-1])
        q = self.r2 / self.last
        self.background = np.column_stack([np.ones_like(q), np.sqrt(q), q])
        self._stored: tuple[float, float, float] | None = None
        self._waves = np.empty((0, len(q)), complex)

    def waves(self, pattern: Pattern) -> np.ndarray:
        """Harmonics of a line at order 0; those of the last pattern are stored."""
        shape = pattern.spacing, pattern.loss, pattern.spread
        if shape != self._stored:
            spread = pattern.spread + blur(self.r2, self.step, pattern.spacing)
            self._waves = _harmonics(self.r2 / pattern.spacing, pattern.loss, spread)
            self._stored = shape
        return self._waves

    def columns(self, pattern: Pattern) -> np.ndarray:
        """Weighted columns of the linear parameters: background, then each line's envelope."""
        q = self.r2 / self.last
        orders = self.last / pattern.spacing
        # over few orders an envelope cannot be separated from the background
        degree = 0 if orders < 2.2 else 1 if orders < 4 else 2
        lines = [
            wave * q**k
            for wave in _sums(self.waves(pattern), pattern.fraction)
            for k in range(degree + 1)
        ]
        return np.column_stack([self.background, *lines]) * self.root[:, None]

    def residual(self, pattern: Pattern) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Weighted residual, columns and linear parameters of least squares."""
        columns = self.columns(pattern)
        linear = np.linalg.solve(_squares(columns), columns.T @ (self.value * self.root))
        return self.value * self.root - columns @ linear, columns, linear

    def matched(
        self, pattern: Pattern, bins: int = 64
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Fractions, height that a further line at each would have, its error for unit noise.

        On a line of the pattern a further one is not determined: its height is anything.
        """
        residual, columns, _ = self.residual(pattern)
        fraction = np.arange(bins) / bins
        shape = _sums(self.waves(pattern), fraction) * self.root
        shape = shape - np.linalg.solve(_squares(columns), columns.T @ shape.T).T @ columns.T
        square = np.maximum((shape**2).sum(1), 1e-9)
        return fraction, shape @ residual / square, 1 / np.sqrt(square)

    def fitted(self, pattern: Pattern, free_spacing: bool = True) -> Pattern:
        """The pattern by nonlinear least squares from a start; heights may come out negative."""
        start = np.array([1.0, *pattern.fraction, pattern.loss, pattern.spread])
        lines = len(pattern.fraction)
        reach = 0.06 if free_spacing else 0.02
        low = np.array([1 - reach, *pattern.fraction - 0.3, 0.01, 0.0])
        high = np.array([1 + reach, *pattern.fraction + 0.3, 6.0, 4.0])

        def made(x: np.ndarray) -> Pattern:
            return replace(
                pattern,
                spacing=pattern.spacing * x[0],
                fraction=x[1 : 1 + lines],
                loss=x[-2],
                spread=x[-1],
            )

        solution = least_squares(
            lambda x: self.residual(made(x))[0],
            start.clip(low + 1e-9, high - 1e-9),
            jac=lambda x: self._slopes(made(x), pattern.spacing),
            bounds=(low, high),
            x_scale=np.array([0.01, *[0.03] * lines, 0.3, 0.1]),
            max_nfev=40,
            ftol=1e-7,
            xtol=1e-6,
        )
        best = made(solution.x)
        residual, columns, linear = self.residual(best)
        wave = columns[:, 3:] @ linear[3:]
        # power of the pattern less the part that a background would explain
        basis = np.linalg.qr(columns[:, :3])[0]
        wave = wave - basis @ (basis.T @ wave)
        per_line = linear[3:].reshape(lines, -1)
        # envelopes are compared at 0.3 of the largest r^2, where most images have rings
        middle = 0.3 ** np.arange(per_line.shape[1])
        height = per_line @ middle
        top = np.abs(height).max() or 1.0
        return replace(
            best,
            height=height / top,
            unexplained=float(residual @ residual),
            power=float(wave @ wave),
            freedom=max(len(residual) - len(linear) - len(solution.x), 1),
        )

    def _slopes(self, pattern: Pattern, unit: float) -> np.ndarray:
        """Derivatives of the residual by spacing / unit, fractions, loss and spread.

        Linear parameters follow along (Kaufman 1975, BIT 15, 49).
        """
        _, columns, linear = self.residual(pattern)
        _, slope, by_loss, by_spread = _derivatives(self.waves(pattern), pattern.fraction)
        per_line = linear[3:].reshape(len(pattern.fraction), -1)
        q = self.r2 / self.last
        height = per_line @ np.stack([q**k for k in range(per_line.shape[1])]) * self.root
        rows = [
            (height * slope).sum(0) * self.r2 * unit / pattern.spacing**2,
            *(height * slope),
            -(height * by_loss).sum(0),
            -(height * by_spread).sum(0),
        ]
        slopes = np.stack(rows, 1)
        return slopes - columns @ np.linalg.solve(_squares(columns), columns.T @ slopes)

    def top(self, pattern: Pattern) -> float:
        """Height of the highest line, in the profile's unit."""
        linear = self.residual(pattern)[2][3:].reshape(len(pattern.fraction), -1)
        return float(np.abs(linear @ 0.3 ** np.arange(linear.shape[1])).max())

    def crest(self, pattern: Pattern) -> np.ndarray:
        """Value at each line less that one width to either side, without the other lines.

        Mean over the orders.
        """
        _, columns, linear = self.residual(pattern)
        lines = len(pattern.fraction)
        waves = columns[:, 3:].reshape(len(self.r2), lines, -1) / self.root[:, None, None]
        parts = (waves * linear[3:].reshape(lines, -1)).sum(2)
        crests = []
        for line, fraction in enumerate(pattern.fraction):
            alone = self.value - parts.sum(1) + parts[:, line]
            orders = np.arange(1, self.last / pattern.spacing - 1)
            place = (orders + fraction) * pattern.spacing
            width = pattern.width * pattern.spacing
            middle, low, high = (
                np.interp(place + by, self.r2, alone) for by in (0.0, -width, width)
            )
            crests.append((middle - (low + high) / 2).mean() if len(place) else np.inf)
        return np.array(crests)

    def height_std(self, pattern: Pattern, noise: float) -> np.ndarray:
        """Standard errors of the relative heights for weighted noise of that variance."""
        _, columns, linear = self.residual(pattern)
        lines = len(pattern.fraction)
        middle = 0.3 ** np.arange((columns.shape[1] - 3) // lines)
        pick = np.kron(np.eye(lines), middle)
        height = pick @ linear[3:]
        covariance = noise * np.linalg.inv(_squares(columns))[3:, 3:]
        return np.sqrt(np.diag(pick @ covariance @ pick.T)) / (np.abs(height).max() or 1.0)


def _squares(columns: np.ndarray) -> np.ndarray:
    """Normal matrix, regular also where lines coincide."""
    matrix = columns.T @ columns
    matrix[np.diag_indices(len(matrix))] *= 1 + 1e-10
    return matrix


def strongest_period(profile: Profile) -> float:
    """Period of the wave that, added to a smooth background, explains most."""
    q = profile.r2 / profile.last
    columns = np.column_stack([profile.background, q**2]) * profile.root[:, None]
    basis = np.linalg.qr(columns)[0]
    value = profile.value * profile.root
    value = value - basis @ (basis.T @ value)
    # a period of fewer than six annuli is not resolved
    number = min(len(q) // 6, 150)

    def strongest(frequencies: np.ndarray) -> float:
        wave = np.exp(2j * np.pi * frequencies[:, None] * q) * profile.root
        wave = wave - (wave @ basis) @ basis.T
        along, length, mixed = wave @ value, (np.abs(wave) ** 2).sum(1), (wave**2).sum(1)
        # squared projection onto the plane of a wave's real and imaginary part
        power = 2 * (length * np.abs(along) ** 2 - (mixed.conj() * along**2).real)
        return frequencies[np.argmax(power / (length**2 - np.abs(mixed) ** 2))]

    coarse = strongest(np.arange(1.2, number, 1 / 8))
    return profile.last / strongest(coarse + np.arange(-32, 33) / 256)


def _folded(profile: Profile, period: float, highest: float) -> float:
    """Residual power of a profile after a fit of waves of a period, up to a frequency in 1/px^2."""
    q = profile.r2 / profile.last
    wave = np.exp(2j * np.pi * profile.r2[:, None] / period * np.arange(1, 1 + highest * period))
    columns = np.hstack([profile.background, wave.real, wave.imag])
    columns = np.hstack([columns, q[:, None] * columns[:, 3:]]) * profile.root[:, None]
    value = profile.value * profile.root
    along = columns.T @ value
    return float(value @ value - along @ np.linalg.solve(_squares(columns), along))


def lines_at(profile: Profile, spacing: float, noise: float, most: int = LINES) -> Pattern | None:
    """The fewest lines at about one spacing that explain a profile; None if there are none.

    A further line must be higher than its standard error allows, and twice as high as the
    residual at other orders, where a shape that is not Airy's appears.
    """
    starts = [_first(profile, spacing, loss) for loss in (0.12, 0.35, 0.9)]
    best = profile.fitted(min(starts, key=lambda p: float((profile.residual(p)[0] ** 2).sum())))
    if best.height[0] <= 0:
        return None
    chosen, further = best, profile.matched(best)
    while len(best.fraction) < most:
        expected = noise * (best.freedom + SIGNIFICANT * math.sqrt(2 * best.freedom))
        if best.unexplained < max(expected, FAINT**2 / 4 * best.power):
            break
        # two further lines may be needed before either helps
        tried = sorted(
            map(profile.fitted, _starts(best, further, most)), key=lambda p: p.unexplained
        )
        # three lines that were chosen stay where two are the start of others
        better = (c for c in tried if c.unexplained < chosen.unexplained)
        chosen = next((c for c in better if _plausible(c, profile, noise)), chosen)
        best = next((candidate for candidate in tried if len(candidate.fraction) < most), tried[0])
        further = profile.matched(best)
        if best.height.min() <= 0:
            break
    return _sorted(chosen)


def _first(profile: Profile, spacing: float, loss: float) -> Pattern:
    """One line of that width where it explains most."""
    none = np.zeros(0)
    fraction, height, std = profile.matched(Pattern(spacing, none, none, loss, 0.0))
    return Pattern(spacing, fraction[[(height / std).argmax()]], np.ones(1), loss, 0.0)


def _starts(pattern: Pattern, further: tuple[np.ndarray, ...], most: int) -> list[Pattern]:
    """Further lines: where `Profile.matched` explains most, or the highest one in two or three."""
    fraction, height, height_std = further
    top = int(pattern.height.argmax())
    others = np.delete(pattern.fraction, top)
    half = max(0.35 * pattern.width, 0.02)
    added = replace(
        pattern, fraction=np.append(pattern.fraction, fraction[(height / height_std).argmax()])
    )
    narrow = replace(pattern, loss=max(pattern.loss / 2, 0.05), spread=pattern.spread / 4)
    three = np.array([-1, 0, 1])
    parts = [half * three[::2], 1.4 * half * three, 2.2 * half * three]
    split = [
        replace(narrow, fraction=np.append(others, pattern.fraction[top] + part))
        for part in parts
        if len(others) + len(part) <= most
    ]
    return [replace(start, height=np.ones(len(start.fraction))) for start in (added, *split)]


def _plausible(pattern: Pattern, profile: Profile, noise: float) -> bool:
    if pattern.height.min() <= 0:
        return False
    fractions = pattern.fraction % 1
    fraction = np.sort(fractions)
    distance = np.diff(np.append(fraction, fraction[0] + 1))
    std = profile.height_std(pattern, noise)
    top = profile.top(pattern)
    _, further, further_std = profile.matched(pattern)
    above_noise = np.abs(further) > SIGNIFICANT * math.sqrt(noise) * further_std
    floor = np.abs(further[above_noise]).max(initial=0.0) / top
    least = np.maximum(SIGNIFICANT * std, max(FAINT, 2 * floor))
    if (pattern.height < least).any() or distance.min() < DISTINCT * pattern.width:
        return False
    # a line away from the others has a crest of its own, which their wings have not; one in a
    # flank must be high, or it mends a shape that is not Airy's
    nearest = np.minimum(distance, np.roll(distance, 1))[np.argsort(np.argsort(fractions))]
    crest = profile.crest(pattern) / top > CREST * pattern.height
    separate = nearest > 1.2 * pattern.width
    return bool(np.where(separate, crest, pattern.height > FLANK).all())


def _sorted(pattern: Pattern) -> Pattern:
    fraction = pattern.fraction % 1
    order = np.argsort(fraction)
    return replace(pattern, fraction=fraction[order], height=pattern.height[order])


def find_pattern(
    profile: Profile, noise: float, spacing: float | None = None
) -> tuple[Pattern, str] | None:
    """Spacing and lines, and in words how the spacing could be another; None without a pattern.

    The strongest wave of the profile is a harmonic of the order. Of its multiples the shortest
    wins, unless a longer one explains a fraction MATERIAL more of the pattern's power: lines at
    equal distances cannot be distinguished from one line of a shorter spacing.
    """
    if spacing is not None:
        pattern = lines_at(profile, spacing, noise)
        return None if pattern is None else (pattern, "")
    base = strongest_period(profile)
    tried: dict[int, Pattern] = {}
    multiples = [m for m in range(1, MULTIPLES + 1) if profile.last >= ORDERS * m * base]
    residual = [_folded(profile, m * base, HARMONICS / base) for m in multiples]
    for multiple, remaining in zip(multiples, residual, strict=True):
        power = max((p.power for p in tried.values()), default=math.inf)
        first = min(tried.values(), key=lambda p: p.unexplained, default=None)
        # no shape of this period explains materially more than what has been tried
        less = (min(residual[: multiples.index(multiple)], default=math.inf)) - remaining
        if first is not None and less < MATERIAL / DOUBTFUL * power:
            continue
        pattern = lines_at(profile, multiple * base, noise)
        if pattern is not None:
            tried[multiple] = pattern
    if not tried:
        return None
    power = max(p.power for p in tried.values())

    def gain(short: int, long: int) -> float:
        """Of the pattern's power, what the longer spacing explains in addition; 0 for noise."""
        more = tried[short].unexplained - tried[long].unexplained
        if more < 40 * noise or repeats(tried[long]):
            return 0.0
        return more / power

    for chosen in tried:
        gains = {m: gain(chosen, m) for m in tried if m > chosen}
        if max(gains.values(), default=0.0) < MATERIAL:
            break
    doubt = [m for m, g in gains.items() if g > MATERIAL / DOUBTFUL]
    doubts = ""
    if doubt:
        doubts = f"the spacing may be {doubt[0] / chosen:.3g} times as large, with further lines"
    shorter = [m for m in tried if m < chosen and chosen % m == 0]
    if not doubts and shorter and gain(shorter[-1], chosen) < DOUBTFUL * MATERIAL:
        doubts = f"the spacing may be {chosen // shorter[-1]} times smaller, with fewer lines"
    return tried[chosen], doubts


def repeats(pattern: Pattern) -> bool:
    """Whether two or three lines are at equal distances and of one height."""
    lines = len(pattern.fraction)
    if lines < 2:
        return False
    steps = np.diff(np.append(pattern.fraction, pattern.fraction[0] + 1))
    return bool(np.ptp(steps) < 0.02 and pattern.height.min() > 0.9)
