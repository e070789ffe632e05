"""Error budget of the wind: its errors without each cause of error in turn.

Causes that act on the images are removed from them and the wind is retrieved again. Causes in the
definition of a vector (window, path) are removed from the truth it is compared with.
"""

from collections.abc import Callable, Mapping, Sequence

import numpy as np
import scipy
import xarray as xr
from numpy.lib.stride_tricks import sliding_window_view

from lidar_mi.assessment.metrics.errors import truth_at_vectors
from lidar_mi.atmosphere.vortices.cores import Core, outside_cores
from lidar_mi.retrieval.method_names import ImageMethod

CAUSES = {
    "detector_noise": "noise of the detector",
    "monte_carlo": "noise of the simulation",
    "beam_blur": "width of the beam",
    "scan_time": "air that moves during a scan",
    "motion": "motion of the platform",
    "scanner_jitter": "jitter of the scanner",
    "navigation": "errors of the reported pose",
    "slab": "motion other than the slab's mean wind",
    "window": "averaging over the window",
    "shear": "shear within the window",
    "time_step": "curved paths in the time step",
    "method": "the method",
}
"""Causes of error by key, and their names."""

PLACES = {"": "all", "outside_cores.": "beyond two core radii"}
"""Sets of vectors in the keys of `error_budget`, and their names."""

Budgets = Mapping[str, Mapping[str, float]]
"""From `error_budget`, by method."""

Pair = Sequence[xr.DataArray]

# Methods that compare undeformed windows: a vector is the mean chord over one.
_BOXES = (ImageMethod.CC, ImageMethod.WS)


def image_scale(blurred: Pair, rendered: Pair, noise: Pair) -> tuple[float, float]:
    """Gain and offset from the air's extinction to the rendered images.

    By least squares over both images, weighted by 1 / `noise`^2 (standard errors of the rendered
    ones). The offset is the light of a pulse longer than the gate from the air around it.
    """
    x, y, s = (
        np.concatenate([i.values.ravel() for i in pair]) for pair in (blurred, rendered, noise)
    )
    x, y, s = (part[np.isfinite(x) & np.isfinite(y)] for part in (x, y, s))
    # in even air gain and offset cannot be separated
    if np.ptp(x) < 1e-9 * np.abs(x).max():
        return float(y.mean() / x.mean()), 0.0
    # polyfit squares its weights
    weight = 1 / s if (s > 0).all() else np.ones_like(s)
    gain, offset = np.polyfit(x / np.abs(x).max(), y, 1, w=weight / weight.max())
    return float(gain / np.abs(x).max()), float(offset)


def images_without(
    measured: Pair,
    blurred: Pair,
    sharp: Pair,
    rendered: Pair | None = None,
    advected: Pair | None = None,
    timed: Mapping[str, Pair] | None = None,
) -> dict[str, Pair]:
    """Images without one cause of error each, with the same realisation of the others.

    Noise is not drawn again: the detector's is its difference to the rendered image, the
    simulation's the difference of the rendered image to the blurred air. So two cases differ by
    the cause alone and not by chance. The detector's noise stays the same although its photons
    follow the signal: where blur reduces that by 20 %, the noise is in error by 10 %. Light
    transport beyond the blur (multiple scattering, extinction within the slab: 0.5 % of the signal
    in the paper's case, nearly uniform) is part of the simulation's noise.

    measured (z, y): images with all noise.
    blurred, sharp: the air averaged over the beams' width without noise, and without blur; unit of
        `measured`.
    rendered: without the noise of a detector; absent if there is none.
    advected: as `blurred`, of air advected by the slab's mean wind only.
    timed: as `blurred`, by cause, with beams that lack it: `scan_time`, `motion`, `scanner_jitter`,
        `navigation`.

    Returns
    -------
    dict
        Pairs by cause: `monte_carlo`, `beam_blur`, with `rendered` `detector_noise`, with
        `advected` `slab`, and those of `timed`.
    """
    pairs: dict[str, Pair] = {} if rendered is None else {"detector_noise": rendered}
    pairs["monte_carlo"] = _plus_difference(blurred, measured, rendered or measured)
    pairs["beam_blur"] = _plus_difference(measured, sharp, blurred)
    if advected is not None:
        pairs["slab"] = _plus_difference(measured, advected, blurred)
    for cause, images in (timed or {}).items():
        pairs[cause] = _plus_difference(measured, images, blurred)
    return pairs


