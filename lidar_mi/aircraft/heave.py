"""Rising and pitching of a rigid aircraft: linear equations about flight at constant speed.

The state is the vertical speed h' (m/s, up, across the path), the pitch angle theta (rad, nose up)
and its rate q (rad/s), all from the trim; the angle of attack by the aircraft's motion is
alpha = theta - h' / V. With the force F upwards and the moment M nose up,

    m h'' = F_alpha alpha + F_alpha' alpha' + F_q q + ..., I q' = M_alpha alpha + ...

(Etkin and Reid 1996, chapter 4).
"""

from dataclasses import dataclass

import numpy as np
from scipy.constants import g

from lidar_mi.aircraft.strips import TAIL_ASPECT_RATIO, finite_span_slope
from lidar_mi.schema.encounter import Aircraft


@dataclass(frozen=True, eq=False)
class Heave:
    """The equations s' = motion s + wind l + controls c, and the bending of both wing roots.

    The sum of both is bending s + bending_controls c - relief h'', and that of the wind itself.

    motion (3, 3): of the state (vertical speed in m/s, pitch in rad, pitch rate in rad/s).
    wind (3, 2): per force upwards (N) and moment (N m, nose down).
    controls (3, 2): per elevator and symmetric aileron (rad).
    bending (3,): N m per unit of the state: air loads.
    bending_controls (2,): N m per rad.
    relief: of the wing's mass, kg m.
    level_bending: sum of both bending moments of level flight, N m.
    """

    motion: np.ndarray
    wind: np.ndarray
    controls: np.ndarray
    bending: np.ndarray
    bending_controls: np.ndarray
    relief: float
    level_bending: float

    def rate(self, state: np.ndarray, loads: np.ndarray, controls: np.ndarray) -> np.ndarray:
        """s', shape (3,), of a state (3,), loads (2,) and controls (2,)."""
        return self.motion @ state + self.wind @ loads + self.controls @ controls

    def bent(self, state: np.ndarray, controls: np.ndarray, acceleration: float) -> float:
        """Sum of both bending moments (N m) without the wind's own; acceleration h'' in m/s^2."""
        return float(
            self.bending @ state + self.bending_controls @ controls - self.relief * acceleration
        )


def bending_of(
    aircraft: Aircraft,
    mass: float,
    pressure: float,
    speed: float,
    place: float,
    span: float,
    area: float,
) -> tuple[np.ndarray, float, float]:
    """`Heave.bending`, `Heave.relief` and `Heave.level_bending` of an elliptic wing.

    Lift and mass are spread as the chord, so that half a wing has both at 4 / (3 pi) of half the
    span.

    aircraft: the lift slope of its sections, the wing's part of the mass.
    mass, pressure, speed: kg, dynamic pressure in Pa, m/s.
    place: of the wing, x in the body frame, m.
    span, area: m and m^2.
    """
    arm = 4 / (3 * np.pi) * span / 2
    slope = finite_span_slope(aircraft.lift_slope, span**2 / area)
    bending = pressure * area * slope * arm * np.array([-1 / speed, 1.0, -place / speed])
    wing = aircraft.heave.wing_mass
    return bending, wing * mass * arm, (1 - wing) * mass * g * arm


@dataclass(frozen=True)
class AileronLift:
    """Ailerons between two stations of an elliptic wing, deflected to one side, per rad.

    lift: coefficient with the wing's area.
    bending: sum of both bending moments over dynamic pressure, area and span.
    """

    lift: float
    bending: float


def aileron_lift(aircraft: Aircraft) -> AileronLift:
    """Lift by the ailerons, from their rolling moment, by strips.

    A strip with the deflection d has the lift of the angle k d. With the integrals over the
    stations eta = 2 |y| / b, I_n = 4 / pi int eta^n sqrt(1 - eta^2) d eta, the rolling moment
    coefficient is a_2 k I_1 / 2, which gives k; lift a_1 k I_0 and bending a_1 k I_1 / 2 follow,
    with the slopes of their modes (`finite_span_slope`).
    """
    keys = aircraft.heave
    ends = np.array([keys.aileron_inner, keys.aileron_outer])
    chord = np.sqrt(1 - ends**2)
    area = np.diff(ends * chord + np.arcsin(ends))[0] * 2 / np.pi  # I_0
    first = -np.diff(chord**3)[0] * 4 / (3 * np.pi)  # I_1
    slope, roll_slope = (
        finite_span_slope(aircraft.lift_slope, aircraft.span**2 / aircraft.wing_area, n)
        for n in (1, 2)
    )
    effect = 2 * aircraft.aileron_power / (roll_slope * first)
    return AileronLift(slope * effect * area, slope * effect * first / 2)


