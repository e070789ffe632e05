"""The air around a pair: a linear wind and turbulence, estimated and eliminated from a fit.

The wind is that of the pair, plus the mean wind at the pair, plus G (r - r_pair) + t(r). The
gradient G is normal about 0; t is isotropic turbulence of von Karman's spectrum. Its strength and
length are those that make the residuals of the fit most likely after the parameters have absorbed
their part (restricted likelihood: Patterson & Thompson 1971, Biometrika 58, 545-554), averaged over
their posterior. The parameters and their errors are then those of generalised least squares.
"""

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import torch
from scipy.linalg import lapack

from lidar_mi.retrieval.ground_winds.turbulence_covariance import correlations
from lidar_mi.retrieval.images.band_limit import even_fast_len
from lidar_mi.retrieval.images.windows import linear_weights, separable
from lidar_mi.retrieval.likelihood.scoring import inverse_of
from lidar_mi.retrieval.vortices.robust_fit import Solution

GRADIENT = 0.1
"""Standard deviation of dv/dy, dv/dz, dw/dy and dw/dz a priori, 1/s."""

LENGTHS = (15.0, 40.0, 100.0, 250.0)
"""Of turbulence, m, equally probable a priori."""

ALONG = 7.5
"""Distance along the path, m, over which the decay of the eddies' effect on the pair is stated."""

# Rms of each component, m/s, of uniform prior density, as close as 300 winds can tell them apart.
_SPREADS = np.geomspace(0.02, 5.0, 64)
# Of the weakest turbulence, the least error of a single residual that is told apart.
_FINEST = 1e-3
# Squares of pixels in which turbulence is uniform: at most so many.
_BLOCKS = 150
# Pixels beyond which the errors by turbulence are those of sums over two by two of them.
_FEW = 4000
# Core radius of a further vortex, m, and radii of the cores of the pair about which none is sought.
_CORE, _OWN = 2.5, 3.0
# Of a block's mean with another's: the difference of two Gauss points each, over its side.
_APART = (-(3**-0.5), 0.0, 3**-0.5)


class AmbientWind(NamedTuple):
    """Wind around a pair in addition to its mean wind; m, m/s.

    gradient (4,): dv/dy, dv/dz, dw/dy, dw/dz, 1/s.
    centre: y and z of its zero: half way between the vortices.
    eddies (2, rows, columns): v and w of the turbulence in the middle of blocks.
    z, y: of the blocks.
    """

    gradient: torch.Tensor
    centre: tuple[float, float]
    eddies: torch.Tensor
    z: torch.Tensor
    y: torch.Tensor

    @property
    def rms(self) -> float:
        """Of each component over the blocks, m/s."""
        z, y = torch.meshgrid(self.z, self.y, indexing="ij")
        return float((self.eddies + self.linear(y, z)).square().mean().sqrt())

    def at(self, y: torch.Tensor, z: torch.Tensor) -> torch.Tensor:
        """v and w (2, z, y) on a grid of places (z, y), one coordinate along each axis."""
        return self.turbulence(y[0], z[:, 0]) + self.linear(y, z)

    def turbulence(self, y: torch.Tensor, z: torch.Tensor) -> torch.Tensor:
        """The part of the eddies alone (2, z, y), at places along each axis."""
        weights = [
            linear_weights(nodes.to(axis), axis) for nodes, axis in ((self.z, z), (self.y, y))
        ]
        return separable(self.eddies.to(y), weights)

    def linear(self, y: torch.Tensor, z: torch.Tensor) -> torch.Tensor:
        """The part of the gradient alone."""
        v_y, v_z, w_y, w_z = self.gradient.to(y)
        y, z = y - self.centre[0], z - self.centre[1]
        return torch.stack([v_y * y + v_z * z, w_y * y + w_z * z])


