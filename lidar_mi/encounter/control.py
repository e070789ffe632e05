"""What steers against the wake: commands from the loads that it will bring.

Three modes fly with the same levelling: off has nothing else, feedforward adds the deflections
against the loads predicted from the lidar's track, perfect those against the true loads.
"""

from collections.abc import Callable

import numpy as np

from lidar_mi.encounter.aircraft import AircraftModel, AircraftState, Commands
from lidar_mi.encounter.strips import Loads

Preview = Callable[[float], Loads]
"""The wake's loads expected at a time (s), for the state flown on."""

Controller = Callable[[Preview | None, AircraftState], Commands]
"""Commands from the preview (None while there is none) and the state."""

_INSTANTS = 9


def wings_level(aircraft: AircraftModel, time: float | None) -> Controller:
    """Levelling alone: the roll rate -roll / time is asked for.

    The aileron deflects by L_p / L_da roll / time. Without limits and slow against the roll mode,
    a bank angle decays with this time.

    Parameters
    ----------
    aircraft : AircraftModel
    time : float or None
        s; None: nothing steers.
    """
    power = aircraft.control_moments[0, 0]
    gain = aircraft.roll_damping / (power * time) if time and power else 0.0

    def controller(preview: Preview | None, state: AircraftState) -> Commands:
        return Commands(aileron=float(gain * state.roll))

    return controller


def feedforward(aircraft: AircraftModel, levelling_time: float | None) -> Controller:
    """Deflections whose moments cancel the predicted ones, and levelling.

    The moments -M(t) are shared out to the controls by the least squares of `control_moments`,
    within the limits of deflection. A control that cannot follow fast enough starts early: of all
    deflections, the one nearest to today's need is taken from which the needs of the next seconds
    can be reached at the control's rate; where there is none, the middle between the two that
    contradict each other most. The horizon is the time from stop to stop.

    Parameters
    ----------
    aircraft : AircraftModel
    levelling_time : float or None
        As in `wings_level`.
    """
    level = wings_level(aircraft, levelling_time)
    shares = np.linalg.pinv(aircraft.control_moments, rcond=1e-9)
    limits = aircraft.limits
    times = np.divide(2 * limits.deflection, limits.rate, out=np.zeros(3), where=limits.rate > 0)
    instants = np.linspace(0.0, times.max(), _INSTANTS)

    def controller(preview: Preview | None, state: AircraftState) -> Commands:
        commands = level(preview, state)
        if preview is None:
            return commands
        moments = np.stack([preview(state.time + s).moment for s in instants])
        needs = np.clip(-moments @ shares.T, -limits.deflection, limits.deflection)
        ways = instants[:, None] * limits.rate
        least, most = (needs - ways).max(0), (needs + ways).min(0)
        chosen = np.where(least > most, (least + most) / 2, np.clip(needs[0], least, most))
        total = np.clip(chosen + commands.array, -limits.deflection, limits.deflection)
        return Commands(*map(float, total))

    return controller
