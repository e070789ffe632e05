"""The filter that passes the texture of images or volumes and stops their noise."""

import math
from collections.abc import Sequence
from functools import lru_cache, reduce
from typing import NamedTuple

import scipy.fft
import torch

from lidar_mi.errors import InputError
from lidar_mi.retrieval.images.settings import FilterSettings

# Shells of the power spectrum with fewer waves have too uncertain a mean.
_SHELL_WAVES = 200
# Least number of shells per cycle per pixel.
_SHELLS = 16


class Filter(NamedTuple):
    """A filter by shells of wavenumber, and its effect on texture and noise.

    gain (shells,)
    level: standard deviation of the white noise before the filter.
    passed: fraction of the variance of white noise that the filter lets pass.
    excess: variance of a displacement over that from noise-free slopes.
    efficiency: fraction of the information in the slopes that is left: 1 unless blur is corrected,
        which amplifies the noise of short waves.
    values, slopes (shells,): the same filter divided between the two factors that inform a
        displacement: differences of the images, whose noise becomes white, and their slopes, which
        become the likeliest ones of the texture (Wiener). Where blur is corrected both are `gain`.
    noisy_slopes: mean square of the slopes that noise alone makes in the mean of two images after
        the filter of the slopes, summed over the axes, per px^2.
    """

    gain: torch.Tensor
    level: float
    passed: float
    excess: float
    efficiency: float
    values: torch.Tensor
    slopes: torch.Tensor
    noisy_slopes: float

    def of_values(self) -> "Filter":
        """The filter of the differences alone."""
        passed = self.passed if self.values is self.gain else 1.0
        return self._replace(gain=self.values, passed=passed)

    def of_slopes(self) -> "Filter":
        """The filter of the slopes alone."""
        return self._replace(gain=self.slopes)

    def to(self, like: torch.Tensor) -> "Filter":
        """The same in the precision of a tensor."""
        gain = self.gain.to(like)
        values = gain if self.values is self.gain else self.values.to(like)
        return self._replace(gain=gain, values=values, slopes=self.slopes.to(like))


class PowerSpectrum(NamedTuple):
    """Power spectral density by shells of wavenumber, and its relative standard errors.

    `shape` is that of the images, `sizes` are the odd lengths of their Fourier transforms.
    """

    density: torch.Tensor
    uncertainty: torch.Tensor
    shape: tuple[int, ...]
    sizes: tuple[int, ...]


def power_spectrum(
    images: torch.Tensor,
    sizes: Sequence[int],
    settings: FilterSettings,
    weight: torch.Tensor | None = None,
    known: torch.Tensor | None = None,
) -> PowerSpectrum:
    """The power spectrum of finite images (images, ...) that `best_filter` takes.

    Fourier transforms have odd ``sizes``; weight and known pixels are those of
    `spline.band_limited`.
    """
    shape = tuple(images.shape[1:])
    _, shell = radii(tuple(sizes), shape, images.dtype, images.device)
    weighted = images if weight is None else images * weight
    means = shell_means(weighted, shell, sizes, settings.smoothing, known)
    return PowerSpectrum(*means, shape, tuple(sizes))


