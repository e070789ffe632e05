"""Likelihood of a flow given two images of air that is integrated over.

Nothing is warped or filtered. In a block of air the values of both images are Gaussian, with a mean
of their own and the covariance

    l_a l_b sum_m w_m s_m^2 |S|^-1/2 exp(-d S^-1 d / 2) + variance of the counts,
    S = s_m^2 + B_a + B_b,

for the distance d at mid-time of the air at two pixels, of either image. The amplitude l is the
smoothed mean image. B is the covariance of a beam's footprint, deformed by the flow on its way to
mid-time. The variances w of air of the widths s are those of the largest likelihood in every block.
So the air is known by its spectrum alone, and blur, strain and noise that varies are exact
(Gaussian process regression: Rasmussen & Williams 2006). Neglected: covariances between blocks, and
the change of the flow along a path by a change of the path, 4 % of the gradient in vortex cores.
"""

import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import torch
from scipy.ndimage import gaussian_filter

from lidar_mi.retrieval.flow.flow_spline import Mesh
from lidar_mi.retrieval.flow.prior import Prior

WIDTHS = (0.6, 1.2, 2.4, 4.8, 9.6)
"""Of the parts of the air, px."""
BLOCK = 16
"""Side of a block, px."""
_AMPLITUDE_WIDTH = 3.0
_MEAN_VARIANCE = 10.0
"""Of a block's relative mean before the images: much larger than any of its structure."""
_LEARNING = 8
_TIMES = (-0.5, 0.5)


class Counts(NamedTuple):
    """Two images as counted.

    Attributes
    ----------
    images, variances : sequences of torch.Tensor, shape (z, y)
        Counts, and the variance of each.
    footprint : float
        Variance of a beam's footprint along each axis, px^2.
    """

    images: Sequence[torch.Tensor]
    variances: Sequence[torch.Tensor]
    footprint: float

    def pixels(self) -> torch.Tensor:
        """(pixels, 2) places of all pixels of an image."""
        axes = [torch.arange(n).to(self.images[0]) for n in self.images[0].shape]
        return torch.cartesian_prod(*axes)

    def amplitude(self) -> torch.Tensor:
        """Of the structure at every pixel: the smoothed mean image."""
        mean = (self.images[0] + self.images[1]).numpy() / 2
        smooth = gaussian_filter(mean, _AMPLITUDE_WIDTH, mode="nearest")
        return torch.as_tensor(smooth).reshape(-1)


