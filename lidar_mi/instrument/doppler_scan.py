"""A Doppler lidar's scan: lines of sight, the volume of air of each, line-of-sight velocities.

Line-of-sight velocities are positive toward the instrument, as in the paper's eq. 1.
"""

import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np
import scipy
from pydantic import Field

from lidar_mi.description import Description
from lidar_mi.errors import InputError
from lidar_mi.instrument.beams import Beams
from lidar_mi.instrument.doppler import DopplerLidar
from lidar_mi.instrument.motion import attitude, tilted
from lidar_mi.instrument.scan import HalfAngle
from lidar_mi.units import Angle, Speed, Within, quantity
from lidar_mi.variables import variable

if TYPE_CHECKING:
    import xarray as xr

# Wind (..., 3) in m/s at points (..., 3) in m.
WindAt = Callable[[np.ndarray], np.ndarray]

# nodes of the quadrature over range bin, pulse and beam: exact for winds of degree 15, 5 and 5
_BIN, _PULSE, _BEAM = 8, 3, 3


class DopplerScan(Description):
    """Directions of a Doppler lidar, equidistant in azimuth and elevation.

    The default has the 63 directions of the paper's table 1 and holds a wing of 60 m from 76 m
    on. With ``gates: planar`` every direction has its own delay, so that the middles of all range
    bins lie in the plane x = range; with ``spherical`` all are at the same distance.
    """

    columns: Annotated[int, Within(1, 1000, "with the other, a million lines of sight")] = Field(
        9, description="directions across"
    )
    rows: Annotated[int, Within(1, 1000, "with the other, a million lines of sight")] = Field(
        7, description="directions up"
    )
    azimuth_half: HalfAngle = Field(quantity("21.5 deg"), description="of the outermost directions")
    elevation_half: HalfAngle = Field(quantity("14 deg"), description="of the outermost directions")
    gates: Literal["planar", "spherical"] = Field(
        "planar", description="middles of the range bins in a plane, or at the same distance"
    )

    def directions(self) -> np.ndarray:
        """Unit vectors, (rows * columns, 3), row by row from the top left."""
        lateral, vertical = self.nodes()
        up, left = np.meshgrid(vertical[::-1], lateral[::-1], indexing="ij")
        lines = np.stack([np.ones_like(up), left, up], -1).reshape(-1, 3)
        return lines / np.linalg.norm(lines, axis=1, keepdims=True)

    def nodes(self) -> tuple[np.ndarray, np.ndarray]:
        """y and z of the directions at the distance 1, ascending: tangents of their angles."""
        return tuple(
            np.tan(_spread(half, count))
            for half, count in ((self.azimuth_half, self.columns), (self.elevation_half, self.rows))
        )

    def ranges(self, lidar: DopplerLidar, beams: Beams | None = None) -> np.ndarray:
        """Distance of the middle of every range bin, m, (rows * columns,).

        Delays are set by where the telescope is reported to be when each beam is sent, so that the
        middles stay in the plane, or at the distance from where it was at the reference time.
        """
        directions = self.directions() if beams is None else beams.reported_direction
        advance = 0.0 if beams is None else beams.reported_origin[:, 0]
        if self.gates == "planar":
            return (lidar.range - advance) / directions[:, 0]
        return np.full(len(directions), lidar.range) - advance


class PlatformErrors(Description):
    """Errors of the platform's attitude, pointing and speed: truth minus the assumed value.

    Pitch is positive nose up, yaw nose to port, roll port wing up. An angle error e causes a
    velocity error of V e sin(t) at the angle t off the axis, V being the speed of the platform.
    """

    roll: Annotated[Angle, Within(-1, 1, "larger errors are no errors of an attitude")] = Field(
        0.0, description="of the attitude"
    )
    pitch: Annotated[Angle, Within(-1, 1, "larger errors are no errors of an attitude")] = Field(
        0.0, description="of the attitude"
    )
    yaw: Annotated[Angle, Within(-1, 1, "larger errors are no errors of an attitude")] = Field(
        0.0, description="of the attitude"
    )
    jitter: Annotated[Angle, Within(0, 0.1, "small angles only")] = Field(
        0.0, description="rms of every direction, on both axes"
    )
    speed: Annotated[Speed, Within(-1000, 1000, "the fastest aircraft")] = Field(
        0.0, description="of the speed along x"
    )


def pointed(directions: np.ndarray, errors: PlatformErrors, seed: int = 0) -> np.ndarray:
    """True lines of sight, (n, 3), for the assumed directions.

    The attitude rotates all of them (yaw, pitch, roll, in this order), then each one is tilted by
    normally distributed small angles about two axes perpendicular to it.
    """
    missed = attitude(errors.roll, errors.pitch, errors.yaw)
    rotated = missed.apply(np.asarray(directions, float))
    if errors.jitter == 0:
        return rotated
    return tilted(rotated, errors.jitter, np.random.default_rng(seed))


