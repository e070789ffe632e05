"""From two images to the wind: one call, CF data set out."""

from collections.abc import Sequence
from functools import partial

import numpy as np
import torch
import xarray as xr

from lidar_mi.arguments import checked_arguments
from lidar_mi.errors import InputError
from lidar_mi.retrieval.checks import checked_stack, identical, on_device, positive
from lidar_mi.retrieval.correlation.bootstrap import bootstrap_covariance
from lidar_mi.retrieval.correlation.outliers import (
    MEDIAN_EPSILON,
    MEDIAN_THRESHOLD,
    median_outliers,
)
from lidar_mi.retrieval.correlation.settings import MultipassSettings
from lidar_mi.retrieval.defects.faint_pattern import Standing, standing
from lidar_mi.retrieval.defects.illumination import described, illumination
from lidar_mi.retrieval.defects.rest import all_at_rest, nothing_at_rest
from lidar_mi.retrieval.defects.unrelated import unrelated
from lidar_mi.retrieval.flow.settings import VariationalSettings
from lidar_mi.retrieval.images.beam_times import checked_times, vector_times
from lidar_mi.retrieval.images.bound import displacement_bound
from lidar_mi.retrieval.images.dataset import centres, dataset, field, flags, spacing, winds
from lidar_mi.retrieval.images.quality import (
    Flag,
    clearly_textured,
    filled,
    low_texture,
    non_finite,
    of_bootstrap,
    uncertain,
)
from lidar_mi.retrieval.images.windows import Windows, working
from lidar_mi.retrieval.threads import threads_for
from lidar_mi.retrieval.wind.coherent_windows import coherent_change
from lidar_mi.retrieval.wind.methods import METHODS, Method


