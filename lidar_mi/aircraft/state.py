"""The aircraft: its state, its controls, and the protocol of its models."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike

from lidar_mi.aircraft.heave import Heave
from lidar_mi.aircraft.strips import Loads, Strips, wake_loads
from lidar_mi.instrument.motion import attitude

LARGEST_ROLL = np.pi / 2
"""Bank angle (rad) beyond which an aircraft counts as upset."""

Wind = Callable[..., tuple[np.ndarray, np.ndarray, np.ndarray]]
"""u, v, w (m/s) from x, y, z (m) and time (s), in the path frame."""


@dataclass(frozen=True)
class AircraftState:
    """Place, attitude and motion of the aircraft in the path frame (x forward, y left, z up).

    time: s.
    x, y, z: centre of gravity, m.
    roll, pitch, yaw: rad: port wing up, nose up, nose to port.
    roll_rate, pitch_rate, yaw_rate: rad/s, about the body's axes, signs as the angles.
    airspeed: m/s.
    departed: the flight is lost: the aircraft is upset (rolled beyond `LARGEST_ROLL`), or its
        equations have no finite solution any more.
    vertical_speed: m/s, of the centre of gravity along z.
    load_factor: specific force along the body's z axis at the centre of gravity over g; 1 in level
        flight. NaN: the model does not rise.
    port_bending, starboard_bending: wing-root bending moments (N m), changes from the trim,
        positive with the tip up: of air loads less the inertia of the wing. NaN: the model does not
        rise.
    """

    time: float = 0.0
    x: float = 0.0
    y: float = 0.0
    z: float = 0.0
    roll: float = 0.0
    pitch: float = 0.0
    yaw: float = 0.0
    roll_rate: float = 0.0
    pitch_rate: float = 0.0
    yaw_rate: float = 0.0
    airspeed: float = 75.0
    departed: bool = False
    vertical_speed: float = 0.0
    load_factor: float = math.nan
    port_bending: float = math.nan
    starboard_bending: float = math.nan


@dataclass(frozen=True)
class Commands:
    """Commanded deflections, rad.

    Positive ones roll the port wing up (aileron), move the nose down (elevator) and to port
    (rudder): each gives a positive moment of `Loads`. A positive symmetric aileron has both
    trailing edges down, and lifts: the port aileron is at symmetric + aileron, the starboard one at
    symmetric - aileron.
    """

    aileron: float = 0.0
    elevator: float = 0.0
    rudder: float = 0.0
    symmetric_aileron: float = 0.0

    @property
    def array(self) -> np.ndarray:
        """(3,), rad, of aileron, elevator and rudder."""
        return np.array([self.aileron, self.elevator, self.rudder])


@dataclass(frozen=True, eq=False)
class Limits:
    """Largest deflections (rad) and their rates (rad/s), of aileron, elevator and rudder.

    deflection, rate (3,): 0 for a control that the model does not have.
    symmetric_aileron: largest symmetric deflection of the ailerons (rad), of the travel that they
        share with roll: each stays within deflection[0] and rate[0]. 0: there is none.
    """

    deflection: np.ndarray
    rate: np.ndarray
    symmetric_aileron: float = 0.0


class AircraftModel(Protocol):
    """A model of an aircraft.

    strips: of the surfaces on which the wake acts.
    limits: of the controls.
    density: of the air at the start, kg m^-3.
    control_moments (3, 3): moment (row, N m) per deflection (column, rad) at the start; zero
        columns for controls that the model does not have.
    roll_damping: rolling moment per roll rate at the start, N m per rad/s, negative.
    roll_inertia: moment of inertia about the body's x axis, kg m^2.
    """

    @property
    def state(self) -> AircraftState: ...  # noqa: D102
    @property
    def strips(self) -> Strips: ...  # noqa: D102
    @property
    def limits(self) -> Limits: ...  # noqa: D102
    @property
    def density(self) -> float: ...  # noqa: D102
    @property
    def control_moments(self) -> np.ndarray: ...  # noqa: D102
    @property
    def roll_damping(self) -> float: ...  # noqa: D102
    @property
    def roll_inertia(self) -> float: ...  # noqa: D102

    def step(self, dt: float, loads: Loads, commands: Commands) -> AircraftState:
        """State after dt (s), with the wake's loads constant and the controls moving."""
        ...


@runtime_checkable
class RisingAircraft(AircraftModel, Protocol):
    """A model that also rises and pitches, whose loads a controller can plan.

    heave: its linear equations about the start.
    """

    @property
    def heave(self) -> Heave: ...  # noqa: D102


def loads_in_wind(
    strips: Strips, state: AircraftState, wind: Wind, density: float, time: ArrayLike | None = None
) -> Loads:
    """The wake's force and moment on an aircraft in a state, or on its straight course from there.

    state: place, attitude, time and airspeed.
    wind: of the path frame: ``wind(x, y, z, time)``.
    density: of the air, kg m^-3.
    time (...): s, at which attitude, course and speed are still those of the state. Default: now.

    Returns
    -------
    Loads
        Force and moment of shape (..., 3).
    """
    at = np.asarray(state.time if time is None else time, dtype=float)[..., None]
    to_path = attitude(state.roll, state.pitch, state.yaw).as_matrix()
    # only x advances: a preview does not predict the aircraft's own motion across the path
    x, y, z = (strips.places @ to_path.T + np.array([state.x, state.y, state.z])).T
    uvw = wind(x + state.airspeed * (at - state.time), y, z, at)
    body = np.stack(np.broadcast_arrays(*uvw), -1) @ to_path
    return wake_loads(strips, body, state.airspeed, density)


def deflected(
    deflection: np.ndarray, commands: Commands, dt: float, limits: Limits
) -> tuple[np.ndarray, np.ndarray]:
    """Controls that move to their commands at most at their rate, within their limits.

    The deflection (rad) after ``dt`` (s), and the time in it that each moves (s) before it rests.
    """
    target = np.clip(commands.array, -limits.deflection, limits.deflection)
    change = target - deflection
    after = deflection + np.clip(change, -limits.rate * dt, limits.rate * dt)
    moved = np.abs(after - deflection)
    # the rate of a control that the model does not have is 0
    time = np.divide(moved, limits.rate, out=np.zeros(3), where=limits.rate > 0)
    return after, np.minimum(time, dt)


def ailerons_deflected(
    aileron: float, symmetric: float, commands: Commands, dt: float, limits: Limits
) -> tuple[float, float]:
    """Both ailerons, each within its limits and at most at its rate; roll has the first claim.

    The symmetric deflection is limited to the travel that a commanded roll leaves.
    Antisymmetric and symmetric deflection (rad) come and go in this order, as by `deflected`.
    """
    largest, way = limits.deflection[0], limits.rate[0] * dt
    rolling = float(np.clip(commands.aileron, -largest, largest))
    room = min(limits.symmetric_aileron, largest - abs(rolling))
    lifting = float(np.clip(commands.symmetric_aileron, -room, room))
    port, starboard = (
        now + float(np.clip(target - now, -way, way))
        for now, target in (
            (symmetric + aileron, lifting + rolling),
            (symmetric - aileron, lifting - rolling),
        )
    )
    return (port - starboard) / 2, (port + starboard) / 2
