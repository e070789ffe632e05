"""Bring images onto one regular (y, z) grid before they are compared."""

from collections.abc import Sequence

import numpy as np
import xarray as xr
from scipy.interpolate import RectBivariateSpline, RegularGridInterpolator
from scipy.ndimage import distance_transform_edt

from lidar_mi.arguments import checked_arguments
from lidar_mi.errors import InputError


def resample(image: xr.DataArray, y: np.ndarray, z: np.ndarray) -> xr.DataArray:
    """The image at the nodes of a grid, by bicubic spline.

    For scans at equidistant angles, whose pixels (y, z) = X (tan theta, tan phi) are not
    equidistant and lie elsewhere at t1 and t2. The spline's error is of fourth order in the
    spacing: structure of 8 px wavelength loses about 1 % of its amplitude half way between
    pixels, structure near 2 px is damped.

    image (xr.DataArray, two dims): with coordinates y and z in metres, finite and ascending: either
        one-dimensional, or two-dimensional with y constant along one dim and z along the other (to
        1e-3 of the spacing), as planar gates give.
    y, z (array, 1-D): nodes wanted, m, ascending.

    Raises InputError: coordinates missing or not separable or not ascending; fewer than 4 pixels in
    a direction; values not finite; nodes all outside.

    Returns
    -------
    xr.DataArray, dims (z, y)
        NaN at nodes outside the image; retrieval flags windows with such nodes.
    """
    if image.ndim != 2:
        raise InputError(f"image: dims {tuple(image.dims)} are not two")
    dim_z, axis_z = _axis(image, "z")
    dim_y, axis_y = _axis(image, "y")
    if dim_z == dim_y:
        raise InputError(f"image: y and z both run along dim {dim_y!r}")
    values = image.transpose(dim_z, dim_y).values.astype(float)
    bad = int((~np.isfinite(values)).sum())
    if bad:
        raise InputError(f"image: {bad} of {values.size} pixels are not finite; cannot resample")
    if min(values.shape) < 4:
        raise InputError(f"image: {values.shape} px are too few for a cubic spline (>= 4)")
    nodes = {"y": np.asarray(y, dtype=float), "z": np.asarray(z, dtype=float)}
    for name, node in nodes.items():
        if node.ndim != 1 or not node.size or not np.all(np.diff(node) > 0):
            raise InputError(f"{name}: nodes are not a one-dimensional, ascending array")
    inside = {"y": _within(nodes["y"], axis_y), "z": _within(nodes["z"], axis_z)}
    for name, axis in (("y", axis_y), ("z", axis_z)):
        if not inside[name].any():
            raise InputError(
                f"{name}: nodes {nodes[name][0]:g} ... {nodes[name][-1]:g} m are all outside the "
                f"image, {axis[0]:g} ... {axis[-1]:g} m"
            )
    spline = RectBivariateSpline(axis_z, axis_y, values, kx=3, ky=3, s=0)
    resampled = spline(nodes["z"], nodes["y"])
    resampled[~inside["z"], :] = np.nan
    resampled[:, ~inside["y"]] = np.nan
    coords = {name: (name, nodes[name], {**image[name].attrs, "units": "m"}) for name in ("z", "y")}
    return xr.DataArray(resampled, coords, ("z", "y"), name=image.name, attrs=image.attrs)


def resample_pair(
    image1: xr.DataArray, image2: xr.DataArray, spacing: float
) -> tuple[xr.DataArray, xr.DataArray]:
    """Both images on the largest grid of square cells that lies inside both.

    Nodes are whole multiples of `spacing` (m). Nodes next to a pixel that is not finite have no
    value. Raises InputError as `resample` otherwise, and where the images do not overlap.
    """
    first, second = _resampled([image1, image2], spacing)
    return first, second


def _resampled(images: Sequence[xr.DataArray], spacing: float) -> list[xr.DataArray]:
    """All images on the largest grid of square cells that lies inside all."""
    if not (np.isfinite(spacing) and spacing > 0):
        raise InputError(f"spacing: {spacing!r} m is not a number > 0")
    nodes = {}
    for name in ("z", "y"):
        axes = [_axis(image, name)[1] for image in images]
        # an edge that is a multiple but for rounding is still a node
        low = np.ceil(max(axis[0] for axis in axes) / spacing - 1e-6)
        high = np.floor(min(axis[-1] for axis in axes) / spacing + 1e-6)
        if high <= low:
            top = min(range(len(axes)), key=lambda k: axes[k][-1])
            last = max(range(len(axes)), key=lambda k: axes[k][0])
            a, b = sorted((top, last))
            raise InputError(
                f"image{b + 1}.{name}: {axes[b][0]:g} ... {axes[b][-1]:g} m does not overlap "
                f"image{a + 1}'s {axes[a][0]:g} ... {axes[a][-1]:g} m by a spacing of {spacing:g} m"
            )
        nodes[name] = np.arange(low, high + 1) * spacing
    return [_around_gaps(image, nodes) for image in images]


def nearest_filled(values: np.ndarray) -> np.ndarray:
    """Values with the nearest finite one where one is not."""
    missing = ~np.isfinite(values)
    if not missing.any():
        return values
    nearest = distance_transform_edt(missing, return_distances=False, return_indices=True)
    return values[tuple(nearest)]


