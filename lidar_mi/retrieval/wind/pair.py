"""From two images to the wind: one call, CF data set out."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np
import torch
import xarray as xr

from lidar_mi.arguments import checked_arguments
from lidar_mi.flags import Flag
from lidar_mi.retrieval.correlation.bootstrap import bootstrap_covariance
from lidar_mi.retrieval.correlation.outliers import median_outliers
from lidar_mi.retrieval.correlation.settings import MultipassSettings
from lidar_mi.retrieval.defects.copies import Copy, copy_at_rest, without_copy
from lidar_mi.retrieval.defects.faint_pattern import Standing, standing
from lidar_mi.retrieval.defects.removal import CleanImages, as_they_are, without_defects
from lidar_mi.retrieval.defects.sampling import no_structure, sampling
from lidar_mi.retrieval.defects.unrelated import unrelated
from lidar_mi.retrieval.device import within_memory
from lidar_mi.retrieval.flow.settings import VariationalSettings
from lidar_mi.retrieval.images.beam_times import vector_times
from lidar_mi.retrieval.images.displacement import Displacement
from lidar_mi.retrieval.images.quality import clearly_textured, low_texture, of_bootstrap, of_fit
from lidar_mi.retrieval.images.windows import Windows
from lidar_mi.retrieval.threads import threads_for
from lidar_mi.retrieval.wind.dataset import centres
from lidar_mi.retrieval.wind.methods import Method
from lidar_mi.retrieval.wind.options import IMAGE_WINDOWS, VALIDATION, VectorValidation, WindowSizes
from lidar_mi.retrieval.wind.pair_dataset import Vectors, pair_dataset
from lidar_mi.retrieval.wind.pair_input import PairInput, checked_input, method_of
from lidar_mi.retrieval.wind.samples import samples_fit, samples_of, wind_from_samples


@checked_arguments
def retrieve_wind(
    image1: xr.DataArray,
    image2: xr.DataArray,
    dt: float,
    method: str | Method = "variational",
    *,
    windows: WindowSizes = IMAGE_WINDOWS,
    validation: VectorValidation = VALIDATION,
    noise: float | xr.DataArray | None = None,
    more: Sequence[xr.DataArray] = (),
    times: Sequence[xr.DataArray] | None = None,
    blur: float = 0.0,
    settings: MultipassSettings | VariationalSettings | None = None,
    checks: bool = True,
    standard_errors: bool = True,
    device: str | torch.device = "cpu",
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
    windows : WindowSizes
        Template, search region and step from vector to vector, px.
    validation : VectorValidation
        Tests that a vector must pass.
    noise : float or xr.DataArray, optional
        Standard deviation of image 1's noise, in its unit. Default: "multipass",
        "variational" and "vortex_fit" estimate it; the test of texture assumes none.
    more : sequence of xr.DataArray
        Further images on the same grid, each dt after the one before ("variational"): a burst.
        The winds are those at its mid-time.
    times : sequence of two xr.DataArray, optional
        When each pixel of image 1 and of image 2 was seen, s from its image's reference time, on
        their grid (not with `more`). ``dt`` is then from reference time to reference time, and
        winds follow from each vector's own time difference, see `beam_times.vector_times`. Default:
        each image is instantaneous.
    blur : float
        Standard deviation, m, of the Gaussian by which the instrument blurs the air, as a beam of
        1/e^2 radius 2 `blur` does ("variational", which then sharpens; square pixels only).
    settings : MultipassSettings or VariationalSettings, optional
        Of the method of that name.
    checks : bool
        Remove or flag structure of the sampling, saturated areas, structure at rest, gains of
        columns and rows, a change of illumination, and images of unrelated air. Without it
        "variational" is 10 to 20 % faster.
    standard_errors : bool
        False: "cc", "ws" and "multipass" state none, and no vector is flagged because of its
        standard error; this halves their time. The other methods always state them.
    device : str or torch.device
        Where to compute: "cpu", "cuda", or "auto" for CUDA if there is one. If its memory is full,
        smaller parts are computed at a time.

    Returns
    -------
    xr.Dataset, dims (z, y)
        At the template centres (an even template's lies between pixels): `v`, `w` (m s-1),
        `v_stderr`, `w_stderr` (m s-1) and `vw_correlation`, the standard errors of v and w and
        their correlation, `time` (s from image 1's reference time, the vector's mid-time),
        `displacement_y`, `displacement_z` (m), `correlation` or `mismatch`, `texture` (px^-1),
        `isotropy`, `flag` (bits of `flags.Flag`, 0 = valid). The auxiliary coordinates
        `y_vector`, `z_vector` are the position of the vector at mid-time: the centre and, with "cc"
        and "ws", half the displacement. "vortex_fit" adds the pair's numbers, see
        `VortexPairFit.quantities`. Rejected vectors keep their value, or NaN if there is none.
        Attributes name what was found in the images: `defects`, `fixed_pattern`, `copy_at_rest`,
        `illumination`, `identical_images` (bit for bit, from which no motion can be known: no
        vector is valid), `sampling` (`defects.sampling`: copied or repeated pixels, interlaced
        rows, no picture).

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
    >>> wind = lm.retrieve_wind(image1, image2, dt=0.1, windows=lm.WindowSizes(stride=2))
    >>> print(f"{float(wind['v'].median()):.1f} {wind['v'].units}")
    10.0 m s-1
    """
    chosen = method_of(method)
    images = [image1, image2, *more]
    inputs = checked_input(images, dt, chosen, windows, noise, times, blur, device)
    structure = sampling(inputs.pixels) if checks else no_structure(inputs.pixels)
    options: dict[str, Any] = {
        "validation": validation,
        "blur": blur,
        "settings": settings,
        "standard_errors": standard_errors,
        "device": device,
    }
    if structure.thinned and samples_fit(inputs.images[0], structure, windows, blur > 0):
        sample_times = None if times is None else [samples_of(t, structure) for t in times]
        options |= {"dt": inputs.dt, "method": chosen, "times": sample_times}
        places = centres(inputs.images[0], inputs.windows, "template")
        return wind_from_samples(
            retrieve_wind, inputs.images, structure, windows, noise, places, **options
        )
    inputs = inputs._replace(pixels=structure.masked(inputs.pixels))

    def retrieve() -> tuple[CleanImages, Vectors]:
        remove = without_defects if checks else as_they_are
        clean = remove(inputs.pixels, inputs.windows)
        return clean, _vectors(chosen, inputs, clean, validation, settings, checks, standard_errors)

    with threads_for(image1.size):
        clean, vectors = within_memory(retrieve)
    wind = pair_dataset(chosen, inputs, clean, vectors, validation)
    # the sampling is at rest and draws displacements to its periods, or leaves too few samples
    if structure.spoilt or structure.thinned:
        wind["flag"] = wind["flag"] | np.int16(Flag.AT_REST)
    return wind.assign_attrs(sampling=structure.said) if structure.said else wind