@checked_arguments
def retrieve_wind(
    image1: xr.DataArray,
    image2: xr.DataArray,
    dt: float,
    method: str | Method = "variational",
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
    times: Sequence[xr.DataArray] | None = None,
    blur: float = 0.0,
    median_size: int = 3,
    median_threshold: float = MEDIAN_THRESHOLD,
    median_epsilon: float = MEDIAN_EPSILON,
    settings: MultipassSettings | VariationalSettings | None = None,
    checks: bool = True,
    standard_errors: bool = True,
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
        fitted to the images as a whole, see `methods.METHODS`. Or a `methods.Method` of one's own.
        Default: "variational", the most accurate of a pair, with errors from its fit.
    template, search, stride : int
        Pixels: template n >= 2, search region >= n + 2, step from window to window >= 1. Winds
        beyond ((search - template) // 2 - 1/2) spacing / dt are out of range (17.5 m/s for 8 in 16
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
        noise is flagged as without texture. Left out, that flag assumes no noise, and methods
        that weight by it ("multipass", "variational", "vortex_fit") estimate it from the images.
    more : sequence of xr.DataArray
        Further images on the same grid, each dt after the one before ("variational"): a burst.
        The winds are those at its mid-time.
    times : sequence of two xr.DataArray, optional
        When each pixel of image 1 and of image 2 was seen, s from its image's reference time, on
        their grid (not with `more`). ``dt`` is then from reference time to reference time, and
        winds follow from each vector's own time difference, see `beam_times.vector_times`. Left
        out: images are photographs.
    blur : float
        Standard deviation, m, of the Gaussian by which the instrument blurs the air, as a beam of
        1/e^2 radius 2 `blur` does ("variational", which then sharpens; square pixels only).
    median_size, median_threshold, median_epsilon
        Normalised median test, see `outliers.median_outliers`. Neighbours are taken half a
        template apart (or a stride, if that is more): closer ones share their pixels.
    settings : MultipassSettings or VariationalSettings, optional
        Of the method of that name, see `settings`. Left out: its defaults.
    checks : bool
        Look for saturated areas, structure at rest, gains of columns and rows, a change of
        illumination, and images of unrelated air. False, for images known to be free of them:
        faster by 0.15 of the time of "variational", and none of this is removed or flagged.
    standard_errors : bool
        False: "cc", "ws" and "multipass" state none and flag no vector for its own, which halves
        their time. The others have theirs from the fit.

    Returns
    -------
    xr.Dataset, dims (z, y)
        At the template centres (an even template's lies between pixels): `v`, `w` (m s-1),
        `v_stderr`, `w_stderr` (m s-1) and `vw_correlation`, the standard errors of v and w and
        their correlation ("cc", "ws" and "multipass": see `bootstrap`), `time` (s from
        image 1's reference time, the vector's mid-time), `displacement_y`, `displacement_z` (m),
        `correlation` or `mismatch`, `texture` (px^-1), `isotropy`, `flag`
        (bits of `quality.Flag`, 0 = valid; low texture also means a standard error beyond half a
        pixel in some direction). The auxiliary coordinates `y_vector`, `z_vector` are the
        position of the vector at mid-time: the centre and, with "cc" and "ws", half the
        displacement. "vortex_fit" adds the pair's numbers (`port_circulation` and so on,
        each with `_stderr`, see `VortexPairFit.quantities`). Rejected vectors keep their value (or
        NaN if there is none); nothing is replaced. Gains of a detector's columns and rows are
        removed beforehand, see `fixed_pattern`, and so is a change of illumination from edge to
        edge, see `illumination`; attributes of these names say so. Pixels that do not move with the
        air are left out, see `rest.at_rest`, and the attribute `defects` says how many.
        `identical_images` names images that are the same, bit for bit, from which no motion can be
        told: no vector is valid then.

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
    if isinstance(method, Method):
        method, chosen = method.name, method
    elif method in METHODS:
        chosen = METHODS[method]
    else:
        raise InputError(f"method: {method!r} is not one of {', '.join(METHODS)}")
    dt = positive("dt", dt)
    stack, noise = checked_stack([image1, image2, *more], noise)
    image1 = stack[0]
    for number, image in enumerate(stack, 1):
        if not np.isfinite(image.values).any():
            raise InputError(f"image{number}: no pixel is finite; expected light somewhere")
    if more and "more" not in chosen.options:
        takes = ", ".join(name for name, known in METHODS.items() if "more" in known.options)
        raise InputError(
            f"more: {len(more) + 2} images are not allowed with method {method!r}; expected two, "
            f"or method {takes}"
        )
    if times is not None and more:
        raise InputError(f"times: not allowed with {len(more) + 2} images; expected two")
    tau = checked_times(times, stack, dt)
    windows = Windows(image1.shape, template, search, stride)
    blurred = _blur_px(image1, blur)
    pixels1, pixels2, *rest = (on_device(image, device) for image in stack)
    if isinstance(noise, xr.DataArray):
        noise = on_device(noise, device)

    axes = tuple(image1.coords.variables[name].values.astype(float) for name in ("z", "y"))
    offered = {
        "min_correlation": min_correlation,
        "noise": noise,
        "axes": axes,
        "dt": dt,
        "more": rest,
        "times": tau,
        "blur": blurred,
        "settings": settings,
        "partly": True,
    }
    with threads_for(image1.size):
        whole = [pixels1, pixels2, *rest]
        resting = all_at_rest(whole, windows) if checks else nothing_at_rest(whole)
        seen = resting.filled(whole)
        light = [illumination(seen[0], i) if checks else torch.ones(1, 1) for i in seen[1:]]
        # a correlation of windows would lose all that see a pixel that is left out
        remedy = resting.left_out if chosen.centred else resting.filled
        first, second, *offered["more"] = _of_one_light(remedy(whole), light)
        options = {name: offered[name] for name in chosen.options}
        find = partial(chosen.find, template=template, search=search, **options)
        found = find(first, second, stride=stride)
        level = 0.0 if noise is None else noise
        pixels1, pixels2 = _of_one_light(resting.filled(whole[:2]), light)
        texture, low = low_texture(pixels1, windows, min_texture, min_isotropy, level)
        apart = max(1, round(template / 2 / stride))
        flag = resting.flags(found, whole, windows, chosen.centred)
        if chosen.local:
            bad = (flag & Flag.NON_FINITE_INPUT.value) > 0
            found = found._replace(d=torch.where(bad, torch.nan, found.d))
        if chosen.repeats:
            if found.covariance is not None:
                flag = flag | (Flag.LOW_TEXTURE * uncertain(found.covariance)).to(torch.int16)
            # errors of what is at rest or saturated say nothing of the vectors around
            pair = [first, second] if chosen.centred else [pixels1, pixels2]
            clear = clearly_textured(texture, min_texture, min_isotropy)
            covariance = None
            if standard_errors:
                moved, left = 0.0, None
                if chosen.centred:
                    moved, left = coherent_change(pair, found, windows, noise)
                covariance = moved + bootstrap_covariance(
                    pair,
                    found,
                    windows,
                    find,
                    chosen.centred,
                    chosen.repeats,
                    textured=~low,
                    clear=clear,
                    stated=left,
                    noise=noise,
                )
            found = found._replace(covariance=covariance)
        if found.covariance is not None:
            if chosen.repeats:
                flag = flag | of_bootstrap(found.covariance)
            else:
                flag = flag | (Flag.LOW_TEXTURE * uncertain(found.covariance)).to(torch.int16)
        still = Standing()
        # a method that takes times by itself gives the displacement in dt
        by_itself = "times" in options
        shown = tau is None or not by_itself
        if checks and not chosen.local and shown and found.covariance is not None:
            still = standing([first, second], found, windows)
            # parameters beside the vectors would stay biased
            if still.spoils or (still.fraction and found.quantities):
                flag = flag | Flag.AT_REST.value
            else:
                found = still.corrected(found)
        if chosen.local:
            outlier = median_outliers(found.d, median_size, apart, median_threshold, median_epsilon)
            flag = flag | (Flag.LOW_TEXTURE * low + Flag.MEDIAN_OUTLIER * outlier).to(torch.int16)
        if chosen.reach and checks:
            apart = unrelated([pixels1, pixels2], windows, chosen.reach > 1, noise)
            # a field fitted as a whole is flagged only if the images are unrelated everywhere
            apart = apart if chosen.local else apart.all().expand_as(apart)
            flag = flag | (Flag.UNRELATED * apart).to(torch.int16)
    same = identical(stack)
    if same:
        flag = flag | Flag.AT_REST.value
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
    if tau is not None:
        attributes["timed"] = 1
    if "min_correlation" in options:
        attributes["min_correlation"] = min_correlation
    patterns = [str(part) for part in (resting.pattern, still) if str(part)]
    if str(resting):
        attributes["defects"] = str(resting)
    if patterns:
        attributes["fixed_pattern"] = ", ".join(patterns)
    if still.fraction:
        attributes["standing_fraction"] = still.fraction
    if same:
        attributes["identical_images"] = same
    if any(map(described, light)):
        attributes["illumination"] = described(light[-1])
    when = vector_times(None if by_itself else tau, dt, windows, found.d.cpu(), chosen.centred)
    reversed_time = torch.as_tensor(np.isnan(when.difference), device=flag.device)
    found = found._replace(flag=flag | (Flag.NO_MATCH * reversed_time).to(torch.int16))
    steps = spacing(image1)
    variables = winds(found, image1.dims, steps, when.difference)
    variables["time"] = field(image1.dims, when.middle, "mid-time of the vector", "s")
    moved = dict(
        zip(image1.dims, found.d.cpu().numpy() * np.reshape(steps, (2, 1, 1)), strict=True)
    )
    for axis in ("y", "z"):
        about = f"displacement along {axis}", "m"
        variables[f"displacement_{axis}"] = field(image1.dims, moved[axis], *about)
    score, meaning = chosen.score
    slope = "weakest rms slope relative to the mean, per pixel"
    isotropy = "weakest over strongest rms slope"
    variables |= {
        score: field(image1.dims, found.score, meaning, "1"),
        "texture": field(image1.dims, texture.slope, slope, "1"),
        "isotropy": field(image1.dims, texture.isotropy, isotropy, "1"),
        "flag": flags(found, image1.dims),
    }
    coords = centres(image1, windows, "template")
    for axis, place in zip(
        image1.dims, np.meshgrid(*(coords[a][1] for a in "zy"), indexing="ij"), strict=True
    ):
        vector = place + (0.0 if chosen.centred else 0.5) * moved[axis]
        about = f"{axis} of the vector at mid-time", "m"
        coords[f"{axis}_vector"] = field(image1.dims, vector, *about)
    title = "Wind in the image plane from an image pair"
    return dataset(variables, coords, title, attributes, found)


def _of_one_light(
    images: Sequence[torch.Tensor], light: Sequence[torch.Tensor]
) -> list[torch.Tensor]:
    """Images without the gains of all but the first."""
    pairs = zip(images[1:], light[: len(images) - 1], strict=True)
    return [images[0], *(working(i) / gain if described(gain) else i for i, gain in pairs)]


def wind_bound(
    image1: xr.DataArray,
    image2: xr.DataArray,
    dt: float,
    noise: float | xr.DataArray,
    template: int = 8,
    search: int = 16,
    stride: int = 1,
    times: Sequence[xr.DataArray] | None = None,
) -> xr.Dataset:
    """Least standard error of v and w (m/s) that any unbiased method has from each template alone.

    The Cramer-Rao bound, see `bound.displacement_bound`. Grid and parameters are those of
    `retrieve_wind`, as is the time difference of a vector, which is that of air at rest. Infinite
    without texture, NaN near non-finite pixels. A field that is fitted
    to the images as a whole uses more than a template and may be better. Noise below 0.001 of the
    median of a map is raised to that.

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
    (image1, image2), noise = checked_stack([image1, image2], noise)
    windows = Windows(image1.shape, template, search, stride)
    if isinstance(noise, xr.DataArray):
        noise = on_device(noise.clip(min=1e-3 * float(noise.median())), "cpu")
    pair = [on_device(image, "cpu") for image in (image1, image2)]
    covariance = displacement_bound(*(filled(image) for image in pair), noise, template)
    rows, columns = (torch.as_tensor(windows.starts(axis)) for axis in (0, 1))
    root = covariance[:2, rows][:, :, columns].sqrt()
    root = torch.where(non_finite(pair, windows), torch.nan, root).numpy()
    tau = checked_times(times, [image1, image2], dt)
    apart = vector_times(tau, dt, windows, np.zeros((2, *windows.count)), False).difference
    found = {}
    for name, values, step in zip("wv", root, spacing(image1), strict=True):
        about = f"Cramer-Rao bound of {name} from one template", "m s-1"
        found[f"{name}_bound"] = field(image1.dims, values * step / apart, *about)
    return xr.Dataset(found, centres(image1, windows, "template"))


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
