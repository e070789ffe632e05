"""Spectrum of the noise: errors of a fitted flow by the noise that the images are seen to have.

A fit takes the differences of the images for white after its filter. What it leaves where the
images have no slopes, and a flow absorbs nothing, shows their covariance in two dimensions.
"""

import torch

from lidar_mi.retrieval.flow.components import normal_fields
from lidar_mi.retrieval.flow.flow_spline import Mesh
from lidar_mi.retrieval.flow.likelihood import Images, Linear
from lidar_mi.retrieval.flow.posterior import Response
from lidar_mi.retrieval.images.band_limit import even_fast_len
from lidar_mi.retrieval.images.windows import Windows, averaged

# Random fields of noise that are sent through the fit.
_DRAWS = 12
# Squared slope over its mean around a pixel at which a pixel counts half.
_LOW = 0.5
# Standard deviations, px: of the mean over which the noise varies, of the lags that count, and of
# the mean over which errors of the draws are compared.
_WIDTH, _TAPER, _AROUND = 8.0, 5.0, 12.0
# Lags, px, from which correlation along a line is that of the line, and its width.
_FAR, _LINE = 12, 4
# Standard errors by which lines must correlate; standard deviations that a pixel counts at most.
_SIGNIFICANT, _CLIPPED = 6.0, 4.0
# Ratio of variances from which stated errors count as wrong.
_LEAST = 2.0


def variance_by_coloured_noise(
    linear: Linear, images: Images, mesh: Mesh, windows: Windows, response: Response
) -> tuple[torch.Tensor, str]:
    """Variance of a component of the flow that noise adds which is not white after the filter.

    Where an image has no slope no flow absorbs noise: the residual there, weighted by
    1 / (1 + s / s_0) with the squared slope s, has the noise's autocovariance, in two dimensions
    and along lines. Random fields of this covariance and of that of the likelihood are sent
    through the fit, as in a sandwich covariance (White 1982, Econometrica 50, 1-25): the
    difference of their variances is added where the first is larger by more than `_LEAST`.
    ``linear`` is about the flow that was found. The variance is in px^2; the lines that have an
    offset each are "columns", "rows", both or none.
    """
    slope, weight, valid = linear.slope, linear.weight, linear.valid
    time = images.time.to(linear.warped).reshape(-1, 1, 1)
    residual = (time * linear.warped).sum(0) / time.square().sum() * valid
    steep = slope.square().sum(0)
    around = averaged(steep, valid, _WIDTH).clamp(min=1e-30)
    use = valid / (1 + steep / (_LOW * around))
    square, share = (averaged(part * use, valid, _WIDTH) for part in (residual.square(), valid))
    level = (square / share.clamp(min=1e-6)).clamp(min=1e-30).sqrt()
    density, lines = _density((residual / level).clamp(-_CLIPPED, _CLIPPED), use)
    rows, columns = residual.shape
    sizes = _periods(residual)
    white = torch.fft.rfft2(normal_fields((_DRAWS, *sizes), residual, 11))
    coloured = torch.fft.irfft2(white * density.sqrt(), s=sizes)[:, :rows, :columns]
    # of the likelihood itself: the variance of a pixel's difference is that of its information
    drawn = normal_fields((_DRAWS, rows, columns), residual, 12) / weight.clamp(min=1e-30).sqrt()
    places = [windows.centres(axis).to(residual) for axis in range(windows.dims)]
    centres = Mesh(mesh.axes, places)
    inside = torch.ones(windows.count, dtype=torch.bool, device=residual.device)

    def variance(draws: torch.Tensor) -> torch.Tensor:
        gradient = mesh.transposed((draws * valid)[:, None] * (slope * weight))
        square = centres.field(response(gradient)).square().mean((0, 1))
        return averaged(square, inside, _AROUND / windows.stride)

    observed, expected = variance(level * coloured), variance(drawn)
    return torch.where(observed > _LEAST * expected, observed - expected, 0.0), lines


def _periods(field: torch.Tensor) -> list[int]:
    """Sizes of a period that holds a field and its lags."""
    return [even_fast_len(2 * n) for n in field.shape]


def _density(field: torch.Tensor, use: torch.Tensor) -> tuple[torch.Tensor, str]:
    """Spectral density of a field that is known in part, of mean its variance, and its lines.

    As `torch.fft.rfft2` has the wavenumbers of its periods.
    """
    sizes = _periods(field)

    def correlated(values: torch.Tensor) -> torch.Tensor:
        return torch.fft.irfft2(torch.fft.rfft2(values, s=sizes).abs().square(), s=sizes)

    pairs = correlated(use)
    lag = [torch.fft.fftfreq(n, 1 / n).to(field) for n in sizes]
    known = pairs > 0.02 * pairs[0, 0]
    covariance = torch.where(known, correlated(field * use) / pairs.clamp(min=1e-9), 0.0)
    taper = [torch.exp(-(part / _TAPER).square() / 2) for part in lag]
    total = covariance * taper[0][:, None] * taper[1]
    said = []
    for axis, name in enumerate(("columns", "rows")):
        along, across = lag[axis], lag[1 - axis]
        far = (along.abs() >= _FAR) & (along.abs() <= field.shape[axis] // 2)
        outside = (across.abs() > 2 * _LINE) & (across.abs() < field.shape[1 - axis] // 2)
        if int(outside.sum()) <= 2 * _LINE or not bool(far.any()):
            continue
        profile = covariance.movedim(axis, 0)[far].mean(0)
        mean, scatter = profile[outside].mean(), profile[outside].std()
        if profile[0] - mean < _SIGNIFICANT * scatter:
            continue
        said.append(name)
        line = (profile - mean) * torch.exp(-(across / _LINE).square() / 2)
        # correlated along all of the line
        excess = line[None] * (1 - taper[axis])[:, None]
        total = total + excess.movedim(0, axis)
    return torch.fft.rfft2(total).real.clamp(min=0.0), " and ".join(said)