class Block(NamedTuple):
    """The pixels of both images, n in all, whose air is in one block at mid-time.

    Attributes
    ----------
    values, noise : torch.Tensor, shape (n,)
        Relative to the mean, which is subtracted; variance by the counts.
    places : torch.Tensor, shape (n, 2)
        Of the air at mid-time, px.
    footprint : torch.Tensor, shape (n, 2, 2)
        Covariance of the beams' footprints at mid-time, px^2.
    amplitude : torch.Tensor, shape (n,)
    response : torch.Tensor, shape (n, knots)
        Derivative of a component of ``places`` with respect to that of the coefficients.
    """

    values: torch.Tensor
    noise: torch.Tensor
    places: torch.Tensor
    footprint: torch.Tensor
    amplitude: torch.Tensor
    response: torch.Tensor

    def covariances(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Of every width (widths, n, n), and their slopes by the first place (widths, 2, n, n)."""
        distance = self.places[:, None] - self.places
        blur = self.footprint[:, None] + self.footprint
        amplitudes = self.amplitude[:, None] * self.amplitude
        parts, slopes = [], []
        for width in WIDTHS:
            spread = blur + width**2 * torch.eye(2).to(blur)
            scaled = torch.linalg.solve(spread, distance[..., None])[..., 0]
            part = torch.exp(-(scaled * distance).sum(-1) / 2)
            part = part * amplitudes * width**2 / torch.linalg.det(spread).sqrt()
            parts.append(part)
            slopes.append(-scaled.movedim(-1, 0) * part)
        return torch.stack(parts), torch.stack(slopes)

    def precision(self, spectrum: torch.Tensor, parts: torch.Tensor) -> torch.Tensor:
        """Inverse covariance of the values, (n, n)."""
        covariance = torch.einsum("m,mij->ij", spectrum, parts) + torch.diag(self.noise)
        return torch.cholesky_inverse(torch.linalg.cholesky(covariance + _MEAN_VARIANCE))

    def learnt(self, spectrum: torch.Tensor, parts: torch.Tensor) -> torch.Tensor:
        """Variances of largest likelihood; a step multiplies by the ratio of both derivatives."""
        for _ in range(_LEARNING):
            precision = self.precision(spectrum, parts)
            scaled = precision @ self.values
            square = torch.einsum("i,mij,j->m", scaled, parts, scaled)
            spectrum = spectrum * square / (parts * precision).sum((1, 2))
        return spectrum

    def score_and_information(self, spectrum: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Gradient of the log-likelihood by the places, (2, n), and its covariance (2, n, 2, n)."""
        parts, slopes = self.covariances()
        precision = self.precision(spectrum, parts)
        scaled = precision @ self.values
        slope = torch.einsum("m,mcij->cij", spectrum, slopes)
        score = ((scaled[:, None] * scaled - precision) * slope).sum(-1)
        # 1/2 tr(P dC_a P dC_b), where dC_a has the slopes in its row and column a alone
        known = slope @ precision
        information = torch.einsum("cab,dba->cadb", known, known)
        information += torch.einsum("cab,dkb->cadk", known, slope) * precision[:, None]
        return score, information


class Likelihood(NamedTuple):
    """About a flow: gradient (2 knots,) by its coefficients and Fisher information (2 knots,)^2."""

    gradient: torch.Tensor
    information: torch.Tensor


def blocks(counts: Counts, mesh: Mesh, coefficients: torch.Tensor) -> Iterator[Block]:
    """All blocks, for the flow (2, knots z, knots y) of displacements between the images, px."""
    pixels, amplitude = counts.pixels(), counts.amplitude()
    moved = [_to_mid_time(mesh, coefficients, pixels, time) for time in _TIMES]
    number = [math.ceil(n / BLOCK) for n in counts.images[0].shape]
    largest = torch.tensor(number) - 1
    cells = [(places / BLOCK).floor().long().clamp(min=0).minimum(largest) for places, _ in moved]
    for z in range(number[0]):
        for y in range(number[1]):
            own = [(cell == torch.tensor([z, y])).all(1) for cell in cells]
            values, noise, places, deformed, strengths = (
                torch.cat([one.reshape(len(pixels), *one.shape[1:])[mine] for one, mine in pairs])
                for pairs in (
                    zip([image.reshape(-1) for image in counts.images], own, strict=True),
                    zip([one.reshape(-1) for one in counts.variances], own, strict=True),
                    zip([places for places, _ in moved], own, strict=True),
                    zip([gradient for _, gradient in moved], own, strict=True),
                    zip([amplitude, amplitude], own, strict=True),
                )
            )
            response = torch.cat(
                [
                    _response(mesh, pixels[mine], one[mine], time)
                    for mine, (one, _), time in zip(own, moved, _TIMES, strict=True)
                ]
            )
            mean = values.mean()
            yield Block(
                values / mean - 1,
                noise / mean**2,
                places,
                counts.footprint * deformed @ deformed.mT,
                strengths / strengths.mean(),
                response,
            )


def spectra(counts: Counts, mesh: Mesh, coefficients: torch.Tensor) -> list[torch.Tensor]:
    """Variances of the air's parts in every block, of largest likelihood for a flow."""
    found = []
    for block in blocks(counts, mesh, coefficients):
        parts, _ = block.covariances()
        first = block.values.square().mean() / len(WIDTHS)
        found.append(block.learnt(first.expand(len(WIDTHS)), parts))
    return found


def likelihood(
    counts: Counts, mesh: Mesh, coefficients: torch.Tensor, air: Sequence[torch.Tensor]
) -> Likelihood:
    """That of a flow, for air of these variances in every block."""
    knots = coefficients[0].numel()
    gradient = coefficients.new_zeros(2, knots)
    information = coefficients.new_zeros(2, knots, 2, knots)
    for block, spectrum in zip(blocks(counts, mesh, coefficients), air, strict=True):
        score, of_places = block.score_and_information(spectrum)
        near = block.response.any(0).nonzero()[:, 0]
        response = block.response[:, near]
        gradient[:, near] += score @ response
        part = torch.einsum("ai,cadb,bj->cidj", response, of_places, response)
        for c in (0, 1):
            for d in (0, 1):
                information[c, near[:, None], d, near] += part[c, :, d]
    return Likelihood(gradient.reshape(-1), information.reshape(2 * knots, 2 * knots))


def precision_of(prior: Prior, ridge: float) -> torch.Tensor:
    """Of all coefficients before the images, (2 knots, 2 knots)."""
    knots = [axis.knots for axis in prior.mesh.axes]
    number = 2 * math.prod(knots)
    rates = prior.rates(torch.eye(number).reshape(number, 2, *knots).to(prior.local))
    rates = rates.reshape(number, -1)
    return (rates * prior.weights.reshape(-1)) @ rates.T + ridge * torch.eye(number).to(rates)


def _to_mid_time(
    mesh: Mesh, coefficients: torch.Tensor, pixels: torch.Tensor, time: float, steps: int = 6
) -> tuple[torch.Tensor, torch.Tensor]:
    """Places at mid-time of the air at pixels at ``time``, and their gradients (n, 2, 2)."""

    def flow(places: torch.Tensor, *orders: int) -> torch.Tensor:
        along = [
            axis.basis(places[:, k], order)
            for k, (axis, order) in enumerate(zip(mesh.axes, orders, strict=True))
        ]
        return torch.einsum("ni,nj,cij->nc", *along, coefficients)

    places, gradient = pixels, torch.eye(2).to(pixels).expand(len(pixels), 2, 2)
    step = -time / steps
    for _ in range(steps):
        middle = places + step / 2 * flow(places, 0, 0)
        rates = torch.stack([flow(middle, 1, 0), flow(middle, 0, 1)], -1)
        gradient = gradient + step * rates @ (gradient + step / 2 * rates @ gradient)
        places = places + step * flow(middle, 0, 0)
    return places, gradient


def _response(mesh: Mesh, pixels: torch.Tensor, places: torch.Tensor, time: float) -> torch.Tensor:
    """Splines averaged along the path to mid-time (Simpson's rule), times the time."""
    total = 0.0
    for at, weight in ((pixels, 1), ((pixels + places) / 2, 4), (places, 1)):
        z, y = (axis.basis(at[:, k]) for k, axis in enumerate(mesh.axes))
        total = total + weight / 6 * torch.einsum("ni,nj->nij", z, y).reshape(len(at), -1)
    return -time * total