def _around_gaps(image: xr.DataArray, nodes: dict[str, np.ndarray]) -> xr.DataArray:
    """The image at the nodes, NaN next to pixels that are not finite."""
    gap = ~np.isfinite(image.values)
    if not gap.any():
        return resample(image, nodes["y"], nodes["z"])
    resampled = resample(image.copy(data=nearest_filled(image.values)), nodes["y"], nodes["z"])
    gap_fraction = RegularGridInterpolator(
        [_axis(image, str(dim))[1] for dim in image.dims], gap.astype(float), bounds_error=False
    )
    at = np.meshgrid(*(nodes[str(dim)] for dim in image.dims), indexing="ij")
    free = xr.DataArray(~(gap_fraction(np.stack(at, -1)) > 1e-6), dims=image.dims)
    return resampled.where(free.transpose("z", "y").values)


@checked_arguments
def on_one_grid(image1: xr.DataArray, image2: xr.DataArray) -> tuple[xr.DataArray, xr.DataArray]:
    """The pair as it is if both images share one uniform grid, else resampled onto one.

    Needed where the scans have equidistant angles from a moving platform: their pixels then lie
    elsewhere at t1 and t2. The common grid has the coarser image's mean spacing along y; values
    come from bicubic splines, whose error is of fourth order in the spacing.

    Parameters
    ----------
    image1, image2 : xr.DataArray, dims (z, y), m
        Of one size.

    Returns
    -------
    xr.DataArray, xr.DataArray
        The pair on its common grid, which covers what both images cover.

    Raises
    ------
    InputError
        Images of different size, without coordinates, or that do not overlap.

    Examples
    --------
    >>> import lidar_mi as lm
    >>> import numpy as np
    >>> import xarray as xr
    >>> near, far = (
    ...     xr.DataArray(np.ones((9, 9)), {"z": s * np.arange(-4, 5), "y": s * np.arange(-4, 5)})
    ...     for s in (0.97, 1.0)
    ... )
    >>> first, second = lm.on_one_grid(near, far)
    >>> bool((first["y"] == second["y"]).all()), first.sizes["y"]
    (True, 7)
    """
    first, second = all_on_one_grid([image1, image2])
    return first, second


def all_on_one_grid(images: Sequence[xr.DataArray]) -> list[xr.DataArray]:
    """`on_one_grid` for a sequence of two or more images; messages count from 1."""
    for number, image in enumerate(images, 1):
        on_axes = {"z", "y"} == set(image.dims) <= set(image.coords)
        if not on_axes or image.ndim != 2 or min(image.shape) < 2:
            raise InputError(
                f"image{number}: dims {tuple(image.dims)} of {image.shape} px; expected z and y "
                "with coordinates, two pixels or more each"
            )
    images = [i if i.dims == ("z", "y") else i.transpose("z", "y") for i in images]
    first = images[0]
    for number, image in enumerate(images[1:], 2):
        if image.shape != first.shape:
            sizes = " and ".join(f"{i.sizes['y']} x {i.sizes['z']}" for i in (first, image))
            raise InputError(
                f"image{number}: sizes {sizes} px (y x z) differ; expected images of one size"
            )
    steps = [float(image["y"][-1] - image["y"][0]) / (image.sizes["y"] - 1) for image in images]
    tolerance = 1e-3 * min(steps)
    shared = all(
        np.abs(np.diff(first[a].values, 2)).max(initial=0) < tolerance
        and all(np.abs(first[a].values - i[a].values).max() < tolerance for i in images[1:])
        for a in ("y", "z")
    )
    return images if shared else _resampled(images, max(steps))


def _axis(image: xr.DataArray, name: str) -> tuple[str, np.ndarray]:
    """The dim that coordinate `name` runs along, and its values there, ascending, in m."""
    if name not in image.coords:
        raise InputError(f"image.{name}: coordinate missing; give it in m")
    coordinate = image[name]
    if coordinate.ndim == 1:
        dim, values = coordinate.dims[0], coordinate.values.astype(float)
    elif coordinate.ndim == 2:
        grid = coordinate.values.astype(float)
        spans = [np.ptp(grid, axis=axis).max() for axis in (0, 1)]
        along = int(spans[1] > spans[0])
        dim, other_dim = coordinate.dims[along], coordinate.dims[1 - along]
        values = grid.mean(axis=1 - along)
        if not spans[1 - along] <= 1e-3 * spans[along] / max(len(values) - 1, 1):
            raise InputError(
                f"image.{name}: varies along both dims; only separable grids can be resampled "
                f"({name} constant along {other_dim!r} to 0.1 % of the spacing)"
            )
    else:
        raise InputError(f"image.{name}: {coordinate.ndim} dims; one or two are allowed")
    if values.size < 2 or not np.all(np.diff(values) > 0):
        raise InputError(f"image.{name}: not at least two finite, ascending values")
    return str(dim), values


def _within(nodes: np.ndarray, axis: np.ndarray) -> np.ndarray:
    """Nodes on the axis, with a tolerance for rounding at its ends."""
    slack = 1e-6 * (axis[-1] - axis[0]) / (len(axis) - 1)
    return (nodes >= axis[0] - slack) & (nodes <= axis[-1] + slack)