def _vectors(
    method: Method,
    inputs: PairInput,
    clean: CleanImages,
    validation: VectorValidation,
    settings: MultipassSettings | VariationalSettings | None,
    checks: bool,
    standard_errors: bool,
) -> Vectors:
    """Displacements with their errors and flags."""
    windows = inputs.windows
    # a correlation would lose every window with a masked pixel
    frames = clean.masked() if method.centred else clean.filled
    estimate = _estimator(method, inputs, frames[2:], validation, settings)
    displacement = estimate(*frames[:2], stride=windows.stride)
    pair: Sequence[torch.Tensor] = frames[:2]
    pattern, copy, copy_remains = Standing(), Copy(), False
    tested = checks and not (inputs.times and method.timed)
    if tested and len(frames) == 2 and displacement.quantities:
        # how a copy biases parameters is unknown: it is detected, not removed
        copy = copy_at_rest(pair, displacement, windows)
        copy_remains = copy.significant
    elif tested and len(frames) == 2:
        again, before = partial(estimate, stride=windows.stride), pair
        field = Displacement.medians if method.local else lambda d: d
        displacement, copy, pair = without_copy(again, displacement, pair, windows, field)
        # a copy that cannot be removed leaves the images as they were
        copy_remains = copy.significant and pair is before
        displacement = copy.widened(displacement)
    flag = clean.defects.flags(displacement, clean.raw, windows, method.centred)
    if method.local:
        blind = (flag & Flag.NON_FINITE_INPUT.value) > 0
        displacement = displacement._replace(d=torch.where(blind, torch.nan, displacement.d))
    level = 0.0 if inputs.noise is None else inputs.noise
    limits = validation.min_texture, validation.min_isotropy
    texture, low = low_texture(clean.filled[0], windows, *limits, level)
    flag = flag | of_fit(displacement.covariance)
    if method.bootstrapped:
        clear, covariance = clearly_textured(texture, *limits), None
        if standard_errors:
            covariance = bootstrap_covariance(
                pair, displacement, windows, estimate, method.centred, ~low, clear, inputs.noise
            )
            flag = flag | of_bootstrap(covariance)
        displacement = copy.widened(displacement._replace(covariance=covariance))
    if tested and not method.local and displacement.covariance is not None:
        pattern = standing(pair, displacement, windows)
    # parameters fitted beside the vectors would stay biased
    if pattern.spoils or (pattern.fraction and displacement.quantities):
        flag = flag | Flag.AT_REST.value
    elif copy_remains and not pattern.fraction:
        flag = flag | Flag.AT_REST.value
    else:
        displacement = pattern.corrected(displacement)
    if method.local:
        flag = flag | _flags_among_neighbours(displacement.d, low, windows, validation)
    if checks and method.reach:
        unrelated_flag = _flags_of_unrelated(clean, inputs, method)
        # unrelated images have large errors, which count as low texture: where it is strong the
        # one reason is that they are unrelated
        unrelated_only = (unrelated_flag > 0) & ~low.to(flag.device)
        flag = torch.where(unrelated_only, flag & ~Flag.LOW_TEXTURE.value, flag) | unrelated_flag
    if inputs.same:
        flag = flag | Flag.AT_REST.value
    times = None if method.timed else inputs.times
    when = vector_times(times, inputs.dt, windows, displacement.d.cpu().numpy(), method.centred)
    reversed_time = torch.as_tensor(np.isnan(when.difference), device=flag.device)
    flag = flag | (Flag.NO_MATCH * reversed_time).to(torch.int16)
    return Vectors(displacement._replace(flag=flag), texture, pattern, copy, when)


