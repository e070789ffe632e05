"""Images and volumes as band-limited functions of place: values and gradients anywhere."""

from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import torch

from lidar_mi.retrieval.images.band_limit import (
    Filter,
    PowerSpectrum,
    best_filter,
    checked_noise,
    even_fast_len,
    faded,
    frequencies,
    odd_fast_len,
    power_spectrum,
    radii,
    shell_means,
)
from lidar_mi.retrieval.images.inpainting import filled_in, nearest_in
from lidar_mi.retrieval.images.settings import FilterSettings
from lidar_mi.retrieval.images.windows import stored

# Points of a volume read at once: their intermediate results stay near the cache.
_POINTS = 1 << 16
# Of images more are read one image after the other: their weights take 30 times the memory.
_TOGETHER = 1 << 19


class Spline(NamedTuple):
    """Cubic B-spline through images or volumes, on nodes half a pixel apart.

    coefficients (images, ...): along each axis as many as there are nodes in the image and the
        margins around it.
    shape: of the images, (z, y), or (x, z, y) of volumes.
    passed, excess, gain, efficiency, noisy_slopes: as in `band_limit.Filter`.
    """

    coefficients: torch.Tensor
    shape: tuple[int, ...]
    passed: float
    excess: float
    gain: torch.Tensor
    efficiency: float
    noisy_slopes: float
    settings: FilterSettings

    def only(self, number: int) -> "Spline":
        """The spline of one of the images."""
        return self._replace(coefficients=self.coefficients[number : number + 1])

    def stacked_with(self, other: "Spline") -> "Spline":
        """The spline with the images of another one, after the same filter."""
        return self._replace(coefficients=torch.cat([self.coefficients, other.coefficients]))

    def filtered(self, field: torch.Tensor) -> torch.Tensor:
        """A field on the images' pixels after the images' filter; it is zero beyond them."""
        margin = self.settings.margin
        # one margin is enough: what passes one edge of the periodic transform enters at the other
        sizes = [even_fast_len(n + margin) for n in self.shape]
        dims = tuple(range(-len(sizes), 0))
        # sizes of another parity may reach one shell further
        _, shell = radii(tuple(sizes), self.shape, field.dtype, field.device)
        shell = shell.clamp(max=len(self.gain) - 1)
        # axis by axis: what is zero before, or not needed after, is not transformed
        spectrum = torch.fft.rfft(field, n=sizes[-1])
        for axis, size in zip(dims[:-1], sizes[:-1], strict=True):
            spectrum = torch.fft.fft(spectrum, n=size, dim=axis)
        spectrum = spectrum * self.gain.to(field)[shell]
        for axis, n in zip(dims[:-1], self.shape[:-1], strict=True):
            spectrum = torch.fft.ifft(spectrum, dim=axis).narrow(axis, 0, n)
        return torch.fft.irfft(spectrum, n=sizes[-1])[..., : self.shape[-1]]

    def holds(self, *place: torch.Tensor) -> torch.Tensor:
        """Which places lie on the images, up to the outer pixels' centres."""
        inside = torch.ones_like(place[0], dtype=torch.bool)
        for p, n in zip(place, self.shape, strict=True):
            inside &= (p >= 0) & (p <= n - 1)
        return inside

    def sample(self, *place: torch.Tensor) -> tuple[torch.Tensor, ...]:
        """Value and slopes along every axis of every image at its own places (images, ...).

        Places are pixels from the first one; those beyond the image take the edge's value.
        """
        at = self._in_nodes(place)
        if len(at) == 2:
            value, *slopes = _read_images(self.coefficients, at[0], at[1])
        else:
            value, *slopes = _read_volumes(self.coefficients, *at)
        # per px from per node
        return value, *(self.settings.nodes * slope for slope in slopes)

    def values(self, *place: torch.Tensor) -> torch.Tensor:
        """Values of `sample` without slopes."""
        at = self._in_nodes(place)
        if len(at) == 2:
            return _read_images(self.coefficients, at[0], at[1], slopes=False)[0]
        return _read_volumes(self.coefficients, *at)[0]

    def _in_nodes(self, place: Sequence[torch.Tensor]) -> list[torch.Tensor]:
        """Places on the images, counted in nodes."""
        finer, margin = self.settings.nodes, self.settings.margin
        return [
            # the first of the four coefficients of a place is that of one node before it
            finer * (p.clamp(0, size - 1) + margin) - 1
            for p, size in zip(place, self.shape, strict=True)
        ]