def sight_volumes(
    directions: np.ndarray, ranges: np.ndarray, lidar: DopplerLidar
) -> tuple[np.ndarray, np.ndarray]:
    """Points and weights of the average over air along each line of sight.

    Range bin (even), pulse (Gaussian of ``pulse_duration``, which smears range by c t / 2), beam
    (Gaussian, ``beam_width`` its 1/e^2 diameter), each weighted with its signal,
    exp(-2 alpha r) / r^2: the centroid of 10 m at 56 m is 0.3 m nearer than the middle. Points
    (lines, points, 3) are in m; weights (lines, points) have the sum 1 for every line.

    Raises InputError: a bin that reaches the telescope.
    """
    directions, ranges = np.asarray(directions, float), np.asarray(ranges, float)
    bin_nodes, bin_weights = np.polynomial.legendre.leggauss(_BIN)
    # probabilists' Hermite: nodes are standard deviations of a Gaussian
    pulse_nodes, pulse_weights = np.polynomial.hermite_e.hermegauss(_PULSE)
    beam_nodes, beam_weights = np.polynomial.hermite_e.hermegauss(_BEAM)
    # half the way of light, and from full width at half maximum to standard deviation
    smear = scipy.constants.c / 2 * lidar.pulse_duration / math.sqrt(8 * math.log(2))
    offsets = lidar.range_bin / 2 * bin_nodes[:, None] + smear * pulse_nodes
    along = ranges[:, None] + offsets.ravel()
    if along.min() <= 0:
        raise InputError(
            f"range_bin: {lidar.range_bin:g} m is not allowed at a range of {ranges.min():g} m; "
            "expected a bin that ends before the telescope"
        )
    signal = (bin_weights[:, None] * pulse_weights).ravel()
    signal = signal * np.exp(-2 * lidar.extinction * along) / along**2
    # 1/e^2 radius is twice the standard deviation
    sigma = (lidar.beam_radius + lidar.divergence_full / 2 * along) / 2
    # elevations stay below 90 degrees: no beam is parallel to z
    across = np.cross(directions, [0.0, 0.0, 1.0])
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    above = np.cross(across, directions)
    first, second = (n.ravel() for n in np.meshgrid(beam_nodes, beam_nodes, indexing="ij"))
    beam = np.outer(beam_weights, beam_weights).ravel()
    sides = first[:, None] * across[:, None] + second[:, None] * above[:, None]
    points = (
        along[:, :, None, None] * directions[:, None, None]
        + sigma[:, :, None, None] * sides[:, None]
    )
    weights = signal[:, :, None] * beam
    lines = len(directions)
    weights = weights.reshape(lines, -1)
    return points.reshape(lines, -1, 3), weights / weights.sum(1, keepdims=True)


def wind_at(wind: "xr.Dataset", points: np.ndarray) -> np.ndarray:
    """Wind (..., 3) at points (..., 3), by linear interpolation.

    wind: u, v, w (m s^-1) on (z, y), the same for all x, or on (x, y, z); coordinates ascending, m.

    Raises InputError: a component or a coordinate is missing, or the points leave the field.
    """
    for name in ("u", "v", "w"):
        if name not in wind:
            raise InputError(f"wind.{name}: missing; expected u, v and w")
    axes = [axis for axis in ("x", "y", "z") if axis in wind["u"].dims]
    if axes[-2:] != ["y", "z"] or set(wind["u"].dims) != set(axes):
        raise InputError(f"wind: dims {tuple(wind['u'].dims)} are not (z, y) or (x, y, z)")
    places = np.asarray(points)[..., 3 - len(axes) :]
    for index, axis in enumerate(axes):
        nodes = wind[axis].values
        low, high = places[..., index].min(), places[..., index].max()
        # rounding of the points themselves may leave the last node
        slack = 1e-9 * max(abs(nodes[0]), abs(nodes[-1]))
        if low < nodes[0] - slack or high > nodes[-1] + slack:
            raise InputError(
                f"wind: {axis} from {nodes[0]:g} to {nodes[-1]:g} m does not hold the lines of "
                f"sight, which need {low:.1f} to {high:.1f} m; expected smaller angles or more air"
            )
    values = np.stack([wind[n].transpose(*axes).values for n in ("u", "v", "w")], -1)
    grid = tuple(wind[axis].values.astype(float) for axis in axes)
    # extrapolates, but by the slack at most
    return scipy.interpolate.RegularGridInterpolator(
        grid, values, bounds_error=False, fill_value=None
    )(places)