def best_filter(
    spectrum: PowerSpectrum,
    settings: FilterSettings,
    noise: float | None = None,
    mismatch: torch.Tensor | None = None,
    blur: float = 0.0,
) -> Filter:
    """The filter of least variance of a displacement between images.

    With texture of spectral density S and white noise N the filter is sqrt(S / (S + N / 2)): of
    all filters applied to both images of a pair before their differences are squared, the one
    with the least variance of the displacement (a wave k informs it by k^2 S at a variance of
    4 S N + 2 N^2, so its weight S / (2 S + N) is the square of this filter but for a factor).
    Noise, mismatch and blur are those of `spline.band_limited`.
    """
    density, uncertainty, shape, sizes = spectrum
    radius, shell = radii(sizes, shape, density.dtype, density.device)
    below = 1 + settings.threshold * uncertainty
    if mismatch is not None:
        # shells that were stopped before stay stopped
        floor = torch.where(mismatch.isfinite(), mismatch, density)
        floor = floor.clamp(min=max(1e-9 * float(density.max()), 1e-30))
    elif noise is None:
        # the lowest shells are low partly by chance: the mean of all shells consistent with them
        floor = (density * below).min()
        fraction = uncertainty**-2 * (density <= floor * below)
        floor = (fraction * density).sum() / fraction.sum()
    else:
        floor = torch.as_tensor(noise**2, dtype=density.dtype, device=density.device)
    # shells of noise alone must not pass because their mean happens to be a little higher
    texture = torch.where(density > floor * below, density - floor, 0.0)
    tiny = torch.finfo(density.dtype).tiny
    response = texture / (texture + floor / 2 + tiny)
    # as if all noise were white and of this variance
    level = floor
    if mismatch is not None and noise is not None:
        level = torch.as_tensor(noise**2).to(floor)
    if blur:
        # the inverse of the Gaussian's transform, limited, as noise is amplified as well
        sharper = torch.exp((blur * wavenumbers(response, shape)).square() / 2).clamp(
            max=settings.sharpening
        )
        # the Wiener filter S / (S + N / 2) / B itself: the root is taken below
        response = torch.where(response > 0, (response * sharper).square(), 0.0)
    passed = _mean(response[shell], sizes)
    # times sqrt(noise^2 / N) the filter whitens the mismatch (Hannan & Thomson 1973)
    white = level / floor if mismatch is not None else torch.ones_like(response)
    gain = (response * white).sqrt()
    values, slopes = (gain, gain) if blur else (white.sqrt(), response * white.sqrt())
    # power of the filtered slopes with noise, the part of it from texture, and its variance
    # the mean of two images has half the variance of their noise
    noisy = texture + floor / 2
    steep = radius**2 * gain[shell] ** 2
    power, informed, spread = (
        float((steep * spectrum[shell]).sum()) for spectrum in (noisy, texture, response * noisy)
    )
    return Filter(
        gain,
        float(level.sqrt()),
        passed,
        power / informed if informed > 0 else 1.0,
        informed / spread if informed > 0 else 1.0,
        values,
        slopes,
        # slopes per px have radians, frequencies have cycles
        (2 * math.pi) ** 2
        * _mean((radius * slopes[shell]).square() * (floor / 2).expand(len(gain))[shell], sizes),
    )


def flat_if_better(
    spectrum: PowerSpectrum, mismatch: torch.Tensor, threshold: float, strain: float
) -> torch.Tensor:
    """The mismatch, at one level if whitening it would not lessen errors.

    A filter of one image and one of an image that strain has deformed are not the same filter in
    the air: where the gain changes by the factor e^a per factor e of the wavenumber, a strain e in
    dt makes the images differ by a e times their texture. So a filter that is not flat costs
    accuracy where there is strain and hardly any noise.

    Displacements from texture of spectral density S through a filter g have the variance
    sum(k^2 S g^4 N) / sum(k^2 S g^2)^2 in noise of the density N, the mismatch.

    spectrum: of the images.
    mismatch (shells,): see `spline.band_limited`.
    threshold: standard errors by which a shell must exceed the mismatch to count as texture.
    strain: mean square of the strain in dt along any direction.

    Returns
    -------
    torch.Tensor, shape (shells,)
        The mean of the mismatch, weighted as in the variance, if whitening does not lessen the
        variance. Else the mismatch.
    """
    density, uncertainty, shape, sizes = spectrum
    above = density > mismatch * (1 + threshold * uncertainty)
    if int(above.sum()) < 3:
        return mismatch
    _, shell = radii(sizes, shape, density.dtype, density.device)
    number = torch.bincount(shell.flatten(), minlength=len(density)).to(density)[above]
    noise, texture = mismatch[above], (density - mismatch)[above]
    wave = wavenumbers(density, shape)[above]
    response = texture / (texture + noise / 2)
    steep = number * wave.square() * texture
    level = (steep * response.square() * noise).sum() / (steep * response.square()).sum()
    slope = torch.gradient(noise.log() / 2)[0] / torch.gradient(wave.log())[0]
    deformed = strain * slope.square() * texture
    # g here is the square of the docstring's: the weight of a wave
    flat, white = (
        (steep * g.square() * n).sum() / (steep * g).sum().square()
        for g, n in ((response, noise), (response / noise, noise + deformed))
    )
    return mismatch if white < flat else level.expand_as(mismatch)


