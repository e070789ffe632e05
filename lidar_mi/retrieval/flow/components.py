"""What makes warped images differ: variance components, by restricted maximum likelihood.

About the fitted flow the difference of two warped images is linear in everything that is not known:
the flow, motion finer than its splines, noise, texture that is replaced, and structure that moves
through the plane. Each is a Gaussian field of known covariance but for its amplitude. The fit
leaves of each what it leaves of random draws of it; amplitudes are those that make the squares of
the residuals likeliest, by place and by scale.
"""

import math
from collections.abc import Callable, Sequence
from functools import reduce
from typing import NamedTuple

import numpy as np
import torch

from lidar_mi.retrieval.flow.flow_spline import Mesh, interpolated
from lidar_mi.retrieval.flow.likelihood import Images, Linear
from lidar_mi.retrieval.flow.prior import Prior
from lidar_mi.retrieval.images.band_limit import flat_if_nearly, radii, shell_means, wavenumbers
from lidar_mi.retrieval.images.quality import filled
from lidar_mi.retrieval.images.spline import filter_of, spectrum_of, transform_sizes
from lidar_mi.retrieval.images.windows import averaged, stored, working
from lidar_mi.retrieval.reml import most_likely

Response = Callable[[torch.Tensor], torch.Tensor]

DRAWS = 4
REGION = 8


class Component(NamedTuple):
    draws: torch.Tensor  # (draws, z, y) of the difference in dt, unit amplitude
    least: float
    most: float


def normal(shape: Sequence[int], like: torch.Tensor, seed: int) -> torch.Tensor:
    """Independent standard normal numbers, the same on every device."""
    random = torch.Generator().manual_seed(seed)
    return torch.randn(tuple(shape), generator=random, dtype=like.dtype).to(like.device)


def structure_density(images: Images) -> torch.Tensor:
    """Spectral density of the structure that stands out of the noise, by shells."""
    spline, stack = images.spline, images.stack
    known = torch.stack([torch.isfinite(image) for image in stack])
    stack = torch.stack([stored(filled(image)) for image in stack])
    sizes = transform_sizes(spline.shape, spline.settings)
    _, shell = radii(tuple(sizes), spline.shape, stack.dtype, stack.device)
    density, uncertainty = shell_means(stack, shell, sizes, spline.settings.smoothing, known)
    floor = images.white**2
    out = density > floor * (1 + spline.settings.threshold * uncertainty)
    return torch.where(out, density - floor, 0.0)


def displaced(wave: torch.Tensor, structure: torch.Tensor) -> torch.Tensor:
    return (wave * structure).flip(0).cumsum(0).flip(0) * (wave[1] - wave[0])


def tail(prior: Prior, knots: float, places) -> torch.Tensor:
    """Variance of a component of the displacement below the knots, if the spectrum goes on as -5/3."""
    wave, fraction = _unresolved_fraction(knots, prior.local)
    step = (wave[1] / wave[0]).log()
    strength, variance = prior.strength, 0.0
    for k, part in zip(wave, fraction, strict=True):
        for plain, gradient in ((0, 2), (1, 3)):
            # spectral density of a component, 1 / (2 k^2 (L + M k^2))
            variance = variance + part * step / (4 * math.pi * (strength[plain] + strength[gradient] * k**2))
    return interpolated(variance, prior.mesh.places, places)


def _unresolved_fraction(knots: float, like: torch.Tensor):
    """Wavenumbers, rad per px, and the fraction of a wave's variance that cubic splines leave."""
    wave = torch.exp(torch.linspace(math.log(0.1 * math.pi / knots), math.log(math.pi), 24).to(like))
    turns = wave * knots / (2 * math.pi)
    images = turns[:, None] + torch.arange(-8, 9).to(like)
    power = torch.sinc(images).pow(8)
    return wave, 1 - torch.sinc(turns).pow(8) / power.sum(1)


