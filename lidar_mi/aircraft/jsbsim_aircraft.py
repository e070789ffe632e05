"""An aircraft of JSBSim (Berndt 2004) on which the wake's force and moment act.

JSBSim integrates the six degrees of freedom of an aircraft with its engines and control system.
The wake enters as a force at the centre of gravity and a moment (``external_reactions``); the
aircraft's own aerodynamics see air at rest. Its axes are x forward, y to starboard, z down.
"""

import math
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
from scipy.constants import foot, g, inch, slug

from lidar_mi.aircraft.heave import bending_of, linear_heave
from lidar_mi.aircraft.jsbsim_derivatives import (
    commands_of,
    control_moments,
    heave_derivatives,
    roll_damping_of,
    set_commands,
    set_loads,
)
from lidar_mi.aircraft.jsbsim_trim import FLAPS, STEP, check_aeroplane, such_as, trimmed
from lidar_mi.aircraft.state import LARGEST_ROLL, AircraftState, Commands, Limits, deflected
from lidar_mi.aircraft.strips import (
    FIN_ASPECT_RATIO,
    TAIL_ASPECT_RATIO,
    Loads,
    Strips,
    as_wing,
    fin_strips,
    in_downwash,
    joined,
    roll_damping,
    wing_strips,
)
from lidar_mi.errors import InputError, one_line
from lidar_mi.instrument.motion import attitude
from lidar_mi.io.jsbsim_files import AXES
from lidar_mi.schema.encounter import Aircraft, Path

if TYPE_CHECKING:
    from jsbsim import FGFDMExec

# trims of aileron, elevator and rudder
_TRIMS = ("fcs/roll-trim-cmd-norm", "fcs/pitch-trim-cmd-norm", "fcs/yaw-trim-cmd-norm")


class JSBSimAircraft:
    """An aircraft of JSBSim, trimmed on the path; a model of `aircraft.AircraftModel`.

    Its wing has JSBSim's span and area and lies at JSBSim's aerodynamic reference point; the tail
    has JSBSim's areas and arms. There are no symmetric ailerons. The controls move at the rate of
    `Aircraft.aileron_rate`, in addition to the dynamics of JSBSim's own actuators.

    aircraft: its model, the lift slope of the sections, the rate of the controls.
    path: speed, climb angle and altitude.

    Raises InputError: there is no JSBSim, or it has no such aircraft, or cannot load or start it;
    it is no aeroplane with an engine (`jsbsim_trim.check_aeroplane`), or does not trim on this
    path.
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
        self.density = air_density(self._fdm)
        self.strips = strips_of(self._fdm, aircraft.lift_slope)
        # derivatives take aircraft of their own, with the flaps of this one
        again = partial(trimmed, aircraft.model, path, [self._fdm["fcs/flap-cmd-norm"]])
        self.control_moments, self._per_command = control_moments(again)
        self._at_trim = commands_of(self._fdm)
        trims = self._at_trim + [self._fdm[name] for name in _TRIMS]
        # travel that the trim uses is not available to commands
        self.limits = Limits(
            np.abs(self._per_command) * np.clip(1 - np.abs(trims), 0, 1),
            np.where(self._per_command != 0, aircraft.aileron_rate, 0.0),
        )
        self.roll_damping = roll_damping_of(again)
        span, area, place = _wing(self._fdm)
        pressure = 0.5 * self.density * path.speed**2
        bending = bending_of(aircraft, self.mass, pressure, path.speed, place[0], span, area)
        inertia = self._fdm["inertia/iyy-slugs_ft2"] * slug * foot**2
        derivatives = heave_derivatives(again, self._per_command[1])
        self.heave = linear_heave(derivatives, self.mass, inertia, path.speed, bending)
        wing = as_wing(wing_strips(span, area, aircraft.lift_slope, place=place))
        self._wing_damping = roll_damping(wing, path.speed, self.density)
        self._roll_relief = aircraft.heave.wing_mass * self.mass * span**2 / 16  # elliptic chord
        self._trim = self._fdm["aero/alpha-rad"], self._fdm["accelerations/Nz"]
        self.deflection = np.zeros(3)
        self._origin = neu_place(self._fdm)
        self.state = self._read(0.0, np.zeros(2))

    @property
    def mass(self) -> float:
        """Mass now, kg."""
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
        set_loads(self._fdm, loads.force, loads.moment)
        for _ in range(count):
            self.deflection, _ = deflected(self.deflection, commands, dt / count, self.limits)
            set_commands(self._fdm, self._at_trim + self._normalised(self.deflection))
            try:
                self._fdm.run()
            except RuntimeError:  # JSBSim's own, of a state that it cannot compute
                self.state = replace(self.state, time=time, departed=True)
                return self.state
        self.state = self._read(time, loads.bending)
        return self.state

    def _normalised(self, deflection: np.ndarray) -> np.ndarray:
        """Commands of JSBSim, -1 to 1, for deflections in rad; 0 for a control without effect."""
        return np.divide(
            deflection, self._per_command, out=np.zeros(3), where=self._per_command != 0
        )

    def _read(self, time: float, by_wind: np.ndarray) -> AircraftState:
        """State in the path frame, with the wind's bending moments."""
        state = state_in_path(self._fdm, self._origin, self._climb, time)
        if state is None:
            return replace(self.state, time=time, departed=True)
        port, starboard = self._bent(by_wind)
        return replace(state, port_bending=port, starboard_bending=starboard)

    def _bent(self, by_wind: np.ndarray) -> tuple[float, float]:
        """Bending moments of port and starboard wing, changes from the trim, N m.

        JSBSim has no lift distribution along the span: it is that of strips of its wing at its roll
        rate and its angle of attack, which is by its motion alone.
        """
        fdm, (incidence, load_factor) = self._fdm, self._trim
        motion = np.array([0.0, fdm["aero/alpha-rad"] - incidence, fdm["velocities/q-rad_sec"]])
        rise = g * (fdm["accelerations/Nz"] - load_factor)
        total = self.heave.bent(motion, np.zeros(2), rise)
        difference = (
            self._wing_damping * fdm["velocities/p-rad_sec"]
            + self.control_moments[0, 0] * self.deflection[0]
            - self._roll_relief * fdm["accelerations/pdot-rad_sec2"]
        )
        port, starboard = by_wind + np.array([total + difference, total - difference]) / 2
        return float(port), float(starboard)


