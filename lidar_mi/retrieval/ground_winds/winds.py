"""Profiles of the wind from scans of a Doppler lidar: VAD, DBS, PPI."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import xarray as xr
from threadpoolctl import threadpool_limits

from lidar_mi.arguments import checked_arguments
from lidar_mi.errors import InputError
from lidar_mi.flags import WindFlag
from lidar_mi.retrieval.ground_winds.folding import ambiguous, unfolded
from lidar_mi.retrieval.ground_winds.outliers import (
    LIMIT,
    refitted,
    residuals,
    spread,
    spread_of_best,
)
from lidar_mi.retrieval.ground_winds.posterior import LENGTHS, Level, along, evidence, mean_wind
from lidar_mi.retrieval.ground_winds.profiles import (
    MAX_CONDITION,
    MAX_STDERR,
    MIN_FRACTION,
    Profile,
    profile_dataset,
)
from lidar_mi.retrieval.ground_winds.source_name import source_name
from lidar_mi.retrieval.ground_winds.tilt import unapplied_tilt

_BLOCK = 5  # levels that share their turbulence
_MOST = 24  # numbers of a level: more lines are averaged with their neighbours
_MOST_LINES = 120  # whose correlation is computed
_ROUNDS = 5  # of the search for outliers
_LEAST_SPREAD = 0.02  # m/s: rounding of the velocities
_IN_ONE_PLANE = 1e6  # condition number of the directions, beyond the rounding of their angles


@checked_arguments
def fit_winds_to_lines(
    lines: xr.Dataset,
    *,
    interval: float | None = None,
    height_step: float | None = None,
    noise: float | None = None,
    length_scale: float | None = None,
) -> xr.Dataset:
    r"""Profiles of the wind from lines of sight: one for each scan, or for each interval.

    At each height the wind is the average along the path of the lines' gates through the air.
    Outlying lines are masked, folded velocities are unfolded. Standard errors contain noise and
    turbulence, as lines of one scan see different air; that of w also contains a tilt that was
    not applied. A divergence D of the horizontal wind is not in it: it shifts w by
    r cos^2(el) D / (2 sin el).

    Parameters
    ----------
    lines : xr.Dataset
        As of `read_lines_of_sight`; gates with a flag are not used. A variable
        ``radial_velocity_stderr`` (m s-1), if there is one, states the noise of every gate; the
        attribute ``nyquist_velocity`` (m s-1) the velocities beyond which they fold.
    interval : float, optional
        Duration over which each profile is averaged, s. Default: a profile for every scan.
    height_step : float, optional
        Step of the heights, m. Default: the heights of the gates; for lines of several elevations,
        the distance between gates.
    noise : float, optional
        Standard error of every velocity, m/s, where the data set does not state it.
    length_scale : float, optional
        Integral scale of the turbulence along the wind, m. Default: unknown, 50 to 800 m.

    Returns
    -------
    xr.Dataset, dims (time, height)
        `u` (to the east), `v` (to the north), `w` (up) in m s-1 with `u_stderr`, ... and
        `uv_correlation`, ...; `wind_speed`, `wind_from_direction`; `residual` (m s-1, rms about the
        uniform wind), `dof`, `lines`, `outliers`, `condition` and `flag` (0: valid). Height is
        above the lidar, m.

    Raises
    ------
    InputError
        A data set without lines of sight, numbers out of range, valid lines in one direction or in
        one plane only at every height.

    Examples
    --------
    >>> import lidar_mi as lm
    >>> import numpy as np
    >>> rows = ["time,azimuth,elevation,range,radial_velocity"]
    >>> for k, azimuth in enumerate(range(0, 360, 45)):
    ...     for distance in (150, 180, 210):
    ...         v = 4 * np.sin(np.deg2rad(azimuth)) * np.cos(np.deg2rad(60))
    ...         rows.append(f"{k},{azimuth},60,{distance},{v:.2f}")
    >>> with open("vad.csv", "w") as file:
    ...     _ = file.write("\n".join(rows))
    >>> winds = lm.fit_winds_to_lines(lm.read_lines_of_sight("vad.csv"))
    >>> winds["u"].values.round(1)
    array([[4., 4., 4.]], dtype=float32)
    """
    _check(lines, interval, height_step, noise, length_scale)
    lengths = LENGTHS if length_scale is None else (length_scale,)
    usable = (lines["flag"].values == 0) & np.isfinite(lines["radial_velocity"].values)
    stated = _stated(lines, noise)
    step = _height_step(lines, height_step)
    profiles: list[Profile] = []
    remarks: list[str] = []
    tilt = unapplied_tilt(lines)
    for index in _scans(lines, interval):
        scan = lines.isel(time=index)
        cells = _cells(scan, usable[index], step)
        if cells is not None:
            # matrices are small: threads would wait for each other
            with threadpool_limits(1, "blas"):
                profiles.append(_profile(scan, cells, stated[index], lengths, remarks))
    if not any((profile.condition < _IN_ONE_PLANE).any() for profile in profiles):
        raise InputError(
            f"{source_name(lines)}: no height has three valid lines that are not in one plane "
            f"(scan: {lines.attrs.get('scan', 'unknown')}; {usable.sum()} of {usable.size} "
            "velocities are valid); expected a VAD, DBS or PPI"
        )
    if tilt > 0:
        for profile in profiles:
            # the tilt's direction is unknown
            profile.covariance[:, 2, 2] += tilt**2 * (profile.wind[:, :2] ** 2).sum(1)
        remarks.append(
            f"pitch and roll of up to {np.rad2deg(tilt):.2f} degrees are not applied: the error of "
            "w contains them"
        )
    known_remarks = filter(None, (lines.attrs.get("remarks", ""), *dict.fromkeys(remarks)))
    return profile_dataset(profiles, {**lines.attrs, "remarks": "\n".join(known_remarks)})


def _check(
    lines: xr.Dataset,
    interval: float | None,
    height_step: float | None,
    noise: float | None,
    length_scale: float | None,
) -> None:
    for name in ("radial_velocity", "flag", "azimuth", "elevation", "range", "time"):
        if name not in lines.variables:
            raise InputError(
                f"lines: {name} is missing; expected a data set of read_lines_of_sight"
            )
    if lines["radial_velocity"].dims != ("time", "range"):
        raise InputError(
            f"lines: radial_velocity has the dims {lines['radial_velocity'].dims}; expected (time, "
            "range)"
        )
    for name, value in (
        ("interval", interval),
        ("height_step", height_step),
        ("noise", noise),
        ("length_scale", length_scale),
    ):
        if value is not None and not 0 < value < np.inf:
            raise InputError(f"{name}: {value} is not allowed; expected a number above 0")


def _stated(lines: xr.Dataset, noise: float | None) -> np.ndarray:
    """Variance of the noise of every gate, (m/s)^2; NaN: unknown."""
    if "radial_velocity_stderr" in lines:
        return lines["radial_velocity_stderr"].values.astype(float) ** 2
    value = np.nan if noise is None else noise**2
    return np.full(lines["radial_velocity"].shape, value)


def _height_step(lines: xr.Dataset, given: float | None) -> float | None:
    """Width of the levels, m; None: every gate is a level."""
    if given is not None:
        return given
    sine = np.sin(np.deg2rad(lines["elevation"].values))
    if np.ptp(sine) < 0.002:
        return None
    return float(np.median(np.diff(lines["range"].values)) * sine.max())


def _scans(lines: xr.Dataset, interval: float | None) -> Iterator[np.ndarray]:
    """Indices of the lines of every profile."""
    if interval is None:
        keys = lines["sweep"].values if "sweep" in lines.coords else np.zeros(lines.sizes["time"])
    else:
        time = lines["time"].values
        keys = ((time - time[0]) / np.timedelta64(1, "s")) // interval
    for key in np.unique(keys):
        yield np.flatnonzero(keys == key)


@dataclass(frozen=True, eq=False)
class _Cells:
    """Usable gates of a scan: line, gate and level of each, heights of the levels, their stride.

    Levels that are one stride apart share no air; `all` is the number of a level's gates, usable or
    not.
    """

    line: np.ndarray
    gate: np.ndarray
    level: np.ndarray
    heights: np.ndarray
    all: np.ndarray
    stride: int


def _cells(scan: xr.Dataset, usable: np.ndarray, step: float | None) -> _Cells | None:
    if usable.sum() < 3:
        return None
    # gates beyond the usable ones form no levels
    present = np.isfinite(scan["radial_velocity"].values) & usable.any(0)
    line, gate = np.nonzero(present)
    sine = np.sin(np.deg2rad(scan["elevation"].values))
    ranges = scan["range"].values
    height = ranges[gate] * sine[line]
    if step is None:
        levels, level = np.unique(gate, return_inverse=True)
        heights = ranges[levels] * sine.mean()
    else:
        number, level = np.unique(np.round(height / step).astype(int), return_inverse=True)
        heights = number * step
    spacing = np.median(np.diff(heights)) if heights.size > 1 else np.inf
    length = float(scan.attrs.get("gate_length", 0.0)) * float(sine.max())
    # at most the whole profile, whatever gate length the file states
    stride = int(np.clip(math.ceil(length / spacing - 0.1), 1, heights.size))
    level, count = level.ravel(), np.bincount(level.ravel())
    used = usable[line, gate]
    return _Cells(line[used], gate[used], level[used], heights, count, stride)


def _profile(
    scan: xr.Dataset,
    cells: _Cells,
    stated: np.ndarray,
    lengths: Sequence[float],
    remarks: list[str],
) -> Profile:
    """The wind at all heights of a scan; what is unusual is added to the remarks."""
    azimuth, elevation = np.deg2rad(scan["azimuth"].values), np.deg2rad(scan["elevation"].values)
    design = np.stack(
        [
            np.sin(azimuth) * np.cos(elevation),
            np.cos(azimuth) * np.cos(elevation),
            np.sin(elevation),
        ],
        axis=-1,
    )
    velocity = scan["radial_velocity"].values.astype(float)[cells.line, cells.gate]
    seconds = (scan["time"].values - scan["time"].values[0]) / np.timedelta64(1, "s")
    count = cells.heights.size
    profile = Profile(
        scan["time"].values[0] + np.timedelta64(round(1e9 * seconds.mean()), "ns"),
        cells.heights,
        np.full((count, 3), np.nan),
        np.full((count, 3, 3), np.nan),
        np.full(count, np.nan),
        np.full(count, np.inf),
        *(np.zeros(count, int) for _ in range(4)),
    )
    members = [np.flatnonzero(cells.level == k) for k in range(count)]
    nyquist = _nyquist(scan)
    folding = unfolded(members, design[cells.line], velocity, nyquist)
    if folding is not None:
        velocity = folding.velocity
        count = int((folding.folds != 0).sum())
        remarks.append(
            f"velocities fold at {folding.interval / 2:.1f} m/s: {count} of {velocity.size} are "
            "unfolded"
        )
    keep = _inliers(members, design[cells.line], velocity, cells.stride)
    levels: dict[int, tuple[Level, float]] = {}
    for k, index in enumerate(members):
        used = index[keep[index]]
        profile.lines[k], profile.outliers[k] = used.size, index.size - used.size
        if profile.outliers[k] > index.size / 3:
            profile.flag[k] |= WindFlag.OUTLIERS.value
        line, gate = cells.line[used], cells.gate[used]
        ranges = scan["range"].values[gate]
        profile.condition[k] = _condition(design[line])
        if not profile.condition[k] < _IN_ONE_PLANE or index.size < MIN_FRACTION * cells.all[k]:
            profile.flag[k] |= WindFlag.TOO_FEW_LINES.value
            continue
        if profile.condition[k] > MAX_CONDITION:
            profile.flag[k] |= WindFlag.ILL_CONDITIONED.value
        directions, noise = design[line], stated[line, gate]
        speed = velocity[used]
        uniform, *_ = np.linalg.lstsq(directions, speed, rcond=None)
        if used.size > 3:
            residual = speed - directions @ uniform
            profile.residual[k] = math.sqrt(float(residual @ residual) / (used.size - 3))
        moved = np.outer(seconds[line] - seconds.mean(), [uniform[0], uniform[1], 0.0])
        if ambiguous(directions, uniform, nyquist):
            profile.flag[k] |= WindFlag.FOLDED.value
        places = directions * ranges[:, None] - moved
        levels[k] = _level(directions, places, speed, noise)
        profile.wind[k] = uniform
    _add_errors(profile, levels, cells.stride, lengths)
    if folding is not None and folding.variance > 0:
        for k in levels:
            used = members[k][keep[members[k]]]
            profile.covariance[k] += folding.wind_error(used, design[cells.line[used]])
    variance = profile.covariance[:, 0, 0] + profile.covariance[:, 1, 1]
    profile.flag[variance > MAX_STDERR**2] |= WindFlag.UNCERTAIN.value
    return profile


def _nyquist(scan: xr.Dataset) -> float | None:
    """Velocity beyond which those of a data set fold, m/s; None: unknown, or one for each file."""
    stated = scan.attrs.get("nyquist_velocity")
    return float(stated) if isinstance(stated, int | float) and stated > 0 else None


def _inliers(
    members: Sequence[np.ndarray], design: np.ndarray, velocity: np.ndarray, stride: int
) -> np.ndarray:
    """Which gates are no outliers: `LIMIT` times the spread of the levels around."""
    residual, count = np.zeros(len(velocity)), np.zeros(len(velocity))
    for index in members:
        if index.size >= 5:
            residual[index] = residuals(design[index], velocity[index])
            count[index] = index.size
    tried = [k for k, index in enumerate(members) if index.size >= 5]
    around = {}
    for k in tried:
        near = np.concatenate([members[j] for j in _around(k, stride, len(members))])
        around[k] = near[count[near] > 0]
    keep, size = np.ones(len(velocity), bool), np.ones(len(velocity))
    for k in tried:
        limit = LIMIT * max(spread_of_best(residual[around[k]], count[around[k]]), _LEAST_SPREAD)
        keep[members[k]] = np.abs(residual[members[k]]) <= limit
    # the fit of three lines is poor: the wind of all that are kept may accept more
    for _ in range(_ROUNDS):
        before = keep.copy()
        refit = [k for k in tried if before[members[k]].sum() >= 4]
        for k in refit:
            index = members[k]
            residual[index], size[index] = refitted(design[index], velocity[index], before[index])
        for k in refit:
            near = around[k][before[around[k]]]
            limit = LIMIT * max(spread(residual[near] / size[near]), _LEAST_SPREAD)
            keep[members[k]] = np.abs(residual[members[k]]) <= limit * size[members[k]]
        if (keep == before).all():
            break
    return keep


def _around(level: int, stride: int, count: int) -> range:
    half = _BLOCK // 2 * stride
    low = level - min(level // stride * stride, half)
    return range(low, min(level + half, count - 1) + 1, stride)


def _condition(design: np.ndarray) -> float:
    """Largest over smallest singular value; infinite: no three lines, or in one plane."""
    if len(design) < 3:
        return math.inf
    values = np.linalg.svd(design, compute_uv=False)
    return float(values[0] / values[-1]) if values[-1] > 0 else math.inf


def _level(
    design: np.ndarray, places: np.ndarray, velocity: np.ndarray, noise: np.ndarray
) -> tuple[Level, float]:
    """A level of at most `_MOST` averages and their mean variance of noise (NaN: unknown).

    Lines come in the order of time. Averages are of lines of nearly one direction.
    """
    path = along(places)
    steep, azimuth = np.round(20 * design[:, 2]), np.arctan2(design[:, 0], design[:, 1])
    order = np.lexsort((azimuth, steep))
    design, places, velocity, noise = (array[order] for array in (design, places, velocity, noise))
    grouped = math.ceil(len(velocity) / _MOST_LINES)
    # neighbours among very many lines are averaged
    every = Level(design, places, path, np.arange(0, len(velocity), grouped), velocity, noise)
    design, places, velocity = (every.averaged(array) for array in (design, places, velocity))
    size = math.ceil(len(velocity) / _MOST)
    starts = np.arange(0, len(velocity), size)
    level = Level(design, places, path, starts, velocity, noise)
    weights = np.where(np.isfinite(noise), noise, 1.0)
    counts = np.diff(np.append(starts, len(velocity)))
    variance = level.averaged(every.averaged(weights)) / counts / grouped
    known = float(variance.mean()) if np.isfinite(noise).all() else math.nan
    noise = variance / variance.mean()
    return Level(design, places, path, starts, level.averaged(velocity), noise), known


def _add_errors(
    profile: Profile, levels: dict[int, tuple[Level, float]], stride: int, lengths: Sequence[float]
) -> None:
    """Winds and covariances, in blocks of levels that share their turbulence but no gate."""
    for offset in range(stride):
        column = [k for k in sorted(levels) if k % stride == offset]
        for start in range(0, len(column), _BLOCK):
            block = column[start : start + _BLOCK]
            # one or two levels have too few lines for statistics of their own
            around = column[-_BLOCK:] if len(block) < 3 else block
            _block(profile, levels, block, around, lengths)


def _block(
    profile: Profile,
    levels: dict[int, tuple[Level, float]],
    block: Sequence[int],
    around: Sequence[int],
    lengths: Sequence[float],
) -> None:
    dof = sum(len(levels[k][0].velocity) - 3 for k in around)
    noise = [levels[k][1] for k in around]
    known = float(np.mean(noise)) if np.isfinite(noise).all() else 0.0
    shared = evidence([levels[k][0] for k in around], lengths, known) if dof > 2 else None
    for k in block:
        level, level_noise = levels[k]
        if shared is not None:
            profile.wind[k], profile.covariance[k] = mean_wind(level, shared, lengths)
            profile.dof[k] = shared.dof
        elif math.isfinite(level_noise):
            means = level.averaged(level.design)
            weight = means / (level.noise * level_noise)[:, None]
            profile.covariance[k] = np.linalg.inv(weight.T @ means)
        else:
            profile.flag[k] |= WindFlag.ERROR_UNKNOWN.value