class Elimination(NamedTuple):
    """What the errors by an ambient wind follow from; winds (2 n,) in blocks, v before w.

    blocks (_Blocks)
    y, z: of the residuals, m.
    parameters: at which the fit is linear.
    variances: of turbulence of each of `LENGTHS`, m^2 s^-2.
    covariance (2 n, 2 n): of turbulence relative to the wind at the pair.
    free, push (torch.Tensor, shapes (2 n, 2 n) and (2 n,)): stiffness and force of winds, as the
        parameters follow them.
    prior: inverse variance of parameters and gradients.
    """

    blocks: "_Blocks"
    y: torch.Tensor
    z: torch.Tensor
    dt: float
    parameters: torch.Tensor
    variances: torch.Tensor
    covariance: torch.Tensor
    free: torch.Tensor
    push: torch.Tensor
    prior: torch.Tensor


class Ambient(NamedTuple):
    """A fit in its ambient wind.

    solution: with the four gradients after the parameters. Its derivatives lack what turbulence
        explains, its residuals the estimated turbulence.
    rms, length: of the turbulence, posterior means: m/s and m.
    """

    solution: Solution
    wind: AmbientWind
    rms: float
    length: float
    elimination: Elimination


class AmbientErrors(NamedTuple):
    """Errors of a fit by its ambient wind.

    covariance (10, 10): of the parameters' error by turbulence, and by the gradients' prior.
    ahead (10, 10): covariance of that error with that of a slab `ALONG` further along the path.
    further: largest chi-square (one degree of freedom) of a further vortex anywhere.
    """

    covariance: torch.Tensor
    ahead: torch.Tensor
    further: float


