"""An aircraft that rises and pitches in gusts: closed forms, delays as they are."""

import numpy as np
from scipy.constants import g

from lidar_mi.aircraft.heave import derivatives_of, wing_place
from lidar_mi.aircraft.heave_model import HeaveModel
from lidar_mi.aircraft.state import Commands, loads_in_wind
from lidar_mi.schema.encounter import Aircraft, Path

from .report import Check, Row

TITLE = "Loads of gusts"
INTRODUCTION = (
    "The model `heave` of a Boeing 737 at 75 m/s and 300 m above sea level: 48.5 t, 108.8 m2, "
    "28.9 m, lift slope 5.3 of the sections, tail of 32.3 m2 14.64 m behind."
)
SPEED, AREA, SPAN, MASS, INERTIA = 75.0, 108.8, 28.9, 48500.0, 2.1e6
TAIL, ARM, GUST = 32.3, 14.64, 3.0
SLOPE = 5.3 / (1 + 5.3 * AREA / (np.pi * SPAN**2))
TAIL_SLOPE = 5.3 / (1 + 5.3 / (4 * np.pi))
DOWNWASH = 2 * SLOPE * AREA / (np.pi * SPAN**2)


def _model(**heave):
    return HeaveModel(Aircraft(model="heave", heave=heave), Path(climb_angle=0.0))


def _flown(model, duration, gust, step=0.01):
    """Time and change of the load factor in a vertical gust(x)."""
    rows = []
    for _ in range(round(duration / step)):
        state = model.state

        def wind(x, y, z, t):
            return 0 * x * y, 0 * x * y, gust(x + 0 * y)

        loads = loads_in_wind(model.strips, state, wind, model.density)
        model.step(step, loads, Commands())
        rows.append((model.state.time, model.state.load_factor - 1))
    return np.array(rows).T


def _sharp(density):
    """rho V a U / (2 W / S), the wing alone."""
    return density * SPEED * SLOPE * GUST * AREA / (2 * MASS * g)


def _plunging(tau, half):
    """Largest x of x' + x / tau = w', w = (1 - cos k t) / 2, over that of a sharp edge."""
    k, time = np.pi * SPEED / half, np.linspace(0, 2 * half / SPEED, 5000)
    x = np.sin(k * time) / tau - k * np.cos(k * time) + k * np.exp(-time / tau)
    return (k / 2 * x / (k**2 + tau**-2)).max()


def gusts(effort):
    """Sharp edge, 1-cosine, steady pull-up."""
    model = _model()
    first = 10.0
    time, load = _flown(model, 0.4, lambda x: GUST * (x > first), step=1e-3)
    enters = int(np.searchsorted(time, (first - wing_place(Aircraft())) / SPEED))
    later = int(np.searchsorted(time, (first + ARM) / SPEED))
    sharp, chord = _sharp(model.density), AREA / SPAN
    plunging, half = _model(pitch_inertia=1e9, tail_area=0.011), 12.5 * chord

    def cosine(x):
        inside = (x > 10) & (x < 10 + 2 * half)
        return np.where(inside, GUST / 2 * (1 - np.cos(np.pi * (x - 10) / half)), 0.0)

    largest = _flown(plunging, 2.5, cosine)[1].max()
    mu = 2 * MASS / (model.density * chord * AREA * SLOPE)
    pulled = _model()
    for _ in range(2500):
        state = pulled.step(
            0.01, loads_in_wind(pulled.strips, pulled.state, _calm, 1.0), Commands(elevator=-0.02)
        )
    pratt = "Pratt and Walker 1954"
    rows = (
        Row("sharp-edged gust of 3 m/s on the wing", pratt, sharp, load[enters + 1], 0, 2e-3),
        Row(
            "the same on the tail",
            "lift slopes and downwash",
            sharp * TAIL_SLOPE * TAIL / (SLOPE * AREA) * (1 - DOWNWASH),
            load[later + 1] - load[later - 1],
            0,
            1e-3,
        ),
        Row(
            "alleviation factor of 25 chords, rising alone",
            "quasi-steady lift, solved",
            _plunging(MASS / (model.density * SPEED * AREA * SLOPE / 2), half),
            largest / sharp,
            0,
            2e-3,
        ),
        Row("the same", f"{pratt}, without 0.88", mu / (5.3 + mu), largest / sharp, 0, 0.03),
        Row(
            "steady pull-up, load factor",
            "V q / g",
            SPEED * state.pitch_rate / g,
            state.load_factor - 1,
            0,
            1e-6,
        ),
    )
    text = (
        "Load factors, changes from level flight. Pratt's factor 0.88 mu / (5.3 + mu) is a fit for "
        "unsteady lift; without 0.88, its limit for heavy aircraft, it is near quasi-steady lift, "
        "the solution of x' + x / tau = w' for the gust w."
    )
    return Check("Discrete gusts", text, rows)


