"""The motion around every pixel, from coarse vectors, and images read further on along it."""

import numpy as np
import torch
from scipy.ndimage import map_coordinates
from torch.nn.functional import grid_sample, pad

from lidar_mi.retrieval.correlation.first_pass import whole_pixels
from lidar_mi.retrieval.images.inpainting import nearest_in
from lidar_mi.retrieval.images.windows import Windows, linear_weights, separable

# Coarse vectors along each axis whose median is the motion around a place.
_AROUND = 5


def motion_around(
    image1: torch.Tensor, image2: torch.Tensor, windows: Windows, continued: bool = False
) -> tuple[torch.Tensor, torch.Tensor]:
    """Displacement (2, z, y) around every pixel, px, and the scatter (z, y) of vectors about it.

    The median of 5 x 5 vectors of such windows, and that of their distances from it; where there
    is none 0, or the nearest ones (`continued`).
    """
    vectors = whole_pixels(image1, image2, windows)
    d = pad(vectors, (_AROUND // 2,) * 4, value=torch.nan)
    near = d.unfold(1, _AROUND, 1).unfold(2, _AROUND, 1).flatten(3)
    d = near.nanmedian(-1).values
    scatter = (near - d[..., None]).norm(dim=0).nanmedian(-1).values
    if continued:
        d, scatter = (nearest_in(part) for part in (d, scatter))
    weights = [
        linear_weights(windows.centres(axis).to(d), torch.arange(n).to(d))
        for axis, n in enumerate(windows.shape)
    ]
    on_pixels = separable(torch.cat([d, scatter[None]]).nan_to_num(0.0), weights)
    return on_pixels[:2], on_pixels[2]


def moved(image: torch.Tensor, d: torch.Tensor) -> torch.Tensor:
    """The image (z, y) read d (2, z, y) px further on, by cubics; or a volume (x, z, y)."""
    if image.ndim > 2:
        places = np.indices(image.shape) + d.cpu().numpy()
        read = map_coordinates(image.cpu().numpy(), places, order=3, mode="nearest")
        return torch.as_tensor(read).to(image)
    place = [torch.arange(n).to(d) for n in image.shape]
    at = [
        2 * (p + part) / (n - 1) - 1
        for p, part, n in zip(torch.meshgrid(*place, indexing="ij"), d, image.shape, strict=True)
    ]
    grid = torch.stack([at[1], at[0]], -1)[None]
    return grid_sample(image[None, None], grid, "bicubic", "border", align_corners=True)[0, 0]
