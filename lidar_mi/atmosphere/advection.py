"""Advection of a scalar field by the wind: the field at other times from the field at one."""

from collections.abc import Callable, Collection, Iterator, Sequence

import numpy as np
import scipy
import xarray as xr

from lidar_mi.errors import InputError

# Cells of edge values added around a plane or a volume, for the spline's response to the edge (it
# falls by a factor 0.43 per cell) and for inflow.
_MARGIN = 12
_ORDER = 5  # of the splines
# Nodes of a field's splines per node of the field. With one, waves of 2 to 3 cells are damped and
# move too little: half way between nodes a wave of two cells stands still.
_FINER = 2


def _axis(field: xr.DataArray, name: str) -> tuple[np.ndarray, float]:
    values = field[name].values.astype(float)
    steps = np.diff(values)
    if values.size < 4 or steps[0] <= 0 or np.ptp(steps) > 1e-3 * abs(steps[0]):
        raise InputError(
            f"advection.{name}: axis of {values.size} nodes is not usable; allowed: "
            "4 nodes or more, ascending, equally spaced"
        )
    return values, (values[-1] - values[0]) / (values.size - 1)


def _sampler(values: np.ndarray, finer: int = 1) -> Callable[[np.ndarray], np.ndarray]:
    """Quintic B-spline through the nodes of a plane or a volume, a function of fractional indices.

    Outside the grid it has the value at the nearest edge. With `finer` nodes the spline is through
    the cosine series of the field, which has all waves of the grid.
    """
    padded = np.pad(values, _MARGIN, mode="edge")
    if finer > 1:
        more = [(0, (finer - 1) * n) for n in padded.shape]
        padded = scipy.fft.idctn(
            np.pad(scipy.fft.dctn(padded, norm="forward"), more), norm="forward"
        )
    coefficients = scipy.ndimage.spline_filter(padded, order=_ORDER, mode="mirror")

    def sample(indices: np.ndarray) -> np.ndarray:
        # the nodes of a cosine series are half a spacing from its ends
        places = finer * (indices + _MARGIN) + (finer - 1) / 2
        return scipy.ndimage.map_coordinates(
            coefficients, places, order=_ORDER, mode="nearest", prefilter=False
        )

    return sample


def _departures(velocity: Sequence[np.ndarray], steps: Collection[float]) -> Iterator[np.ndarray]:
    """Node indices from which the air at the nodes came, after each of successive steps (s).

    Velocity by axis, in nodes per second.
    """
    samplers = [_sampler(component) for component in velocity]
    place = np.indices(velocity[0].shape, dtype=float)
    speed_at = np.stack(velocity)
    for number, h in enumerate(steps):
        if number:
            speed_at = np.stack([sample(place) for sample in samplers])
        half = place - 0.5 * h * speed_at
        place = place - h * np.stack([sample(half) for sample in samplers])
        yield place


def advect(
    field: xr.DataArray,
    v: xr.DataArray,
    w: xr.DataArray,
    dt: float,
    steps: int = 4,
    u: xr.DataArray | None = None,
) -> xr.DataArray:
    """The field after dt in the frozen flow: Df/Dt = 0, semi-Lagrangian.

    Every node is followed back along its trajectory in `steps` midpoint steps (second order:
    in solid rotation the departure point is off by r (omega dt)^3/(6 steps^2), which for
    omega = 5 s^-1 and dt = 0.1 s is 2 % of r in one step and 0.13 % in four), and the field
    there is read from a quintic B-spline (Staniforth and Cote, Mon. Wea. Rev. 119, 1991) with two
    nodes per node of the grid, between which its cosine series is evaluated: waves of 2.1 cells and
    longer keep their amplitude to 0.2 % and move as far as the air. (A spline through the nodes
    alone moves them too little: images of such air lack up to 5 % of the wind where noise is low.)
    Where a field does not end smoothly, the series rings within some 20 cells of the edge, by
    0.2 % of the step in its slope per cell.

    Without u there is no motion along x, and planes are independent of each other. Air that enters
    through an edge has the value at the edge, so that a strip of width speed*dt along inflow edges
    is not meaningful. A field without negative values remains so: the undershoots of the spline at
    sharp edges are set to zero.

    field: any scalar, dims (y, z) or (x, y, z) in any order, y and z equally spaced, metres.
    v, w: velocity along y and z, m s^-1, same dims and coordinates as `field`.
    dt: s; negative goes back in time.
    steps: trajectory steps in dt, >= 1.
    u: velocity along x, m s^-1, for a field on (x, y, z) with x equally spaced as well.

    Raises InputError: other dims, unequal grids, uneven axes, values or dt not finite.

    Returns
    -------
    xarray.DataArray
        float64, dims, coordinates and attributes of `field`.
    """
    _check_step(dt, steps)
    _check_grid(field, v, w, u)  # a fault of the field, or of the velocities
    return carrier(v, w, dt, steps, u)(field)


def carrier(
    v: xr.DataArray, w: xr.DataArray, dt: float, steps: int = 4, u: xr.DataArray | None = None
) -> Callable[[xr.DataArray], xr.DataArray]:
    """`advect` for many fields of one flow, whose trajectories are followed once.

    Returns
    -------
    callable
        From a field to the field after dt.
    """
    _check_step(dt, steps)
    _check_grid(v, v, w, u)
    speeds = _speeds(v, v, w, u)
    durations = [dt / int(steps)] * int(steps)
    places = []
    for speed in zip(*speeds, strict=True):
        *_, last = _departures(speed, durations)
        places.append(last)

    def advected(field: xr.DataArray) -> xr.DataArray:
        _check_grid(field, v, w, u)
        return _reader(field, u is not None)(places)

    return advected


