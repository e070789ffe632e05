"""Standard errors of vectors that another program retrieved from an image pair."""

import numpy as np
import torch
import xarray as xr

from lidar_mi.arguments import checked_arguments
from lidar_mi.errors import InputError
from lidar_mi.flags import Flag
from lidar_mi.retrieval.images.windows import averaged
from lidar_mi.retrieval.wind.options import WindowSizes
from lidar_mi.retrieval.wind.pair import retrieve_wind

_WIDTH = 1.5
"""Standard deviation of the Gaussian means, windows."""
_FEWEST = 5.0
"""Independent windows that a mean needs."""
_FAR, _ROUNDS = 5.0, 3
"""Standard deviations beyond which a difference is an outlier: of normal ones 1 in 5000, as the
deviations are those of about 28 others. Rounds in which outliers are found."""


@checked_arguments
def standard_errors(
    image1: xr.DataArray,
    image2: xr.DataArray,
    v: xr.DataArray,
    w: xr.DataArray,
    dt: float,
    *,
    window: float,
    noise: float | xr.DataArray | None = None,
    device: str | torch.device = "cpu",
) -> xr.Dataset:
    """Standard errors of vectors that another program retrieved from an image pair.

    The same images are retrieved by the variational model, whose errors follow from its fit. Where
    that is the more efficient estimate, its error is uncorrelated with its difference to another
    one (Hausman 1978, Econometrica 46, 1251, lemma 2.1), so that the covariance of the given
    vectors is

        C = C_variational + < d d^T > f / (f - 2),

    with the difference d and its mean < > over a Gaussian of 1.5 windows of the vectors that are no
    outliers. With f differences in a mean, normalised errors have Student's distribution, of the
    variance f / (f - 2). Errors of all kinds are in d: noise, peak locking, motion that windows do
    not resolve.

    Parameters
    ----------
    image1, image2 : xr.DataArray, dims (z, y)
        As of `retrieve_wind`.
    v, w : xr.DataArray, dims (z, y)
        Wind of the other program, m s-1, at the places and the mid-time that it belongs to: on a
        uniform grid in m, NaN where there is none.
    dt : float
        Time from image 1 to image 2, s.
    window : float
        Side of the other program's last interrogation window, px: errors of vectors that are
        nearer to each other are not independent.
    noise, device
        As of `retrieve_wind`.

    Returns
    -------
    xr.Dataset, dims (z, y)
        `v`, `w` as given, `v_stderr`, `w_stderr` (m s-1), `vw_correlation`, the differences
        `v_difference`, `w_difference`, and `flag` (bits of `Flag`). `MEDIAN_OUTLIER`: farther from
        the variational wind than five standard deviations of the others around. `ERROR_UNKNOWN`:
        the variational model has no valid vector there, or too few differences are known around.

    Raises
    ------
    InputError
        Images or a grid that are not suitable, vectors outside of the images.

    Examples
    --------
    >>> import lidar_mi as lm
    >>> errors = lm.standard_errors(a, b, v, w, dt=0.1, window=32)  # doctest: +SKIP
    >>> errors["v_stderr"].plot()  # doctest: +SKIP
    """
    step = _step(image1, v, w)
    if not window >= 2:
        raise InputError(f"window: {window:g} px is not allowed; expected 2 or more")
    sizes = WindowSizes(template=8, search=16, stride=1)
    variational = retrieve_wind(image1, image2, dt, noise=noise, windows=sizes, device=device)
    at = {axis: v[axis] for axis in ("z", "y")}
    variational = variational.where(variational["flag"] == 0)
    names = ("v", "w", "v_stderr", "w_stderr", "vw_correlation")
    near = variational[list(names)].interp(at).transpose("z", "y")
    vectors = [component.transpose("z", "y") for component in (w, v)]
    differences = (wind - near[name] for wind, name in zip(vectors, "wv", strict=True))
    d = torch.stack([torch.as_tensor(difference.values) for difference in differences])
    width = _WIDTH * window / step
    use = d.isfinite().all(0)
    outlier = torch.zeros_like(use)
    for _ in range(_ROUNDS):
        outlier = outlier | _outliers(d, use, width)
        use = d.isfinite().all(0) & ~outlier
    ones = torch.ones_like(use)
    # independent differences in a Gaussian mean: separate windows, two components
    number = 4 * np.pi * _WIDTH**2 * 2 * averaged(use.to(d), ones, width)
    student = torch.where(number > 2 * _FEWEST, number / (number - 2), torch.nan)
    spread = _mean_square(d, use, width) * student
    vv, ww = (near[f"{name}_stderr"].values ** 2 for name in "vw")
    vw = near["vw_correlation"].values * np.sqrt(vv * ww)
    total = spread.numpy() + np.array([[ww, vw], [vw, vv]])
    stderr = np.sqrt(total[[1, 0], [1, 0]])
    unknown = ~np.isfinite(stderr).all(0)
    flag = Flag.MEDIAN_OUTLIER.value * outlier.numpy() + Flag.ERROR_UNKNOWN.value * unknown
    about = {"units": "m s-1"}
    on = ("z", "y")
    return xr.Dataset(
        {
            "v": (on, vectors[1].values, about),
            "w": (on, vectors[0].values, about),
            "v_stderr": (on, stderr[0], about | {"long_name": "standard error of v"}),
            "w_stderr": (on, stderr[1], about | {"long_name": "standard error of w"}),
            "vw_correlation": (on, total[0, 1] / np.prod(stderr, 0), {"units": "1"}),
            "v_difference": (on, d[1].numpy(), about | {"long_name": "v less variational v"}),
            "w_difference": (on, d[0].numpy(), about | {"long_name": "w less variational w"}),
            "flag": (on, flag.astype(np.int16)),
        },
        coords={axis: v[axis] for axis in on},
    )


