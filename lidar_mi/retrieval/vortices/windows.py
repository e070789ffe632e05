"""The wind of a fitted pair at the windows of the local methods."""

from collections.abc import Sequence

import numpy as np
import torch

from lidar_mi.flags import Flag
from lidar_mi.retrieval.images.displacement import Displacement
from lidar_mi.retrieval.images.quality import non_finite
from lidar_mi.retrieval.images.windows import Windows, image_pair
from lidar_mi.retrieval.vortices.image_builder import Acquisition
from lidar_mi.retrieval.vortices.image_fit import fit_pixels


def vortex_windows(
    image1: torch.Tensor,
    image2: torch.Tensor,
    template: int = 8,
    search: int = 16,
    stride: int = 1,
    *,
    axes: tuple[np.ndarray, np.ndarray],
    dt: float,
    noise: float | torch.Tensor | None = None,
    times: Sequence[np.ndarray] | None = None,
) -> Displacement:
    """The wind of a fitted pair at the windows' centres, as displacement in dt.

    image1, image2 (z, y)
    template, search, stride: pixels; only the positions of the vectors depend on them.
    axes (array, array): z and y of the pixels, m.
    dt: s.
    noise: as `fit_vortices`.
    times: of the pixels, from `lidar_mi.retrieval.images.beam_times.checked_times`.

    Returns
    -------
    Displacement
        With the pair's `quantities`. If the fit is not accepted every vector has the flag NO_MATCH;
        without any fit they are NaN.
    """
    image_pair(image1, image2)
    windows = Windows(tuple(image1.shape), template, search, stride)
    taken = Acquisition(*axes, dt, noise, "lamb_oseen", times=times)
    pair = fit_pixels(image1, image2, taken)
    centres = [
        (axis[start := np.asarray(windows.starts(k))] + axis[start + template - 1]) / 2
        for k, axis in enumerate(axes)
    ]
    values, covariance = pair.wind_and_covariance(centres[1][None, :], centres[0][:, None])
    pixel_z, pixel_y = (float(a[-1] - a[0]) / (len(a) - 1) / dt for a in axes)

    def tensor(array: np.ndarray) -> torch.Tensor:
        return torch.as_tensor(np.ascontiguousarray(array), device=image1.device)

    v, w = tensor(values)
    variance_v, variance_w, both = tensor(covariance)
    vv, ww, wv = variance_v / pixel_y**2, variance_w / pixel_z**2, both / (pixel_y * pixel_z)
    flag = torch.zeros(windows.count, dtype=torch.int16, device=image1.device)
    flag[non_finite([image1, image2], windows)] |= Flag.NON_FINITE_INPUT.value
    if not pair.success:
        flag |= Flag.NO_MATCH.value
    if "an image is constant" in pair.reasons:
        flag |= Flag.LOW_TEXTURE.value
    return Displacement(
        torch.stack([w / pixel_z, v / pixel_y]),
        torch.full_like(v, pair.correlation),
        flag,
        torch.stack([torch.stack([ww, wv]), torch.stack([wv, vv])]),
        pair.quantities,
        {
            "profile": pair.profile,
            "fit": "; ".join(pair.reasons) or "accepted",
            "chi2": pair.chi2,
            "model_error": pair.model_error,
            "model_error_length": pair.model_error_length,
        },
    )
