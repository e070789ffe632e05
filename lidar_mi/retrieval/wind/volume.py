"""From two volumes to the wind in three dimensions: one call, CF data set out."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from functools import partial
from typing import Any

import torch
import xarray as xr

from lidar_mi.arguments import checked_arguments
from lidar_mi.errors import InputError
from lidar_mi.flags import Flag
from lidar_mi.retrieval.checks import checked_stack, identical, on_device, positive
from lidar_mi.retrieval.correlation.bootstrap import bootstrap_covariance, enough_windows
from lidar_mi.retrieval.correlation.multipass import multipass
from lidar_mi.retrieval.correlation.outliers import median_outliers
from lidar_mi.retrieval.correlation.settings import MultipassSettings
from lidar_mi.retrieval.defects.copies import Copy, without_copy
from lidar_mi.retrieval.defects.rest import all_at_rest
from lidar_mi.retrieval.defects.sampling import no_structure, sampling
from lidar_mi.retrieval.defects.unrelated import unrelated
from lidar_mi.retrieval.defects.voxels import outstanding
from lidar_mi.retrieval.device import within_memory
from lidar_mi.retrieval.flow.settings import VariationalSettings
from lidar_mi.retrieval.flow.variational import variational
from lidar_mi.retrieval.images.displacement import Displacement
from lidar_mi.retrieval.images.quality import check_between, of_bootstrap, of_fit
from lidar_mi.retrieval.images.windows import Windows, working
from lidar_mi.retrieval.wind.dataset import centres, dataset, field, flags, spacing, winds
from lidar_mi.retrieval.wind.options import (
    VALIDATION,
    VOLUME_WINDOWS,
    VectorValidation,
    WindowSizes,
)
from lidar_mi.retrieval.wind.samples import samples_fit, wind_from_samples

AXES = ("x", "z", "y")

METHODS: Mapping[str, Callable[..., Displacement]] = {
    "correlation": multipass,
    "variational": variational,
}
"""Methods by name."""


@checked_arguments
def retrieve_wind_volume(
    volume1: xr.DataArray,
    volume2: xr.DataArray,
    dt: float,
    method: str = "variational",
    *,
    windows: WindowSizes = VOLUME_WINDOWS,
    validation: VectorValidation = VALIDATION,
    noise: float | xr.DataArray | None = None,
    more: Sequence[xr.DataArray] = (),
    settings: MultipassSettings | VariationalSettings | None = None,
    checks: bool = True,
    device: str | torch.device = "cpu",
) -> xr.Dataset:
    """Wind in three dimensions from two volumes of the same air, dt apart.

    Parameters
    ----------
    volume1, volume2 : xr.DataArray, dims (x, z, y)
        On one grid: coordinates in metres (`units` attribute), ascending and uniform, spacings may
        differ from axis to axis; positive in the mean. Brightness may differ by a factor and by a
        decay along x. Non-finite voxels are masked.
    dt : float
        Time from volume to volume, s.
    method : {"correlation", "variational"}
        Correlation of deformed windows (`multipass.multipass`), or a smooth flow fitted to the
        volumes as a whole (`variational.variational`).
    windows : WindowSizes
        Voxels: windows of template^3, displacements up to (search - template) / 2 in each
        direction, a vector every `stride`.
    validation : VectorValidation
        Its least correlation is that of the volumes warped to mid-time, over a window, and its
        median test is that of "correlation". Volumes are not tested for texture.
    noise : float or xr.DataArray, optional
        Standard deviation of a voxel's noise in volume 1, in its unit. Default: from the spectra.
    more : sequence of xr.DataArray
        Further volumes, each dt after the one before ("variational" only).
    settings : MultipassSettings or VariationalSettings, optional
        Of "correlation" or "variational". Default: those of volumes.
    checks : bool
        Replace voxels that stand out of their neighbours, as hard targets and dead gates do, and
        remove or flag structure of the sampling, and of two volumes a copy of one in the other.
    device : str or torch.device
        Where to compute.

    Returns
    -------
    xr.Dataset, dims (x, z, y)
        At the windows' centres at mid-time: `u`, `v`, `w` and `u_stderr`, `v_stderr`, `w_stderr`
        (m s-1), `uv_correlation`, `uw_correlation`, `vw_correlation` of their errors,
        `correlation`, `flag` (bits of `flags.Flag`, 0 = valid; low texture means a standard error
        beyond half a voxel in some direction). Those of "correlation" are from `bootstrap` where
        there are enough windows. Rejected vectors keep their value, or NaN where
        there is none. `identical_images`, `sampling`, `copy_at_rest` and `defects` as of
        `wind.retrieve_wind`.

    Raises
    ------
    InputError
        Volumes on different or unsuitable grids, thinner than a template, not bright; a parameter
        out of its range.

    Examples
    --------
    Air that moves by a voxel of 0.5 m along y in 0.1 s:

    >>> import lidar_mi as lm
    >>> import numpy as np
    >>> import xarray as xr
    >>> from scipy.ndimage import gaussian_filter
    >>> air = 2 + gaussian_filter(np.random.default_rng(1).normal(size=(18, 18, 19)), 1.5)
    >>> axes = {d: (d, 0.5 * np.arange(18), {"units": "m"}) for d in "xzy"}
    >>> volume1, volume2 = (xr.DataArray(air[..., k : k + 18], axes, tuple("xzy")) for k in (1, 0))
    >>> wind = lm.retrieve_wind_volume(volume1, volume2, dt=0.1, method="correlation")
    >>> abs(float(wind["v"].median()) - 5) < 0.3
    True
    """
    if method not in METHODS:
        raise InputError(f"method: {method!r} is not one of {', '.join(METHODS)}")
    if more and method != "variational":
        raise InputError(f"more: {len(more)} volumes are not allowed with {method}; expected none")
    dt = positive("dt", dt)
    check_between("min_correlation", validation.min_correlation, -1, 1)
    stack, level = checked_stack([volume1, volume2, *more], noise, AXES, "volume")
    frame = windows.on(stack[0].shape)
    raw = [on_device(volume, device) for volume in stack]
    sigma = on_device(level, device) if isinstance(level, xr.DataArray) else level
    steps, same = spacing(stack[0]), identical(stack, "volumes")
    structure = sampling(raw) if checks else no_structure(raw)
    if structure.thinned and samples_fit(stack[0], structure, windows, False):
        return wind_from_samples(
            retrieve_wind_volume,
            stack,
            structure,
            windows,
            level,
            centres(stack[0], frame, "window"),
            dt=dt,
            method=method,
            validation=validation,
            settings=settings,
            device=device,
        )
    pixels = structure.masked(raw)
    outliers = [outstanding(v) if checks else torch.zeros_like(v, dtype=torch.bool) for v in pixels]
    pixels = [
        torch.where(outlier, torch.nan, volume) if outlier.any() else volume
        for outlier, volume in zip(outliers, pixels, strict=True)
    ]
    displacement, copy = within_memory(
        lambda: _displacements(pixels, sigma, method, frame, validation, settings, steps, checks)
    )
    if same or structure.spoilt or structure.thinned:
        displacement = displacement._replace(flag=displacement.flag | Flag.AT_REST.value)
    variables = winds(displacement, AXES, steps, dt)
    long_name = "correlation of the volumes warped to mid-time"
    variables["correlation"] = field(AXES, displacement.score, long_name, "1")
    variables["flag"] = flags(displacement, AXES)
    attributes = {
        "method": method,
        **asdict(windows),
        "dt": dt,
        "min_correlation": validation.min_correlation,
    }
    number = sum(int(outlier.sum()) for outlier in outliers)
    remarks = {
        "identical_images": same,
        "sampling": structure.said,
        "copy_at_rest": str(copy),
        "defects": f"{number} voxels are replaced in {len(outliers)} volumes" if number else "",
    }
    attributes |= {name: value for name, value in remarks.items() if value}
    coords = centres(stack[0], frame, "window")
    return dataset(variables, coords, "Wind from two volumes", attributes, displacement)


def _displacements(
    raw: Sequence[torch.Tensor],
    noise: float | torch.Tensor | None,
    method: str,
    frame: Windows,
    validation: VectorValidation,
    settings: MultipassSettings | VariationalSettings | None,
    steps: Sequence[float],
    checks: bool,
) -> tuple[Displacement, Copy]:
    """Displacements in voxels, with errors and flags, and a copy that was removed.

    `steps` are the spacings, m; copies are looked for with `checks` and in two volumes.
    """
    defects = all_at_rest(raw, frame)
    volumes, relative = without_attenuation(defects.masked(raw), noise)
    options: dict[str, Any] = {
        "min_correlation": validation.min_correlation,
        "noise": relative,
        "settings": settings,
    }
    if method == "variational":
        options |= {"more": volumes[2:], "spacing": steps}
    estimate = partial(METHODS[method], template=frame.template, search=frame.search, **options)
    displacement, copy, unexplained = estimate(*volumes[:2], stride=frame.stride), Copy(), False
    if checks and len(volumes) == 2:
        bright = [volume + 1 for volume in volumes]

        def again(*pair: torch.Tensor) -> Displacement:
            return estimate(*(volume - 1 for volume in pair), stride=frame.stride)

        local = Displacement.medians if method == "correlation" else lambda d: d
        displacement, copy, clean = without_copy(again, displacement, bright, frame, local)
        unexplained = copy.significant and clean is bright
        volumes = [volume - 1 for volume in clean]
    flag = defects.flags(displacement, raw, frame, True) | of_fit(displacement.covariance)
    if unexplained:
        flag = flag | Flag.AT_REST.value
    if method == "correlation":
        if enough_windows(frame):
            textured = flag & Flag.LOW_TEXTURE.value == 0
            covariance = bootstrap_covariance(
                volumes, displacement, frame, estimate, True, textured=textured, noise=relative
            )
            flag = flag | of_bootstrap(covariance)
            displacement = displacement._replace(covariance=covariance)
        outlier = median_outliers(
            displacement.d,
            validation.median_size,
            max(1, round(frame.template / 2 / frame.stride)),
            validation.median_threshold,
            validation.median_epsilon,
            continued=True,
        )
        flag = flag | (Flag.MEDIAN_OUTLIER * outlier).to(torch.int16)
    # shear lowers the correlation of windows as large as a volume is thick: all windows together
    if bool(unrelated(volumes, frame, False, relative).all()):
        flag = flag | Flag.UNRELATED.value
    return copy.widened(displacement)._replace(flag=flag), copy


def without_attenuation(
    volumes: Sequence[torch.Tensor], noise: float | torch.Tensor | None = None
) -> tuple[list[torch.Tensor], torch.Tensor | None]:
    """Volumes divided by their brightness c exp(a x), less 1, and the noise of the first likewise.

    The brightness is fitted to the means of the gates, so that attenuation through the volume
    causes no displacement. Non-finite voxels stay so.

    volumes (x, z, y)
    noise: of a voxel of the first volume, in its unit.

    Raises InputError: a volume that is not bright in some gate; noise below 0.
    """
    brightness = [_brightness(volume, n) for n, volume in enumerate(volumes, 1)]
    if noise is not None:
        noise = torch.as_tensor(noise, dtype=volumes[0].dtype, device=volumes[0].device)
        if not bool((noise[noise.isfinite()] >= 0).all()):
            raise InputError("noise: below 0 is not allowed; expected standard deviations >= 0")
        noise = (noise / brightness[0]).expand_as(volumes[0])
    return [volume / level - 1 for volume, level in zip(volumes, brightness, strict=True)], noise


def _brightness(volume: torch.Tensor, number: int) -> torch.Tensor:
    """c exp(a x), shape (x, 1, 1)."""
    values = working(volume)
    known = torch.isfinite(values)
    values = torch.where(known, values, 0.0)
    count = known.sum((1, 2))
    gates = values.sum((1, 2)) / count.clamp(min=1)
    if not bool((gates[count > 0] > 0).all()) or not bool(count.any()):
        raise InputError(
            f"volume{number}: gates that are 0, negative or not finite on the whole are not "
            "allowed; expected a brightness above 0 in every gate"
        )
    x = torch.arange(len(gates)).to(gates)
    x = x - (x * count).sum() / count.sum()
    logarithm = torch.where(count > 0, gates.clamp(min=1e-300).log(), 0.0)
    decay = (count * x * logarithm).sum() / (count * x * x).sum().clamp(min=1e-30)
    level = (decay * x).exp()[:, None, None]
    return level * (values / level).sum() / count.sum()
