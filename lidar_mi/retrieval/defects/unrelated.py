"""Whether two images show the same air: their correlation against that of unrelated ones."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from scipy.special import stdtrit
from torch.nn.functional import pad

from lidar_mi.retrieval.correlation.cross_correlation import cross_correlation
from lidar_mi.retrieval.correlation.first_pass import coarse_volumes, coarse_windows, volume_scores
from lidar_mi.retrieval.images.intensity import normalised, rms
from lidar_mi.retrieval.images.settings import VOLUME_FILTER, FilterSettings
from lidar_mi.retrieval.images.spline import Spline, band_limited
from lidar_mi.retrieval.images.windows import (
    Windows,
    linear_weights,
    separable,
    window_sums,
    working,
)

FALSE_ALARM = 1e-3
"""Probability that unrelated textures count as related at a vector."""
# Windows along each axis whose correlations are averaged.
_REGION = 5
# Few windows need more surrogates for the scatter of their mean.
_FEW_WINDOWS = 100
# Fractions of the last two axes by which surrogates are rolled, of many windows and of few.
_THIRDS = tuple((i / 3, j / 3) for i, j in ((1, 1), (2, 2), (1, 2)))
_FIFTHS = tuple((i / 5, j / 5) for i in range(5) for j in range(5) if i or j)
# Noise added, over the images' rms, so that rounding and ringing do not correlate.
_FLOOR = 1e-3
# Student's t where no window is finite.
_CERTAIN = 1e6


def unrelated(
    images: Sequence[torch.Tensor],
    windows: Windows,
    wide: bool,
    noise: float | torch.Tensor | None = None,
    false_alarm: float = FALSE_ALARM,
) -> torch.Tensor:
    """Windows about which two images correlate no better than unrelated textures.

    Any two textures correlate somewhere in a search region: the highest of many correlations of
    windows with few independent pixels is often beyond 0.8. Its level depends on the
    autocorrelations of both images and on the range, so it is estimated with surrogates of image
    2: rotated by 180 degrees and rolled by thirds of its sides (of few windows by fifths), they
    keep its autocorrelation and are otherwise independent of image 1. Fisher's z of the highest
    correlations, averaged over 5 windows along each axis, must exceed the mean of the surrogates
    by Student's t at the rate of false alarms (their scatter is pooled over all regions).

    The windows are twice as large as the template where they fit into the images, half a window
    apart, and the images are band-limited. Assumed is texture that is homogeneous and not
    periodic. Images of one repeated pattern, or the same rotated by 180 degrees and rolled by 1/3,
    count as unrelated. Windows unrelated over less than half a region (24 px with windows of 8
    px) may count as related.

    images (shape (z, y), or (x, z, y) of volumes): the first two of them are used.
    wide: whether the displacement may be twice that of the windows, as in `coarse_windows`.
    noise: standard deviation of the images' white noise; default: from their spectra.

    Returns
    -------
    torch.Tensor of bool, shape windows.count
    """
    finite = torch.stack([torch.isfinite(image) for image in images[:2]]).all(0)
    settings = VOLUME_FILTER if windows.dims > 2 else FilterSettings()
    noise = noise if noise is None else rms(noise)
    spline, _ = band_limited(normalised(images[:2]), noise, settings=settings)
    search = (_of_images if windows.dims == 2 else _of_volumes)(spline, finite, windows, wide)
    first, second = search.values
    observed = search.score(first, second)
    rolls = _FIFTHS if observed.numel() < _FEW_WINDOWS else _THIRDS
    rotated = second.flip(tuple(range(second.ndim)))
    rows, columns = second.shape[-2:]
    others = [rotated.roll((int(i * rows), int(j * columns)), (-2, -1)) for i, j in rolls]
    chance = torch.stack([search.score(first, other) for other in others])
    excess = _excess(observed, chance, search.known)
    regions = max(1.0, observed.numel() / _REGION**windows.dims)
    least = float(stdtrit((len(rolls) - 1) * regions, 1 - false_alarm))
    weights = [
        linear_weights(at.to(excess), windows.centres(axis).to(excess))
        for axis, at in enumerate(search.centres)
    ]
    return separable(excess, weights) < least


def _excess(observed: torch.Tensor, chance: torch.Tensor, known: torch.Tensor) -> torch.Tensor:
    """Student's t of the correlations' regional means over those of the surrogates."""
    dims = observed.ndim
    fields = torch.stack([observed, *chance]).clamp(-1 + 1e-6, 1 - 1e-6).atanh()
    fields = torch.cat([fields * known, known[None].to(fields)])
    box = [torch.ones(_REGION).to(fields)]
    for axis in range(1, dims + 1):
        rim = [0, 0] * (dims - axis) + [_REGION // 2] * 2
        fields = window_sums(pad(fields, rim), box, 1, axis)[0]
    number = fields[-1]
    observed, *others = fields[:-1] / number.clamp(min=1.0)
    chance = torch.stack(others)
    mean, degrees = chance.mean(0), len(chance) - 1
    scatter = (chance - mean).square().sum(0)[number > 0].mean() / degrees
    excess = (observed - mean) / (scatter * (1 + 1 / len(chance))).sqrt().clamp(min=1e-9)
    # without a finite window nothing is flagged
    return torch.where(number > 0, excess, _CERTAIN)


class _Search(NamedTuple):
    """The correlation of two band-limited images, `values`, with the windows' `centres` in pixels.

    `score` gives the highest correlation of every window; `known` says which are finite.
    """

    score: Callable[[torch.Tensor, torch.Tensor], torch.Tensor]
    values: torch.Tensor
    known: torch.Tensor
    centres: list[torch.Tensor]


def _of_images(spline: Spline, finite: torch.Tensor, windows: Windows, wide: bool) -> _Search:
    template = windows.template
    frame = Windows(windows.shape, template, windows.search, max(1, template // 2))
    if wide:
        frame = coarse_windows(windows)
    elif min(windows.shape) >= template + windows.search:
        frame = Windows(windows.shape, 2 * template, template + windows.search, template)
    along = [torch.arange(n).to(spline.coefficients) for n in windows.shape]
    places = [place.expand(2, -1, -1) for place in torch.meshgrid(*along, indexing="ij")]

    def score(first: torch.Tensor, second: torch.Tensor) -> torch.Tensor:
        return cross_correlation(first, second, frame.template, frame.search, frame.stride).score

    known = frame.of_regions(working(~finite)) == 0
    values = _floored(spline.sample(*places)[0])
    return _Search(score, values, known, [frame.centres(axis) for axis in range(2)])


def _of_volumes(spline: Spline, finite: torch.Tensor, windows: Windows, _: bool) -> _Search:
    values = _floored(coarse_volumes(spline, finite.expand(2, *finite.shape)))
    scores, centres = volume_scores(values, windows)

    def score(first: torch.Tensor, second: torch.Tensor) -> torch.Tensor:
        return volume_scores(torch.stack([first, second]), windows)[0].nan_to_num(0.0).amax(0)

    return _Search(score, values, torch.ones_like(scores[0], dtype=torch.bool), centres)


def _floored(values: torch.Tensor) -> torch.Tensor:
    """Images with independent noise added, see `_FLOOR`."""
    draw = torch.Generator().manual_seed(0)
    noise = torch.randn(values.shape, generator=draw, dtype=values.dtype).to(values.device)
    return values + _FLOOR * values.square().mean().sqrt() * noise
