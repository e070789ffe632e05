"""Whether two images show a wake vortex, how probably, and where: the start of a fit."""

from typing import NamedTuple

import numpy as np
import torch

from lidar_mi.retrieval.vortices.images import Builder
from lidar_mi.retrieval.vortices.matched_filter import Likelihoods, matched_filter

# Logarithm of the odds of a vortex at inverse hyperbolic sines of the filters' logarithm of the
# likelihood ratio; constant beyond. The ratio is that of white residuals: turbulence and the
# images' finer structure make it too decisive. `python -m validation.detections` computes them.
RATIO_NODES = (-2.5, -1.0, 0.0, 1.0, 2.5, 4.0, 6.0)
_LOG_ODDS = (-6.86, -0.54, 0.12, 0.67, 0.67, 2.33, 10.29)


class Detection(NamedTuple):
    """What matched filters say of two images.

    probability: that at least one vortex of a wake is in the image, if before the images it is 1/2.
    pair (10,): parameters of the likeliest pair; None where no pair lowers the misfit.
    """

    probability: float
    pair: torch.Tensor | None


def detect(make: Builder) -> Detection:
    """The detection of a pair in the images of a fit."""
    likeliest = likelihoods(make)
    probability = probability_of(likeliest.log_ratio)
    if likeliest.pair is None:
        return Detection(probability, None)
    pair = likeliest.pair.clone()
    pair[[2, 6]] += float(make.y[0])
    pair[[3, 7]] += float(make.z[0])
    return Detection(probability, pair.to(make.pair.device))


def likelihoods(make: Builder) -> Likelihoods:
    """What the matched filters say of the images of a fit; places from the first pixel."""
    return matched_filter(make.pair, make.spacing, make.dt, make.noise, make.profile)


def probability_of(log_ratio: float) -> float:
    """Probability of a vortex for a logarithm of the likelihood ratio of `matched_filter`."""
    odds = np.interp(np.arcsinh(log_ratio), RATIO_NODES, _LOG_ODDS)
    return float(1 / (1 + np.exp(-odds)))
