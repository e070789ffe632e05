"""Loads of the wind on strips with a memory: unsteady lift, stall, wind along the body.

The lift of a thin section follows a step of its motion by the function of Wagner, and a gust that
it enters by that of Kuessner. Both are sums of exponentials of the distance s flown in half chords,
for wings of infinite span (R. T. Jones, NACA report 681, 1940):

phi(s) = 1 - .165 exp(-.0455 s) - .335 exp(-.3 s),
psi(s) = 1 - .236 exp(-.058 s) - .513 exp(-.364 s) - .171 exp(-2.42 s).

An aircraft model has the steady lift of its motion. The loads here are all that the strips have in
addition, so that every model can fly with them. Apparent mass is neglected, and the motion of a
fin, whose sideslip no state has.
"""

from dataclasses import dataclass

import numpy as np
from scipy.constants import g

from lidar_mi.aircraft.state import AircraftModel, AircraftState, Wind
from lidar_mi.aircraft.strips import Loads, Strips, wake_loads
from lidar_mi.instrument.motion import attitude
from lidar_mi.schema.aerodynamics import Aerodynamics


@dataclass(frozen=True)
class Indicial:
    """A lift 1 - sum_i a_i exp(-b_i s) after a step, s in half chords: weights a and rates b."""

    weights: tuple[float, ...]
    rates: tuple[float, ...]

    def response(self, frequency: np.ndarray) -> np.ndarray:
        """Lift over steady lift at reduced frequencies k = omega c / 2 V."""
        k = np.asarray(frequency)[..., None] * 1j
        return 1 - (np.array(self.weights) * k / (k + np.array(self.rates))).sum(-1)


WAGNER = Indicial((0.165, 0.335), (0.0455, 0.3))
KUESSNER = Indicial((0.236, 0.513, 0.171), (0.058, 0.364, 2.42))


class Memory:
    """Unsteady response of strips to their inputs, exact for inputs linear between samples.

    rate (n,): half chords flown in a second, by strip.
    """

    def __init__(self, indicial: Indicial, rate: np.ndarray) -> None:
        self._weights = np.array(indicial.weights)[:, None]
        self._rates = np.array(indicial.rates)[:, None] * rate
        self._state: np.ndarray | None = None
        self._before = np.zeros(0)

    def __call__(self, dt: float, value: np.ndarray) -> np.ndarray:
        """Effective input (n,) dt (s) after the last one; the first input is a steady state."""
        if self._state is None:
            self._state = self._weights * value
        elif dt > 0:
            distance = self._rates * dt
            decay, mean = np.exp(-distance), -np.expm1(-distance) / distance
            driven = (mean - decay) * self._before + (1 - mean) * value
            self._state = decay * self._state + self._weights * driven
        self._before = value
        return np.asarray((1 - self._weights.sum()) * value + self._state.sum(axis=0))


class StripLoads:
    """Loads of the wind on an aircraft, state after state.

    With the default keys these are `lidar_mi.aircraft.state.loads_in_wind`.

    aircraft: at the start, in steady flight.
    wind: of the path frame.
    mass: of the aircraft, kg: its weight is the steady lift of its wing.
    """

    def __init__(
        self, aircraft: AircraftModel, wind: Wind, keys: Aerodynamics, mass: float
    ) -> None:
        self._strips, self._density, self._wind = aircraft.strips, aircraft.density, wind
        self._keys = keys
        self._speed, self._time = aircraft.state.airspeed, aircraft.state.time
        self._trim = _trim_angles(self._strips, mass, self._speed, self._density)
        self._unsteady = keys.lift == "unsteady"
        rate = 2 * self._speed / self._strips.chords
        self._of_wind, self._of_motion = Memory(KUESSNER, rate), Memory(WAGNER, rate)
        # a gust is met by the leading edge, a quarter of the chord ahead of the centre of pressure
        ahead = self._strips.chords / 4 if self._unsteady else 0.0
        self._places = self._strips.places + np.outer(np.ones(len(rate)) * ahead, [1.0, 0.0, 0.0])
        cl = keys.largest_lift_coefficient
        self._largest = np.inf if cl is None else cl / self._strips.slopes
        self._steady = np.zeros(len(rate))
        self._steady = self._motion(aircraft.state)

    def __call__(self, state: AircraftState) -> Loads:
        """Loads in a state, which is later than that of the last call."""
        dt, self._time = state.time - self._time, state.time
        to_path = attitude(state.roll, state.pitch, state.yaw).as_matrix()
        x, y, z = (self._places @ to_path.T + np.array([state.x, state.y, state.z])).T
        body = np.stack(np.broadcast_arrays(*self._wind(x, y, z, state.time)), -1) @ to_path
        wind = (body * self._strips.normals).sum(-1)
        speed, motion = state.airspeed, self._motion(state)
        of_wind, of_motion = wind, motion
        if self._unsteady:
            of_wind, of_motion = self._of_wind(dt, wind), self._of_motion(dt, motion)
        along = speed - body[:, 0] if self._keys.wind_along else speed
        angle = self._trim + (of_wind + of_motion) / along
        angle = np.clip(angle, -self._largest, self._largest)
        # the normal wind at which quasi-steady strips have these loads
        equivalent = (along**2 * angle - speed**2 * self._trim) / speed - motion
        normal = equivalent[:, None] * self._strips.normals
        return wake_loads(self._strips, normal, speed, self._density)

    def _motion(self, state: AircraftState) -> np.ndarray:
        """Air along the normals by the aircraft's motion, less that of the start, m/s; (n,)."""
        to_path = attitude(state.roll, state.pitch, state.yaw).as_matrix()
        flight = np.array([state.airspeed, 0.0, state.vertical_speed]) @ to_path
        # a pitch rate is nose up, against the right hand about y
        roll, pitch = state.roll_rate, -state.pitch_rate
        rise = flight[2] + roll * self._strips.places[:, 1] - pitch * self._strips.places[:, 0]
        return np.asarray(-rise * self._strips.normals[:, 2] - self._steady)


def _trim_angles(strips: Strips, mass: float, speed: float, density: float) -> np.ndarray:
    """Angles of attack, from zero lift, of wing strips that carry the weight; 0 of others; rad."""
    wing = strips.bends if strips.bends.any() else np.ones(len(strips.areas), bool)
    lift = 0.5 * density * speed**2 * (strips.areas * strips.slopes)[wing].sum()
    return np.where(wing, mass * g / lift, 0.0)