def fine_motion(shape, knots: float, like: torch.Tensor, seed: int) -> torch.Tensor:
    """Random motion (draws, 2, z, y) of unit variance in waves that splines leave."""
    field = normal((DRAWS, 2, *shape), like, seed)
    k = torch.hypot(*torch.meshgrid(torch.fft.fftfreq(shape[0]).to(like), torch.fft.rfftfreq(shape[1]).to(like), indexing="ij"))
    wave, fraction = _unresolved_fraction(knots, like)
    at = (torch.searchsorted(wave, 2 * math.pi * k)).clamp(max=len(wave) - 1)
    gain = torch.where(k > 0, (fraction / wave**3).sqrt()[at], 0.0)
    field = torch.fft.irfft2(torch.fft.rfft2(field) * gain, s=tuple(shape))
    return field / field.square().mean().sqrt()


def residuals_of(linear: Linear, mesh: Mesh, response: Response):
    slope, weight = working(linear.slope), working(linear.weight)

    def left(difference: torch.Tensor) -> torch.Tensor:
        difference = working(difference) * linear.valid
        change = response(mesh.transposed(-difference * slope * weight))
        return (difference + (slope * mesh.field(change)).sum(0)) * linear.valid

    return left


def squares(rest: torch.Tensor, valid: torch.Tensor) -> torch.Tensor:
    """Mean squares by scale and place, (scales, z, y)."""
    fine, coarse = averaged(rest, valid, 1.5), averaged(rest, valid, 3.0)
    bands = (rest - fine, fine - coarse, coarse)
    return torch.stack([averaged((b * valid).square(), valid, REGION)[::REGION, ::REGION] for b in bands])


DEBUG = []


def _shrunk(ratio, number, use):
    """Ratios of squares to what is expected, with as much freedom as their scatter shows."""
    known = ratio[use]
    chance = (1 / number[use]).mean()
    scatter = (known - 1).square().mean()
    free = (scatter - chance).clamp(min=1e-6)
    more = 1 / free
    return (number * ratio + more) / (number + more)