def state_in_path(
    fdm: "FGFDMExec", origin: np.ndarray, climb: float, time: float
) -> AircraftState | None:
    """The state of JSBSim in a path frame, without bending moments; None: it is not finite.

    The path goes north from an origin (m) as of `neu_place`, at an angle ``climb`` (rad).
    """
    north, east, up = neu_place(fdm) - origin
    northward, downward = (fdm[f"velocities/v-{to}-fps"] * foot for to in ("north", "down"))
    along, upward = math.cos(climb), math.sin(climb)
    # heading is clockwise seen from above, yaw is to port
    level = attitude(fdm["attitude/phi-rad"], fdm["attitude/theta-rad"], -fdm["attitude/psi-rad"])
    numbers = [north, east, up, *level.as_quat(), fdm["velocities/vt-fps"]]
    if not np.isfinite(numbers).all():
        return None
    # the path frame is inclined by the climb angle
    in_path = attitude(0.0, climb, 0.0).inv() * level
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
        vertical_speed=float(-downward * along - northward * upward),
        load_factor=fdm["accelerations/Nz"],
    )


def neu_place(fdm: "FGFDMExec") -> np.ndarray:
    """North, east, up, m."""
    return foot * np.array([fdm[f"position/from-start-neu-{axis}-ft"] for axis in "neu"])


def air_density(fdm: "FGFDMExec") -> float:
    """Density of the air at the aircraft, kg/m^3."""
    return fdm["atmosphere/rho-slugs_ft3"] * slug / foot**3


def _wing(fdm: "FGFDMExec") -> tuple[float, float, np.ndarray]:
    """Span (m), area (m^2) and place in the body frame (m)."""
    arm = [fdm[f"metrics/aero-rp-{axis}-in"] - fdm[f"inertia/cg-{axis}-in"] for axis in AXES]
    place = np.array([-arm[0], 0.0, arm[2]]) * inch  # JSBSim's x is to the rear here, z up
    return fdm["metrics/bw-ft"] * foot, fdm["metrics/Sw-sqft"] * foot**2, place


def strips_of(fdm: "FGFDMExec", lift_slope: float) -> Strips:
    """Wing, and the tail surfaces that JSBSim knows."""
    span, area, place = _wing(fdm)
    surfaces = [as_wing(wing_strips(span, area, lift_slope, place=place))]
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
