"""Controllers: commands from the preview of the wake's loads and the state.

Without control a pilot levels the wings. Feedforward steers by the loads predicted from the lidar's
track, perfect preview by the true loads, the autopilot by a preview of no loads. Without a track
feedforward is the autopilot: `bumpless_transfer`.
"""

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike

from lidar_mi.aircraft.load_plan import load_plan
from lidar_mi.aircraft.planning import HORIZON, INTERVAL, KNOTS, TRAVEL, least_squares, least_travel
from lidar_mi.aircraft.state import (
    AircraftModel,
    AircraftState,
    Commands,
    RisingAircraft,
    ailerons_deflected,
    deflected,
)
from lidar_mi.aircraft.strips import Loads

Preview = Callable[[ArrayLike], Loads]
"""The wake's loads expected at a time or at several (s), for the state flown on."""

Controller = Callable[[Preview, AircraftState], Commands]
"""Commands from the preview, of no loads while nothing is known, and the state."""

Transfer = Callable[[Preview | None, AircraftState], Preview]
"""The preview to steer by, from the present one, or None, and the state."""

RATE_TIME = 0.5
"""A roll rate counts as much as the bank angle that it makes in this time, s."""

_INSTANTS = 9
_EFFORT = 1e-2  # of a deflection against a bank angle, both in rad


def no_loads(time: ArrayLike) -> Loads:
    """The preview of an autopilot, which knows of no wake."""
    none = np.zeros((*np.shape(time), 3))
    return Loads(none, none)


def bumpless_transfer() -> Transfer:
    """From a preview that is lost to no loads, over the `HORIZON` of the plan.

    Loads that a lost preview expects are weighted by a factor that falls linearly from 1 to 0. So
    an aileron held against a wake returns gradually, and the extrapolation of an ended track loses
    its weight. Before the first preview no loads are expected.
    """
    last: Preview = no_loads
    last_time = -np.inf

    def transfer(preview: Preview | None, state: AircraftState) -> Preview:
        nonlocal last, last_time
        if preview is not None:
            last, last_time = preview, state.time
            return preview
        fraction = 1 - (state.time - last_time) / HORIZON
        return _fraction_of(last, fraction) if fraction > 0 else no_loads

    return transfer


def _fraction_of(preview: Preview, fraction: float) -> Preview:
    def expected(time: ArrayLike) -> Loads:
        loads = preview(time)
        return Loads(*(fraction * part for part in (loads.force, loads.moment, loads.bending)))

    return expected


def wings_level(aircraft: AircraftModel, time: float | None) -> Controller:
    """Levelling: commands the roll rate -roll / time (s); without a time nothing steers.

    The aileron deflects by L_p / L_da roll / time. Without limits and slow against the roll mode,
    a bank angle decays with this time.
    """
    power = aircraft.control_moments[0, 0]
    gain = aircraft.roll_damping / (power * time) if time and power else 0.0

    def controller(preview: Preview, state: AircraftState) -> Commands:
        return Commands(aileron=float(gain * state.roll))

    return controller


def feedforward(aircraft: AircraftModel) -> Controller:
    """The aileron planned against the roll by the wake ahead; the other controls cancel moments.

    Where the wake has more moment than the ailerons, cancelling is incomplete. An aircraft with a
    preview first banks a little to the other side. The deflections of the next `HORIZON` minimise
    the sum of roll^2 + (`RATE_TIME` roll rate)^2 of the linear roll mode, from the state flown and
    the moments expected, within the limits of deflection and rate; the first is commanded, and all
    are planned again at the next call. Elevator and rudder cancel, as in `cancelling`; the rudder's
    rolling moment is part of the plan.

    Of a `RisingAircraft` elevator and symmetric ailerons are planned against loads (`load_plan`),
    with the travel of the ailerons that the plan of roll leaves.

    A preview of no loads makes it an autopilot that holds the wings level as well as the ailerons
    can, and the path.
    """
    limits, moments = aircraft.limits, aircraft.control_moments
    rising = aircraft if isinstance(aircraft, RisingAircraft) else None
    cancel = cancelling(aircraft, None)
    rolls = bool(moments[0, 0] and limits.deflection[0] and limits.rate[0])
    # without an aileron that moves there is no roll to plan
    if not (rolls or rising):
        return cancel
    roll = _roll_plan(aircraft) if rolls else None
    loads = load_plan(rising.heave, limits) if rising else None
    has_others = bool(moments[:, 2 if rising else 1 :].any())
    trim = _heave_state(aircraft.state)
    middles = (np.arange(KNOTS) + 0.5) * INTERVAL
    last, before, deflection, symmetric = Commands(), np.nan, np.zeros(3), 0.0

    def controller(preview: Preview, state: AircraftState) -> Commands:
        nonlocal last, before, deflection, symmetric
        # the controls follow this controller's commands alone: where they are is known
        if state.time > before:
            dt, aileron = state.time - before, deflection[0]
            deflection, _ = deflected(deflection, last, dt, limits)
            deflection[0], symmetric = ailerons_deflected(aileron, symmetric, last, dt, limits)
        before = state.time
        others = cancel(preview, state) if has_others else Commands()
        expected = preview(state.time + middles)
        ailerons = np.zeros(KNOTS)
        if roll:
            wind = expected.moment[:, 0] + moments[0, 1:] @ others.array[1:]
            ailerons = roll(state, wind, deflection[0])
        elevator, lifting = others.elevator, 0.0
        if loads:
            wind = np.stack([expected.force[:, 2], expected.moment[:, 1]], -1)
            bending = np.broadcast_to(expected.bending.sum(-1), (KNOTS,))
            planned = loads(
                _heave_state(state) - trim,
                wind,
                bending,
                np.array([deflection[1], symmetric]),
                np.array([deflection[0], *ailerons]),
            )
            elevator, lifting = map(float, planned)
        last = Commands(float(ailerons[0]), elevator, others.rudder, lifting)
        return last

    return controller