def _calm(x, y, z, t):
    return 0 * x * y, 0 * x * y, 0 * x * y


def _transfer(omega, density):
    """Load factor per gust at the centre of gravity, with the delay of the downwash as it is."""
    place, lift = wing_place(Aircraft()), 0.5 * density * SPEED
    wing, tail = lift * AREA * SLOPE, lift * TAIL * TAIL_SLOPE
    by_wing = np.array(
        [-1j * omega, SPEED - 1j * omega * place, np.exp(1j * omega * place / SPEED)]
    )
    by_tail = np.array([-1j * omega, SPEED + 1j * omega * ARM, np.exp(-1j * omega * ARM / SPEED)])
    by_tail = by_tail - DOWNWASH * np.exp(-1j * omega * (place + ARM) / SPEED) * by_wing
    force = wing * by_wing + tail * by_tail
    moment = wing * place * by_wing - tail * ARM * by_tail
    left = np.diag([-(omega**2) * MASS, -(omega**2) * INERTIA]) - [force[:2], moment[:2]]
    h, _ = np.linalg.solve(left, [force[2], moment[2]])
    return abs(omega**2 * h / g)


def response(effort):
    """Amplitude of the load factor in a sinusoidal gust of 1 m/s, and the short period."""
    rows = []
    for omega in (0.5, 1.0, 2.0, 4.0, 8.0):
        model, step = _model(), min(0.01, 0.02 / omega)
        duration = 10 + 4 * np.pi / omega
        time, load = _flown(model, duration, lambda x, k=omega / SPEED: np.cos(k * x), step)
        last = time > time[-1] - 4 * np.pi / omega
        basis = np.stack([np.cos(omega * time), np.sin(omega * time)], -1)[last]
        found = np.hypot(*np.linalg.lstsq(basis, load[last], rcond=None)[0])
        expected = _transfer(omega, model.density)
        name = f"load factor at {omega:g} rad/s, per m/s"
        rows.append(Row(name, "wing and tail, true delays", expected, found, 0, 0.03 * expected))
    model = _model()
    (f_alpha, _, f_q), (m_alpha, m_late, m_q) = derivatives_of(Aircraft(), SPEED, model.density)[
        :, :3
    ]
    turn = 1 - f_q / (MASS * SPEED)
    damping = f_alpha / (MASS * SPEED) - (m_q + m_late * turn) / INERTIA
    stiffness = -f_alpha / (MASS * SPEED) * m_q / INERTIA - m_alpha * turn / INERTIA
    modes = np.linalg.eigvals(model.heave.motion)
    pair = modes[np.abs(modes) > 1e-6]
    source = "Etkin and Reid 1996, section 6.3"
    rows += [
        Row("short period", source, stiffness**0.5, abs(pair[0]), 0, 0.015, "rad/s"),
        Row(
            "its damping ratio",
            source,
            damping / 2 / stiffness**0.5,
            -pair[0].real / abs(pair[0]),
            0,
            0.015,
        ),
    ]
    text = (
        "The reference is solved in the frequency domain, with the downwash as late at the tail as "
        "it is; the model continues it to first order."
    )
    return Check("Response to gusts", text, tuple(rows))


CHECKS = (gusts, response)
