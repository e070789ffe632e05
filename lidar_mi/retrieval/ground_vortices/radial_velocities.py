"""Vortices by the method of radial velocities: the peer of the fit.

Köpp, Rahm & Smalikho (J. Atmos. Oceanic Technol. 21, 194-206, 2004); Smalikho, Banakh, Holzäpfel &
Rahm (Opt. Express 23, A1194-A1207, 2015). As understood here: after the mean wind is taken off, the
ranges at which the velocities of a gate differ most over the angles are those of the vortices,
half way between the angles of the extremes they have their heights, and the circulations fit a
pair of known core radius to the velocities at both ranges by least squares.
"""

import numpy as np

from lidar_mi.instrument.coherent.weighting import CoherentLidar
from lidar_mi.retrieval.ground_vortices.fit import Assumptions
from lidar_mi.retrieval.ground_vortices.scan_plane import PlaneScan
from lidar_mi.retrieval.ground_vortices.swirl import lines_of, radial_velocity

_ACROSS = 40.0  # m of lines above and below that circulations are fitted to
_SEARCH = 25.0  # m around the first guess


def by_radial_velocities(
    scan: PlaneScan, lidar: CoherentLidar, assumed: Assumptions, guess: np.ndarray
) -> np.ndarray | None:
    """y, z (m) and circulation (m^2/s) of the vortices (n, 3); None: no extremes.

    assumed: profile and core radius.
    guess (n, 4): vortices as of a candidate of the detection, which say where to search.
    """
    extremes = []
    for vortex in guess:
        place = _place(scan, vortex)
        if place is None:
            return None
        extremes.append(place)
    places = np.array(extremes)
    ranges, angles = np.hypot(*places.T), np.arctan2(places[:, 1], places[:, 0])
    design, values = [], []
    for place_range, angle in zip(ranges, angles, strict=True):
        gate = int(np.abs(scan.ranges - place_range).argmin())
        near = np.abs(scan.angle - angle) * place_range < _ACROSS
        rows = np.flatnonzero(near & np.isfinite(scan.velocity[:, gate]))
        if rows.size < 6:
            return None
        lines = lines_of(
            scan.time[rows],
            scan.angle[rows],
            np.full(rows.size, scan.span),
            np.zeros(rows.size),
            scan.ranges[[gate]],
            lidar,
        )
        columns = []
        for place in places:
            at = np.broadcast_to(place, (rows.size, 2, 2))
            core = np.array([1.0, np.log(assumed.core_radius)])
            columns.append(radial_velocity(lines, at, core, assumed.ground, assumed.model)[0][:, 0])
        design.append(np.column_stack(columns))
        values.append((scan.velocity - _background(scan))[rows, gate])
    circulation, *_ = np.linalg.lstsq(np.concatenate(design), np.concatenate(values), rcond=None)
    return np.column_stack([places, circulation])


def _background(scan: PlaneScan) -> np.ndarray:
    """Mean wind (lines, 1) over the gates, robust: the median of each line."""
    velocity = scan.velocity
    known = np.isfinite(velocity).any(1)
    middle = np.zeros(len(velocity))
    middle[known] = np.nanmedian(velocity[known], axis=1)
    return middle[:, None]


def _place(scan: PlaneScan, vortex: np.ndarray) -> np.ndarray | None:
    """y and z of the largest difference over the angles near a guess."""
    distance, angle = np.hypot(vortex[0], vortex[1]), np.arctan2(vortex[1], vortex[0])
    gates = np.flatnonzero(np.abs(scan.ranges - distance) <= _SEARCH)
    lines = np.flatnonzero(np.abs(scan.angle - angle) * distance <= _SEARCH)
    part = (scan.velocity - _background(scan))[np.ix_(lines, gates)]
    whole = np.isfinite(part).any(0)
    if not whole.any() or lines.size < 5:
        return None
    # means of three lines, as noise alone makes extremes
    smooth = np.stack([part[:-2], part[1:-1], part[2:]]).mean(0)
    differences = np.where(whole, np.nanmax(smooth, 0) - np.nanmin(smooth, 0), -np.inf)
    k = int(np.nanargmax(differences))
    place_range = scan.ranges[gates[k]]
    if 0 < k < len(gates) - 1 and np.isfinite(differences[[k - 1, k + 1]]).all():
        before, peak, after = differences[k - 1 : k + 2]
        curvature = before - 2 * peak + after
        shift = (before - after) / (2 * curvature) if curvature < 0 else 0.0
        place_range += shift * (scan.ranges[gates[k + 1]] - scan.ranges[gates[k]])
    column = smooth[:, k]
    ends = scan.angle[lines[1:-1]][[int(np.nanargmax(column)), int(np.nanargmin(column))]]
    middle = ends.mean()
    return place_range * np.array([np.cos(middle), np.sin(middle)])
