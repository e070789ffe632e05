"""An aircraft of JSBSim (Berndt 2004) on which the wake's force and moment act.

JSBSim integrates the six degrees of freedom of an aircraft with its engines and control system.
The wake enters as a force at the centre of gravity and a moment (``external_reactions``); the
aircraft's own aerodynamics see air at rest. Its axes are x forward, y to starboard, z down.
"""

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
from scipy.constants import foot, inch, lbf, slug

from lidar_mi.encounter.aircraft import LARGEST_ROLL, AircraftState, Commands, Limits, deflected
from lidar_mi.encounter.jsbsim_trim import FLAPS, STEP, check_aeroplane, such_as, trimmed
from lidar_mi.encounter.strips import Loads, Strips, fin_strips, in_downwash, joined, wing_strips
from lidar_mi.errors import InputError, one_line
from lidar_mi.experiment.schema.encounter import Aircraft, Path
from lidar_mi.instrument.motion import attitude
from lidar_mi.io.jsbsim_files import AXES

if TYPE_CHECKING:
    from jsbsim import FGFDMExec

TAIL_ASPECT_RATIO, FIN_ASPECT_RATIO = 4.0, 1.6
"""Usual for transport aircraft (Raymer 2018, table 4.3); JSBSim knows areas and arms alone."""

# from y to starboard and z down to y to port and z up
_TO_OURS = np.array([1.0, -1.0, -1.0])
_CONTROLS = ("aileron", "elevator", "rudder")
_POSITIONS = ("fcs/left-aileron-pos-rad", "fcs/elevator-pos-rad", "fcs/rudder-pos-rad")
_TRIMS = ("fcs/roll-trim-cmd-norm", "fcs/pitch-trim-cmd-norm", "fcs/yaw-trim-cmd-norm")
_NOMINAL = math.radians(20)  # full deflection of a control that states no angle
_SETTLED = 30  # steps in which a control reaches a small command


