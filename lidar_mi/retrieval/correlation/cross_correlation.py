"""Cross-correlation of image windows: displacement from the peak (CC).

The coefficient is the true zero-mean normalised one (NCC): mean and energy are those of the
template and of each candidate, shift by shift,

    c(s) = sum (f - <f>) (g_s - <g_s>) / sqrt(sum (f - <f>)^2  sum (g_s - <g_s>)^2),

with f the template of image 1 and g_s the equally large piece of image 2 at shift s. One
normalisation for a whole search region, as in some tools, biases the peak toward the
brighter side of a smooth image.
"""

import math

import scipy.fft
import torch
from kornia.contrib import extract_tensor_patches

from lidar_mi.errors import InputError
from lidar_mi.flags import Flag
from lidar_mi.retrieval.images.displacement import Displacement
from lidar_mi.retrieval.images.quality import check_between, filled, non_finite
from lidar_mi.retrieval.images.windows import (
    Windows,
    box_sum,
    candidates,
    image_pair,
    strided,
    working,
)

ALGORITHMS = ("auto", "dense", "fft")


def cross_correlation(
    image1: torch.Tensor,
    image2: torch.Tensor,
    template: int = 8,
    search: int = 16,
    stride: int = 1,
    *,
    min_correlation: float = 0.5,
    algorithm: str = "auto",
) -> Displacement:
    """Displacement of every template by the highest correlation in its search region.

    The integer peak is refined in both directions by a Gaussian through the peak and its two
    neighbours (Willert & Gharib 1991, Exp. Fluids 10, 181-193). On smooth images with few
    correlation lengths in a window the peak is no Gaussian: expect 0.1 px rms without any noise
    for an 8 px template on texture of 3 px correlation length. A displacement beyond
    (search - template) // 2 - 1/2 px is out of range; its peak lies on the rim and is flagged.
    Pixels are those of `windows.Windows`. Peaks below ``min_correlation`` are flagged; the
    algorithms are those of `correlate`. The `score` is the correlation at the integer peak.

    Raises InputError: sizes, algorithm or threshold out of range; images that differ in size.
    """
    check_between("min_correlation", min_correlation, -1, 1)
    image_pair(image1, image2)
    windows = Windows(tuple(image1.shape), template, search, stride)
    chosen = _choose(algorithm, windows)
    bad = non_finite([image1, image2], windows)
    # before the conversion to the working precision, which hides how the numbers were rounded
    floors = [_rounding(image) for image in (image1, image2)]
    image1, image2 = working(filled(image1)), working(filled(image2))
    displacement = Displacement.empty(windows, image1)
    for tile in windows.tiles(_bytes_per_window(windows, chosen)):
        coefficient = _correlate(image1[tile.pixels], image2[tile.pixels], windows, chosen, floors)
        displacement.fill(_peak(coefficient, windows, min_correlation), tile.vectors)
    displacement.d[:, bad] = torch.nan
    displacement.flag[bad] |= Flag.NON_FINITE_INPUT.value
    return displacement


def correlate(
    image1: torch.Tensor,
    image2: torch.Tensor,
    template: int = 8,
    search: int = 16,
    stride: int = 1,
    *,
    algorithm: str = "auto",
) -> torch.Tensor:
    """Normalised correlation of every template with all candidates of its search region.

    image1, image2 (z, y): finite; the coefficient does not depend on their scale and offset.
    template, search, stride: pixels, see `windows.Windows`.
    algorithm {"auto", "dense", "fft"}: "dense" multiplies the whole images at each shift and sums
        over boxes: its cost does not depend on the template and hardly on the stride. "fft"
        transforms each window: its cost scales with the number of windows and hardly depends on the
        number of shifts. Both give the same numbers; "auto" takes the cheaper one.

    Raises InputError: as `cross_correlation`.

    Returns
    -------
    torch.Tensor, shape (shifts, shifts, rows, columns)
        Between -1 and 1; [p, q, i, j] belongs to the shift (p - lead, q - lead) px in (z, y) of
        window (i, j). Zero where template or candidate has no contrast beyond the rounding of
        the images' own numbers. All of it is held in memory; `cross_correlation` works by tiles.
    """
    image_pair(image1, image2)
    windows = Windows(tuple(image1.shape), template, search, stride)
    floors = [_rounding(image) for image in (image1, image2)]
    chosen = _choose(algorithm, windows)
    image1, image2 = (working(image)[windows.pixels] for image in (image1, image2))
    return _correlate(image1, image2, windows, chosen, floors)