def _read_images(
    coefficients: torch.Tensor, z: torch.Tensor, y: torch.Tensor, slopes: bool = True
) -> list[torch.Tensor]:
    """Values, and slopes per node, at places counted in nodes: two dimensions."""
    images, height, width = coefficients.shape
    if images > 1 and z.numel() > _TOGETHER:
        parts = [
            _read_images(coefficients[k : k + 1], z[k : k + 1], y[k : k + 1], slopes)
            for k in range(images)
        ]
        return [torch.cat(part) for part in zip(*parts, strict=True)]
    row, column = z.floor(), y.floor()
    form = spline_weights if slopes else _value_weights
    weight_z, weight_y = form(z - row), form(y - column)
    first = torch.arange(images, device=z.device).view(-1, *[1] * (z.ndim - 1)) * height
    # whole numbers of half the size, and no new memory, take half the time
    kind = torch.int32 if coefficients.numel() < 2**31 else torch.int64
    corner = ((first + row.to(kind)) * width + column.to(kind)).reshape(-1)
    flat = coefficients.reshape(-1)
    # derivatives along z and y
    orders = [(0, 0), (1, 0), (0, 1)] if slopes else [(0, 0)]
    total = [torch.zeros_like(z) for _ in orders]
    knot, *along = (torch.empty_like(z) for _ in range(1 + len(weight_y)))
    for i in range(4):
        for j in range(4):
            # a view that begins further on saves an addition to every number
            torch.index_select(flat[i * width + j :], 0, corner, out=knot.view(-1))
            for part, weight in zip(along, weight_y, strict=True):
                if j:
                    part.addcmul_(knot, weight[j])
                else:
                    torch.mul(knot, weight[j], out=part)
        for part, (by_z, by_y) in zip(total, orders, strict=True):
            part.addcmul_(along[by_y], weight_z[by_z][i])
    return total


def _read_volumes(coefficients: torch.Tensor, *place: torch.Tensor) -> torch.Tensor:
    """Values and slopes, per node, at places counted in nodes: three dimensions, by tiles."""
    sampled = place[0].new_empty(4, *place[0].shape)
    for number, volume in enumerate(coefficients[: len(place[0])]):
        points = [axis[number].reshape(-1) for axis in place]
        part = sampled[:, number].reshape(4, -1)
        for start in range(0, len(points[0]), _POINTS):
            chunk = slice(start, start + _POINTS)
            part[:, chunk] = _read_volume(volume, *(axis[chunk] for axis in points))
        sampled[:, number] = part.reshape(4, *place[0].shape[1:])
    return sampled


def _read_volume(volume: torch.Tensor, *at: torch.Tensor) -> torch.Tensor:
    _, height, width = volume.shape
    low = [p.floor() for p in at]
    x, z, y = (spline_weights(p - below) for p, below in zip(at, low, strict=True))
    # whole numbers of half the size, and no new memory, take half the time
    kind = torch.int32 if volume.numel() < 2**31 else torch.int64
    corner = (low[0].to(kind) * height + low[1].to(kind)) * width + low[2].to(kind)
    flat = volume.reshape(-1)
    total = torch.zeros_like(at[0]).repeat(4, 1)
    plane, line, knot = total[:3].clone(), total[:2].clone(), total[0].clone()
    for i in range(4):
        plane.zero_()
        for j in range(4):
            line.zero_()
            number = corner + (i * height + j) * width
            for k in range(4):
                torch.index_select(flat, 0, number, out=knot)
                number += 1
                line[0].addcmul_(knot, y[0][k])
                line[1].addcmul_(knot, y[1][k])
            plane[0].addcmul_(line[0], z[0][j])
            plane[1].addcmul_(line[0], z[1][j])
            plane[2].addcmul_(line[1], z[0][j])
        total[0].addcmul_(plane[0], x[0][i])
        total[1].addcmul_(plane[0], x[1][i])
        total[2].addcmul_(plane[1], x[0][i])
        total[3].addcmul_(plane[2], x[0][i])
    return total


def nearest(mask: torch.Tensor, place: torch.Tensor | Sequence[torch.Tensor]) -> torch.Tensor:
    """A mask (images, ...) at the pixels nearest to places (images, ...)."""
    if bool(mask.all()):
        return torch.ones_like(place[0], dtype=torch.bool)
    at = [p.round().long().clamp(0, n - 1) for p, n in zip(place, mask.shape[1:], strict=True)]
    number = torch.arange(len(mask), device=mask.device).reshape(-1, *[1] * (mask.ndim - 1))
    return mask[number, *at]