def advect_to(
    field: xr.DataArray,
    v: xr.DataArray,
    w: xr.DataArray,
    times: Sequence[float] | np.ndarray,
    u: xr.DataArray | None = None,
) -> xr.DataArray:
    """The field at several times before and after its own, as of `advect`.

    Trajectories go on from one time to the next, in midpoint steps no longer than the shortest
    interval between times: the departure point in solid rotation is off by
    r (omega t)^3/(6 n^2) after n steps. Times (s) ascend, 0 is that of ``field``; the result has
    dims (time, ...) and is float64.

    Raises InputError: times not finite or not ascending; else as `advect`.
    """
    times = np.asarray(times, float)
    if not np.isfinite(times).all() or (np.diff(times) <= 0).any():
        raise InputError(f"advection.times: {times} s are not allowed; finite, ascending ones are")
    states = {0.0: field.astype(float)}
    longest = np.diff(times).min() if len(times) > 1 else np.abs(times).max() / 4
    for side in (times[times > 0], times[times < 0][::-1]):
        intervals = np.diff(side, prepend=0.0)
        counts = np.ceil(np.abs(intervals) / longest - 1e-6).astype(int).clip(1)
        steps = np.repeat(intervals / counts, counts)
        advected = _advected(field, v, w, u, steps, np.cumsum(counts) - 1)
        states.update(zip(side, advected, strict=True))
    return xr.concat([states[time] for time in times], xr.Variable("time", times))


def _advected(
    field: xr.DataArray,
    v: xr.DataArray,
    w: xr.DataArray,
    u: xr.DataArray | None,
    steps: Collection[float],
    numbers: Collection[int],
) -> Iterator[xr.DataArray]:
    """The field after each of the steps (s, successive) of these ``numbers``."""
    _check_grid(field, v, w, u)
    read = _reader(field, u is not None)
    paths = [_departures(speed, steps) for speed in zip(*_speeds(field, v, w, u), strict=True)]
    for number, places in enumerate(zip(*paths, strict=True)):
        if number in numbers:
            yield read(places)


def _check_step(dt: float, steps: int) -> None:
    if not np.isfinite(dt):
        raise InputError(f"advection.dt: {dt} s is not allowed; any finite time is")
    if steps != int(steps) or steps < 1:
        raise InputError(f"advection.steps: {steps} is not allowed; a whole number >= 1 is")


def _velocity(
    v: xr.DataArray, w: xr.DataArray, u: xr.DataArray | None
) -> dict[str, tuple[str, xr.DataArray]]:
    """Names and components by axis."""
    along = {} if u is None else {"x": ("u", u)}
    return {**along, "y": ("v", v), "z": ("w", w)}


def _check_grid(
    field: xr.DataArray, v: xr.DataArray, w: xr.DataArray, u: xr.DataArray | None
) -> None:
    dims = set(field.dims)
    if dims not in ({"y", "z"}, {"x", "y", "z"}) or len(field.dims) != len(dims):
        raise InputError(
            f"advection.field: dims {tuple(field.dims)} are not allowed; (y, z) or (x, y, z) are"
        )
    if u is not None and "x" not in dims:
        raise InputError(
            "advection.u: not allowed for a plane (y, z); expected a field on (x, y, z)"
        )
    velocity = _velocity(v, w, u)
    finest = min(_axis(field, axis)[1] for axis in velocity)
    for name, component in (("field", field), *velocity.values()):
        if set(component.dims) != dims or any(
            component.sizes[d] != field.sizes[d]
            or not np.allclose(component[d], field[d], rtol=0, atol=1e-3 * finest)
            for d in dims
        ):
            raise InputError(
                f"advection.{name}: grid {dict(component.sizes)} differs from the field's "
                f"{dict(field.sizes)}; it must be the same nodes"
            )
        bad = int((~np.isfinite(component)).sum())
        if bad:
            raise InputError(
                f"advection.{name}: not finite at {bad} of {component.size} places; allowed: "
                "nowhere"
            )


def _pieces(field: xr.DataArray, whole: bool) -> np.ndarray:
    """Arrays that are advected together: the ``whole`` volume, or each plane."""
    order = [axis for axis in ("x", "y", "z") if axis in field.dims]
    values = field.transpose(*order).values.astype(float)
    return values.reshape(-1, *values.shape[-3 if whole else -2 :])


def _speeds(
    grid: xr.DataArray, v: xr.DataArray, w: xr.DataArray, u: xr.DataArray | None
) -> list[np.ndarray]:
    """Components of the velocity of all `_pieces`, in nodes per second."""
    return [
        _pieces(component, u is not None) / _axis(grid, axis)[1]
        for axis, (_, component) in _velocity(v, w, u).items()
    ]


def _reader(field: xr.DataArray, whole: bool) -> Callable[[Sequence[np.ndarray]], xr.DataArray]:
    """A function from places of the nodes of all `_pieces` (node indices) to the field there."""
    pieces = _pieces(field, whole)
    samplers = [_sampler(piece, _FINER) for piece in pieces]
    result = field.transpose(*(axis for axis in ("x", "y", "z") if axis in field.dims))
    result = result.astype(float)

    def read(places: Sequence[np.ndarray]) -> xr.DataArray:
        moved = np.stack([sample(p) for sample, p in zip(samplers, places, strict=True)])
        if pieces.min() >= 0:
            moved = np.maximum(moved, 0.0)
        return result.copy(data=moved.reshape(result.shape)).transpose(*field.dims)

    return read