def wing_place(aircraft: Aircraft) -> float:
    """x_w of the wing (m) with which the aircraft has its static margin.

    The neutral point is where the lifts of wing and tail by an angle of attack have no moment
    (Etkin and Reid 1996, section 2.3). Here the wing stands for wing and fuselage.
    """
    keys = aircraft.heave
    wing, tail, downwash = _slopes(aircraft)
    tail *= 1 - downwash
    margin = keys.static_margin * aircraft.wing_area / aircraft.span
    return float((keys.tail_arm * tail - margin * (wing + tail)) / wing)


def derivatives_of(aircraft: Aircraft, speed: float, density: float) -> np.ndarray:
    """Derivatives of an aircraft from its geometry, shape (2, 5), as `linear_heave` takes them.

    Wing and tail are lifting surfaces at x_w and x_t. By the aircraft's motion the air moves along
    the wing's normal with u_w = V alpha - q x_w, along the tail's with V alpha - q x_t less the
    downwash epsilon u_w, epsilon = 2 a / (pi A), that left the wing by (x_w - x_t) / V before. To
    first order in this delay the derivatives are those of Etkin and Reid 1996, chapter 5 (pitch
    rate, rate of the angle of attack). Lift is quasi-steady. V is in m/s, the density of the air in
    kg m^-3.
    """
    keys, pressure = aircraft.heave, 0.5 * density * speed**2
    wing, tail, downwash = _slopes(aircraft)
    wing, tail = wing * pressure, tail * pressure
    x_w, x_t = wing_place(aircraft), -keys.tail_arm
    delay = (x_w - x_t) / speed
    of_wing = wing * np.array([1.0, 0.0, -x_w / speed])
    of_tail = tail * np.array([1 - downwash, downwash * delay, (downwash * x_w - x_t) / speed])
    lift = pressure * aircraft.wing_area
    elevator = lift * aircraft.wing_area / aircraft.span * keys.elevator_power / keys.tail_arm
    ailerons = lift * aileron_lift(aircraft).lift
    force = [*(of_wing + of_tail), elevator, ailerons]
    return np.array([force, [*(x_w * of_wing + x_t * of_tail), x_t * elevator, x_w * ailerons]])


def linear_heave(
    derivatives: np.ndarray,
    mass: float,
    inertia: float,
    speed: float,
    bending: tuple[np.ndarray, float, float],
    aileron_bending: float = 0.0,
) -> Heave:
    """The equations of an aircraft with these derivatives.

    derivatives (2, 5): force upwards (N) and moment nose up (N m) per angle of attack (rad), its
        rate (rad/s), pitch rate (rad/s), elevator (rad, nose down) and symmetric aileron (rad).
    mass, inertia, speed: kg, kg m^2, m/s.
    bending: from `bending_of`.
    aileron_bending: sum of both bending moments per symmetric aileron, N m per rad.
    """
    lift, lag, damping = derivatives[:, :3].T
    # per vertical speed, pitch, pitch rate; up, nose down; elevator, symmetric aileron
    known = np.column_stack(
        [-lift / speed, lift, damping + lag, [1.0, 0.0], [0.0, -1.0], derivatives[:, 3:]]
    )
    # alpha' = q - h'' / V
    matrix = np.array([[mass + lag[0] / speed, 0.0], [lag[1] / speed, inertia]])
    rise, pitch = np.linalg.solve(matrix, known)
    whole = np.array([rise, [0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0], pitch])
    outer = np.array([0.0, aileron_bending])
    return Heave(whole[:, :3], whole[:, 3:5], whole[:, 5:], bending[0], outer, *bending[1:])


def heave_of(aircraft: Aircraft, speed: float, density: float) -> Heave:
    """The equations of an aircraft from its geometry; parameters as of `derivatives_of`."""
    keys, pressure = aircraft.heave, 0.5 * density * speed**2
    span, area = aircraft.span, aircraft.wing_area
    bending = bending_of(aircraft, keys.mass, pressure, speed, wing_place(aircraft), span, area)
    outer = pressure * area * span * aileron_lift(aircraft).bending
    derivatives = derivatives_of(aircraft, speed, density)
    return linear_heave(derivatives, keys.mass, keys.pitch_inertia, speed, bending, outer)


def _slopes(aircraft: Aircraft) -> tuple[float, float, float]:
    """Lift per dynamic pressure and angle of wing and tail (m^2 per rad), and the downwash."""
    ratio = aircraft.span**2 / aircraft.wing_area
    slope = finite_span_slope(aircraft.lift_slope, ratio)
    tail = finite_span_slope(aircraft.lift_slope, TAIL_ASPECT_RATIO)
    downwash = 2 * slope / (np.pi * ratio)
    return slope * aircraft.wing_area, tail * aircraft.heave.tail_area, downwash