def spline_weights(t: torch.Tensor) -> tuple[list[torch.Tensor], list[torch.Tensor]]:
    """The four cubic B-splines over a cell, and their slopes, at the fraction t of the cell."""
    s = 1 - t
    slope = [s * s / -2, t * (1.5 * t - 2), s * (2 - 1.5 * s), t * t / 2]
    return *_value_weights(t), slope


def _value_weights(t: torch.Tensor) -> tuple[list[torch.Tensor]]:
    s, t2 = 1 - t, t * t
    s2 = s * s
    return ([s2 * s / 6, 2 / 3 - t2 + t2 * t / 2, 2 / 3 - s2 + s2 * s / 2, t2 * t / 6],)


def band_limited(
    images: torch.Tensor | Sequence[torch.Tensor],
    noise: float | None = None,
    mismatch: torch.Tensor | None = None,
    weight: torch.Tensor | None = None,
    blur: float = 0.0,
    settings: FilterSettings | None = None,
) -> tuple[Spline, float]:
    """Splines through the images, after the filter of `band_limit.best_filter`.

    images (images, ...): non-finite pixels take the value of the nearest finite one, as a step to
        any other would be structure at rest. They do not count in the power spectrum.
    noise: standard deviation of the images' white noise. Default: from the lowest shell of the
        power spectrum.
    mismatch (shells,): spectral density N of the differences of warped images, see `mismatch`. The
        filter is then sqrt(noise^2 / N) of that for white noise (Hannan & Thomson 1973, Biometrika
        60, 241-253), so that the mismatch is whitened.
    weight (shape of an image): of the pixels, for the texture's spectrum.
    blur: standard deviation, px, of a Gaussian that blurred the images. It is corrected by a Wiener
        filter, S / (S + N / 2) / B with the Gaussian's transform B and the spectral density S of
        the blurred images.
    settings: default: those of images.

    Raises InputError: a noise that is no standard deviation.

    Returns
    -------
    spline : Spline
    noise : float
        As given or estimated.
    """
    settings = settings or FilterSettings()
    chosen = filter_of(images, noise, mismatch, weight, blur, settings)
    return filtered_spline(finite(images), chosen, settings), chosen.level


def likeliest(image: torch.Tensor, settings: FilterSettings) -> Spline:
    """Spline through an image after its Wiener filter, which removes white noise.

    Of texture of spectral density S with noise N, S / (S + N) of the image is the mean of the
    texture given the image. The filter of `band_limited` is g = sqrt(S / (S + N / 2)), so that this
    one is g^2 / (2 - g^2).
    """
    chosen = filter_of([image], settings=settings)
    square = chosen.gain.square()
    chosen = chosen._replace(gain=square / (2 - square))
    return filtered_spline(finite([image]), chosen, settings)


def filter_of(
    images: torch.Tensor | Sequence[torch.Tensor],
    noise: float | None = None,
    mismatch: torch.Tensor | None = None,
    weight: torch.Tensor | None = None,
    blur: float = 0.0,
    settings: FilterSettings | None = None,
) -> Filter:
    """The filter of `band_limited`, which takes the same arguments, without the splines."""
    checked_noise(noise)
    settings = settings or FilterSettings()
    return best_filter(spectrum_of(images, weight, settings), settings, noise, mismatch, blur)


def spectrum_of(
    images: torch.Tensor | Sequence[torch.Tensor],
    weight: torch.Tensor | None,
    settings: FilterSettings,
) -> PowerSpectrum:
    """The power spectrum of images that `band_limited` filters."""
    known = torch.stack([torch.isfinite(image) for image in images])
    sizes = transform_sizes(images[0].shape, settings)
    spectrum = power_spectrum(finite(images), sizes, settings, weight, known)
    if bool(known.all()):
        return spectrum
    # smooth values go on with the noise at the rim, the nearest ones make steps: both add power
    nearest = torch.stack([stored(nearest_in(image)) for image in images])
    by_nearest = power_spectrum(nearest, sizes, settings, weight, known)
    return spectrum._replace(density=torch.minimum(spectrum.density, by_nearest.density))


def finite(images: torch.Tensor | Sequence[torch.Tensor]) -> torch.Tensor:
    """Images (images, ...) as they are stored, with smooth values where they are not finite."""
    return torch.stack([stored(filled_in(image)) for image in images])


def transform_sizes(shape: Sequence[int], settings: FilterSettings) -> list[int]:
    """Odd lengths of the Fourier transforms of images with their margins."""
    return [odd_fast_len(n + 2 * settings.margin) for n in shape]


