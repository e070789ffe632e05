"""Errors of windows where structure moves otherwise than the air, see `coherent_change`.

A window follows what moves in it. The known motion that a bootstrap retrieves has no such structure
(`bootstrap`), so that this error comes besides.
"""

from collections.abc import Sequence

import torch

from lidar_mi.retrieval.correlation.bootstrap import at_mid_time
from lidar_mi.retrieval.correlation.outliers import validated
from lidar_mi.retrieval.correlation.settings import MultipassSettings
from lidar_mi.retrieval.flow.coherent_change import (
    SMOOTH,
    ResidualOperator,
    mean_square_displacement,
    square_left,
)
from lidar_mi.retrieval.flow.flow_spline import Axis, Mesh
from lidar_mi.retrieval.flow.likelihood import Linear, linearised, prepared, steepness_of_structure
from lidar_mi.retrieval.flow.settings import VariationalSettings
from lidar_mi.retrieval.images.displacement import Displacement
from lidar_mi.retrieval.images.windows import Windows, working

# Standard deviation of a window's weights over the template.
_SIGMA = MultipassSettings().sigma


def coherent_change(
    stack: Sequence[torch.Tensor],
    found: Displacement,
    windows: Windows,
    noise: float | torch.Tensor | None,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Covariance of vectors by structure that moves otherwise than the air, and what is left of it.

    Where structure of slope s moves by e, the images differ by |s| e. Over a window, where e is
    alike, that displaces the vector by J^-1 <I' |s|> e, with the slopes I' of the image, J the mean
    over the window of their products, and s their Gaussian mean over 3 px. A window that holds
    nothing but structure follows it, and fine texture beside it holds the vector. e has a
    correlation of exp(-r^2 / 4 S^2), S = 3 px. What is alike in a window, its mean over a Gaussian
    of a third of the template n, has 1 / (1 + n^2 / 9 S^2) of the variance of e. The rest differs
    within the window, as noise does.

    The mean square of e is `coherent_change.mean_square_displacement`, about the flow of the
    vectors, as windows of least squares leave it.

    Parameters
    ----------
    stack : sequence of torch.Tensor, shape (z, y)
        Two images.
    found : Displacement
        Of windows that are deformed with the flow; at their centres.
    windows : Windows
    noise : float or torch.Tensor, optional
        Standard deviation of the images' noise, see `variational.variational`.

    Returns
    -------
    covariance : torch.Tensor, shape (2, 2, *windows.count)
        px^2; 0 where air is carried as a whole.
    left : torch.Tensor, shape (z, y)
        Variance of the images' differences that displaced windows leave of this change: the
        residuals contain it.
    """
    settings = VariationalSettings()
    images = prepared(stack, noise, 0.0, settings)
    flow, _ = validated(working(found.d), max(1, round(windows.template / 2 / windows.stride)))
    axes = [Axis(n, windows.template / 2) for n in windows.shape]
    pixels = [torch.arange(n).to(flow) for n in windows.shape]
    mesh = Mesh(axes, pixels)
    linear = linearised(images, mesh, mesh.fitted(at_mid_time(flow, windows, True)), settings)
    left = left_by_windows(linear, windows)
    square = mean_square_displacement(images, linear, left)
    slope = working(linear.slope)
    steep = steepness_of_structure(slope, linear.valid).sqrt()
    along = displacement_of_windows(slope, steep, windows)
    alike = 1 / (1 + (_SIGMA * windows.template / SMOOTH) ** 2)
    remains = square * square_left(linear, left) if square else torch.zeros_like(steep)
    return alike * square * along[:, None] * along, remains


def left_by_windows(linear: Linear, windows: Windows) -> ResidualOperator:
    """What displacements of windows leave of a difference of the images, to first order."""
    slope = working(linear.slope) * linear.valid

    def left(difference: torch.Tensor) -> torch.Tensor:
        difference = working(difference) * linear.valid
        moved = at_mid_time(displacement_of_windows(slope, difference, windows), windows, True)
        return (difference - (slope * moved).sum(0)) * linear.valid

    return left


def displacement_of_windows(
    slope: torch.Tensor, difference: torch.Tensor, windows: Windows
) -> torch.Tensor:
    """Of each window by least squares, (2, *windows.count) px: J^-1 <slope difference>."""
    products = windows.of_templates(slope[:, None] * slope).movedim((0, 1), (-2, -1))
    # windows with nothing in them are not moved
    least = 1e-3 * products.diagonal(dim1=-2, dim2=-1).mean()
    products = products + (least + 1e-30) * torch.eye(2).to(products)
    means = windows.of_templates(slope * difference).movedim(0, -1)
    return torch.linalg.solve(products, means[..., None])[..., 0].movedim(-1, 0)
