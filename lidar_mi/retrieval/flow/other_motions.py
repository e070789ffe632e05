"""Displacements of single windows that explain two images better than the flow fitted to them.

A fit ends at the maximum of the likelihood that is next to its first displacements, which may be
another one: of a lattice of dots, that one period off. Windows that move rigidly, without a prior,
show it (two estimators of one quantity: Hausman 1978, Econometrica 46, 1251-1271).
"""

import math

import torch
from torch.nn.functional import max_pool2d, pad

from lidar_mi.retrieval.correlation.first_pass import coarse_windows
from lidar_mi.retrieval.flow.likelihood import Images, Linear
from lidar_mi.retrieval.images.windows import Windows, linear_weights, separable

AS_LIKELY = 0.05
"""Likelihood of another solution over that of the flow."""
AS_WELL, FINER = 0.15, 0.025
"""Misfit of another solution over that of 1.5 to 3 px beside the flow, as far as it is known.

In a lattice of 5 px parabolas through whole pixels leave 0.08 of it, polynomials of fourth degree
0.023; in one of 4 px 0.14 and 0.06, so that a motion by halves of a pixel is overlooked.
"""
FALSE_ALARM = 1e-3
"""Probability that a window of images that are as the model has them is better explained."""


def better_elsewhere(
    images: Images, linear: Linear, d: torch.Tensor, windows: Windows
) -> torch.Tensor:
    """Where a rigid displacement explains two images better, bool of shape `windows.count`.

    Over a Gaussian window (standard deviation of the template's size) minus the log-likelihood is
    half the squared differences over their variance: of the images warped by the flow, and of the
    images displaced by whole pixels within the range of the first displacements, with the
    parabolas through it and its neighbours. At the true flow the probability that one of n
    displacements is better by ln(n / p) is below p (Markov's inequality for ratios of
    likelihoods). Those within 2 px of the flow are on its own maximum. The flow of a window that
    is better explained is wrong as far as the window reaches, two standard deviations.

    A displacement that is as likely (`AS_LIKELY`) is another solution if all those 1.5 to 3 px
    beside the flow are excluded with the certainty above: a pattern that repeats. Where texture is
    weak, they are not.

    images: two.
    linear: their likelihood about the flow.
    d (2, *windows.count): the flow at the windows' centres, px.
    """
    size, step = windows.template, max(windows.stride, windows.template // 2)
    frame = Windows(windows.shape, size, windows.search, step)
    centres = [frame.centres(axis).to(linear.warped) for axis in (0, 1)]
    at = [windows.centres(axis).to(linear.warped) for axis in (0, 1)]
    pairs = list(zip(at, centres, strict=True))
    flow = separable(d.nan_to_num(0.0).to(linear.warped), [linear_weights(a, c) for a, c in pairs])
    reach = math.ceil(coarse_windows(windows).reach)
    rim = reach // 2 + 1
    pixels = [torch.arange(n).to(linear.warped) for n in windows.shape]
    places = [place.expand(2, -1, -1) for place in torch.meshgrid(*pixels, indexing="ij")]
    # in single precision, which suffices to compare sums of squares
    gauss = [
        torch.exp(-(c[:, None] - pixel).square() / 2 / size**2).float()
        for c, pixel in zip(centres, pixels, strict=True)
    ]
    one, two, *known = (
        pad(field.float(), (rim,) * 4) for field in (*images.spline.values(*places), *images.usable)
    )
    weight = (linear.weight * linear.valid / 2).float()
    fitted = (linear.warped[1] - linear.warped[0]).float().square()

    def at_shift(field: torch.Tensor, z: int, y: int) -> torch.Tensor:
        rows, columns = windows.shape
        return field[rim - z : rim - z + rows, rim - y : rim - y + columns]

    def excess(z: int, y: int) -> torch.Tensor:
        """Minus the log-likelihood of a displacement over that of the flow, by the same pixels."""
        back, on = (z // 2, y // 2), (z // 2 - z, y // 2 - y)
        off = (at_shift(two, *on) - at_shift(one, *back)).square_().sub_(fitted).mul_(weight)
        off.mul_(at_shift(known[0], *back)).mul_(at_shift(known[1], *on))
        return separable(off, gauss)

    shifts = range(-reach - 1, reach + 2)
    wide = torch.stack([torch.stack([excess(z, y) for y in shifts]) for z in shifts])
    misfit = wide[1:-1, 1:-1]
    least = misfit.clone()
    for before, after in ((wide[:-2, 1:-1], wide[2:, 1:-1]), (wide[1:-1, :-2], wide[1:-1, 2:])):
        bottom = torch.minimum(before, after) > misfit
        bend = torch.where(bottom, before + after - 2 * misfit, torch.inf)
        least -= (after - before).square() / (8 * bend)
    whole = torch.arange(-reach, reach + 1).to(flow)
    far = torch.maximum(
        (whole[:, None, None, None] - flow[0]).abs(), (whole[:, None, None] - flow[1]).abs()
    )
    sure = math.log(len(whole) ** 2 / FALSE_ALARM)
    better = (far >= 2) & (least < -sure)
    # a pattern that repeats: a displacement explains it, and those next to the flow do not
    beside = torch.where((far > 1.5) & (far < 3), misfit, torch.inf).amin((0, 1))
    alike = ((far >= 3) & (least < AS_WELL * beside)).any(0).any(0) & (beside > sure)
    elsewhere = better.any(0).any(0)
    if alike.any():
        finer = _between_pixels(wide[:, :, alike])
        apart = far[1:-1, 1:-1, alike] >= 3
        again = torch.where(apart, finer, torch.inf).amin((0, 1))
        elsewhere[alike] |= again < FINER * beside[alike] - math.log(AS_LIKELY)
    around = 2 * math.ceil(2 * size / step) + 1
    wrong = max_pool2d(elsewhere.to(flow)[None], around, 1, around // 2)[0]
    return separable(wrong, [linear_weights(c, a) for a, c in pairs]) > 0


def _between_pixels(misfit: torch.Tensor) -> torch.Tensor:
    """Least misfits about whole displacements, (n - 4, m - 4, ...) of (n, m, ...).

    Polynomials of fourth degree in both axes, at eighths of a pixel.
    """
    offsets, nodes = torch.linspace(-0.5, 0.5, 9).to(misfit), torch.arange(-2, 3).to(misfit)
    gaps = nodes[:, None] - nodes + torch.eye(5).to(misfit)
    away = (offsets[:, None, None] - nodes).expand(-1, 5, -1).clone()
    away.diagonal(dim1=1, dim2=2).fill_(1.0)
    weights = (away / gaps).prod(-1)  # of Lagrange, (offset, node)
    rows = torch.einsum("ok,nm...k->onm...", weights, misfit.unfold(0, 5, 1))
    least = torch.full_like(rows[0, :, 4:], torch.inf)
    for row in rows:
        both = torch.einsum("ok,nm...k->onm...", weights, row.unfold(1, 5, 1))
        least = torch.minimum(least, both.amin(0))
    return least
