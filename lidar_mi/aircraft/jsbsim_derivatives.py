"""Derivatives of an aircraft of JSBSim at its trim, from small loads and commands.

Two aircraft fly side by side, one of them disturbed: in their difference the aircraft's own motion
in an imperfect trim cancels.
"""

import math
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
from scipy.constants import foot, lbf, slug

from lidar_mi.io.jsbsim_files import AXES

if TYPE_CHECKING:
    from jsbsim import FGFDMExec

# from y to starboard and z down to y to port and z up
_TO_OURS = np.array([1.0, -1.0, -1.0])
_CONTROLS = ("aileron", "elevator", "rudder")
_POSITIONS = ("fcs/left-aileron-pos-rad", "fcs/elevator-pos-rad", "fcs/rudder-pos-rad")
_MOTION = ("aero/alpha-rad", "aero/alphadot-rad_sec", "velocities/q-rad_sec")
_NOMINAL = math.radians(20)  # full deflection of a control that states no angle
_SETTLED = 30  # steps in which a control reaches a small command


def set_loads(fdm: "FGFDMExec", force: np.ndarray, moment: np.ndarray) -> None:
    """Let a force (N) and a moment (N m) of the body frame act from now on."""
    for k, axis in enumerate(AXES):
        # the force acts at the centre of gravity, which moves as fuel burns
        for along in AXES:
            place = f"external_reactions/wake-force-{axis}/location-{along}-in"
            fdm[place] = fdm[f"inertia/cg-{along}-in"]
        fdm[f"external_reactions/wake-force-{axis}/magnitude"] = _TO_OURS[k] * force[k] / lbf
        fdm[f"external_reactions/wake-moment-{axis}/magnitude-lbsft"] = (
            _TO_OURS[k] * moment[k] / (lbf * foot)
        )


def commands_of(fdm: "FGFDMExec") -> np.ndarray:
    """Commands of aileron, elevator and rudder, -1 to 1."""
    return np.array([fdm[f"fcs/{name}-cmd-norm"] for name in _CONTROLS])


def set_commands(fdm: "FGFDMExec", normalised: np.ndarray) -> None:
    """Command aileron, elevator and rudder, -1 to 1."""
    for name, value in zip(_CONTROLS, normalised, strict=True):
        fdm[f"fcs/{name}-cmd-norm"] = value


def _moments(fdm: "FGFDMExec") -> np.ndarray:
    """Aerodynamic moment in our axes, N m."""
    names = [f"moments/{axis}-aero-lbsft" for axis in "lmn"]
    return _TO_OURS * [fdm[name] for name in names] * lbf * foot


def control_moments(
    again: Callable[[], "FGFDMExec"], small: float = 0.05
) -> tuple[np.ndarray, np.ndarray]:
    """Moment per deflection, and deflection per normalised command, from small commands in trim."""
    moments, per_command = np.zeros((3, 3)), np.zeros(3)
    for k, position in enumerate(_POSITIONS):
        steered, trimmed = again(), again()
        before = steered[position]
        set_commands(steered, commands_of(steered) + small * np.eye(3)[k])
        last = before
        for _ in range(_SETTLED):
            steered.run()
            trimmed.run()
            # the actuator has arrived
            if steered[position] == last != before:
                break
            last = steered[position]
        change = _moments(steered) - _moments(trimmed)
        deflection = steered[position] - before
        if not change.any():
            continue
        per_command[k] = (deflection or small * _NOMINAL) / small
        moments[:, k] = change / (per_command[k] * small)
    return moments, per_command


def roll_damping_of(again: Callable[[], "FGFDMExec"], steps: int = 6) -> float:
    """Aerodynamic rolling moment per roll rate, from a moment that acts for 0.05 s in trim."""
    rolling, trimmed = again(), again()
    # 1 rad/s^2: small rates, at which the moment is linear
    inertia = rolling["inertia/ixx-slugs_ft2"] * slug * foot**2
    set_loads(rolling, np.zeros(3), np.array([inertia * 1.0, 0.0, 0.0]))
    for _ in range(steps):
        rolling.run()
        trimmed.run()
    change = _moments(rolling)[0] - _moments(trimmed)[0]
    return float(change / (rolling["velocities/p-rad_sec"] - trimmed["velocities/p-rad_sec"]))


def heave_derivatives(
    again: Callable[[], "FGFDMExec"], per_command: float, small: float = 0.02, steps: int = 24
) -> np.ndarray:
    """Force upwards and moment nose up by rising and pitching, shape (2, 5).

    As `lidar_mi.aircraft.heave.linear_heave` takes them, without symmetric ailerons. Least squares
    over the aerodynamic forces of 0.2 s after a force, a moment or the elevator begins to act.

    again: gives the aircraft in trim.
    per_command: elevator (rad) per normalised command; 0: there is none.
    small: of the commands; of the angle of attack (rad) that the loads make in a second.
    steps: of JSBSim.
    """
    causes, effects = [], []
    for disturb in (_lifted, _pitched, _elevated)[: 3 if per_command else 2]:
        moved, still = again(), again()
        disturb(moved, small)
        for _ in range(steps):
            moved.run()
            still.run()
            change = [moved[name] - still[name] for name in _MOTION]
            elevator = moved[_POSITIONS[1]] - still[_POSITIONS[1]]
            if not elevator:  # of a control that states no angle
                elevator = per_command * (commands_of(moved) - commands_of(still))[1]
            causes.append([*change, elevator])
            effects.append(_upward(moved) - _upward(still))
    derivatives = np.linalg.lstsq(np.array(causes), np.array(effects), rcond=None)[0].T
    return np.column_stack([derivatives, np.zeros(2)])


def _upward(fdm: "FGFDMExec") -> np.ndarray:
    """Aerodynamic force upwards (N) and moment nose up (N m)."""
    lift, moment = fdm["forces/fbz-aero-lbs"], fdm["moments/m-aero-lbsft"]
    return np.array([-lift, moment * foot]) * lbf


def _lifted(fdm: "FGFDMExec", small: float) -> None:
    mass = fdm["inertia/mass-slugs"] * slug
    speed = fdm["velocities/vt-fps"] * foot
    set_loads(fdm, np.array([0.0, 0.0, mass * speed * small]), np.zeros(3))


def _pitched(fdm: "FGFDMExec", small: float) -> None:
    inertia = fdm["inertia/iyy-slugs_ft2"] * slug * foot**2
    set_loads(fdm, np.zeros(3), np.array([0.0, inertia * small, 0.0]))


def _elevated(fdm: "FGFDMExec", small: float) -> None:
    set_commands(fdm, commands_of(fdm) + small * np.eye(3)[1])