def _mean(values: torch.Tensor, sizes: Sequence[int]) -> float:
    """Mean over all waves of values at those of a real Fourier transform."""
    # all but the first column stand for two waves
    return float(values[..., :1].sum() + 2 * values[..., 1:].sum()) / math.prod(sizes)


def checked_noise(noise: float | None) -> None:
    """Raise an `InputError` unless a standard deviation, if given, is one."""
    if noise is not None and not noise >= 0:
        raise InputError(f"noise: {noise!r} is not a standard deviation >= 0")


def odd_fast_len(least: int) -> int:
    """A length, fast to transform, at which no wave is its own mirror image."""
    size = scipy.fft.next_fast_len(least, real=True)
    while size % 2 == 0:
        size = scipy.fft.next_fast_len(size + 1, real=True)
    return size


def even_fast_len(least: int) -> int:
    """A length of the fastest transforms: a multiple of 16."""
    return 16 * scipy.fft.next_fast_len(-(-least // 16))


def frequencies(sizes: Sequence[int], like: torch.Tensor) -> list[torch.Tensor]:
    """Cycles per pixel along the axes of a real Fourier transform, as they broadcast."""
    *others, last = sizes
    kind = {"dtype": like.dtype, "device": like.device}
    along = [torch.fft.fftfreq(n, **kind) for n in others] + [torch.fft.rfftfreq(last, **kind)]
    return [f.reshape(-1, *[1] * (len(sizes) - 1 - axis)) for axis, f in enumerate(along)]


def shells(frequency: Sequence[torch.Tensor], shape: Sequence[int]) -> torch.Tensor:
    """Wavenumber in whole cycles per shortest side of the image (at least 16 px)."""
    return (_radius(frequency) * _per_cycle(shape)).long()


@lru_cache(maxsize=8)
def _radii(
    sizes: tuple[int, ...], shape: Sequence[int], dtype: torch.dtype, device: torch.device
) -> tuple[torch.Tensor, torch.Tensor]:
    frequency = frequencies(sizes, torch.empty(0, dtype=dtype, device=device))
    return _radius(frequency), shells(frequency, shape)


def radii(
    sizes: tuple[int, ...], shape: Sequence[int], dtype: torch.dtype, device: torch.device
) -> tuple[torch.Tensor, torch.Tensor]:
    """Frequency of each wave of a real Fourier transform, cycles per px, and its shell.

    They depend on the grid alone: those of images are stored for the next images.
    """
    return (_radii if len(sizes) == 2 else _radii.__wrapped__)(sizes, shape, dtype, device)


def wavenumbers(of: torch.Tensor, shape: Sequence[int]) -> torch.Tensor:
    """Mean wavenumber of each shell, radians per px; `of` holds one value per shell."""
    return 2 * torch.pi * (torch.arange(len(of)).to(of) + 0.5) / _per_cycle(shape)


def _per_cycle(shape: Sequence[int]) -> int:
    return max(min(shape), _SHELLS)


def _radius(frequency: Sequence[torch.Tensor]) -> torch.Tensor:
    return reduce(torch.hypot, frequency)


def shell_means(
    images: torch.Tensor,
    shell: torch.Tensor,
    sizes: Sequence[int],
    smoothing: int,
    known: torch.Tensor | None = None,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Power spectrum by shells of wavenumber, mean over the images; white noise gives its variance.

    This holds also where only some pixels are `known`, (images, ...), and the others are the mean.

    Each shell's value is a mean over `smoothing` neighbours. Returns these means and their
    relative standard errors.
    """
    shape = images.shape[1:]
    dims = tuple(range(1, images.ndim))
    window = torch.ones((), dtype=images.dtype, device=images.device)
    for n in shape:
        hann = torch.hann_window(n + 2, periodic=False, dtype=images.dtype, device=images.device)
        # without the zeros at its ends, which would discard the outer pixels
        window = window[..., None] * hann[1:-1]
    # as the window weights it: the windowed field then has no wave of frequency 0
    mean = (images * window).sum(dims, keepdim=True) / window.sum()
    power = torch.fft.rfftn((images - mean) * window, s=list(sizes), dim=dims)
    power = power.abs().square().mean(0)
    covered = window.square()
    if known is not None and not bool(known.all()):
        covered = (covered * known).sum() / len(images)
    power = power / covered.sum().clamp(min=1e-30)
    number = torch.bincount(shell.flatten())
    total = torch.bincount(shell.flatten(), weights=power.flatten())
    kernel = torch.ones(1, 1, smoothing, dtype=images.dtype, device=images.device)
    total, number = (
        torch.nn.functional.conv1d(sums.to(images)[None], kernel, padding=smoothing // 2)[0]
        for sums in (total, number)
    )
    density = total / number.clamp(min=1)
    # the last shells are cut by the corners: they take the last full shell's value
    most = int(number.argmax())
    last = most + int((number[most:] >= min(_SHELL_WAVES, float(number[most]))).sum()) - 1
    density[last + 1 :] = density[last]
    fraction = len(images) * independent_fraction(shape, sizes)
    return density, (fraction * number.clamp(min=1)).rsqrt()


def independent_fraction(shape: Sequence[int], sizes: Sequence[int]) -> float:
    """Of the waves of the transform of an image, as `shell_means` takes it, how many count.

    An image has as many as pixels, and tapering leaves two fifths of them.
    """
    return 0.4 ** (len(shape) / 2) * math.prod(shape) / math.prod(sizes)


def faded(
    images: torch.Tensor, sizes: Sequence[int], margin: int, antisymmetric: bool
) -> torch.Tensor:
    """Images or volumes of mean 0, mirrored at their edges, fading to 0 over the margin.

    A Fourier transform is periodic. Were one side brighter than the other, a low-pass filter would
    ring from that step into the image.

    images (number, ...)
    sizes: of the result along all axes but the first; `margin` pixels of it come before the image.
    antisymmetric: mirrored about the edge's value as well, which keeps the slope.
    """
    for axis, size in enumerate(sizes, 1):
        n = images.shape[axis]
        place = torch.arange(-margin, size - margin, device=images.device)
        beyond = torch.maximum(-place, place - (n - 1)).clamp(0, margin).to(images)
        # a raised cosine: no step of value or slope at either end
        fade = (1 + torch.cos(torch.pi * beyond / margin)) / 2
        edge = place.clamp(0, n - 1)
        # mirrored about the outer pixels, which are not repeated: the period is 2 n - 2
        place = place % max(2 * n - 2, 1)
        mirrored = images.index_select(axis, torch.minimum(place, (2 * n - 2 - place) % (2 * n)))
        if antisymmetric:
            mirrored = torch.where(
                (beyond > 0).reshape(-1, *[1] * (len(sizes) - axis)),
                2 * images.index_select(axis, edge) - mirrored,
                mirrored,
            )
        images = mirrored * fade.reshape(-1, *[1] * (len(sizes) - axis))
    return images
