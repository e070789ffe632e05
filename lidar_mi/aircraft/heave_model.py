"""A rigid aircraft that rolls, pitches and rises, about level flight at constant speed.

Roll is that of `roll_model.RollModel`, with the tail: I p' = L_wind + L_p p + L_da da. Rising and
pitching are `heave.Heave`. Both are independent of each other, as for small bank angles.
"""

from dataclasses import replace

import numpy as np
from scipy.constants import g
from scipy.linalg import expm

from lidar_mi.aircraft.heave import heave_of, wing_place
from lidar_mi.aircraft.state import (
    LARGEST_ROLL,
    AircraftState,
    Commands,
    Limits,
    ailerons_deflected,
    deflected,
)
from lidar_mi.aircraft.strips import (
    TAIL_ASPECT_RATIO,
    Loads,
    as_wing,
    in_downwash,
    joined,
    roll_damping,
    wing_strips,
)
from lidar_mi.atmosphere.air.standard_atmosphere import standard_atmosphere
from lidar_mi.schema.encounter import Aircraft, Path

# z, vertical speed, pitch, pitch rate, roll, roll rate
_Z, _HEAVE, _ROLL, _STATES = 0, slice(1, 4), slice(4, 6), 6


class HeaveModel:
    """An aircraft with three degrees of freedom; a model of `aircraft.RisingAircraft`."""

    def __init__(self, aircraft: Aircraft, path: Path) -> None:
        keys, speed = aircraft.heave, path.speed
        self.density = standard_atmosphere(path.altitude).density
        span, area, slope = aircraft.span, aircraft.wing_area, aircraft.lift_slope
        wing = as_wing(wing_strips(span, area, slope, place=(wing_place(aircraft), 0, 0)))
        tail_span = np.sqrt(TAIL_ASPECT_RATIO * keys.tail_area)
        tail = wing_strips(tail_span, keys.tail_area, slope, place=(-keys.tail_arm, 0, 0))
        self.strips = joined(wing, in_downwash(tail, slope, span**2 / area))
        self.roll_damping = roll_damping(self.strips, speed, self.density)
        self.roll_inertia = aircraft.roll_inertia
        self.heave = heave_of(aircraft, speed, self.density)
        rate = aircraft.aileron_rate
        self.limits = Limits(
            np.array([aircraft.largest_aileron, keys.largest_elevator, 0.0]),
            np.array([rate, rate if keys.largest_elevator else 0.0, 0.0]),
            min(keys.largest_symmetric_aileron, aircraft.largest_aileron),
        )
        lift = 0.5 * self.density * speed**2 * area
        self.control_moments = np.zeros((3, 3))
        self.control_moments[0, 0] = lift * span * aircraft.aileron_power
        if keys.largest_elevator:
            self.control_moments[1, 1] = lift * area / span * keys.elevator_power
        self.deflection, self.symmetric = np.zeros(3), 0.0
        self.state = AircraftState(
            airspeed=speed, load_factor=1.0, port_bending=0.0, starboard_bending=0.0
        )
        self._wing_damping = roll_damping(wing, speed, self.density)
        # mass spread as an elliptic chord: b^2 / 16
        self._roll_relief = keys.wing_mass * keys.mass * span**2 / 16
        self._steps: dict[float, tuple[np.ndarray, ...]] = {}

    def step(self, dt: float, loads: Loads, commands: Commands) -> AircraftState:
        """State after dt (s): exact, for constant loads and deflections that are linear in dt."""
        state, before = self.state, self._deflections
        if state.departed:
            self.state = replace(state, time=state.time + dt)
            return self.state
        self.deflection = deflected(self.deflection, commands, dt, self.limits)[0]
        self.deflection[0], self.symmetric = ailerons_deflected(
            before[0], before[2], commands, dt, self.limits
        )
        wind = np.array([loads.force[2], loads.moment[1], loads.moment[0]])
        start, end = (np.concatenate([wind, controls]) for controls in (before, self._deflections))
        flow, constant, ramp = self._step(dt)
        vector = [state.z, state.vertical_speed, state.pitch]
        vector += [state.pitch_rate, state.roll, state.roll_rate]
        now = flow @ vector + constant @ start + ramp @ (end - start)
        self.state = self._after(state, dt, now, end, loads)
        return self.state

    @property
    def _deflections(self) -> np.ndarray:
        """Aileron, elevator, symmetric aileron, rad."""
        return np.array([self.deflection[0], self.deflection[1], self.symmetric])

    def _equations(self) -> tuple[np.ndarray, np.ndarray]:
        """Rates per state; per force, pitching and rolling moment, aileron, elevator, symmetric."""
        motion, inputs = np.zeros((_STATES, _STATES)), np.zeros((_STATES, 6))
        motion[_Z, 1] = 1.0
        motion[_HEAVE, _HEAVE] = self.heave.motion
        inputs[_HEAVE, :2], inputs[_HEAVE, 4:] = self.heave.wind, self.heave.controls
        motion[_ROLL, _ROLL] = [[0.0, 1.0], [0.0, self.roll_damping / self.roll_inertia]]
        inputs[5, 2:4] = 1 / self.roll_inertia, self.control_moments[0, 0] / self.roll_inertia
        return motion, inputs

    def _step(self, dt: float) -> tuple[np.ndarray, ...]:
        """State after a step per state, per inputs at its start, and per their change in it."""
        if dt not in self._steps:
            motion, inputs = self._equations()
            count = inputs.shape[1]
            # inputs that grow linearly, as states of their own (Van Loan 1978)
            whole = np.zeros((_STATES + 2 * count,) * 2)
            whole[:_STATES, : _STATES + count] = np.hstack([motion, inputs])
            whole[_STATES:-count, -count:] = np.eye(count) / dt
            flow = expm(whole * dt)[:_STATES]
            self._steps[dt] = (flow[:, :_STATES], flow[:, _STATES:-count], flow[:, -count:])
        return self._steps[dt]

    def _after(
        self, before: AircraftState, dt: float, now: np.ndarray, inputs: np.ndarray, loads: Loads
    ) -> AircraftState:
        motion, per_input = self._equations()
        rates = motion @ now + per_input @ inputs
        rise, roll_acceleration = rates[1], rates[5]
        total = self.heave.bent(now[_HEAVE], inputs[4:], rise)
        difference = (
            self._wing_damping * now[5]
            + self.control_moments[0, 0] * inputs[3]
            - self._roll_relief * roll_acceleration
        )
        port, starboard = loads.bending + np.array([total + difference, total - difference]) / 2
        z, climb, pitch, pitch_rate, roll, roll_rate = map(float, now)
        return replace(
            before,
            time=before.time + dt,
            x=before.x + before.airspeed * dt,
            z=z,
            vertical_speed=climb,
            pitch=pitch,
            pitch_rate=pitch_rate,
            roll=roll,
            roll_rate=roll_rate,
            load_factor=1 + float(rise) / g,
            port_bending=float(port),
            starboard_bending=float(starboard),
            # NaN is an upset, too
            departed=not (abs(roll) <= LARGEST_ROLL and abs(pitch) <= LARGEST_ROLL),
        )
