"""Equal brightness of images of the same air: over the whole, and over pixels valid in all."""

from collections.abc import Sequence

import torch

from lidar_mi.retrieval.images.quality import filled
from lidar_mi.retrieval.images.windows import stored, working


def normalised(images: Sequence[torch.Tensor]) -> torch.Tensor:
    """Images of different brightness, brought to mean 0 and the first one's contrast.

    Non-finite pixels are NaN.
    """
    finite = torch.stack([torch.isfinite(image) for image in images])
    known = [stored(filled(image)) for image in images]
    centred = torch.stack([image - image.mean() for image in known])
    dims = tuple(range(1, centred.ndim))
    contrast = centred.square().mean(dims, keepdim=True).sqrt()
    scaled = centred * torch.where(contrast > 0, contrast[:1] / contrast, 1.0)
    return torch.where(finite, scaled, torch.nan)


def normalised_intensity(
    value: torch.Tensor, weight: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Warped images (images, ...) with one mean and contrast, and the factor of each.

    From air that is valid in all images, weighted by inverse variance: bright air that enters an
    image changes its mean by little, but by more than the noise of dark air. Volumes, whose
    attenuation may differ, lose their linear trend along x as well.
    """
    dims = tuple(range(1, value.ndim))
    fraction = weight / weight.sum().clamp(min=1e-30)
    value = value - (fraction * value).sum(dims, keepdim=True)
    if len(dims) > 2:
        x = torch.arange(len(weight)).to(value)[:, None, None]
        x = x - (fraction * x).sum()
        trend = fraction * x / (fraction * x * x).sum().clamp(min=1e-30)
        value = value - x * (trend * value).sum(dims, keepdim=True)
    contrast = (fraction * value.square()).sum(dims, keepdim=True).sqrt()
    # images come with nearly one contrast: a larger factor means that there is none
    gain = (contrast[:1] / contrast).nan_to_num(1.0).clamp(0.5, 2.0)
    return gain * value, gain


def rms(noise: float | torch.Tensor) -> float:
    """Rms standard deviation of an image's noise, of a number or a map (NaN masked)."""
    if not isinstance(noise, torch.Tensor):
        return noise
    finite = working(noise[torch.isfinite(noise)])
    return float(finite.square().mean().sqrt()) if finite.numel() else 0.0