class JSBSimAircraft:
    """An aircraft of JSBSim, trimmed on the path; a model of `aircraft.AircraftModel`.

    Its wing has JSBSim's span and area and lies at JSBSim's aerodynamic reference point; the tail
    has JSBSim's areas and arms. The controls move at the rate of `Aircraft.aileron_rate`, in
    addition to the dynamics of JSBSim's own actuators.

    Parameters
    ----------
    aircraft : lidar_mi.experiment.schema.encounter.Aircraft
        Its model, the lift slope of the sections, the rate of the controls.
    path : lidar_mi.experiment.schema.encounter.Path
        Speed, climb angle and altitude.

    Raises
    ------
    InputError
        There is no JSBSim, or it has no such aircraft, or cannot load or start it; it is no
        aeroplane with an engine (`jsbsim_trim.check_aeroplane`), or does not trim on this path.
    """

    def __init__(self, aircraft: Aircraft, path: Path) -> None:
        try:
            self._start(aircraft, path)
        except (RuntimeError, ArithmeticError) as error:  # as all of JSBSim's own
            reason = one_line(error, 100).rstrip(".") or type(error).__name__
            raise InputError(
                f"encounter.aircraft.model: JSBSim does not fly {aircraft.model!r} ({reason}); "
                f"expected another aircraft, {such_as(aircraft.model)}"
            ) from None

    def _start(self, aircraft: Aircraft, path: Path) -> None:
        self._climb = path.climb_angle
        check_aeroplane(aircraft.model, path)
        self._fdm = trimmed(aircraft.model, path, FLAPS)
        self.density = self._fdm["atmosphere/rho-slugs_ft3"] * slug / foot**3
        self.strips = _strips(self._fdm, aircraft.lift_slope)
        # derivatives take aircraft of their own, with the flaps of this one
        again = partial(trimmed, aircraft.model, path, [self._fdm["fcs/flap-cmd-norm"]])
        self.control_moments, self._per_command = _control_moments(again)
        self._at_trim = _commands(self._fdm)
        trims = self._at_trim + [self._fdm[name] for name in _TRIMS]
        # travel that the trim uses is not available to commands
        self.limits = Limits(
            np.abs(self._per_command) * np.clip(1 - np.abs(trims), 0, 1),
            np.where(self._per_command != 0, aircraft.aileron_rate, 0.0),
        )
        self.roll_damping = _roll_damping(again)
        self.deflection = np.zeros(3)
        self._origin = _place(self._fdm)
        self.state = self._read(0.0)

    @property
    def mass(self) -> float:
        """Now, kg."""
        return self._fdm["inertia/mass-slugs"] * slug

    @property
    def roll_inertia(self) -> float:
        """Moment of inertia about the body's x axis, kg m^2."""
        return self._fdm["inertia/ixx-slugs_ft2"] * slug * foot**2

    def step(self, dt: float, loads: Loads, commands: Commands) -> AircraftState:
        """State after dt (s), in equal steps of at most `STEP`, with constant loads.

        JSBSim moves the aircraft before it sums up forces: loads and controls act one step later.
        """
        time = self.state.time + dt
        inputs = np.concatenate([loads.force, loads.moment, commands.array])
        if self.state.departed or not np.isfinite(inputs).all():
            self.state = replace(self.state, time=time, departed=True)
            return self.state
        # rounding must not add a step to a whole number of them
        count = max(1, math.ceil(dt / STEP - 1e-6))
        self._fdm.set_dt(dt / count)
        _set_loads(self._fdm, loads.force, loads.moment)
        for _ in range(count):
            self.deflection, _ = deflected(self.deflection, commands, dt / count, self.limits)
            _set_commands(self._fdm, self._at_trim + self._normalised(self.deflection))
            try:
                self._fdm.run()
            except RuntimeError:  # JSBSim's own, of a state that it cannot compute
                self.state = replace(self.state, time=time, departed=True)
                return self.state
        self.state = self._read(time)
        return self.state

    def _normalised(self, deflection: np.ndarray) -> np.ndarray:
        """Commands of JSBSim, -1 to 1, for deflections in rad; 0 for a control without effect."""
        return np.divide(
            deflection, self._per_command, out=np.zeros(3), where=self._per_command != 0
        )

    def _read(self, time: float) -> AircraftState:
        """State in the path frame."""
        fdm = self._fdm
        north, east, up = _place(fdm) - self._origin
        along, upward = math.cos(self._climb), math.sin(self._climb)
        # heading is clockwise seen from above, yaw is to port
        level = attitude(
            fdm["attitude/phi-rad"], fdm["attitude/theta-rad"], -fdm["attitude/psi-rad"]
        )
        numbers = [north, east, up, *level.as_quat(), fdm["velocities/vt-fps"]]
        if not np.isfinite(numbers).all():
            return replace(self.state, time=time, departed=True)
        # the path frame is inclined by the climb angle
        in_path = attitude(0.0, self._climb, 0.0).inv() * level
        # right-handed about y, which is to port: the nose goes down
        yaw, nose_down, roll = in_path.as_euler("ZYX")
        p, q, r = (fdm[f"velocities/{axis}-rad_sec"] for axis in "pqr")
        # the path goes north, so that port is west; q is nose up as pitch, r to starboard
        return AircraftState(
            time=time,
            x=float(north * along + up * upward),
            y=float(-east),
            z=float(up * along - north * upward),
            roll=float(roll),
            pitch=float(-nose_down),
            yaw=float(yaw),
            roll_rate=p,
            pitch_rate=q,
            yaw_rate=-r,
            airspeed=fdm["velocities/vt-fps"] * foot,
            departed=bool(abs(roll) > LARGEST_ROLL or fdm["position/h-agl-ft"] <= 0),
        )


def _place(fdm: "FGFDMExec") -> np.ndarray:
    """North, east, up, m."""
    return foot * np.array([fdm[f"position/from-start-neu-{axis}-ft"] for axis in "neu"])


