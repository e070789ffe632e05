"""The least standard error of a wind from the templates of an image pair."""

from collections.abc import Sequence

import numpy as np
import torch
import xarray as xr

from lidar_mi.retrieval.checks import checked_stack, on_device, positive
from lidar_mi.retrieval.images.beam_times import checked_times, vector_times
from lidar_mi.retrieval.images.bound import displacement_bound
from lidar_mi.retrieval.images.quality import filled, non_finite
from lidar_mi.retrieval.wind.dataset import centres, field, spacing
from lidar_mi.retrieval.wind.options import IMAGE_WINDOWS, WindowSizes


def wind_bound(
    image1: xr.DataArray,
    image2: xr.DataArray,
    dt: float,
    noise: float | xr.DataArray,
    windows: WindowSizes = IMAGE_WINDOWS,
    times: Sequence[xr.DataArray] | None = None,
    device: str | torch.device = "cpu",
) -> xr.Dataset:
    """Least standard error of v and w (m/s) that any unbiased method has from each template alone.

    The Cramer-Rao bound, see `bound.displacement_bound`. Grid and parameters are those of
    `retrieve_wind`, as is the time difference of a vector, which is that of air at rest. Infinite
    without texture, NaN near non-finite pixels. A field that is fitted to the images as a whole
    uses more than a template and may be better. Noise below 0.001 of the map's median is raised to
    that value.

    Raises InputError: as `retrieve_wind`.

    Returns
    -------
    xr.Dataset, dims (z, y)
        `v_bound`, `w_bound`.
    """
    dt = positive("dt", dt)
    (image1, image2), checked = checked_stack([image1, image2], noise)
    frame = windows.on(image1.shape)
    sigma: float | torch.Tensor | None
    if isinstance(checked, xr.DataArray):
        sigma = on_device(checked.clip(min=1e-3 * float(checked.median())), device)
    else:
        sigma = checked
    pair = [on_device(image, device) for image in (image1, image2)]
    covariance = displacement_bound(filled(pair[0]), filled(pair[1]), sigma, frame.template)
    rows, columns = (torch.as_tensor(frame.starts(axis)) for axis in (0, 1))
    root = covariance[:2, rows][:, :, columns].sqrt()
    bound = torch.where(non_finite(pair, frame), torch.nan, root).cpu().numpy()
    tau = checked_times(times, [image1, image2], dt)
    interval = vector_times(tau, dt, frame, np.zeros((2, *frame.count)), False).difference
    bounds = {}
    for name, values, step in zip("wv", bound, spacing(image1), strict=True):
        about = f"Cramer-Rao bound of {name} from one template", "m s-1"
        bounds[f"{name}_bound"] = field(("z", "y"), values * step / interval, *about)
    return xr.Dataset(bounds, centres(image1, frame, "template"))
