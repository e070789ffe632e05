"""Elevator and symmetric ailerons planned against the loads of a wind that is expected.

The deflections of the next `HORIZON` minimise, over its intervals, the sum of the squares of

- the mean change of the load factor, and `PEAK` times the largest of them;
- `BENDING` times the sum of both root bending moments over that of level flight;
- `PITCH_TIME` times the pitch rate;
- the load factor that ends the vertical speed in `PATH_TIME`;

and of the deflections with a small weight, within limits of deflection and rate, from the state
flown, by the linear equations of `heave.Heave`.
"""

from collections.abc import Callable

import numpy as np
from scipy.constants import g
from scipy.linalg import block_diag, expm

from lidar_mi.aircraft.heave import Heave
from lidar_mi.aircraft.planning import INTERVAL, KNOTS, TRAVEL, least_squares, least_travel
from lidar_mi.aircraft.state import Limits

PEAK = 2.0
"""The largest load factor counts four times its interval: a structure is sized by the largest."""

BENDING = 1.0
"""The bending of level flight counts as much as a load factor of 1: the wing carries both."""

PITCH_TIME = 0.5
"""A pitch rate (rad/s) counts as this time (s) of it: 10 degrees/s as 0.09 g."""

PATH_TIME = 2.0
"""s: a climb ends slowly against a gust, which is not to be met by holding the path."""

_EFFORT = 1e-2  # of a deflection in rad against a load factor

LoadPlan = Callable[[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray], np.ndarray]
"""Elevator and symmetric aileron (rad), shape (2,), to be commanded.

From the state, shape (3,); force and moment of the wind in the intervals (N, N m, nose down), shape
(`KNOTS`, 2); the sum of its bending moments (N m), shape (`KNOTS`,); elevator and symmetric aileron
now, shape (2,); the ailerons that roll, now and as planned (rad), shape (`KNOTS` + 1,).
"""


def load_plan(heave: Heave, limits: Limits) -> LoadPlan:
    """The plan of an aircraft. Roll has the first claim on the ailerons' travel and rate."""
    largest = np.array([limits.deflection[1], limits.symmetric_aileron])
    rate = np.array([limits.rate[1], limits.rate[0]])
    used = np.flatnonzero((largest > 0) & (rate > 0))
    if not used.size:
        return lambda state, wind, bending, now, ailerons: np.zeros(2)
    from_state, from_wind, from_controls = _outputs(heave)
    from_controls = from_controls[:, :, used].transpose(0, 2, 1).reshape(len(from_controls), -1)
    count = from_controls.shape[1]
    # the last unknown is the largest load factor of the intervals
    matrix = block_diag(np.concatenate([from_controls, _EFFORT * np.eye(count)]), PEAK)
    load, unity = from_controls[:KNOTS], np.ones((KNOTS, 1))
    within = np.pad(np.kron(np.eye(used.size), TRAVEL), ((0, 0), (0, 1)))
    solved = least_squares(matrix, np.block([[within], [-load, unity], [load, unity]]))
    # the second of the four outputs of each interval
    by_bending = np.kron([[0], [1], [0], [0]], np.eye(KNOTS)) * (BENDING / heave.level_bending)

    def plan(
        state: np.ndarray,
        wind: np.ndarray,
        bending: np.ndarray,
        now: np.ndarray,
        ailerons: np.ndarray,
    ) -> np.ndarray:
        without = from_state @ state + np.einsum("okl,kl->o", from_wind, wind)
        without = without + by_bending @ bending
        room, reach = (np.tile(limit[:, None], KNOTS) for limit in (largest, rate * INTERVAL))
        # travel and rate of the ailerons that roll does not use
        room[1] = np.minimum(room[1], limits.deflection[0] - np.abs(ailerons[1:]))
        reach[1] = np.maximum(reach[1] - np.abs(np.diff(ailerons)), 0.0)
        ways = [least_travel(now[k], room[k], reach[k]) for k in used]
        least = np.concatenate([*ways, without[:KNOTS], -without[:KNOTS]])
        target = -np.concatenate([without, np.zeros(count + 1)])
        chosen = np.zeros(2)
        chosen[used] = solved(target, least)[:-1].reshape(-1, KNOTS)[:, 0]
        return np.clip(chosen, -largest, largest)

    return plan


def _outputs(heave: Heave) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """What the plan minimises, shape (4 `KNOTS`, ...), per state, wind and controls.

    Of shape (..., 3), (..., `KNOTS`, 2) and (..., `KNOTS`, 2); constant inputs in an interval.
    """
    inputs = np.hstack([heave.wind, heave.controls])
    whole = np.zeros((7, 7))
    whole[:3] = np.hstack([heave.motion, inputs])
    flow = expm(whole * INTERVAL)[:3]
    # derivatives of the state by the first state and all inputs
    now = np.zeros((3, 3 + 4 * KNOTS))
    now[:, :3] = np.eye(3)
    rows: list[list[np.ndarray]] = [[], [], [], []]
    for k in range(KNOTS):
        interval = slice(3 + 4 * k, 7 + 4 * k)
        after = flow[:, :3] @ now
        after[:, interval] += flow[:, 3:]
        rise = (after[0] - now[0]) / INTERVAL
        bent = heave.bending @ (now + after) / 2 - heave.relief * rise
        bent[interval] += [0.0, 0.0, *heave.bending_controls]
        for row, value in zip(
            rows,
            (
                rise / g,
                BENDING / heave.level_bending * bent,
                PITCH_TIME * after[2],
                after[0] / (g * PATH_TIME),
            ),
            strict=True,
        ):
            row.append(value)
        now = after
    outputs = np.concatenate(rows)
    each = outputs[:, 3:].reshape(4 * KNOTS, KNOTS, 4)
    return outputs[:, :3], each[..., :2], each[..., 2:]
