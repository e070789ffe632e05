"""Departure of a flow from its model, and the error of the parameters that it causes.

A real flow is not two vortices. The departure moves the air by a smooth random field, taken to be
isotropic: each component has the covariance sum_j a_j exp(-h^2 / (2 L_j^2)) at the distance h.
In the residuals of a fit it is a displacement correlated between neighbours, in the parameters an
error that does not average out over pixels.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache, reduce

import numpy as np
import torch
from scipy.optimize import nnls

from lidar_mi.retrieval.images.band_limit import even_fast_len
from lidar_mi.retrieval.images.windows import linear_weights, separable

# Standard errors by which a departure must exceed what change and noise explain.
_SIGNIFICANT = 3.0
# Lengths L_j in steps of the grid; those up to 1/5 of its shorter side are used.
_LENGTHS = (3.0, 6.0, 12.0, 24.0, 48.0)
# Squares over which responses are summed, on grids whose shorter side is at least so long.
_SIDE, _LARGE = 4, 64


@dataclass(frozen=True)
class ModelError:
    """Covariance of each component of the flow's departure from the model.

    variances: a_j, m^2 (of displacements) or m^2 s^-2 (of winds).
    lengths: L_j, steps of the grid.
    """

    variances: tuple[float, ...] = ()
    lengths: tuple[float, ...] = ()

    @property
    def variance(self) -> float:
        """Of each component at a place."""
        return float(sum(self.variances))

    @property
    def density(self) -> float:
        """Spectral density of each component, in the mean over the waves that have its variance.

        Of a Gaussian covariance half of that at wavenumber 0: pi a_j L_j^2, per step squared.
        """
        pairs = zip(self.variances, self.lengths, strict=True)
        return float(np.pi * sum(variance * length**2 for variance, length in pairs))

    def covariance(self, distance: torch.Tensor) -> torch.Tensor:
        """At distances in steps of the grid."""
        total = torch.zeros_like(distance)
        for variance, length in zip(self.variances, self.lengths, strict=True):
            total = total + variance * torch.exp(-(distance**2) / (2 * length**2))
        return total


@dataclass(frozen=True)
class Lags:
    """Correlations of fields on a (z, y) grid, by Fourier transforms padded against wrapping.

    shape: of the grid.
    like: of the type and device to work in.
    reach: lags (steps of the grid) that do not wrap. Default: all of the grid.
    """

    shape: tuple[int, int]
    like: torch.Tensor
    reach: float = np.inf

    @property
    def sizes(self) -> list[int]:
        """Lengths of the padded Fourier transform along each axis."""
        return [even_fast_len(n + int(min(n, self.reach + 1))) for n in self.shape]

    def distance(self) -> torch.Tensor:
        """Of every lag, steps of the grid."""
        return _distance(*self.sizes, self.like.dtype, self.like.device)

    def between(self, shortest: float, longest: float = np.inf) -> torch.Tensor:
        """Numbers of the lags of `autocorrelation` from shortest to longest that do not wrap."""
        kind = self.like.dtype, self.like.device
        ends = float(shortest), float(min(longest, self.reach))
        return _between(*self.sizes, self.rows, *kind, *ends)

    @property
    def rows(self) -> int:
        """Of the lags of `autocorrelation`."""
        return 1 + int(min(self.sizes[0] // 2, self.reach))

    def transform(self, fields: torch.Tensor) -> torch.Tensor:
        """Fourier transform of fields, padded so that lags do not wrap."""
        rows, columns = self.sizes
        # rows of zeros are not transformed
        return torch.fft.fft(torch.fft.rfft(fields, n=columns), n=rows, dim=-2)

    def autocorrelation(
        self, fields: torch.Tensor | Sequence[torch.Tensor], weights: Sequence[float]
    ) -> torch.Tensor:
        """Sum over the fields of weight * sum_x f(x) f(x + lag), for lags of 0 or more along z.

        It is the same for the opposite lags.
        """
        waves = (self.transform(f) for f in fields)
        # a sum over a last axis of two takes six times as long
        power = reduce(
            torch.add,
            (w * (f.real.square() + f.imag.square()) for f, w in zip(waves, weights, strict=True)),
        )
        return self.by_lags(power)

    def by_lags(self, power: torch.Tensor) -> torch.Tensor:
        """Correlation of a (cross) power spectrum, for lags of 0 or more along z."""
        along_z = torch.fft.ifft(power, dim=0)[: self.rows]
        return torch.fft.irfft(along_z, n=self.sizes[1])

    def quadratic(self, fields: torch.Tensor, covariance: torch.Tensor) -> torch.Tensor:
        """Matrix sum_a sum_x,x' f_ia(x) C(x - x') f_ja(x') of fields (i, a, z, y), C by lags."""
        # a covariance has no negative power but by rounding and by its end at the longest lag
        spectrum = torch.fft.rfft2(covariance).real.clamp(min=0)
        # columns of a real transform stand for both signs, but for the first and the last
        double = torch.full_like(spectrum, 2.0)
        double[:, 0] = 1
        if self.sizes[1] % 2 == 0:
            double[:, -1] = 1
        root = (spectrum * double / (self.sizes[0] * self.sizes[1])).sqrt()
        total = fields.new_zeros(fields.shape[0], fields.shape[0])
        for component in fields.unbind(1):
            waves = torch.view_as_real(self.transform(component) * root).flatten(1)
            total += waves @ waves.T
        return total


def model_error(
    force: torch.Tensor,
    stiffness: torch.Tensor,
    shortest: float,
    change: torch.Tensor | None = None,
    response: "Response | None" = None,
    tested: bool = True,
) -> ModelError:
    """The departure from a model that explains the correlation of the residuals of its fit.

    With the residual r, its slope g and its weight w, the force is q = w g r and the stiffness
    A = w g g^T. A field of displacements with covariance C(h) adds C(h) tr sum A(x) A(x + h) to
    the correlation sum q(x) . q(x + h); noise that differs from pixel to pixel adds nothing at
    h > 0. The variances a_j >= 0 follow by least squares over the lags.

    force (2, z, y): q; zero where there is no residual.
    stiffness (3, z, y): A: yy, yz, zz.
    shortest: lags below this (steps of the grid) are not used, as noise may correlate over them.
    change: correlation by another cause, of unknown amplitude, by the lags of `lags_used`; see
        `of_change`.
    response: of the fit. With it the departure is that before the fit, which absorbs part of it:
        the residuals lack the expected part of a departure of each length (restricted maximum
        likelihood: Patterson & Thompson 1971, Biometrika 58, 545-554). Without it, the departure is
        that in the residuals.
    tested: whether a departure that is not significant is none; with `change` only.
    """
    lags = lags_used(force)
    observed = lags.autocorrelation(force, (1.0, 1.0))
    # tr A(x) A(x + h): the mixed element counts twice
    unit = lags.autocorrelation(stiffness, (1.0, 2.0, 1.0))
    lengths = _lengths(lags.shape)
    used = lags.between(shortest)
    scale = unit[0, 0]
    if not float(scale) > 0 or not len(used):
        return ModelError()
    distance = lags.distance()[: lags.rows]
    # in units of the stiffness at lag 0, so that the coefficients are the variances
    correlation, square = observed.take(used) / scale, distance.take(used).square()
    size = float(correlation.abs().max())
    if not size > 0:
        return ModelError()
    relative = unit.take(used) / scale
    columns = [relative * torch.exp(-square / (2 * n**2)) for n in lengths]
    if response is not None:
        taken = response.absorbed(stiffness, lags, lengths)
        columns = [c - part.take(used) / scale for c, part in zip(columns, taken, strict=True)]
    if change is not None:
        columns.append(change.take(used) / change.abs().max().clamp(min=1e-300))
    # normalised in both directions: least squares needs numbers near one
    amplitudes, _ = nnls(torch.stack(columns, 1).cpu().numpy(), (correlation / size).cpu().numpy())
    variances = amplitudes[: len(lengths)] * size
    if change is not None and tested:
        explained = scale * sum(
            a * column for a, column in zip(variances, columns[:-1], strict=True)
        )
        # of white noise the sum at a lag has the variance of that at lag 0 squared, over pixels
        below = lags.between(1.0, np.nextafter(shortest, 0))
        near = observed[0, 0] + 2 * observed.take(below).sum()
        noise = near / (force != 0).any(0).sum().sqrt()
        if not explained.square().sum().sqrt() > _SIGNIFICANT * noise:
            return ModelError()
    positive = [(float(a), n) for a, n in zip(variances, lengths, strict=True) if a > 0]
    return ModelError(tuple(a for a, _ in positive), tuple(n for _, n in positive))


# They depend on the grid alone and are stored for the next images.
@lru_cache(maxsize=8)
def _distance(rows: int, columns: int, dtype: torch.dtype, device: torch.device) -> torch.Tensor:
    along = [torch.fft.fftfreq(n, 1 / n, dtype=dtype, device=device) for n in (rows, columns)]
    return torch.hypot(along[0][:, None], along[1][None, :])


@lru_cache(maxsize=8)
def _between(
    rows: int,
    columns: int,
    positive: int,
    dtype: torch.dtype,
    device: torch.device,
    shortest: float,
    longest: float,
) -> torch.Tensor:
    distance = _distance(rows, columns, dtype, device)[:positive]
    chosen = (distance >= shortest) & (distance <= longest)
    # of opposite lags along y alone, one
    chosen[0, columns // 2 + 1 :] = False
    return chosen.flatten().nonzero()[:, 0]


def lags_used(like: torch.Tensor) -> Lags:
    """The lags that `model_error` looks at, of fields (..., z, y)."""
    rows, columns = like.shape[-2:]
    shape = rows, columns
    return Lags(shape, like, 2 * max(_lengths(shape)))


def _lengths(shape: tuple[int, int]) -> list[float]:
    side = min(shape)
    return [length for length in _LENGTHS if length <= side / 5] or [side / 5]


@dataclass(frozen=True)
class Response:
    """How the parameters of a fit follow a departure d of the flow: by H^-1 sum_x P(x) . d(x).

    force (p, 2, z, y): P: weight times slope times derivative by each parameter.
    inverse (p, p): H^-1.
    even (z, y): factor by which the forces are multiplied that are correlated; 1 by default.
    """

    force: torch.Tensor
    inverse: torch.Tensor
    even: torch.Tensor | float = 1.0

    def absorbed(
        self, stiffness: torch.Tensor, lags: Lags, lengths: Sequence[float]
    ) -> Iterator[torch.Tensor]:
        """What is missing in the correlation of `model_error` for each length, by lags.

        The force of a departure d is A d before the fit and A d - P a after it, with its response
        a; `stiffness` is A times `even`. For a unit variance the expectation of a d(x) is
        K(x) = H^-1 sum_x' P(x') C(x - x'), so that the missing part follows from the correlations
        of A K with P and of P with itself. They are sums over squares of 4 pixels, between
        which lags are interpolated.
        """
        side = _SIDE if min(lags.shape) >= _LARGE else 1
        force, correlated, stiff = (
            _sums(field, side) for field in (self.force, self.even * self.force, stiffness)
        )
        # as far as the longest covariance reaches
        rows, columns = force.shape[-2:]
        coarse = Lags((rows, columns), force, 2 * lags.reach / side)
        inverse = self.inverse.to(force)
        waves = coarse.transform(correlated)
        follow = torch.tensordot(inverse.to(waves), coarse.transform(force), 1)
        to_lags = _interpolation(lags, coarse, side)
        for length in lengths:
            # means over two squares of a Gaussian
            wide = (length / side) ** 2 + (1 - side**-2) / 6
            peak = (length / side) ** 2 / wide
            covariance = peak * torch.exp(-coarse.distance().square() / (2 * wide))
            spectrum = torch.fft.rfft2(covariance).real.clamp(min=0)
            # K of the docstring: the response to a departure correlated over this length
            back = torch.fft.ifft(follow * spectrum, dim=-2)[..., :rows, :]
            expected = torch.fft.irfft(back, n=coarse.sizes[1])[..., :columns]
            spread = torch.einsum("iazy,jazy->ij", expected, force) @ inverse
            first, second = expected.unbind(1)
            moved = torch.stack(
                [stiff[0] * first + stiff[1] * second, stiff[1] * first + stiff[2] * second], 1
            )
            # half of the last term: both orders of x and x + h are added below
            cross = coarse.transform(moved) - torch.tensordot(spread.to(waves), waves, 1) / 2
            power = 2 * (cross.conj() * waves).real.sum((0, 1))
            absorbed = coarse.by_lags(power) / side**2
            yield separable(torch.fft.fftshift(absorbed, 1), to_lags)


def _sums(field: torch.Tensor, side: int) -> torch.Tensor:
    """Sums of fields (..., z, y) over squares; what is missing at the edges is zero."""
    pad = [extra for n in reversed(field.shape[-2:]) for extra in (0, -n % side)]
    padded = torch.nn.functional.pad(field, pad).flatten(0, -3)
    return (side**2 * torch.nn.functional.avg_pool2d(padded, side)).unflatten(0, field.shape[:-2])


def _interpolation(lags: Lags, coarse: Lags, side: int) -> list[torch.Tensor]:
    """Matrices along z and y from lags of squares, those along y in ascending order, to `lags`."""
    columns = coarse.sizes[1]
    known = torch.arange(coarse.rows), torch.arange(columns) - columns // 2
    wanted = torch.arange(lags.rows), torch.fft.fftfreq(lags.sizes[1], 1 / lags.sizes[1])
    return [
        linear_weights(side * old.to(lags.like), new.to(lags.like))
        for old, new in zip(known, wanted, strict=True)
    ]


def of_change(residual: torch.Tensor, slope: torch.Tensor, valid: torch.Tensor) -> torch.Tensor:
    """Correlation of the force by residuals that do not depend on the slopes, by lags.

    Where air changes, the residuals correlate between neighbours for another reason than flow. Over
    the lag h they add R(h) sum s(x) . s(x + h) with the residuals' autocorrelation R and the
    weighted slopes s. Texture without long correlation has next to none of this at large lags.

    residual (z, y)
    slope (2, z, y): weighted.
    valid (z, y)
    """
    lags = lags_used(residual)
    # pairs of pixels at every lag
    number = lags.autocorrelation([valid.to(residual)], (1.0,)).clamp(min=1)
    correlation = lags.autocorrelation([valid * residual], (1.0,)) / number
    return correlation * lags.autocorrelation(slope, (1.0, 1.0))


def spread_of(responses: torch.Tensor, error: ModelError) -> torch.Tensor:
    """Covariance (p, p) of sum_x P_p(x) . d(x), d the field of the flow's error, P (p, 2, z, y)."""
    rows, columns = responses.shape[2:]
    lags = Lags((rows, columns), responses)
    if not error.variances:
        return responses.new_zeros(len(responses), len(responses))
    return lags.quadratic(responses, error.covariance(lags.distance()))


def mean_length(error: ModelError) -> float:
    """Length over which the error correlates, steps of the grid, weighted by variance."""
    return float(np.average(error.lengths, weights=error.variances)) if error.variances else 0.0