def wind_of_lines(
    wind: "xr.Dataset", points: np.ndarray, times: np.ndarray | None = None
) -> np.ndarray:
    """Wind (lines, points, 3) at points (lines, points, 3), each line at its own time.

    wind: as for `wind_at`; or two states of it, dims (time, ...), linear in time between and beyond
        them.
    times (lines,): s; 0 for all by default.
    """
    if "time" not in wind.dims:
        return wind_at(wind, points)
    first, last = wind["time"].values
    part = (np.zeros(len(points)) if times is None else times) - first
    later = (part / (last - first))[:, None, None]
    states = [wind_at(wind.isel(time=k, drop=True), points) for k in (0, 1)]
    return (1 - later) * states[0] + later * states[1]


def scan_wind(
    wind: "xr.Dataset | WindAt",
    scan: DopplerScan,
    lidar: DopplerLidar,
    v_los_std: float | np.ndarray,
    seed: int,
    speed: float = 0.0,
    errors: PlatformErrors | None = None,
    beams: Beams | None = None,
) -> "xr.Dataset":
    """Measurement of a wind field by a Doppler lidar, line by line.

    The velocity is the wind's projection averaged over the volume (`sight_volumes`) plus the
    platform's own, plus normal noise. Photons arrive evenly from all of the volume: extinction and
    backscatter coefficient are homogeneous in it.

    wind: as for `wind_of_lines`, in the lidar's frame; or u, v, w (..., 3) in m/s of points (...,
        3) in m.
    v_los_std (float or (lines,) array): standard error of a measured velocity, m/s: what the fringe
        chain gives for as many pulses as a line has.
    seed: of noise and jitter.
    speed: of the platform along x, as measured on board, m/s.
    errors: errors of the assumed attitude, pointing and speed; by default none.
    beams: time and pose of every line, true and reported, from the telescope's place at the
        reference time; `errors` come on top of them. None: all at once and from there.

    Raises InputError: a field that does not contain the scan; a negative standard error.

    Returns
    -------
    xr.Dataset, dim line (and axis: x, y, z)
        `direction` and `range` (m; where the lines are taken to go), `range_bin` (m),
        `v_los`, `v_los_std` and `v_los_true` (m s-1; without noise), `platform_velocity` (m s-1).
        With beams these are as reported, line by line, with `time` (s) and `origin` (m).
    """
    import xarray as xr

    ranges, errors = scan.ranges(lidar, beams), errors or PlatformErrors()
    directions = scan.directions() if beams is None else beams.reported_direction
    std = np.broadcast_to(np.asarray(v_los_std, float), len(directions)).copy()
    if not (std >= 0).all():
        raise InputError(f"v_los_std: {std.min():g} m/s is not allowed; expected >= 0 m/s")
    # independent streams: either can change without the other
    jitter_seed, noise_seed = np.random.SeedSequence(seed).generate_state(2)
    steered = directions if beams is None else beams.direction
    actual = pointed(steered, errors, int(jitter_seed))
    points, weights = sight_volumes(actual, ranges, lidar)
    velocity = reported = np.array([speed, 0.0, 0.0])
    if beams is not None:
        points = points + beams.origin[:, None]
        velocity, reported = velocity + beams.velocity, reported + beams.reported_velocity
    if isinstance(wind, xr.Dataset):
        met = wind_of_lines(wind, points, None if beams is None else beams.time)
    else:
        met = wind(points)
    mean = np.einsum("lp,lpc->lc", weights, met)
    # positive toward the instrument: its own advance counts, wind along the beam reduces it
    toward = velocity + np.array([errors.speed, 0.0, 0.0]) - mean
    true = np.einsum("lc,lc->l", actual, toward)
    noise = np.random.default_rng(int(noise_seed)).standard_normal(len(true))
    measurement = xr.Dataset(
        {
            "v_los": variable("line", true + std * noise, "m s-1", _LOS),
            "v_los_std": variable("line", std, "m s-1", "standard error of v_los"),
            "v_los_true": variable("line", true, "m s-1", _LOS + ", without noise"),
            "range": variable("line", ranges, "m", "distance of the middle of the range bin"),
            "range_bin": variable((), lidar.range_bin, "m", "length of range bin"),
            "platform_velocity": variable(
                "axis" if beams is None else ("line", "axis"),
                reported,
                "m s-1",
                "velocity of the platform",
            ),
        },
        coords={
            "direction": variable(("line", "axis"), directions, "1", "unit vector"),
            "axis": ("axis", ["x", "y", "z"]),
        },
        attrs={"Conventions": "CF-1.11", "title": "Line-of-sight velocities", "seed": seed},
    )
    if beams is None:
        return measurement
    return measurement.assign(
        time=variable("line", beams.time, "s", "time from the reference time of the scan"),
        origin=variable(
            ("line", "axis"), beams.reported_origin, "m", "place of the telescope, as reported"
        ),
    )


_LOS = "velocity toward the instrument along the line of sight"


def _spread(half: float, count: int) -> np.ndarray:
    return np.linspace(-half, half, count) if count > 1 else np.zeros(1)