def _plus_difference(base: Pair, more: Pair, less: Pair) -> list[xr.DataArray]:
    """Sums base + more - less of images on one grid, up to rounding of its coordinates."""
    return [
        a.copy(data=a.values + (b.values - c.values))
        for a, b, c in zip(base, more, less, strict=True)
    ]


def chord_wind(
    truth: xr.Dataset, y: np.ndarray, z: np.ndarray, dt: float, steps: int = 2
) -> tuple[np.ndarray, np.ndarray]:
    """Mean wind over dt of the air whose path has its middle at given places.

    The displacement between two images is the chord of a curved path. In a solid rotation at the
    rate a the mean wind is that at the chord's middle times tan(a dt / 2) / (a dt / 2).

    truth: v, w (m s^-1) on (z, y); the flow is steady over dt. Beyond the field its edge is
        repeated.
    y, z: middles between the positions of the air in both images, m.
    dt: s.
    steps: Runge-Kutta steps (4th order) in dt / 2.

    Returns
    -------
    v, w : arrays
        m s^-1; NaN where the place is.
    """
    axes = [truth[name].values for name in ("z", "y")]
    spacing = np.array([axis[1] - axis[0] for axis in axes])[:, None]
    # in nodes and nodes per second, along z and y
    speeds = [
        scipy.ndimage.spline_filter(truth[name].transpose("z", "y").values / h, mode="mirror")
        for name, h in zip(("w", "v"), spacing, strict=True)
    ]
    place = np.stack([z, y]).astype(float)
    inside = np.isfinite(place).all(0)
    nodes = (place[:, inside] - np.array([axis[0] for axis in axes])[:, None]) / spacing

    def wind(at: np.ndarray) -> np.ndarray:
        return np.stack(
            [
                scipy.ndimage.map_coordinates(speed, at, prefilter=False, mode="nearest")
                for speed in speeds
            ]
        )

    def moved(at: np.ndarray, time: float) -> np.ndarray:
        h = time / steps
        for _ in range(steps):
            k1 = wind(at)
            k2 = wind(at + h / 2 * k1)
            k3 = wind(at + h / 2 * k2)
            k4 = wind(at + h * k3)
            at = at + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
        return at

    middle = nodes
    # each iteration reduces the error to 1 - cos of the rotation in dt / 2
    for _ in range(4):
        before, after = moved(middle, -dt / 2), moved(middle, dt / 2)
        middle = middle + nodes - (before + after) / 2
    chord = np.full((2, *inside.shape), np.nan)
    chord[:, inside] = (moved(middle, dt / 2) - moved(middle, -dt / 2)) * spacing / dt
    return chord[1], chord[0]


def window_mean(truth: xr.Dataset, template: int, method: str) -> xr.Dataset | None:
    """The true wind averaged over a method's windows; None for a method without windows.

    truth: v, w on (z, y), with the images' spacing.
    template: size of a window, px.
    method: "cc", "ws": the mean over the template. "multipass": a Gaussian of a third of the
        template (the value of a weighted affine fit in its middle).
    """
    if method == ImageMethod.MULTIPASS:
        smooth = {
            name: truth[name].copy(
                data=scipy.ndimage.gaussian_filter(truth[name].values, template / 3, mode="nearest")
            )
            for name in ("v", "w")
        }
        return xr.Dataset(smooth)
    return _box_mean(truth, template) if method in _BOXES else None


