"""How well images agree in a flow fitted to them, and the flags of its vectors."""

from collections.abc import Sequence

import torch

from lidar_mi.flags import Flag
from lidar_mi.retrieval.flow.likelihood import Linear
from lidar_mi.retrieval.images.displacement import Displacement
from lidar_mi.retrieval.images.quality import no_skill, non_finite, worst_variance
from lidar_mi.retrieval.images.windows import Windows, window_sums, working


def flagged(
    d: torch.Tensor,
    covariance: torch.Tensor,
    before: torch.Tensor,
    score: torch.Tensor,
    stack: Sequence[torch.Tensor],
    windows: Windows,
    min_correlation: float,
) -> Displacement:
    """The result, with flags where images inform too little or do not agree."""
    # remaining fraction of the prior's variance: in the mean of all directions, and in the worst
    known = before.diagonal().mean(-1) / 2
    matched = (covariance.diagonal().mean(-1) < known) & score.isfinite()
    flag = (
        Flag.NO_MATCH * ~matched
        + Flag.LOW_TEXTURE * ((worst_variance(covariance) > known) | ~matched)
        + Flag.LOW_CORRELATION * (matched & (score < (1 + min_correlation) / 2))
    ).to(torch.int16)
    bad = non_finite(stack, windows)
    flag[bad] |= Flag.NON_FINITE_INPUT.value
    return Displacement(torch.where(matched, d, torch.nan), score.nan_to_num(0.0), flag, covariance)


def agreement(linear: Linear, windows: Windows) -> torch.Tensor:
    """Smallest correlation, over a template, of a warped image with the others' mean.

    Of shape `windows.count`; NaN without contrast.
    """
    warped, valid = working(linear.smooth), linear.valid
    box = [torch.ones(windows.template, dtype=warped.dtype, device=warped.device)]
    scores = []
    # of two each is the other's mean
    for image in warped if len(warped) > 2 else warped[:1]:
        others = (warped.sum(0) - image) / (len(warped) - 1)
        sums = torch.stack(
            [torch.ones_like(image), image, others, image**2, others**2, image * others]
        )
        sums = sums * valid
        for axis, n in enumerate(windows.count):
            start = windows.starts(axis).start
            length = (n - 1) * windows.stride + windows.template
            sums = window_sums(sums.narrow(axis + 1, start, length), box, windows.stride, axis + 1)[
                0
            ]
        first, second, square1, square2, cross = sums[1:] / sums[0].clamp(min=1)
        contrast = (square1 - first**2).clamp(min=0) * (square2 - second**2).clamp(min=0)
        rounding = torch.finfo(linear.warped.dtype).eps ** 2 * square1 * square2
        score = (cross - first * second) / contrast.sqrt()
        scores.append(torch.where(contrast > rounding, score, torch.nan))
    return torch.stack(scores).amin(0)


def unskilled(d: torch.Tensor, covariance: torch.Tensor) -> torch.Tensor:
    """Flags of vectors in a plane whose standard errors approach the spread of the wind."""
    return (Flag.NO_SKILL * no_skill(d, covariance)).to(torch.int16)