def _mean_square(d: torch.Tensor, use: torch.Tensor, width: float) -> torch.Tensor:
    """Local means of d d^T over the differences that are used."""
    used = torch.where(use, d, 0.0)
    return torch.stack([torch.stack([averaged(a * b, use, width) for b in used]) for a in used])


def _outliers(d: torch.Tensor, use: torch.Tensor, width: float) -> torch.Tensor:
    """Differences farther from 0 than five standard deviations of the others around."""
    used = torch.where(use, d, 0.0)
    reach = torch.arange(-int(4 * width) - 1, int(4 * width) + 2)
    centre = 1 / float(torch.exp(-((reach / width) ** 2) / 2).sum()) ** 2
    weight = averaged(use.to(d), torch.ones_like(use), width)
    others = _mean_square(d, use, width) * weight - centre * used[:, None] * used[None]
    others = (others / (weight - centre * use).clamp(min=1e-12)).movedim((0, 1), (-2, -1))
    # where all others are 0, any difference is an outlier
    others = others + 1e-12 * torch.eye(2, dtype=d.dtype)
    column = used.movedim(0, -1)[..., None]
    return (column * torch.linalg.solve(others, column)).sum((-2, -1)) > _FAR**2


def _step(image: xr.DataArray, v: xr.DataArray, w: xr.DataArray) -> float:
    """Distance between vectors, px; their grid is checked."""
    if set(v.dims) != {"z", "y"} or set(w.dims) != {"z", "y"}:
        raise InputError(f"v, w: dims {v.dims} and {w.dims}; expected z and y")
    steps = []
    for axis in ("z", "y"):
        places, pixels = (field[axis].values.astype(float) for field in (v, image))
        if not np.array_equal(places, w[axis].values) or len(places) < 3:
            raise InputError(f"v, w: not on one grid along {axis}; expected three places or more")
        gaps = np.diff(places)
        if not (gaps > 0).all() or np.ptp(gaps) > 1e-3 * gaps.mean():
            raise InputError(f"v.{axis}: not uniform and ascending; expected a uniform grid in m")
        if places[0] < pixels[0] or places[-1] > pixels[-1]:
            raise InputError(
                f"v.{axis}: {places[0]:g} to {places[-1]:g} m is not within the images, "
                f"{pixels[0]:g} to {pixels[-1]:g} m"
            )
        steps.append(gaps.mean() / np.diff(pixels).mean())
    if abs(steps[0] / steps[1] - 1) > 1e-2:
        raise InputError(f"v: steps of {steps[0]:g} and {steps[1]:g} px; expected equal ones")
    return float(steps[0])
