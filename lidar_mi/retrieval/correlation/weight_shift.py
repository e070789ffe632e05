"""Weight shift (WS): displacement from the best match of weight and centre of mass."""

import torch

from lidar_mi.flags import Flag
from lidar_mi.retrieval.images.displacement import Displacement
from lidar_mi.retrieval.images.quality import filled, non_finite
from lidar_mi.retrieval.images.windows import Windows, candidates, image_pair, strided, working


def weight_shift(
    image1: torch.Tensor, image2: torch.Tensor, template: int = 8, search: int = 16, stride: int = 1
) -> Displacement:
    """Displacement of every template to the candidate of like weight and like centre of mass.

    Pixel values are taken as mass. A template has a weight M (sum) and a centre of mass
    C = (C_z, C_y) relative to its middle; the candidate at shift s has M_s and C_s. The best
    match is the least

        J(s) = ((M_s - M) / S_M)^2 + |C_s - C|^2 / S_C^2,

    S_M and S_C being the standard deviations of the candidates' weight and centre (vector) over
    the search region: so weight and centre have equal influence, whatever the image's unit and
    contrast. The displacement is s + C_s - C, which includes the remaining difference of the
    centres of mass.

    The method uses three numbers of a template's n^2, so candidates are easily confused: on
    texture of 3 px correlation length advected by two vortices (2.7 m/s rms) its error is
    3.3 m/s where cross-correlation has 0.9; a match by centre alone has 5.7. It performs well
    where a template holds one compact blob on little background. Unlike correlation it depends on
    the offset of the images (a background adds mass at rest, which shifts the centres to the
    middle) and on their relative brightness.

    Most of its errors are candidates confused, of up to the size of the search region, and not
    normally distributed. Of a known motion (`bootstrap`) it then finds few vectors again, so that
    `retrieve_wind` flags all of them on random textures: their errors are unknown. Templates need a
    positive weight; pixels are those of `windows.Windows`. The `score` is the mismatch sqrt(J) of
    the best candidate.

    Raises InputError: sizes out of range; images that differ in size.
    """
    image_pair(image1, image2)
    windows = Windows(tuple(image1.shape), template, search, stride)
    bad = non_finite([image1, image2], windows)
    # Spreads below the rounding of the images' own numbers count as none.
    rounding = 4 * max(
        (torch.finfo(i.dtype).eps for i in (image1, image2) if i.is_floating_point()), default=0.0
    )
    image1, image2 = working(filled(image1)), working(filled(image2))
    displacement = Displacement.empty(windows, image1)
    for tile in windows.tiles(8 * 8 * windows.shifts**2 + 64 * (template + 4) * stride**2):
        part = _best_match(image1[tile.pixels], image2[tile.pixels], windows, rounding)
        displacement.fill(part, tile.vectors)
    displacement.d[:, bad] = torch.nan
    displacement.flag[bad] |= Flag.NON_FINITE_INPUT.value
    return displacement


def mass(image: torch.Tensor, size: int) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Weight and centre of mass (z, y; px from the middle) of every size x size box of an image.

    The centre is NaN where the weight is not positive.
    """
    ones = torch.ones(size, dtype=image.dtype, device=image.device)
    ramp = torch.arange(size, dtype=image.dtype, device=image.device) - (size - 1) / 2
    along_z = image.unfold(0, size, 1)
    sums, moments = along_z @ ones, along_z @ ramp
    weight = sums.unfold(1, size, 1) @ ones
    divisor = torch.where(weight > 0, weight, torch.nan)
    return (
        weight,
        (moments.unfold(1, size, 1) @ ones) / divisor,
        (sums.unfold(1, size, 1) @ ramp) / divisor,
    )


def _best_match(
    image1: torch.Tensor, image2: torch.Tensor, windows: Windows, rounding: float
) -> Displacement:
    windows = Windows(tuple(image1.shape), windows.template, windows.search, windows.stride)
    n, lead = windows.template, windows.lead
    inner = image1[lead:, lead:][tuple(slice(s - windows.search + n) for s in windows.shape)]
    reference = [strided(strided(v, windows.stride, 0), windows.stride, 1) for v in mass(inner, n)]
    regions = [candidates(v, windows) for v in mass(image2, n)]
    weight, centre_z, centre_y = (r - f for r, f in zip(regions, reference, strict=True))
    spread = [region.var((0, 1), correction=0) for region in regions]
    spread_weight, spread_centre = spread[0], spread[1] + spread[2]
    contrast = (spread_weight > (rounding * reference[0]) ** 2) & (
        spread_centre > (rounding * n) ** 2
    )
    misfit = weight**2 / spread_weight + (centre_z**2 + centre_y**2) / spread_centre
    misfit = torch.where(contrast & misfit.isfinite(), misfit, torch.inf).flatten(0, 1)
    best, index = misfit.min(0)
    shift_z, shift_y, rim = windows.unravel(index)
    matched = best.isfinite()
    offset = [part.flatten(0, 1).gather(0, index[None])[0] for part in (centre_z, centre_y)]
    d = torch.stack([shift_z, shift_y]) + torch.stack(offset)
    d = torch.where(matched & ~rim, d, torch.nan)
    flag = Flag.PEAK_ON_RIM * (matched & rim) + Flag.NO_MATCH * ~matched
    return Displacement(d, best.sqrt(), flag.to(torch.int16))