def _choose(algorithm: str, windows: Windows) -> str:
    if algorithm not in ALGORITHMS:
        raise InputError(f"algorithm: {algorithm!r} is not one of {', '.join(ALGORITHMS)}")
    if algorithm != "auto":
        return algorithm
    # Passes over the data, weighted by measured times: box sums stream through memory, an FFT of
    # a window costs about ten times as much per value.
    rows, columns = windows.count
    pixels = (rows - 1) * windows.stride + windows.template
    pixels *= (columns - 1) * windows.stride + windows.template
    doublings = windows.template.bit_length()
    dense = windows.shifts**2 * pixels * (1 + doublings * (1 + 1 / windows.stride))
    side = scipy.fft.next_fast_len(windows.search, real=True)
    fft = rows * columns * (10 * side**2 * math.log2(side) + 8 * windows.shifts**2)
    return "dense" if dense <= fft else "fft"


def _bytes_per_window(windows: Windows, algorithm: str) -> int:
    values = 4 * windows.shifts**2 + (8 * windows.search**2 if algorithm == "fft" else 0)
    return 8 * values + 64 * windows.stride**2


def _rounding(image: torch.Tensor) -> float:
    """Variance below which differences between pixels are rounding of the numbers themselves."""
    finite = image[torch.isfinite(image)]
    if not finite.numel():
        return 0.0
    eps = torch.finfo(image.dtype if image.is_floating_point() else torch.float64).eps
    return (4 * eps * float(finite.abs().max())) ** 2


def _correlate(
    image1: torch.Tensor,
    image2: torch.Tensor,
    windows: Windows,
    algorithm: str,
    floors: list[float],
) -> torch.Tensor:
    windows = Windows(tuple(image1.shape), windows.template, windows.search, windows.stride)
    # The coefficient does not depend on an offset; sums of squares lose least without one.
    image1, image2 = image1 - image1.mean(), image2 - image2.mean()
    n = windows.template
    mean1 = windows.of_templates(image1)
    weight1 = _inverse_deviation(windows.of_templates(image1**2), mean1, floors[0])
    mean2, square2 = (box_sum(box_sum(power, n, -1), n, -2) / n**2 for power in (image2, image2**2))
    weight2 = candidates(_inverse_deviation(square2, mean2, floors[1]), windows)
    if algorithm == "dense":
        covariance = _covariance_dense(image1, image2, mean1, candidates(mean2, windows), windows)
    else:
        covariance = _covariance_fft(image1, image2, windows)
    return covariance.mul_(weight2).mul_(weight1)


def _inverse_deviation(square: torch.Tensor, mean: torch.Tensor, floor: float) -> torch.Tensor:
    """1 / standard deviation from <x^2> and <x>; 0 where it is within rounding."""
    variance = square - mean**2
    # <x^2> - <x>^2 cancels: its rounding error is that of <x^2>
    limit = floor + 16 * torch.finfo(square.dtype).eps * square
    # 1 / sqrt(inf) = 0: without contrast no correlation
    return torch.where(variance > limit, variance, torch.inf).rsqrt()


