"""A rigid aircraft that only rolls: I p' = L_wake + L_p p + L_da da.

It flies its nominal path at constant speed. The damping L_p comes from the strips on which the
wake acts (`strips.roll_damping`); the aileron's moment is q S b C_lda da.
"""

from dataclasses import replace

import numpy as np

from lidar_mi.aircraft.state import LARGEST_ROLL, AircraftState, Commands, Limits, deflected
from lidar_mi.aircraft.strips import Loads, roll_damping, wing_strips
from lidar_mi.atmosphere.air.standard_atmosphere import standard_atmosphere
from lidar_mi.schema.encounter import Aircraft, Path


class RollModel:
    """An aircraft with one degree of freedom; a model of `aircraft.AircraftModel`."""

    def __init__(self, aircraft: Aircraft, path: Path) -> None:
        self.state = AircraftState(airspeed=path.speed)
        self.density = standard_atmosphere(path.altitude).density
        self.strips = wing_strips(aircraft.span, aircraft.wing_area, aircraft.lift_slope)
        self.roll_damping = roll_damping(self.strips, path.speed, self.density)
        self.limits = Limits(
            np.array([aircraft.largest_aileron, 0.0, 0.0]),
            np.array([aircraft.aileron_rate, 0.0, 0.0]),
        )
        self.control_moments = np.zeros((3, 3))
        pressure = 0.5 * self.density * path.speed**2
        self.control_moments[0, 0] = (
            pressure * aircraft.wing_area * aircraft.span * aircraft.aileron_power
        )
        self.deflection = np.zeros(3)
        self.roll_inertia = aircraft.roll_inertia

    @property
    def time_constant(self) -> float:
        """Of the roll mode, I / -L_p, s."""
        return -self.roll_inertia / self.roll_damping

    def step(self, dt: float, loads: Loads, commands: Commands) -> AircraftState:
        """State after dt (s): exact, for loads that are constant over dt and a moving aileron."""
        state = self.state
        if state.departed:
            self.state = replace(state, time=state.time + dt)
            return self.state
        before = self.deflection[0]
        self.deflection, moving = deflected(self.deflection, commands, dt, self.limits)
        after = self.deflection[0]
        roll, rate = state.roll, state.roll_rate
        # the aileron moves at its rate, then rests: the moment is linear in both parts
        for duration, start, end in ((moving[0], before, after), (dt - moving[0], after, after)):
            if duration > 0:
                moments = loads.moment[0] + self.control_moments[0, 0] * np.array([start, end])
                roll, rate = self._rolled(roll, rate, duration, *(moments / self.roll_inertia))
        time = state.time + dt
        # NaN is an upset, too
        self.state = replace(
            state,
            time=time,
            x=state.x + state.airspeed * dt,
            roll=roll,
            roll_rate=rate,
            departed=not abs(roll) <= LARGEST_ROLL,
        )
        return self.state

    def _rolled(
        self, roll: float, rate: float, dt: float, start: float, end: float
    ) -> tuple[float, float]:
        """Roll (rad) and roll rate (rad/s) after dt of p' = -p / tau + m.

        m changes linearly from start to end (rad/s^2).
        """
        tau = self.time_constant
        slope = (end - start) / dt
        # a particular solution is p = tau (m - slope tau)
        free = rate - tau * (start - slope * tau)
        decay = np.exp(-dt / tau)
        after = tau * (end - slope * tau) + free * decay
        change = tau * (dt * (start + end) / 2 - slope * tau * dt)
        change -= free * tau * np.expm1(-dt / tau)
        return float(roll + change), float(after)