def filtered_spline(images: torch.Tensor, chosen: Filter, settings: FilterSettings) -> Spline:
    """Splines through finite images (images, ...) after a filter, in their precision."""
    return filtered_splines(images, [chosen], settings)[0]


def splines_of_values_and_slopes(
    images: torch.Tensor, chosen: Filter, settings: FilterSettings
) -> tuple[Spline, Spline]:
    """Splines through finite images (images, ...) for their differences, and for their slopes.

    See `band_limit.Filter`.
    """
    values, slopes = filtered_splines(images, [chosen.of_values(), chosen.of_slopes()], settings)
    return values, slopes


def filtered_splines(
    images: torch.Tensor, filters: Sequence[Filter], settings: FilterSettings
) -> list[Spline]:
    """Splines through finite images (images, ...) after each of several filters."""
    shape, margin, finer = tuple(images.shape[1:]), settings.margin, settings.nodes
    sizes = transform_sizes(shape, settings)
    dims = tuple(range(1, images.ndim))
    shell = radii(tuple(sizes), shape, images.dtype, images.device)[1]
    # images fade to 0 beyond their edges, that is to their mean
    mean = images.mean(dims, keepdim=True)
    spectrum = torch.fft.rfftn(
        faded(images - mean, sizes, margin, settings.antisymmetric), dim=dims
    )
    # cached for images only
    factor = _through_nodes if len(dims) == 2 else _through_nodes.__wrapped__
    through = factor(tuple(sizes), finer, images.dtype, images.device)
    keep = [slice(finer * (n + 2 * margin)) for n in shape]
    return [
        Spline(
            _refined(spectrum * (filter_.gain[shell] * through), sizes, finer)[:, *keep] + mean,
            shape,
            filter_.passed,
            filter_.excess,
            filter_.gain,
            filter_.efficiency,
            filter_.noisy_slopes,
            settings,
        )
        for filter_ in filters
    ]


@lru_cache(maxsize=4)
def _through_nodes(
    sizes: tuple[int, ...], finer: int, dtype: torch.dtype, device: torch.device
) -> torch.Tensor:
    """Coefficients over values of a spline through nodes, `finer` of them a pixel, by its waves."""
    factor = torch.ones((), dtype=dtype, device=device)
    for axis in frequencies(sizes, factor):
        # a cubic B-spline is 1/6, 4/6, 1/6 at its nodes: (2 + cos) / 3 in its waves
        factor = factor * 3 / (2 + torch.cos(2 * torch.pi * axis / finer))
    return factor


def mismatch(spline: Spline, residual: torch.Tensor, number: int | None = None) -> torch.Tensor:
    """Spectral density, by shells, of the differences of warped images, before their filter.

    spline: that the warped images were sampled from.
    residual (images, ...): each warped image less the mean of all; zero where not all are valid.
    number: of warped images, where `residual` is only some. Default: as many as `residual`.

    Returns
    -------
    torch.Tensor, shape (shells,)
        As `band_limited` takes it. Infinite where the filter passed nothing.
    """
    sizes = transform_sizes(spline.shape, spline.settings)
    _, shell = radii(tuple(sizes), spline.shape, residual.dtype, residual.device)
    number = number or len(residual)
    # the mean of all has taken one degree of freedom
    residual = residual * (number / (number - 1)) ** 0.5
    density, _ = shell_means(residual, shell, sizes, spline.settings.smoothing)
    passed = spline.gain.square()
    # where the filter passes next to nothing, the quotient would be rounding
    return torch.where(passed > 1e-3, density / passed, torch.inf)


def _refined(spectrum: torch.Tensor, sizes: Sequence[int], finer: int) -> torch.Tensor:
    """Fields of odd sizes (axes but the first) from their spectra, on a grid that is finer."""
    # axis by axis: the axes not yet refined are small
    for axis, n in enumerate(sizes[:-1], 1):
        # of odd length: no wave at the end of the spectrum has to be divided between both signs
        low, high = spectrum.split([n // 2 + 1, n // 2], axis)
        shape = [*spectrum.shape[:axis], (finer - 1) * n, *spectrum.shape[axis + 1 :]]
        spectrum = torch.fft.ifft(torch.cat([low, low.new_zeros(shape), high], axis), dim=axis)
    # inverse transforms divide by the finer sizes
    return finer ** len(sizes) * torch.fft.irfft(spectrum, n=finer * sizes[-1])