def in_ambient_wind(
    calm: Solution, y: torch.Tensor, z: torch.Tensor, dt: float, known: AmbientWind | None = None
) -> Ambient:
    """The solution of a fit with the ambient wind in its model, linear in it.

    calm: without it. Its first ten parameters are those of a pair, without a prior.
    y, z (z, y): of the residuals, m.
    dt: displacements per wind, as those of `Misfit.slope`, s: 1 of vectors.
    known: with which the residuals were computed.
    """
    misfit = calm.misfit
    # one scale: weights may state less or more noise than the residuals have
    weight = calm.weight / _scale(calm)
    slope, residual, jacobian = misfit.slope, misfit.residual, misfit.jacobian
    if residual.ndim == 2:
        slope, residual, jacobian, weight = (
            slope[:, None],
            residual[None],
            jacobian[:, None],
            weight[None],
        )
    # exact winds would leave nothing but rounding
    sharpest = float((weight * slope.square()).sum(0).amax()) * dt**2
    weight = weight * min(1.0, (_FINEST * float(_SPREADS[0])) ** -2 / sharpest)
    middle_y, middle_z = (float(calm.parameters[[k, k + 4]].mean()) for k in (2, 3))
    centre = middle_y, middle_z
    if known is not None:
        residual = residual - dt * (slope * known.linear(y, z)[:, None]).sum(0)
    away = torch.stack([y - centre[0], z - centre[1]]) * dt
    linear = torch.stack([slope[a] * away[b] for a in (0, 1) for b in (0, 1)])
    columns = torch.cat([jacobian, linear.to(jacobian)])

    blocks = _blocks(y, z, max(1, math.ceil((y.numel() / _BLOCKS) ** 0.5)))
    stiff = torch.stack([(weight * slope[a] * slope[b]).sum(0) for a, b in _PAIRS])
    stiffness = _matrix(blocks.sums(stiff)) * dt**2
    steep = weight * slope
    # one component at a time: what a cache holds
    coupling = torch.cat([blocks.sums((columns * part).sum(1)).flatten(1) for part in steep], 1)
    coupling = coupling * dt
    force = blocks.sums(weight * residual * slope).sum(1).flatten() * dt
    flat = columns.flatten(1)
    weighted = flat * weight.flatten()
    normal = (weighted @ flat.T).double()
    gradient = (weighted @ residual.flatten()).double()
    if known is not None:
        # its blocks are those of another image where the scan follows the pair
        before = known.turbulence(blocks.y, blocks.z)
        eddies = before.flatten().to(force)
        # the residuals without the eddies that are known
        force = force - stiffness @ eddies
        gradient = gradient - coupling @ eddies
    prior = torch.zeros(len(normal), dtype=torch.float64, device=normal.device)
    prior[-4:] = GRADIENT**-2
    normal = normal + torch.diag(prior)

    # turbulence is that relative to the place of the pair, whose air the mean wind is
    here = blocks.at_pair(calm.parameters)
    # as the parameters follow: what they leave of stiffness and force
    followed = inverse_of(normal) @ torch.cat([coupling, gradient[:, None]], 1)
    free = stiffness - coupling.T @ followed[:, :-1]
    push = force - coupling.T @ followed[:, -1]
    variances = _variances(blocks, here, free, push)
    between = _relative(blocks.covariance(variances), here)
    covariance = _relative(between.T, here)
    # (A + K^-1)^-1 = (1 + K A)^-1 K
    one = torch.eye(len(force), dtype=torch.float64, device=force.device)
    explained = torch.linalg.solve(
        one + covariance @ stiffness, covariance @ torch.cat([coupling.T, force[:, None]], 1)
    )
    absorbed = -explained[:, :-1].T
    reduced = normal + absorbed @ coupling.T
    reduced = (reduced + reduced.T) / 2
    step = -inverse_of(reduced) @ (gradient + absorbed @ force)
    eddies = absorbed.T @ step - explained[:, -1]

    shaped = absorbed.view(len(columns), 2, *blocks.shape)
    projected = columns
    for part, along in zip(shaped.to(jacobian).unbind(1), dt * slope, strict=True):
        projected = torch.addcmul(projected, blocks.spread(part)[:, None], along)
    air = AmbientWind(step[-4:], centre, eddies.view(2, *blocks.shape), blocks.z, blocks.y)
    estimated = blocks.spread(air.eddies.to(jacobian)) * dt
    remains = residual + torch.tensordot(step.to(jacobian), columns, 1)
    remains = remains + (estimated[:, None] * slope).sum(0)
    if known is not None:
        stored = blocks.spread(before.to(jacobian)) * dt
        remains = remains - (stored[:, None] * slope).sum(0)
    if misfit.residual.ndim == 2:
        remains, projected, weight = remains[0], projected[:, 0], weight[0]
    moved = torch.cat([calm.parameters, calm.parameters.new_zeros(4)]) + step.to(calm.parameters)
    solution = calm._replace(
        parameters=moved,
        misfit=misfit._replace(residual=misfit.valid * remains, jacobian=projected),
        weight=weight,
        fisher=reduced,
    )
    lengths = variances.new_tensor(LENGTHS)
    return Ambient(
        solution,
        air,
        float(variances.sum().sqrt()),
        float((variances * lengths.log()).sum().div(variances.sum()).exp()),
        Elimination(blocks, y, z, dt, calm.parameters, variances, covariance, free, push, prior),
    )


def ambient_errors(ambient: Ambient) -> AmbientErrors:
    """Errors of a fit by its ambient wind, and the test for a further vortex."""
    (_, misfit, weight, fisher, *_), known = ambient.solution, ambient.elimination
    inverse = inverse_of(fisher)
    of_pair = torch.tensordot(known.dt * inverse[:10].to(misfit.jacobian), misfit.jacobian, 1)
    response = torch.stack([of_pair * weight * part for part in misfit.slope], 1)
    if misfit.residual.ndim == 3:
        response = response.sum(2)
    by_prior = ((inverse * known.prior) @ inverse)[:10, :10]
    here, ahead = _spread(response, known.parameters, known.y, known.z, known.variances)
    return AmbientErrors(here + by_prior, ahead + by_prior, _further_vortex(known))


_PAIRS = ((0, 0), (0, 1), (1, 1))