def _estimator(
    method: Method,
    inputs: PairInput,
    more: Sequence[torch.Tensor],
    validation: VectorValidation,
    settings: MultipassSettings | VariationalSettings | None,
) -> Callable[..., Displacement]:
    """The method with its options, (image1, image2, stride=...) -> Displacement."""
    z, y = (inputs.images[0].coords.variables[name].values.astype(float) for name in ("z", "y"))
    offered = {
        "min_correlation": validation.min_correlation,
        "noise": inputs.noise,
        "axes": (z, y),
        "dt": inputs.dt,
        "more": more,
        "times": inputs.times,
        "blur": inputs.blur_px,
        "settings": settings,
        "partly": True,  # windows with masked pixels are matched by the others, and flagged
    }
    windows = inputs.windows
    options = {name: offered[name] for name in method.options}
    return partial(method.find, template=windows.template, search=windows.search, **options)


def _flags_among_neighbours(
    d: torch.Tensor, low: torch.Tensor, windows: Windows, validation: VectorValidation
) -> torch.Tensor:
    """Flags of vectors ``d`` (px) of single windows: of low texture, outliers among neighbours."""
    outlier = median_outliers(
        d,
        validation.median_size,
        max(1, round(windows.template / 2 / windows.stride)),
        validation.median_threshold,
        validation.median_epsilon,
    )
    return (Flag.LOW_TEXTURE * low + Flag.MEDIAN_OUTLIER * outlier).to(torch.int16)


def _flags_of_unrelated(clean: CleanImages, inputs: PairInput, method: Method) -> torch.Tensor:
    """Flags where the images show different air, of a fitted field where they do everywhere."""
    different = unrelated(clean.filled[:2], inputs.windows, method.reach > 1, inputs.noise)
    different = different if method.local else different.all().expand_as(different)
    return (Flag.UNRELATED * different).to(torch.int16)