def estimated(images: Images, linear: Linear, mesh: Mesh, coefficients, posterior, prior: Prior, separation: float, template: float):
    valid, spline = linear.valid, images.spline
    if not bool(valid.any()):
        return images, None
    times = images.time.square().sum()
    time = images.time.to(linear.warped).reshape(-1, 1, 1)
    difference = working((time * linear.warped).sum(0) / times * valid)
    slope = working(linear.slope)
    shape, like = difference.shape, difference
    given = images.given_weight
    # white noise
    white = normal((DRAWS, *shape), like, 1) / given.sqrt()
    unit = images.known_noise if images.noise_known else 1.0
    white = unit * spline.filtered(white) / times.sqrt()
    # texture
    structure = structure_density(images)
    wave = wavenumbers(structure, spline.shape)
    steep = averaged(slope.square().sum(0), valid, 0.5 * template)
    modulation = (steep / steep[valid].mean()).sqrt()

    def of_spectrum(density, seed):
        density = density[: len(spline.gain)]
        shaped = spline._replace(gain=spline.gain * density.clamp(min=0).sqrt())
        return modulation * shaped.filtered(normal((DRAWS, *shape), like, seed))

    replaced = of_spectrum(structure, 2)
    moved = of_spectrum(displaced(wave, structure), 3)
    variance = tail(prior, separation, mesh.places)
    fine = (slope * fine_motion(shape, separation, like, 4)).sum(1) * variance.sqrt()
    left = residuals_of(linear, mesh, posterior.response)
    # what the prior leaves of the flow itself
    flows = prior.rates_transposed(prior.weights.sqrt() * normal((DRAWS, *prior.weights.shape), prior.local, 5))
    own = [(slope * mesh.field(posterior.response(one))).sum(0) * valid for one in flows]
    q = lambda part: squares(part, valid)
    found = q(difference)
    held = torch.stack([q(one) for one in own])
    kinds = {"noise": white, "replaced": replaced, "moved": moved, "fine": fine}
    rests = {name: [left(one) for one in part] for name, part in kinds.items()}
    drawn = {name: torch.stack([q(one) for one in part]) for name, part in rests.items()}
    use = (averaged(valid.to(found), torch.ones_like(valid), REGION)[::REGION, ::REGION] > 0.5).expand_as(found)
    use = use & (found > 0)
    # independent squares in each mean, from the scatter of the noise's
    rel = drawn["noise"] / drawn["noise"].mean(0)
    chance = rel.var(0).mean((1, 2), keepdim=True).expand_as(found) * DRAWS / (DRAWS - 1)
    number = (1 / chance)[use].cpu().numpy()
    terms = np.stack([part.mean(0)[use].cpu().numpy() for part in drawn.values()])
    own_term = held.mean(0)[use].cpu().numpy()
    if images.noise_known:
        own_term = own_term + terms[0]
    observed = found[use].cpu().numpy()
    limits = np.array([1e-6 if images.noise_known else np.inf, np.inf, np.inf, 1.0])
    misfit, factors = most_likely(observed, terms, limits, number, own_term)
    DEBUG.append(dict(zip(kinds, factors), misfit=misfit, n=number.mean()))
    if images.noise_known:
        factors = factors + np.array([1.0, 0, 0, 0])
    amplitude = {name: max(float(f), 0.0) for name, f in zip(kinds, factors)}
    total = reduce(torch.add, [amplitude[n] ** 0.5 * part for n, part in kinds.items()])
    after = [
        reduce(torch.add, [amplitude[n] ** 0.5 * part[d] for n, part in rests.items()]) + own[d]
        for d in range(DRAWS)
    ]
    expected = torch.stack([q(one) for one in after]).mean(0)
    count = (1 / chance) * use
    local = (count * (found / expected.clamp(min=1e-30))).sum(0) / count.sum(0).clamp(min=1e-30)
    seen = use.any(0)
    local = torch.where(seen, _shrunk(local, count.sum(0), seen), 1.0)
    places = [torch.arange(0, n, REGION).to(like) for n in shape]
    local = interpolated(local.log(), places, [torch.arange(n).to(like) for n in shape]).exp()
    level = averaged(total.square().mean(0), valid, 0.75 * template) * local * times / max(spline.passed, 1e-6)
    floor = (1e-5 * float(images.stack[torch.isfinite(images.stack)].std())) ** 2
    level = level.clamp(min=floor)
    mean = float(level[valid].mean())
    weight = mean / level
    sizes = transform_sizes(spline.shape, spline.settings)
    _, shell = radii(tuple(sizes), spline.shape, total.dtype, total.device)
    def shells(part):
        return shell_means(part * (weight * times).sqrt() * valid, shell, sizes, spline.settings.smoothing)
    total = total * local.sqrt()
    density, uncertainty = shells(total)
    there, _ = shells(torch.stack(after) * local.sqrt())
    seen_there, chance_there = shells(difference[None])
    inside = torch.ones_like(there, dtype=torch.bool)
    colour = _shrunk(seen_there / there.clamp(min=1e-30), 1 / chance_there.square(), inside)
    density = density * colour
    density = density / spline.gain.square().clamp(min=1e-6)
    density = density.clamp(min=1e-6 * mean)
    spectrum = spectrum_of(images.stack, weight.sqrt(), spline.settings)
    along_z, along_y = mesh.slopes(coefficients)
    stretched, sheared = along_z[0] - along_y[1], along_z[1] + along_y[0]
    # mean square of the strain in dt along any direction
    strain = float(((stretched.square() + sheared.square()) / 8)[valid].mean())
    density = flat_if_nearly(spectrum, density, spline.settings.threshold, 0.0, strain)
    DEBUG.append({"local": float(local.min()), "localmax": float(local.max())})
    chosen = filter_of(images.stack, mean**0.5, density, weight.sqrt(), images.blur, spline.settings)
    out = images.filtered(chosen, chosen.level)._replace(weight=weight, noise_updated=True, white=min(images.white, max(amplitude["noise"],1e-12) ** 0.5 * unit))
    return out, amplitude["fine"] * variance * local.clamp(max=1.0)