def _covariance_dense(
    image1: torch.Tensor,
    image2: torch.Tensor,
    mean1: torch.Tensor,
    mean2: torch.Tensor,
    windows: Windows,
) -> torch.Tensor:
    """<f g_s> - <f> <g_s> from box means of the product at each shift, row by row of shifts."""
    n, stride = windows.template, windows.stride
    height, width = (size - windows.search + n for size in windows.shape)
    fixed = image1[windows.lead :, windows.lead :][:height, :width] / n**2
    out = image1.new_empty((windows.shifts, windows.shifts, *windows.count))
    for shift in range(windows.shifts):
        moved = image2[shift : shift + height].unfold(1, width, 1).transpose(0, 1)
        product = strided(box_sum(fixed * moved, n, -2), stride, -2)
        product = strided(box_sum(product, n, -1), stride, -1)
        torch.addcmul(product, mean1, mean2[shift], value=-1, out=out[shift])
    return out


def _covariance_fft(image1: torch.Tensor, image2: torch.Tensor, windows: Windows) -> torch.Tensor:
    """<(f - <f>) g_s> of each window by the correlation theorem.

    Candidates never wrap: a transform of the region's length holds every shift inside it.
    """
    n, m, lead = windows.template, windows.search, windows.lead
    side = scipy.fft.next_fast_len(m, real=True)
    region = extract_tensor_patches(image2[None, None], m, windows.stride)[0, :, 0]
    inner = image1[lead:, lead:][tuple(slice(size - m + n) for size in windows.shape)]
    fixed = extract_tensor_patches(inner[None, None], n, windows.stride)[0, :, 0]
    fixed = fixed - fixed.mean((-2, -1), keepdim=True)
    # against a template of mean 0 an offset does not matter, but costs digits
    region = region - region.mean((-2, -1), keepdim=True)
    spectrum = torch.fft.rfft2(fixed / n**2, s=(side, side)).conj()
    spectrum = spectrum * torch.fft.rfft2(region, s=(side, side))
    shifts = windows.shifts
    covariance = torch.fft.irfft2(spectrum, s=(side, side))[:, :shifts, :shifts]
    return covariance.permute(1, 2, 0).reshape(shifts, shifts, *windows.count)


def _peak(coefficient: torch.Tensor, windows: Windows, min_correlation: float) -> Displacement:
    """Highest value over all shifts, and a Gaussian through its neighbours in z and in y."""
    shifts = windows.shifts
    flat = coefficient.flatten(0, 1)
    best, index = flat.max(dim=0)
    shift_z, shift_y, rim = windows.unravel(index)
    # exactly 0 only where template or candidates have no contrast
    matched = best != 0
    inside = matched & ~rim
    centre = torch.where(inside, index, shifts + 1)  # any inner place, where neighbours exist
    offsets, fitted = zip(*(_gaussian_fit(flat, centre, step) for step in (shifts, 1)), strict=True)
    d = torch.stack([shift_z, shift_y]) + torch.stack(offsets)
    flag = (
        Flag.PEAK_ON_RIM * (matched & rim)
        + Flag.LOW_CORRELATION * (matched & (best < min_correlation))
        + Flag.NO_SUBPIXEL_FIT * (inside & ~(fitted[0] & fitted[1]))
        + Flag.NO_MATCH * ~matched
    )
    return Displacement(torch.where(inside, d, torch.nan), best, flag.to(torch.int16))


def _gaussian_fit(
    flat: torch.Tensor, index: torch.Tensor, step: int
) -> tuple[torch.Tensor, torch.Tensor]:
    """Offset of a Gaussian's peak from three values `step` apart, and where there is one.

    ln c is a parabola: offset = (ln c- - ln c+) / (2 (ln c- - 2 ln c0 + ln c+)). Zero where a
    value is not positive.
    """
    before, middle, after = (flat.gather(0, (index + move)[None])[0] for move in (-step, 0, step))
    positive = torch.minimum(torch.minimum(before, after), middle) > 0
    before, middle, after = (
        torch.where(positive, value, 1.0).log() for value in (before, middle, after)
    )
    curvature = before - 2 * middle + after
    fitted = positive & (curvature < 0)
    return torch.where(fitted, (before - after) / (2 * curvature), 0.0), fitted
