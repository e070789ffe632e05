"""Standard errors of vectors from images: those of the method's fit, or from a bootstrap."""

from collections.abc import Callable, Sequence

import torch

from lidar_mi.retrieval.correlation.bootstrap import bootstrap_covariance
from lidar_mi.retrieval.images.displacement import Displacement
from lidar_mi.retrieval.images.quality import Flag, uncertain
from lidar_mi.retrieval.images.windows import Windows
from lidar_mi.retrieval.wind.methods import Method


def bootstrapped(
    estimate: Callable[..., Displacement],
    method: Method,
    pair: Sequence[torch.Tensor],
    found: Displacement,
    windows: Windows,
    noise: float | torch.Tensor | None,
    textured: torch.Tensor,
    clear: torch.Tensor,
) -> torch.Tensor:
    """Covariance of vectors from windows, (2, 2, *windows.count), px^2.

    Parameters
    ----------
    estimate : callable
        (image1, image2, stride=...) -> Displacement, the method with its options.
    method : Method
    pair : sequence of torch.Tensor, shape (z, y)
    found : Displacement
        Retrieved from the pair.
    windows : Windows
    noise : float or torch.Tensor, optional
        Standard deviation in image 1.
    textured, clear : torch.Tensor of bool, shape windows.count
        Windows that pass the thresholds of texture, and that clearly do.
    """
    return bootstrap_covariance(
        pair,
        found,
        windows,
        estimate,
        method.centred,
        method.repeats,
        textured=textured,
        clear=clear,
        noise=noise,
    )


def flags_of_fit(covariance: torch.Tensor | None) -> torch.Tensor | int:
    """Flags of vectors whose standard error by the method's own fit is too large."""
    if covariance is None:
        return 0
    return (Flag.LOW_TEXTURE * uncertain(covariance)).to(torch.int16)
