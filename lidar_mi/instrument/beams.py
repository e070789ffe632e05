"""The beams of a scan: when each one looks, from where and where to, in truth and as reported."""

from dataclasses import dataclass

import numpy as np

from lidar_mi.errors import InputError
from lidar_mi.instrument.motion import Pose, tilted


@dataclass(frozen=True)
class Beams:
    """Every beam of a scan, in film order: row by row from the top left, or in order of time.

    Light takes the true pose, the retrieval knows the reported one. Lengths in m; x is measured
    in the frame of the air, in which the gates are fixed: the telescope is at ``ScanPlan.position``
    at the scan's reference time, and the middle of the gates at ``position + centre``.

    time (n,): s, from the scan's reference time, the middle of its duration.
    origin, direction (n, 3): true place of the telescope and true unit vectors.
    reported_origin, reported_direction (n, 3): the same, as the retrieval knows them.
    velocity, reported_velocity (n, 3): of the telescope less that of straight flight, m/s.
    """

    time: np.ndarray
    origin: np.ndarray
    direction: np.ndarray
    reported_origin: np.ndarray
    reported_direction: np.ndarray
    velocity: np.ndarray | None = None
    reported_velocity: np.ndarray | None = None

    def true_places(self, x: float) -> np.ndarray:
        """Where the beams cross the plane at x, in the frame of the air: y, z in m, (n, 2)."""
        return _crossings(self.origin, self.direction, x)

    def reported_places(self, x: float) -> np.ndarray:
        """Where the beams as reported cross the plane at x: y, z in m, (n, 2)."""
        return _crossings(self.reported_origin, self.reported_direction, x)


def _crossings(origin: np.ndarray, direction: np.ndarray, x: float) -> np.ndarray:
    distance = (x - origin[:, 0]) / direction[:, 0]
    return origin[:, 1:] + distance[:, None] * direction[:, 1:]


@dataclass(frozen=True)
class Targets:
    """Where the beams of a scan are to go.

    time (n,): s from the scan's reference time.
    places (n, 2): y and z in the plane at ``distance`` (m) from the telescope at the reference
        time. Steered beams, as reported, go to these; beams fixed to the body go as if from a
        telescope at rest.
    position: x of the telescope at the reference time, m, in the frame of the air.
    """

    time: np.ndarray
    places: np.ndarray
    distance: float
    position: float = 0.0
    body_fixed: bool = False


def steered_beams(
    targets: Targets,
    speed: float,
    true: Pose,
    reported: Pose,
    *,
    jitter: float = 0.0,
    random: np.random.Generator | None = None,
) -> Beams:
    """The beams of a scanner that is steered by the reported pose, or fixed to the body.

    speed: of straight flight in the frame of the air, m/s.
    true, reported: of the telescope at the times.
    jitter: rms of true directions on both axes, rad, by the generator ``random``.

    Raises InputError: a pose that takes the telescope beyond the plane or turns beams away from it.
    """
    time, position = targets.time, targets.position
    slab = position + targets.distance
    straight = np.zeros((len(time), 3))
    straight[:, 0] = position + speed * time
    origin, reported_origin = straight + true.place, straight + reported.place
    target = np.column_stack([np.full(len(time), targets.distance), targets.places])
    if targets.body_fixed:
        reported_direction = reported.attitude.apply(_unit(target))
    else:
        reported_direction = _unit(target + np.array([position, 0.0, 0.0]) - reported_origin)
    # the scanner follows the report; the difference turns the beam with the body
    error = true.attitude * reported.attitude.inv()
    direction = error.apply(reported_direction)
    if jitter > 0 and random is not None:
        direction = tilted(direction, jitter, random)
    beams = Beams(
        time,
        origin,
        direction,
        reported_origin,
        reported_direction,
        true.velocity,
        reported.velocity,
    )
    for kind, places_from, going in (
        ("true", origin, direction),
        ("reported", reported_origin, reported_direction),
    ):
        behind = np.flatnonzero(places_from[:, 0] >= slab)
        if behind.size:
            first = behind[0]
            raise InputError(
                f"the {kind} place at {time[first]:g} s, x = {places_from[first, 0]:.4g} m, is not "
                f"allowed; expected before the slab, {slab:.4g} m"
            )
        away = np.flatnonzero(going[:, 0] < _LEAST_AHEAD)
        if away.size:
            first = away[0]
            turned = np.degrees(np.arccos(np.clip(going[first, 0], -1, 1)))
            raise InputError(
                f"the {kind} attitude at {time[first]:g} s turns a beam to {turned:.3g} deg from "
                "the axis; expected at most 86 deg, that it reaches the slab"
            )
    return beams


# cosine of 86 degrees, as far as a scan may reach
_LEAST_AHEAD = 0.07


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)
