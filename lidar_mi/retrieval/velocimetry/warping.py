"""Images as smooth functions of place: band-limited, then read anywhere with their slopes."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import scipy.fft
import torch

from lidar_mi.errors import InputError
from lidar_mi.retrieval.velocimetry.quality import filled
from lidar_mi.retrieval.velocimetry.windows import working

# Pixels of mirrored image around each image. The spline's answer to the edge falls by 0.27 a
# pixel, the filter's within a correlation length of the texture.
_MARGIN = 24
# Nodes of the spline in a pixel, along each axis: the images' shortest waves are then four nodes long
# or more, of which a cubic spline loses 2.8 % at most. Through pixels it would lose all of them half way
# between, and turn the phase of longer ones: displacements of texture near 2 px were off by 0.09 px.
_FINER = 2
# Waves that blur lowered are raised by this at most: of more, the rims that the blur did not see
# and what a spline loses between pixels is all there is.
_SHARPEST = 4.0
# Rings of the power spectrum with fewer waves say too little about their mean.
_RING_WAVES = 200


class Spline(NamedTuple):
    """Cubic B-spline through images, on nodes half a pixel apart.

    Attributes
    ----------
    coefficients : torch.Tensor, shape (images, 2 z + 4 margin, 2 y + 4 margin)
    shape : (int, int)
        Of the images, (z, y).
    passed : float
        Share of the variance of white noise that the filter before the spline let pass.
    excess : float
        Variance of a displacement over what the slopes would allow, were they free of noise.
    gain : torch.Tensor, shape (rings,)
        Of the filter, by wavenumber in cycles per shorter side of the image.
    worth : float
        Of what the slopes seem to tell, the share that they do: 1 but where blur was undone, which
        makes the noise of short waves stronger.
    """

    coefficients: torch.Tensor
    shape: tuple[int, int]
    passed: float
    excess: float
    gain: torch.Tensor
    worth: float

    def filtered(self, field: torch.Tensor) -> torch.Tensor:
        """A field on the images' pixels after the images' filter; it is zero beyond them."""
        sizes = [scipy.fft.next_fast_len(n + _MARGIN, real=True) for n in self.shape]
        # sizes of another parity may reach one ring further
        ring = _ring(_frequencies(sizes, field), self.shape).clamp(max=len(self.gain) - 1)
        smooth = torch.fft.irfft2(torch.fft.rfft2(field, s=sizes) * self.gain[ring], s=sizes)
        return smooth[..., : self.shape[0], : self.shape[1]]

    def holds(self, z: torch.Tensor, y: torch.Tensor) -> torch.Tensor:
        """Which places lie on the images, up to the outer pixels' centres."""
        inside = [(p >= 0) & (p <= n - 1) for p, n in zip((z, y), self.shape)]
        return inside[0] & inside[1]

    def sample(
        self, z: torch.Tensor, y: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Value and slopes along z and y of every image at its own places.

        Parameters
        ----------
        z, y : torch.Tensor, shape (images, ...)
            Pixels from the first one; places beyond the image take the edge's value.

        Returns
        -------
        value, slope_z, slope_y : torch.Tensor, shape (images, ...)
        """
        images, height, width = self.coefficients.shape
        z, y = (
            _FINER * (place.clamp(0, size - 1) + _MARGIN) - 1
            for place, size in zip((z, y), self.shape)
        )
        row, column = z.floor(), y.floor()
        weight_z, weight_y = spline_weights(z - row), spline_weights(y - column)
        first = torch.arange(images, device=z.device).view(-1, *[1] * (z.ndim - 1)) * height
        corner = (first + row.long()) * width + column.long()
        flat = self.coefficients.reshape(-1)
        total = [torch.zeros_like(z) for _ in range(3)]
        for i in range(4):
            along = [torch.zeros_like(z) for _ in range(2)]
            for j in range(4):
                knot = flat[corner + (i * width + j)]
                along[0].addcmul_(knot, weight_y[0][j])
                along[1].addcmul_(knot, weight_y[1][j])
            total[0].addcmul_(along[0], weight_z[0][i])
            total[1].addcmul_(along[0], weight_z[1][i])
            total[2].addcmul_(along[1], weight_z[0][i])
        return total[0], _FINER * total[1], _FINER * total[2]


def spline_weights(t: torch.Tensor) -> tuple[list[torch.Tensor], list[torch.Tensor]]:
    """The four cubic B-splines over a cell, and their slopes, at the fraction t of the cell."""
    s, t2 = 1 - t, t * t
    s2 = s * s
    value = [s2 * s / 6, 2 / 3 - t2 + t2 * t / 2, 2 / 3 - s2 + s2 * s / 2, t2 * t / 6]
    slope = [-s2 / 2, t * (1.5 * t - 2), s * (2 - 1.5 * s), t2 / 2]
    return value, slope


def levelled(images: Sequence[torch.Tensor]) -> torch.Tensor:
    """Images of one texture but unlike brightness: all with mean 0 and the first one's contrast."""
    images = [working(filled(image)) for image in images]
    images = torch.stack([image - image.mean() for image in images])
    contrast = images.square().mean((1, 2), keepdim=True).sqrt()
    return images * torch.where(contrast > 0, contrast[:1] / contrast, 1.0)


def rms(noise: float | torch.Tensor) -> float:
    """One standard deviation for an image, from its own or those of its pixels (NaN left out)."""
    if not isinstance(noise, torch.Tensor):
        return noise
    finite = working(noise[torch.isfinite(noise)])
    return float(finite.square().mean().sqrt()) if finite.numel() else 0.0


def averaged(field: torch.Tensor, known: torch.Tensor, width: float) -> torch.Tensor:
    """Mean of a field (z, y) over Gaussians, of what is known; of all of it where nothing is near."""
    reach = math.ceil(3 * width)
    place = torch.arange(-reach, reach + 1, dtype=field.dtype, device=field.device) / width
    bell = torch.exp(-place.square() / 2)
    both = torch.stack([torch.where(known, field, 0.0), known.to(field)])[:, None]
    for shape, rim in (((-1, 1), (reach, 0)), ((1, -1), (0, reach))):
        both = torch.nn.functional.conv2d(both, bell.reshape(1, 1, *shape), padding=rim)
    total, number = both[:, 0]
    mean = field[known].mean() if bool(known.any()) else 0.0
    return torch.where(number > 1e-3, total / number.clamp(min=1e-3), mean)


def band_limited(
    images: torch.Tensor,
    noise: float | None = None,
    mismatch: torch.Tensor | None = None,
    weight: torch.Tensor | None = None,
    blur: float = 0.0,
) -> tuple[Spline, float]:
    """Splines through the images, after a filter that passes the texture and stops the noise.

    With texture of spectral density S and white noise N the filter is sqrt(S / (S + N / 2)): of
    all filters applied to both images of a pair before their differences are squared, the one
    with the least variance of the displacement (a wave k tells k^2 S of it, against a variance of
    4 S N + 2 N^2, so its weight S / (2 S + N) is the square of this filter but for a factor).
    Parameters
    ----------
    images : torch.Tensor, shape (images, z, y)
        Non-finite pixels take the image's mean.
    noise : float, optional
        Standard deviation of the images' white noise. Left out: from the lowest ring of the
        power spectrum.
    mismatch : torch.Tensor, shape (rings,), optional
        Spectral density N of what the images do not share, see `mismatch`. The filter is then
        sqrt(noise^2 / N) of what it would be in white noise (Hannan & Thomson 1973, Biometrika
        60, 117-130), so that what it passes of the mismatch is as if it had been white.
    weight : torch.Tensor, shape (z, y), optional
        Of the pixels, for the texture's spectrum.
    blur : float, optional
        Standard deviation, px, of a Gaussian that blurred the images. It is undone by a Wiener
        filter, S / (S + N / 2) / B with the Gaussian's transform B and S as it is in the images.

    Returns
    -------
    spline : Spline
    noise : float
        As given or estimated.
    """
    if noise is not None and not noise >= 0:
        raise InputError(f"noise: {noise!r} is not a standard deviation >= 0")
    images = torch.stack([working(filled(image)) for image in images])
    shape = tuple(images.shape[1:])
    sizes = [_odd_fast_len(n + 2 * _MARGIN) for n in shape]
    frequency = _frequencies(sizes, images)
    radius = torch.hypot(*frequency)
    ring = _ring(frequency, shape)
    density, uncertainty = _ring_means(images if weight is None else images * weight, ring, sizes)
    if mismatch is not None:
        # rings that were stopped before stay stopped
        floor = torch.where(mismatch.isfinite(), mismatch, density)
        floor = floor.clamp(min=max(1e-9 * float(density.max()), 1e-30))
    elif noise is None:
        # the lowest rings are low by chance as well: the mean of all that may be as low
        floor = (density * (1 + 2 * uncertainty)).min()
        weight = uncertainty**-2 * (density <= floor * (1 + 2 * uncertainty))
        floor = (weight * density).sum() / weight.sum()
    else:
        floor = torch.as_tensor(noise**2, dtype=images.dtype, device=images.device)
    # rings of noise alone must not pass because their mean happens to be a little higher
    texture = density - floor
    texture = torch.where(density > floor * (1 + 2 * uncertainty), texture, 0.0)
    tiny = torch.finfo(images.dtype).tiny
    response = texture / (texture + floor / 2 + tiny)
    # as if all noise were white and of this variance
    level = floor if mismatch is None else torch.as_tensor(noise**2).to(floor)
    if blur:
        wave = (torch.arange(len(response)).to(response) + 0.5) / min(shape)
        sharper = torch.exp(2 * (torch.pi * blur * wave).square()).clamp(max=_SHARPEST)
        response = torch.where(response > 0, (response * sharper).square(), 0.0)
    passed = response[ring]
    passed = float(passed[:, :1].sum() + 2 * passed[:, 1:].sum())
    white = level / floor if mismatch is not None else torch.ones_like(response)
    gain = (response * white).sqrt()[ring]
    # the slopes' power with noise and filter, what of it tells the displacement, and its variance
    both = texture + floor / 2
    power, told, spread = (
        float((radius**2 * gain**2 * spectrum[ring]).sum())
        for spectrum in (both, texture, response * both)
    )

    mean = images.mean((1, 2), keepdim=True)
    spectrum = torch.fft.rfft2(extended(images - mean, sizes))
    for axis in frequency:
        gain = gain / ((2 + torch.cos(2 * torch.pi * axis / _FINER)) / 3)
    smooth = _refined(spectrum * gain, sizes) + mean
    keep = [_FINER * (n + 2 * _MARGIN) for n in shape]
    smooth = smooth[:, : keep[0], : keep[1]].contiguous()
    excess = power / told if told > 0 else 1.0
    passed /= sizes[0] * sizes[1]
    worth = told / spread if told > 0 else 1.0
    return Spline(smooth, shape, passed, excess, (response * white).sqrt(), worth), float(
        level.sqrt()
    )


def mismatch(spline: Spline, rest: torch.Tensor) -> torch.Tensor:
    """Spectral density, by rings, of what carried images do not share, before their filter.

    Parameters
    ----------
    spline : Spline
        That the images were read from.
    rest : torch.Tensor, shape (images, z, y)
        Each carried image less the mean of all; zero where not all are seen.

    Returns
    -------
    torch.Tensor, shape (rings,)
        As `band_limited` takes it. Infinite where the filter passed nothing.
    """
    sizes = [_odd_fast_len(n + 2 * _MARGIN) for n in spline.shape]
    ring = _ring(_frequencies(sizes, rest), spline.shape)
    number = len(rest)
    density, _ = _ring_means(rest * (number / (number - 1)) ** 0.5, ring, sizes)
    passed = spline.gain.square()
    return torch.where(passed > 1e-3, density / passed, torch.inf)


def _odd_fast_len(least: int) -> int:
    """A length, fast to transform, at which no wave is its own mirror image."""
    size = scipy.fft.next_fast_len(least, real=True)
    while size % 2 == 0:
        size = scipy.fft.next_fast_len(size + 1, real=True)
    return size


def _refined(spectrum: torch.Tensor, sizes: Sequence[int]) -> torch.Tensor:
    """Fields (..., z, y) of odd sizes from their spectra, on a grid that is `_FINER` times finer."""
    rows, columns = spectrum.shape[-2:]
    fine = [_FINER * size for size in sizes]
    padded = spectrum.new_zeros(*spectrum.shape[:-2], fine[0], fine[1] // 2 + 1)
    low = rows // 2 + 1
    padded[..., :low, :columns] = spectrum[..., :low, :]
    padded[..., low - rows :, :columns] = spectrum[..., low:, :]
    return _FINER**2 * torch.fft.irfft2(padded, s=fine)


def _frequencies(sizes: list[int], like: torch.Tensor) -> list[torch.Tensor]:
    """Cycles per pixel along z and y of a real Fourier transform, as they broadcast."""
    return [
        torch.fft.fftfreq(sizes[0], dtype=like.dtype, device=like.device)[:, None],
        torch.fft.rfftfreq(sizes[1], dtype=like.dtype, device=like.device)[None, :],
    ]


def _ring(frequency: list[torch.Tensor], shape: tuple[int, int]) -> torch.Tensor:
    """Wavenumber in whole cycles per shorter side of the image."""
    return (torch.hypot(*frequency) * min(shape)).long()


def extended(images: torch.Tensor, sizes: Sequence[int], margin: int = _MARGIN) -> torch.Tensor:
    """Images or volumes of mean 0, mirrored at their edges, fading to 0 over the margin.

    A Fourier transform goes on from the last pixel to the first. Were one side brighter than the
    other, a filter that stops short waves would ring from that step into the image.

    Parameters
    ----------
    images : torch.Tensor, shape (number, ...)
    sizes : sequence of int
        Of the result along all axes but the first; `margin` pixels of it come before the image.
    """
    for axis, size in enumerate(sizes, 1):
        n = images.shape[axis]
        place = torch.arange(-margin, size - margin, device=images.device)
        beyond = torch.maximum(-place, place - (n - 1)).clamp(0, margin).to(images)
        fade = (1 + torch.cos(torch.pi * beyond / margin)) / 2
        place = place % max(2 * n - 2, 1)
        images = images.index_select(axis, torch.minimum(place, (2 * n - 2 - place) % (2 * n)))
        images = images * fade.reshape(-1, *[1] * (len(sizes) - axis))
    return images


def _ring_means(
    images: torch.Tensor, ring: torch.Tensor, sizes: list[int]
) -> tuple[torch.Tensor, torch.Tensor]:
    """Power spectrum by rings of wavenumber, mean over the images; white noise gives its variance.

    Each ring's value is a mean over itself and its four neighbours. Returns these means and their
    relative standard errors.
    """
    shape = images.shape[1:]
    window = [
        torch.hann_window(n + 2, periodic=False, dtype=images.dtype, device=images.device)[1:-1]
        for n in shape
    ]
    window = window[0][:, None] * window[1]
    mean = (images * window).sum((1, 2), keepdim=True) / window.sum()
    power = torch.fft.rfft2((images - mean) * window, s=sizes).abs().square().mean(0)
    power = power / window.square().sum()
    number = torch.bincount(ring.flatten())
    total = torch.bincount(ring.flatten(), weights=power.flatten())
    kernel = torch.ones(1, 1, 5, dtype=images.dtype, device=images.device)
    total, number = (
        torch.nn.functional.conv1d(sums.to(images)[None], kernel, padding=2)[0]
        for sums in (total, number)
    )
    density = total / number.clamp(min=1)
    # the last rings are cut by the corners: they take the last full ring's value
    most = int(number.argmax())
    last = most + int((number[most:] >= min(_RING_WAVES, float(number[most]))).sum()) - 1
    density[last + 1 :] = density[last]
    # independent waves: an image has as many as pixels, tapering leaves two fifths of them
    share = 0.4 * len(images) * shape[0] * shape[1] / (sizes[0] * sizes[1])
    return density, (share * number.clamp(min=1)).rsqrt()
