"""The smoothest values for unknown pixels, used by filters only."""

from collections.abc import Callable

import numpy as np
import torch
from scipy import sparse
from scipy.ndimage import distance_transform_edt
from scipy.sparse.linalg import spsolve

from lidar_mi.retrieval.images.common_grid import nearest_filled

# Px from the known ones up to which values are smooth: what a filter reaches. Further on they are
# those of the nearest pixel.
_REACH = 8.0
# Squared first over squared second differences: slopes fade over 3 px.
_TENSION = 0.1


def inpainted(values: np.ndarray) -> np.ndarray:
    """Values with smooth ones in place of non-finite ones.

    They minimise the squared second differences along the axes plus a tenth of the squared first
    ones, which makes slopes fade: a thin plate under tension (Smith & Wessel 1990, Geophysics 55,
    293-305). Steps to any constant would be structure at rest. Beyond 8 px from the known ones they
    are constant. Some value must be finite.
    """
    missing = ~np.isfinite(values)
    distance, nearest = distance_transform_edt(missing, return_indices=True)
    filled = values[tuple(nearest)]
    unknown = missing & (distance <= _REACH)
    number = np.full(values.shape, -1)
    number[unknown] = np.arange(np.count_nonzero(unknown))
    matrices, rights = [], []
    for axis in range(values.ndim):
        along, known = np.moveaxis(number, axis, 0), np.moveaxis(filled, axis, 0)
        for stencil in (np.array([1.0, -2.0, 1.0]), np.sqrt(_TENSION) * np.array([-1.0, 1.0])):
            length = len(along) - len(stencil) + 1
            if length < 1:
                continue
            parts = [along[k : k + length] for k in range(len(stencil))]
            use = np.any([part >= 0 for part in parts], 0)
            rows = np.arange(np.count_nonzero(use))
            right, entries = np.zeros(len(rows)), []
            for k, (part, weight) in enumerate(zip(parts, stencil, strict=True)):
                column = part[use]
                inside = column >= 0
                entries.append((np.full(inside.sum(), weight), rows[inside], column[inside]))
                right -= weight * np.where(inside, 0.0, known[k : k + length][use])
            data, row, column = (np.concatenate(parts) for parts in zip(*entries, strict=True))
            shape = len(rows), np.count_nonzero(unknown)
            matrices.append(sparse.csr_matrix((data, (row, column)), shape=shape))
            rights.append(right)
    matrix, right = sparse.vstack(matrices).tocsr(), np.concatenate(rights)
    filled = filled.astype(float, copy=True)
    filled[unknown] = spsolve((matrix.T @ matrix).tocsc(), matrix.T @ right)
    return filled


def filled_in(image: torch.Tensor, pixels: torch.Tensor | None = None) -> torch.Tensor:
    """An image `inpainted`, all of it or only where some pixels are.

    Unchanged if it is finite everywhere; zero if nowhere.
    """
    smooth = _replaced(image, inpainted)
    return smooth if pixels is None else torch.where(pixels, smooth, image)


def nearest_in(image: torch.Tensor) -> torch.Tensor:
    """An image with the value of the nearest finite pixel where one is not."""
    return _replaced(image, nearest_filled)


def _replaced(image: torch.Tensor, fill: Callable[[np.ndarray], np.ndarray]) -> torch.Tensor:
    finite = torch.isfinite(image)
    if bool(finite.all()):
        return image
    if not bool(finite.any()):
        return torch.zeros_like(image)
    return torch.as_tensor(fill(image.cpu().numpy())).to(image)