def _set_loads(fdm: "FGFDMExec", force: np.ndarray, moment: np.ndarray) -> None:
    """Let a force (N) and a moment (N m) of the body frame act from now on."""
    for k, axis in enumerate(AXES):
        # the force acts at the centre of gravity, which moves as fuel burns
        for other in AXES:
            place = f"external_reactions/wake-force-{axis}/location-{other}-in"
            fdm[place] = fdm[f"inertia/cg-{other}-in"]
        fdm[f"external_reactions/wake-force-{axis}/magnitude"] = _TO_OURS[k] * force[k] / lbf
        fdm[f"external_reactions/wake-moment-{axis}/magnitude-lbsft"] = (
            _TO_OURS[k] * moment[k] / (lbf * foot)
        )


def _commands(fdm: "FGFDMExec") -> np.ndarray:
    return np.array([fdm[f"fcs/{name}-cmd-norm"] for name in _CONTROLS])


def _set_commands(fdm: "FGFDMExec", normalised: np.ndarray) -> None:
    for name, value in zip(_CONTROLS, normalised, strict=True):
        fdm[f"fcs/{name}-cmd-norm"] = value


def _moments(fdm: "FGFDMExec") -> np.ndarray:
    """Aerodynamic moment in our axes, N m."""
    names = [f"moments/{axis}-aero-lbsft" for axis in "lmn"]
    return _TO_OURS * [fdm[name] for name in names] * lbf * foot


def _control_moments(
    again: Callable[[], "FGFDMExec"], small: float = 0.05
) -> tuple[np.ndarray, np.ndarray]:
    """Moment per deflection, and deflection per normalised command, from small commands in trim.

    Two aircraft fly side by side, one with the command: in their difference the aircraft's own
    motion in an imperfect trim cancels.
    """
    moments, per_command = np.zeros((3, 3)), np.zeros(3)
    for k, position in enumerate(_POSITIONS):
        steered, trimmed = again(), again()
        before = steered[position]
        _set_commands(steered, _commands(steered) + small * np.eye(3)[k])
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


def _roll_damping(again: Callable[[], "FGFDMExec"], steps: int = 6) -> float:
    """Aerodynamic rolling moment per roll rate, from a moment that acts for 0.05 s in trim."""
    rolling, trimmed = again(), again()
    # 1 rad/s^2: small rates, at which the moment is linear
    inertia = rolling["inertia/ixx-slugs_ft2"] * slug * foot**2
    _set_loads(rolling, np.zeros(3), np.array([inertia * 1.0, 0.0, 0.0]))
    for _ in range(steps):
        rolling.run()
        trimmed.run()
    change = _moments(rolling)[0] - _moments(trimmed)[0]
    return float(change / (rolling["velocities/p-rad_sec"] - trimmed["velocities/p-rad_sec"]))


def _strips(fdm: "FGFDMExec", lift_slope: float) -> Strips:
    """Wing, and the tail surfaces that JSBSim knows."""
    arm = [fdm[f"metrics/aero-rp-{axis}-in"] - fdm[f"inertia/cg-{axis}-in"] for axis in AXES]
    place = np.array([-arm[0], 0.0, arm[2]]) * inch  # JSBSim's x is to the rear here, z up
    span, area = fdm["metrics/bw-ft"] * foot, fdm["metrics/Sw-sqft"] * foot**2
    surfaces = [wing_strips(span, area, lift_slope, place=place)]
    tail, fin = (fdm[f"metrics/S{which}-sqft"] * foot**2 for which in "hv")
    if tail > 0:
        # JSBSim's arms are distances; x is forward
        behind = (-fdm["metrics/lh-ft"] * foot, 0.0, 0.0)
        strips = wing_strips(math.sqrt(TAIL_ASPECT_RATIO * tail), tail, lift_slope, place=behind)
        surfaces.append(in_downwash(strips, lift_slope, span**2 / area))
    if fin > 0:
        behind = (-fdm["metrics/lv-ft"] * foot, 0.0, 0.0)
        height = math.sqrt(FIN_ASPECT_RATIO * fin)
        surfaces.append(fin_strips(height, fin, lift_slope, place=behind))
    return joined(*surfaces)