def _heave_state(state: AircraftState) -> np.ndarray:
    return np.array([state.vertical_speed, state.pitch, state.pitch_rate])


def _roll_plan(aircraft: AircraftModel) -> Callable[[AircraftState, np.ndarray, float], np.ndarray]:
    """The ailerons (rad) of the intervals, for moments expected in them and the deflection now."""
    largest, reach = aircraft.limits.deflection[0], aircraft.limits.rate[0] * INTERVAL
    from_rate, rolls, rates = _roll_mode(aircraft, INTERVAL)
    power, effort = aircraft.control_moments[0, 0], _EFFORT * np.eye(KNOTS)
    matrix = np.concatenate([rolls * power, RATE_TIME * rates * power, effort])
    solved = least_squares(matrix, TRAVEL)

    def plan(state: AircraftState, wind: np.ndarray, now: float) -> np.ndarray:
        start = from_rate * state.roll_rate + [[state.roll], [0.0]]
        target = -np.concatenate(
            [start[0] + rolls @ wind, RATE_TIME * (start[1] + rates @ wind), np.zeros(KNOTS)]
        )
        least = least_travel(
            float(np.clip(now, -largest, largest)), np.full(KNOTS, largest), np.full(KNOTS, reach)
        )
        return np.clip(solved(target, least), -largest, largest)

    return plan


def cancelling(aircraft: AircraftModel, levelling_time: float | None) -> Controller:
    """Deflections whose moments cancel the predicted ones at every moment; levels as `wings_level`.

    The moments -M(t) are distributed over the controls by least squares of `control_moments`,
    within the limits of deflection. A control that cannot follow fast enough starts early: of all
    deflections, the one nearest to today's need is taken from which the needs of the next seconds
    can be reached at the control's rate; where there is none, the middle between the two that
    contradict each other most. The horizon is the time from stop to stop.
    """
    level = wings_level(aircraft, levelling_time)
    # an aircraft that only rolls has one control: the pseudo-inverse leaves the others at zero
    per_moment = np.linalg.pinv(aircraft.control_moments, rcond=1e-9)
    limits = aircraft.limits
    times = np.divide(2 * limits.deflection, limits.rate, out=np.zeros(3), where=limits.rate > 0)
    instants = np.linspace(0.0, times.max(), _INSTANTS)

    def controller(preview: Preview, state: AircraftState) -> Commands:
        commands = level(preview, state)
        moments = preview(state.time + instants).moment
        needs = np.clip(-moments @ per_moment.T, -limits.deflection, limits.deflection)
        ways = instants[:, None] * limits.rate
        least, most = (needs - ways).max(0), (needs + ways).min(0)
        chosen = np.where(least > most, (least + most) / 2, np.clip(needs[0], least, most))
        total = np.clip(chosen + commands.array, -limits.deflection, limits.deflection)
        return Commands(*map(float, total))

    return controller


def _roll_mode(aircraft: AircraftModel, dt: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Roll and roll rate after each interval of `HORIZON`.

    From the first roll rate, shape (2, `KNOTS`), and from constant moments in the intervals, two of
    shape (`KNOTS`, `KNOTS`).
    """
    tau = aircraft.roll_inertia / -aircraft.roll_damping
    decay = np.exp(-dt / tau)
    gain = tau / aircraft.roll_inertia
    step = np.array([[1.0, tau * (1 - decay)], [0.0, decay]])
    pushed = gain * np.array([dt - tau * (1 - decay), 1 - decay])
    now = np.zeros((2, KNOTS + 1))  # of roll and rate, on each moment and on the first rate
    now[1, -1] = 1.0
    all_of_them = []
    for k in range(KNOTS):
        now = step @ now
        now[:, k] += pushed
        all_of_them.append(now)
    rolls, rates = np.swapaxes(all_of_them, 0, 1)
    return np.stack([rolls[:, -1], rates[:, -1]]), rolls[:, :-1], rates[:, :-1]
