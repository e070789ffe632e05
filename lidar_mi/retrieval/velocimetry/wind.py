"""From two images to the wind: one call, CF data set out."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
import xarray as xr

from lidar_mi.errors import InputError
from lidar_mi.retrieval.checks import checked_pair, on_device, positive
from lidar_mi.retrieval.velocimetry.bound import displacement_bound
from lidar_mi.retrieval.velocimetry.correlation import cross_correlation
from lidar_mi.retrieval.velocimetry.displacement import Displacement
from lidar_mi.retrieval.velocimetry.multipass import multipass
from lidar_mi.retrieval.velocimetry.quality import (
    Flag,
    Texture,
    filled,
    low_texture,
    median_outliers,
    non_finite,
    uncertain,
)
from lidar_mi.retrieval.velocimetry.variational import variational
from lidar_mi.retrieval.velocimetry.weight_shift import weight_shift
from lidar_mi.retrieval.velocimetry.windows import Windows
from lidar_mi.retrieval.vortices.windows import vortex_windows


@dataclass(frozen=True)
class Method:
    """A way to find displacements.

    Attributes
    ----------
    find : callable
        (image1, image2, template, search, stride, **options) -> Displacement, in pixels.
    score : (str, str)
        What its `Displacement.score` is: name in the data set, meaning.
    options : tuple of str
        Keywords of `retrieve_wind` it takes, `min_correlation` and `noise` among them.
    centred : bool
        Vectors belong to the windows' centres, not half their displacement further on.
    local : bool
        A vector knows its window only: without texture there, or contradicted by its neighbours,
        it is flagged. A field that is fitted as a whole says itself how certain it is where.
    """

    find: Callable[..., Displacement]
    score: tuple[str, str]
    options: tuple[str, ...] = ()
    centred: bool = False
    local: bool = True


METHODS: Mapping[str, Method] = {
    "cc": Method(
        cross_correlation,
        ("correlation", "normalised cross-correlation at the peak"),
        ("min_correlation",),
    ),
    "ws": Method(
        weight_shift, ("mismatch", "misfit of weight and centre of mass over their spread")
    ),
    "multipass": Method(
        multipass,
        ("correlation", "normalised cross-correlation of the deformed windows"),
        ("min_correlation", "noise"),
        centred=True,
    ),
    "variational": Method(
        variational,
        ("correlation", "normalised cross-correlation of the images carried to mid-time"),
        ("min_correlation", "noise", "more", "blur"),
        centred=True,
        local=False,
    ),
    "vortex_fit": Method(
        vortex_windows,
        ("correlation", "correlation of the images, each carried to mid-time"),
        ("noise", "axes", "dt"),
        centred=True,
        local=False,
    ),
}
"""Methods by name."""


def retrieve_wind(
    image1: xr.DataArray,
    image2: xr.DataArray,
    dt: float,
    method: str = "cc",
    template: int = 8,
    search: int = 16,
    stride: int = 1,
    device: str | torch.device = "cpu",
    *,
    min_correlation: float = 0.5,
    min_texture: float = 0.01,
    min_isotropy: float = 0.2,
    noise: float | xr.DataArray | None = None,
    more: Sequence[xr.DataArray] = (),
    blur: float = 0.0,
    median_size: int = 3,
    median_threshold: float = 2.0,
    median_epsilon: float = 0.1,
) -> xr.Dataset:
    """Wind in the image plane from two images of the same air, dt apart.

    Parameters
    ----------
    image1, image2 : xr.DataArray, dims (z, y)
        On one grid: coordinates z and y in metres (`units` attribute), ascending and uniform;
        the spacings may differ between z and y.
    dt : float
        Time from image 1 to image 2, s.
    method : {"cc", "ws", "multipass", "variational", "vortex_fit"}
        Cross-correlation, weight shift, multi-pass correlation, a smooth flow or a vortex pair
        fitted to the images as a whole, see `METHODS`.
    template, search, stride : int
        Pixels: template n >= 2, search region >= n + 2, step from window to window >= 1. Winds
        beyond ((search - template) // 2 - 1/2) spacing / dt cannot be seen (17.5 m/s for 8 in 16
        at 0.5 m and 0.1 s).
    device : str or torch.device
        Where to compute.
    min_correlation : float
        Flag vectors with a lower peak (not "ws").
    min_texture, min_isotropy : float
        Flag vectors whose template of image 1 has an rms slope, in its weakest direction and
        relative to its mean, not above this (px^-1), or below this fraction of the slope in its
        strongest direction. See `quality.texture`.
    noise : float or xr.DataArray, optional
        Standard deviation of image 1's noise, in its unit; a template with less structure than
        noise is flagged as without texture. Left out, no noise is assumed for that, and methods
        that weight by it ("multipass", "variational", "vortex_fit") estimate it from the images.
    more : sequence of xr.DataArray
        Further images on the same grid, each dt after the one before ("variational"): a burst,
        whose mid-time is the winds'.
    blur : float
        Standard deviation, m, of the Gaussian by which the instrument blurs the air, as a beam of
        1/e^2 radius 2 `blur` does ("variational", which then sharpens; square pixels only).
    median_size, median_threshold, median_epsilon
        Normalised median test, see `quality.median_outliers`. Neighbours are taken half a
        template apart (or a stride, if that is more): closer ones share their pixels.

    Returns
    -------
    xr.Dataset, dims (z, y)
        At the template centres (an even template's lies between pixels): `v`, `w` (m s-1),
        `v_stderr`, `w_stderr` (m s-1) and `vw_correlation`, the standard errors of v and w and
        their correlation (NaN from methods that know none: "cc", "ws"),
        `displacement_y`, `displacement_z` (m), `correlation` or `mismatch`, `texture` (px^-1),
        `isotropy`, `flag` (bits of `quality.Flag`, 0 = good; also without texture counts a vector
        whose standard error is beyond half a pixel in some direction). The auxiliary coordinates `y_vector`,
        `z_vector` are where the vector belongs, at mid-time: the centre and, with "cc" and "ws",
        half the displacement. "vortex_fit" adds the pair's numbers (`port_circulation` and so on,
        each with `_stderr`, see `VortexPairFit.quantities`). Rejected vectors keep their value (or NaN if there is none);
        nothing is replaced.

    Raises
    ------
    InputError
        Images on different or unsuitable grids, or a parameter out of its range.

    Examples
    --------
    Air that moves by two pixels of 0.5 m along y in 0.1 s:

    >>> import lidar_mi as lm
    >>> import numpy as np
    >>> import xarray as xr
    >>> from scipy.ndimage import gaussian_filter
    >>> air = 1 + gaussian_filter(np.random.default_rng(1).normal(size=(32, 50)), 1.5)
    >>> axes = {d: (d, 0.5 * np.arange(n), {"units": "m"}) for d, n in (("z", 32), ("y", 48))}
    >>> image1, image2 = (xr.DataArray(air[:, k : k + 48], axes, ("z", "y")) for k in (2, 0))
    >>> wind = lm.retrieve_wind(image1, image2, dt=0.1)
    >>> print(f"{float(wind['v'].median()):.1f} {wind['v'].units}")
    10.0 m s-1
    """
    if method not in METHODS:
        raise InputError(f"method: {method!r} is not one of {', '.join(METHODS)}")
    dt = positive("dt", dt)
    image1, image2, noise = checked_pair(image1, image2, noise)
    more = [checked_pair(image1, image)[1] for image in more]
    if more and "more" not in METHODS[method].options:
        takes = ", ".join(name for name, known in METHODS.items() if "more" in known.options)
        raise InputError(
            f"more: {len(more) + 2} images are not allowed with method {method!r}; expected two, "
            f"or method {takes}"
        )
    windows = Windows(image1.shape, template, search, stride)
    blurred = _blur_px(image1, blur)
    pixels1, pixels2 = (on_device(image, device) for image in (image1, image2))
    if isinstance(noise, xr.DataArray):
        noise = on_device(noise, device)

    chosen = METHODS[method]
    axes = tuple(image1[name].values.astype(float) for name in ("z", "y"))
    offered = {
        "min_correlation": min_correlation,
        "noise": noise,
        "axes": axes,
        "dt": dt,
        "more": [on_device(image, device) for image in more],
        "blur": blurred,
    }
    options = {name: offered[name] for name in chosen.options}
    found = chosen.find(pixels1, pixels2, template, search, stride, **options)
    level = 0.0 if noise is None else noise
    texture, low = low_texture(pixels1, windows, min_texture, min_isotropy, level)
    spacing = max(1, round(template / 2 / stride))
    outlier = median_outliers(
        found.dz, found.dy, median_size, spacing, median_threshold, median_epsilon
    )
    flag = found.flag
    if found.covariance is not None:
        flag = flag | (Flag.LOW_TEXTURE * uncertain(found.covariance)).to(torch.uint8)
    if chosen.local:
        flag = flag | (Flag.LOW_TEXTURE * low + Flag.MEDIAN_OUTLIER * outlier).to(torch.uint8)
    attributes = {
        "method": method,
        "template": template,
        "search": search,
        "stride": stride,
        "dt": dt,
        "images": 2 + len(more),
        "min_texture": min_texture,
        "min_isotropy": min_isotropy,
        "median_size": median_size,
        "median_threshold": median_threshold,
        "median_epsilon": median_epsilon,
    }
    if blur and "blur" in options:
        attributes["blur"] = blur
    if "min_correlation" in options:
        attributes["min_correlation"] = min_correlation
    return _dataset(image1, windows, found._replace(flag=flag), texture, attributes)


def wind_bound(
    image1: xr.DataArray,
    image2: xr.DataArray,
    dt: float,
    noise: float | xr.DataArray,
    template: int = 8,
    search: int = 16,
    stride: int = 1,
) -> xr.Dataset:
    """Least standard error of v and w (m/s) that any unbiased method has from each template alone.

    The Cramer-Rao bound, see `bound.displacement_bound`; on the grid of `retrieve_wind`, which
    says what the parameters are. Infinite without texture, NaN near non-finite pixels. A field that is fitted to the images
    as a whole uses more than a template and may be better. Noise of 0 in some pixels of a map
    counts as a thousandth of the median.

    Returns
    -------
    xr.Dataset, dims (z, y)
        `v_bound`, `w_bound`.

    Raises
    ------
    InputError
        As `retrieve_wind`.
    """
    dt = positive("dt", dt)
    image1, image2, noise = checked_pair(image1, image2, noise)
    windows = Windows(image1.shape, template, search, stride)
    if isinstance(noise, xr.DataArray):
        noise = on_device(noise.clip(min=1e-3 * float(noise.median())), "cpu")
    pair = [on_device(image, "cpu") for image in (image1, image2)]
    covariance = displacement_bound(*(filled(image) for image in pair), noise, template)
    rows, columns = (torch.as_tensor(windows.starts(axis)) for axis in (0, 1))
    root = covariance[:2, rows][:, :, columns].sqrt()
    root = torch.where(non_finite(*pair, windows), torch.nan, root).numpy()
    axes = {axis: image1[axis].values.astype(float) for axis in ("z", "y")}
    found = {}
    for name, axis, values in (("w", "z", root[0]), ("v", "y", root[1])):
        spacing = (axes[axis][-1] - axes[axis][0]) / (len(axes[axis]) - 1)
        about = {"long_name": f"Cramer-Rao bound of {name} from one template", "units": "m s-1"}
        found[f"{name}_bound"] = ("z", "y"), (values * spacing / dt).astype(np.float32), about
    half = (template - 1) / 2
    coords = {
        axis: np.interp(
            np.asarray(windows.starts(k)) + half, np.arange(len(axes[axis])), axes[axis]
        )
        for k, axis in enumerate(("z", "y"))
    }
    return xr.Dataset(found, coords)


def _blur_px(image: xr.DataArray, blur: float) -> float:
    """From m to px."""
    if not 0 <= blur < np.inf:
        raise InputError(f"blur: {blur!r} m is not allowed; expected a standard deviation >= 0")
    z, y = (np.ptp(image[name].values) / (image.sizes[name] - 1) for name in ("z", "y"))
    if blur and abs(z / y - 1) > 0.01:
        raise InputError(
            f"blur: not allowed with pixels of {y:g} m along y and {z:g} m along z; expected "
            "square ones"
        )
    return float(blur / y)


def _dataset(
    image: xr.DataArray, windows: Windows, found: Displacement, texture: Texture, attributes: dict
) -> xr.Dataset:
    centre, spacing = {}, {}
    for axis, name in enumerate(("z", "y")):
        pixel = image[name].values.astype(float)
        start = np.asarray(windows.starts(axis))
        centre[name] = (pixel[start] + pixel[start + windows.template - 1]) / 2
        spacing[name] = (pixel[-1] - pixel[0]) / (len(pixel) - 1)
    moved = {"z": found.dz.cpu().numpy() * spacing["z"], "y": found.dy.cpu().numpy() * spacing["y"]}
    method = METHODS[attributes["method"]]
    further = 0.0 if method.centred else 0.5
    shape = windows.count
    vector = {
        "z": np.broadcast_to(centre["z"][:, None], shape) + further * moved["z"],
        "y": np.broadcast_to(centre["y"][None, :], shape) + further * moved["y"],
    }
    dt = attributes["dt"]
    score, score_name = method.score
    stderr, correlation = _spread(found, spacing, dt)

    def field(values: np.ndarray | torch.Tensor, long_name: str, units: str, **more: str):
        values = values.cpu().numpy() if isinstance(values, torch.Tensor) else values
        attrs = {"long_name": long_name, "units": units, **more}
        return ("z", "y"), values.astype(np.float32), attrs

    dataset = xr.Dataset(
        {
            "v": field(moved["y"] / dt, "wind along y", "m s-1", standard_name="y_wind"),
            "w": field(
                moved["z"] / dt, "wind along z", "m s-1", standard_name="upward_air_velocity"
            ),
            "v_stderr": field(
                stderr["y"], "standard error of v", "m s-1", standard_name="y_wind standard_error"
            ),
            "w_stderr": field(
                stderr["z"],
                "standard error of w",
                "m s-1",
                standard_name="upward_air_velocity standard_error",
            ),
            "vw_correlation": field(correlation, "correlation of the errors of v and w", "1"),
            "displacement_y": field(moved["y"], "displacement along y", "m"),
            "displacement_z": field(moved["z"], "displacement along z", "m"),
            score: field(found.score, score_name, "1"),
            "texture": field(
                texture.slope, "weakest rms slope relative to the mean, per pixel", "1"
            ),
            "isotropy": field(texture.isotropy, "weakest over strongest rms slope", "1"),
            "flag": (
                ("z", "y"),
                found.flag.cpu().numpy(),
                {
                    "long_name": "reasons to reject the vector, 0 = good",
                    "standard_name": "quality_flag",
                    "flag_masks": np.array([bit.value for bit in Flag], dtype=np.uint8),
                    "flag_meanings": " ".join(bit.name.lower() for bit in Flag),
                },
            ),
        },
        coords={
            "z": ("z", centre["z"], {"long_name": "template centre, up", "units": "m"}),
            "y": ("y", centre["y"], {"long_name": "template centre, left", "units": "m"}),
            "z_vector": field(vector["z"], "z of the vector at mid-time", "m"),
            "y_vector": field(vector["y"], "y of the vector at mid-time", "m"),
        },
        attrs={
            "Conventions": "CF-1.11",
            "title": "Wind in the image plane from an image pair",
            **attributes,
            "dt_units": "s",
        },
    )
    for name, quantity in found.quantities.items():
        about = {"long_name": quantity.long_name, "units": quantity.units}
        dataset[name] = (), quantity.value, about
        about = about | {"long_name": f"standard error of {quantity.long_name}"}
        dataset[f"{name}_stderr"] = (), quantity.stderr, about
    dataset.attrs |= found.attributes
    dataset["z"].attrs |= {"axis": "Z", "positive": "up"}
    dataset["y"].attrs |= {"axis": "Y"}
    for name in ("z", "y"):
        dataset[name].encoding["_FillValue"] = None
    return dataset


def _spread(
    found: Displacement, spacing: Mapping[str, float], dt: float
) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Standard errors of the wind along z and y, m/s, and their correlation; NaN if not known."""
    if found.covariance is None:
        nothing = np.full(found.dz.shape, np.nan)
        return {"z": nothing, "y": nothing}, nothing
    zz, yy, zy = (
        torch.where(found.dz.isnan(), torch.nan, part).cpu().numpy() for part in found.covariance
    )
    root = {"z": np.sqrt(zz), "y": np.sqrt(yy)}
    both = root["z"] * root["y"]
    correlation = np.divide(zy, both, out=np.zeros_like(both), where=both != 0)
    return {axis: root[axis] * spacing[axis] / dt for axis in root}, correlation