class _Blocks(NamedTuple):
    """Squares of the grid's steps in which turbulence is uniform."""

    side: int
    grid: tuple[int, int]
    z: torch.Tensor
    y: torch.Tensor

    @property
    def shape(self) -> tuple[int, int]:
        return len(self.z), len(self.y)

    def sums(self, fields: torch.Tensor) -> torch.Tensor:
        """Sums of fields (..., z, y) over the blocks, in double precision (..., rows, columns)."""
        rows, columns = self.grid
        pad = (0, -columns % self.side, 0, -rows % self.side)
        padded = torch.nn.functional.pad(fields, pad)
        return (
            padded.unflatten(-1, (-1, self.side)).unflatten(-3, (-1, self.side)).sum((-3, -1))
        ).double()

    def spread(self, values: torch.Tensor) -> torch.Tensor:
        """Values (..., rows, columns) of the blocks at their grid points (..., z, y)."""
        rows, columns = self.grid
        pixels = values.repeat_interleave(self.side, -2).repeat_interleave(self.side, -1)
        return pixels[..., :rows, :columns]

    def at_pair(self, parameters: torch.Tensor) -> torch.Tensor:
        """Weights (rows x columns,) of the wind's mean over both vortices' places."""
        weights = self.z.new_zeros(self.shape)
        for first in (0, 4):
            row = (self.z - float(parameters[first + 3])).abs().argmin()
            column = (self.y - float(parameters[first + 2])).abs().argmin()
            weights[row, column] += 0.5
        return weights.flatten()

    @property
    def steps(self) -> tuple[float, float]:
        """Between the blocks along z and y, m."""
        along_z, along_y = (
            float(axis[1] - axis[0]) if len(axis) > 1 else 1.0 for axis in (self.z, self.y)
        )
        return along_z, along_y

    def covariance(self, variances: torch.Tensor) -> torch.Tensor:
        """Covariance (2 n, 2 n) of v and w, of turbulence with a variance of each length."""
        parts = [
            variance * _covariances(*self.shape, *self.steps, length, variances.device)[0]
            for variance, length in zip(variances, LENGTHS, strict=True)
        ]
        return torch.stack(parts).sum(0)