def _box_mean(truth: xr.Dataset, template: int) -> xr.Dataset:
    axes = {name: sliding_window_view(truth[name].values, template).mean(1) for name in ("z", "y")}
    windows = {
        name: sliding_window_view(truth[name].transpose("z", "y").values, (template, template))
        for name in ("v", "w")
    }
    return xr.Dataset({n: (("z", "y"), w.mean((2, 3))) for n, w in windows.items()}, axes)


def moved_rigidly(
    wind: xr.Dataset,
    measured: Pair,
    blurred: Pair,
    truth: xr.Dataset,
    retrieve: Callable[[Pair, int], xr.Dataset],
) -> xr.Dataset | None:
    """The wind retrieved if the air of every window moves rigidly, with the window's mean wind.

    Shear deforms the air in a window, so that its two images do not match at any shift. Here
    every window's search region is a separate image, and all of them are placed side by side. The
    second image is the blurred air of the first, advected by the mean wind over the template, plus
    the difference of the second measured image to its own blurred air.

    wind: from `retrieve_wind`, with the attributes method, template, search, stride and dt.
    measured, blurred: see `images_without`.
    truth: v, w on (z, y).
    retrieve: retrieves the wind from a pair by the method of `wind`, with windows so many pixels
        apart.

    Returns
    -------
    xr.Dataset or None
        `wind` with other v and w; None for a method whose windows depend on each other.
    """
    if wind.attrs["method"] not in _BOXES:
        return None
    template, search, stride, dt = (wind.attrs[n] for n in ("template", "search", "stride", "dt"))
    mean = truth_at_vectors(wind, _box_mean(truth, template))
    regions = sliding_window_view(np.zeros(measured[0].shape), (search, search))[::stride, ::stride]
    places = []
    for axis, (name, component) in enumerate((("z", "w"), ("y", "v"))):
        spacing = float(measured[0][name][1] - measured[0][name][0])
        start = np.arange(regions.shape[axis]) * stride
        start = start[:, None] if axis == 0 else start[None, :]
        pixel = np.arange(search)[:, None] if axis == 0 else np.arange(search)[None, :]
        shift = np.nan_to_num(mean[component].values) * dt / spacing
        # where the air of a window comes from, by its mean wind
        place = (start - shift)[:, :, None, None] + pixel
        places.append(np.broadcast_to(place, regions.shape))
    advected = scipy.ndimage.map_coordinates(blurred[0].values, places, mode="nearest")

    def cut(image: np.ndarray) -> np.ndarray:
        return sliding_window_view(image, (search, search))[::stride, ::stride]

    # the difference to the blurred air, mostly noise, is unchanged
    remaining = cut(measured[1].values - blurred[1].values)
    pair = [
        _side_by_side(blocks, measured[0])
        for blocks in (cut(measured[0].values), advected + remaining)
    ]
    # with a stride of a search region there is one window in each block
    rigid = retrieve(pair, search)
    return wind.assign({name: (("z", "y"), rigid[name].values) for name in ("v", "w")})


def _side_by_side(blocks: np.ndarray, like: xr.DataArray) -> xr.DataArray:
    """Blocks (rows, columns, z, y) as one image with the pixels of another."""
    image = blocks.transpose(0, 2, 1, 3).reshape(
        blocks.shape[0] * blocks.shape[2], blocks.shape[1] * blocks.shape[3]
    )
    axes = {}
    for name, size in zip(("z", "y"), image.shape, strict=True):
        spacing = float(like[name][1] - like[name][0])
        axes[name] = (name, np.arange(size) * spacing, {"units": "m"})
    return xr.DataArray(image, axes, ("z", "y"))


def error_budget(
    wind: xr.Dataset,
    without: Mapping[str, xr.Dataset],
    truth: xr.Dataset,
    cores: Sequence[Core],
    perfect: xr.Dataset | None = None,
    flagged: bool = False,
) -> dict[str, float]:
    """Errors of a wind with all causes of error, and without each of them in turn.

    The fraction of a cause is 1 - (rms error without it)^2 / (rms error with it)^2. Fractions need
    not add up to 1: causes interact, and one may even reduce errors (methods that adapt to noise
    smooth more), which makes its fraction negative.

    wind: from `lidar_mi.retrieval.wind.pair.retrieve_wind`; with the attributes method, template
        and dt.
    without: the same from `images_without`, by cause, and from `moved_rigidly` as `shear`.
    truth: v, w on (z, y).
    cores: of the true vortices; without any there are no keys `outside_cores.*`.
    perfect: the same from the air without noise or blur: the cause `method` is its deviation from
        the truth.
    flagged: include every vector with a displacement, flagged or not.

    Returns
    -------
    dict
        Flat. `rmse_v`, `rmse_w` (m s^-1) with all causes; `CAUSE.rmse_v`, `.rmse_w` without it;
        `CAUSE.fraction_v`, `.fraction_w`, and `.fraction` of both together; the same of vectors
        beyond two core radii as `outside_cores....`; `vectors`, their number. Always the same
        vectors: those of `wind` that all cases retrieved. Empty where there are none.
    """
    method, template, dt = (wind.attrs[name] for name in ("method", "template", "dt"))
    true = truth_at_vectors(wind, truth)
    errors = {"": _difference(wind, true)}
    for cause, partial in without.items():
        errors[cause] = _difference(partial, truth_at_vectors(partial, truth))
    averaged = window_mean(truth, template, method)
    if averaged is not None:
        errors["window"] = _difference(wind, truth_at_vectors(wind, averaged))
    if method in _BOXES:
        chord = chord_wind(truth, wind["y_vector"].values, wind["z_vector"].values, dt)
        errors["time_step"] = _difference(wind, dict(zip("vw", chord, strict=True)))
    if perfect is not None:
        bias = _difference(perfect, truth_at_vectors(perfect, truth))
        # as for the other causes: the errors without it
        errors["method"] = errors[""] - bias
    chosen = np.logical_and.reduce([np.isfinite(e).all(0) for e in errors.values()])
    if not flagged:
        chosen &= wind["flag"].values == 0
    far = chosen & outside_cores(wind["y_vector"].values, wind["z_vector"].values, list(cores))
    metrics = _fractions(errors, chosen)
    if cores:
        metrics |= {f"outside_cores.{key}": x for key, x in _fractions(errors, far).items()}
    return metrics


def _difference(wind: xr.Dataset, true: xr.Dataset | Mapping[str, np.ndarray]) -> np.ndarray:
    return np.stack([np.asarray(wind[n], float) - np.asarray(true[n], float) for n in ("v", "w")])


def _fractions(errors: Mapping[str, np.ndarray], chosen: np.ndarray) -> dict[str, float]:
    if not chosen.any():
        return {}
    square = {cause: (e[:, chosen] ** 2).mean(1) for cause, e in errors.items()}
    full = square.pop("")
    metrics: dict[str, float] = {"vectors": int(chosen.sum())}
    metrics |= {f"rmse_{name}": float(value**0.5) for name, value in zip("vw", full, strict=True)}
    for cause, remaining in square.items():
        metrics |= {
            f"{cause}.rmse_{name}": float(value**0.5)
            for name, value in zip("vw", remaining, strict=True)
        }
        if (full > 0).all():
            parts = 1 - remaining / full
            metrics |= {
                f"{cause}.fraction_{name}": float(x) for name, x in zip("vw", parts, strict=True)
            }
            metrics[f"{cause}.fraction"] = float(1 - remaining.sum() / full.sum())
    return metrics


def causes_of(budget: Mapping[str, float]) -> list[str]:
    """Causes in a budget from `error_budget`."""
    return [cause for cause in CAUSES if f"{cause}.fraction" in budget]


def component_rmse(budget: Mapping[str, float], place: str) -> float:
    """Rms error of v and w together, per component, m s^-1; ``place`` of `PLACES`."""
    return float(np.hypot(budget[f"{place}rmse_v"], budget[f"{place}rmse_w"]) / np.sqrt(2))