def _blocks(y: torch.Tensor, z: torch.Tensor, side: int) -> _Blocks:
    rows, columns = y.shape
    along = []
    for axis in (z[:, 0], y[0]):
        step = (axis[-1] - axis[0]) / (len(axis) - 1)
        number = -(-len(axis) // side)
        middles = torch.arange(number, dtype=torch.float64, device=y.device) * side
        along.append(axis[0].double() + step.double() * (middles + (side - 1) / 2))
    return _Blocks(side, (rows, columns), *along)


def _matrix(parts: torch.Tensor) -> torch.Tensor:
    """The symmetric matrix (2 n, 2 n) of blocks that are independent, of parts (3, n, n)."""
    yy, yz, zz = (torch.diag(part.flatten()) for part in parts)
    return torch.cat([torch.cat([yy, yz], 1), torch.cat([yz, zz], 1)])


def _scale(solution: Solution) -> float:
    """Mean square of the residuals over what their weights state."""
    misfit = solution.misfit
    used = misfit.valid & (solution.weight > 0)
    # weights are of the noise before a filter, with the departure from the model
    stated = (1 / solution.weight - misfit.variance + misfit.scatter)[used]
    return max(float((misfit.residual[used].square() / stated).mean()), 1e-6)


def _variances(
    blocks: _Blocks, here: torch.Tensor, free: torch.Tensor, push: torch.Tensor
) -> torch.Tensor:
    """Posterior means of the variances of turbulence of each of `LENGTHS`, m^2 s^-2.

    Only one of them is there: a variance is weighted by the probability of its length.
    """
    variance = torch.as_tensor(_SPREADS**2, device=push.device)
    local = _before_relative(_before_relative(free, here).T, here).cpu().numpy()
    force = _before_relative(push[:, None], here).cpu().numpy()
    likelihoods = []
    for length in LENGTHS:
        root = _covariances(*blocks.shape, *blocks.steps, length, push.device)[1]
        likelihoods.append(_log_likelihoods(local, force, root))
    # uniform in the rms, whose nodes are logarithmic
    together = torch.as_tensor(np.stack(likelihoods) + np.log(_SPREADS), device=push.device)
    probability = (together - together.max()).exp()
    return (probability * variance).sum(1) / probability.sum()


def _log_likelihoods(stiffness: np.ndarray, force: np.ndarray, root: np.ndarray) -> np.ndarray:
    """Of `_SPREADS`, for winds with the covariance s^2 C C' and the lower triangular root C.

    (s^2 b . (1 + s^2 M)^-1 b - log det (1 + s^2 M)) / 2 with b = C' force and M = C' stiffness C,
    which is once made tridiagonal.
    """
    matrix, _ = lapack.dsygst(stiffness, root, itype=2, lower=1)
    # as much memory as for blocks of 64 columns
    reflectors, diagonal, beside, scales, _ = lapack.dsytrd(matrix, 1, 64 * len(matrix))
    turned = root.T @ force
    turned[1:] = lapack.dormqr("L", "T", reflectors[1:, :-1], scales, turned[1:], 64)[0]
    likelihoods = np.empty(len(_SPREADS))
    for number, variance in enumerate(_SPREADS**2):
        pivots, _, solution, _ = lapack.dptsv(1 + variance * diagonal, variance * beside, turned)
        gain = variance * float((turned * solution).sum())
        likelihoods[number] = (gain - np.log(pivots).sum()) / 2
    return likelihoods


def _further_vortex(known: Elimination) -> float:
    """Largest score statistic of one more vortex in the middle of a block, in the turbulence.

    Chi-square with one degree of freedom at each place, if there is no such vortex (Rao 1948). Not
    of places within `_OWN` core radii of the pair, whose profile may differ from the model.
    """
    blocks, free, push = known.blocks, known.free, known.push
    z, y = (a.flatten() for a in torch.meshgrid(blocks.z, blocks.y, indexing="ij"))
    away = torch.stack([y[:, None] - y, z[:, None] - z])
    square = away.square().sum(0) + _CORE**2
    swirl = torch.cat([-away[1] / square, away[0] / square])
    clear = torch.ones_like(y, dtype=torch.bool)
    for first in (0, 4):
        _, log_radius, at_y, at_z = (float(a) for a in known.parameters[first : first + 4])
        clear &= torch.hypot(y - at_y, z - at_z) > _OWN * math.exp(log_radius)
    swirl = swirl[:, clear]
    one = torch.eye(len(push), dtype=torch.float64, device=push.device)
    scores = torch.linalg.solve(
        one + free @ known.covariance, torch.cat([push[:, None], free @ swirl], 1)
    )
    square = (swirl.T @ scores[:, 0]).square() / (swirl * scores[:, 1:]).sum(0).clamp(min=1e-30)
    return float(square.max())


def _spread(
    response: torch.Tensor,
    parameters: torch.Tensor,
    y: torch.Tensor,
    z: torch.Tensor,
    variances: torch.Tensor,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Covariance (q, q) of sum_x R(x) . t(x), in one plane and between planes `ALONG` apart.

    response (q, 2, z, y): R.
    parameters: of the pair, the wind at which is no part of t.
    variances: of turbulence of each length.
    """
    blocks = _blocks(y, z, 2 if y.numel() > _FEW else 1)
    response = blocks.sums(response).to(response)
    (rows, columns), steps = blocks.shape, blocks.steps
    sizes = even_fast_len(2 * rows), even_fast_len(2 * columns)
    here = blocks.at_pair(parameters).view(rows, columns)
    total = response.sum((-2, -1), keepdim=True)
    waves = torch.fft.rfft2(response - total * here.to(response), s=sizes)
    # columns of a real transform stand for both signs, but for the first and the last
    double = torch.full(waves.shape[-2:], 2.0, dtype=response.dtype, device=y.device)
    double[:, 0] = double[:, -1] = 1.0
    spreads = []
    for along in (0.0, ALONG):
        vv, vw, ww = torch.stack(
            [
                float(variance) * _spectra(sizes, steps, length, along, response.dtype, y.device)
                for variance, length in zip(variances, LENGTHS, strict=True)
            ]
        ).sum(0)
        v, w = (waves[:, 0] * vv + waves[:, 1] * vw), (waves[:, 0] * vw + waves[:, 1] * ww)
        both = torch.view_as_real(torch.stack([v, w], 1) * double).flatten(1)
        matrix = torch.view_as_real(waves).flatten(1) @ both.T / (sizes[0] * sizes[1])
        spreads.append(((matrix + matrix.T) / 2).double())
    return spreads[0], spreads[1]


def _relative(fields: torch.Tensor, here: torch.Tensor) -> torch.Tensor:
    """Fields (2 n, m) of v and w in blocks, less their value at the pair."""
    parts = fields.unflatten(0, (2, -1))
    return (parts - torch.einsum("n,anm->am", here, parts)[:, None]).flatten(0, 1)


def _before_relative(forces: torch.Tensor, here: torch.Tensor) -> torch.Tensor:
    """Forces (2 n, m) on winds in blocks, of forces on these less the wind at the pair."""
    parts = forces.unflatten(0, (2, -1))
    return (parts - here[:, None] * parts.sum(1, keepdim=True)).flatten(0, 1)


# They depend on the grid alone and are stored for the next slabs.
@lru_cache(maxsize=64)
def _covariances(
    rows: int, columns: int, step_z: float, step_y: float, length: float, device: torch.device
) -> tuple[torch.Tensor, np.ndarray]:
    """Covariance (2 n, 2 n) of v and w of unit variance, averaged over blocks; its lower root."""
    lag_z, lag_y = np.arange(1 - rows, rows) * step_z, np.arange(1 - columns, columns) * step_y
    total = np.zeros((3, len(lag_z), len(lag_y)))
    for apart_z, weight_z in zip(_APART, (0.25, 0.5, 0.25), strict=True):
        for apart_y, weight_y in zip(_APART, (0.25, 0.5, 0.25), strict=True):
            part = _of_lags(lag_z + apart_z * step_z, lag_y + apart_y * step_y, length, 0.0)
            total += weight_z * weight_y * part
    row, column = (a.ravel() for a in np.indices((rows, columns)))
    at = row[:, None] - row + rows - 1, column[:, None] - column + columns - 1
    vv, vw, ww = total[:, *at]
    plane = np.block([[vv, vw], [vw, ww]])
    # in the order of columns, as LAPACK reads it
    return torch.as_tensor(plane, device=device), np.asfortranarray(np.linalg.cholesky(plane))


@lru_cache(maxsize=64)
def _spectra(
    sizes: tuple[int, int],
    steps: tuple[float, float],
    length: float,
    along: float,
    dtype: torch.dtype,
    device: torch.device,
) -> torch.Tensor:
    """Transform (3, ...) of the covariances vv, vw and ww by lags that wrap."""
    lag_z, lag_y = (np.fft.fftfreq(n, 1 / n) * step for n, step in zip(sizes, steps, strict=True))
    spectra = np.fft.rfft2(_of_lags(lag_z, lag_y, length, along)).real
    return torch.as_tensor(spectra, dtype=dtype, device=device)


def _of_lags(lag_z: np.ndarray, lag_y: np.ndarray, length: float, along: float) -> np.ndarray:
    """Covariances (3, z, y) vv, vw, ww of turbulence of unit variance by lags, m."""
    dz, dy = np.meshgrid(lag_z, lag_y, indexing="ij")
    square = along**2 + dy**2 + dz**2
    longitudinal, lateral = correlations(np.sqrt(square), length)
    more = (longitudinal - lateral) / np.where(square > 0, square, 1.0)
    return np.stack([lateral + more * dy**2, more * dy * dz, lateral + more * dz**2])
