"""Air about a wake: turbulence, gusts and a microburst against theory and regulations."""

import numpy as np

from lidar_mi.aircraft.roll_model import RollModel
from lidar_mi.aircraft.state import Commands, loads_in_wind
from lidar_mi.aircraft.strips import Loads
from lidar_mi.atmosphere.air.gust import Gust
from lidar_mi.atmosphere.air.microburst import Microburst
from lidar_mi.atmosphere.air.standards import (
    design_gust_speed,
    flight_profile_alleviation,
    mil_f_8785c,
)
from lidar_mi.atmosphere.air.turbulence import turbulence
from lidar_mi.schema.encounter import Aircraft, Path
from tests.support.turbulence import (
    correlations,
    finer_variance,
    line_spectra,
    plunge,
    plunge_variance,
    roll_rate_variance,
)

from .report import Check, Row

TITLE = "Air about a wake"
INTRODUCTION = (
    "Synthesised turbulence of 1.5 m/s rms and the length 150 m, without waves of less than 3 m, "
    "in 60 realisations, whose scatter gives sigma; gusts and a microburst against the numbers of "
    "their sources."
)

SIGMA, LENGTH, SHORTEST = 1.5, 150.0, 3.0
REALISATIONS = 60
FOOT = 0.3048


def _fields(effort, first=700):
    seeds = range(first, first + REALISATIONS * effort.scale)
    return [turbulence(SIGMA, LENGTH, seed, shortest=SHORTEST) for seed in seeds]


def _row(name, reference, samples, expected, unit=""):
    """The mean over realisations, with its standard error."""
    samples = np.asarray(samples, float)
    sigma = samples.std(ddof=1) / np.sqrt(len(samples))
    return Row(name, reference, float(expected), float(samples.mean()), float(sigma), unit=unit)


def statistics(effort):
    """Variance, structure functions, spectra along a flight."""
    fields, rows = _fields(effort), []
    missing = finer_variance(SIGMA, LENGTH, SHORTEST)
    random = np.random.default_rng(1)
    here = random.uniform(-5000, 5000, (3, 500))
    winds = [np.stack(field.velocity(*here, 0.0)) for field in fields]
    for axis, name in enumerate("uvw"):
        variance = [(wind[axis] ** 2).mean() for wind in winds]
        rows.append(_row(f"variance of {name}", "spectrum", variance, SIGMA**2 - missing, "m2/s2"))
    for r in (10.0, 30.0, 100.0):
        change = [
            np.stack(field.velocity(here[0] + r, *here[1:], 0.0)) - wind
            for field, wind in zip(fields, winds, strict=True)
        ]
        for what, square, one in zip(
            ("along", "across"),
            ([(c[0] ** 2).mean() for c in change], [(c[1:] ** 2).mean() for c in change]),
            correlations(r, LENGTH),
            strict=True,
        ):
            expected = 2 * SIGMA**2 * (1 - one) - 2 * missing
            name = f"structure function {what} {r:g} m"
            rows.append(_row(name, "von Karman's correlation", square, expected, "m2/s2"))
    step, count = 1.5, 4096
    window = np.hanning(count)
    k1 = 2 * np.pi * np.fft.rfftfreq(count, step)
    laws = line_spectra(k1, SIGMA, LENGTH, SHORTEST)
    flown = [field.velocity(step * np.arange(count), 0.0, 0.0, 0.0) for field in fields]
    for component, law in ((0, laws[0]), (2, laws[1])):
        density = [
            np.abs(np.fft.rfft(window * wind[component])) ** 2
            * (2 * step / (2 * np.pi * (window**2).sum()))
            for wind in flown
        ]
        for low in (0.01, 0.05, 0.2):
            octave = (k1 >= low) & (k1 < 2 * low)
            ratio = [(one[octave] / law[octave]).mean() for one in density]
            name = f"spectrum of {'uvw'[component]} over the law, {low:g} to {2 * low:g} rad/m"
            rows.append(_row(name, "MIL-F-8785C, 3.7.1.2; CS 25.341(b)(2)", ratio, 1.0))
    return Check("Turbulence", "Von Karman's spectrum.", tuple(rows))


def divergence(effort):
    """Of turbulence with waves of 15 m and more, by central differences of 0.4 m."""
    field = turbulence(SIGMA, LENGTH, 4, shortest=15.0)
    place, h = np.random.default_rng(5).uniform(-500, 500, (3, 300)), 0.2
    gradient = np.empty((3, 3, 300))
    for axis in range(3):
        shift = h * np.eye(3)[axis][:, None]
        ahead, behind = (field.velocity(*(place + sign * shift), 0.0) for sign in (1, -1))
        gradient[axis] = np.subtract(ahead, behind) / (2 * h)
    size = np.sqrt((gradient**2).sum((0, 1)).mean())
    found = np.sqrt((np.einsum("iin->n", gradient) ** 2).mean()) / size
    k, (a, b) = field.waves[:3], field.amplitudes
    along = max(np.abs((k.T * one).sum(1)).max() for one in (a, b)) / np.abs(k).max()
    rows = (
        Row("divergence over the gradient, rms", "continuity", 0.0, float(found), tolerance=2e-3),
        Row("amplitudes along their waves", "continuity", 0.0, float(along), tolerance=1e-12),
    )
    text = "Finite differences leave 2e-4 of the gradient; the amplitude of each wave is exactly "
    "perpendicular to its wave vector."
    return Check("Divergence of turbulence", text, rows)


def aircraft(effort):
    """Responses against the integral of spectrum times transfer function."""
    fields = _fields(effort, 800)
    mass, area, speed, slope, density = 1000.0, 16.2, 60.0, 4.9, 1.2
    tau = mass / (0.5 * density * speed * area * slope)
    time = 0.02 * np.arange(3000)
    lifted = [
        (plunge(field.velocity(speed * time, 0.0, 0.0, time)[2], 0.02, tau)[500:] ** 2).mean()
        for field in fields
    ]
    expected = plunge_variance(SIGMA, LENGTH, SHORTEST, speed, tau)
    rolled, time = [], 0.025 * np.arange(1600)
    for field in fields:
        model = RollModel(Aircraft(), Path(climb_angle=0.0))
        loads = loads_in_wind(model.strips, model.state, field.velocity, model.density, time)
        rates = []
        for force, moment in zip(loads.force, loads.moment, strict=True):
            rates.append(model.state.roll_rate)
            model.step(0.025, Loads(force, moment), Commands())
        rolled.append(1e6 * np.square(rates)[80:].mean())
    model = RollModel(Aircraft(), Path(climb_angle=0.0))
    rows = (
        _row(
            "Cessna 172, variance of the vertical acceleration",
            "integral of spectrum |H|^2",
            lifted,
            expected,
            "m2/s4",
        ),
        _row(
            "Boeing 737, variance of the roll rate",
            "correlation between the strips",
            rolled,
            1e6 * roll_rate_variance(SIGMA, LENGTH, model),
            "mrad2/s2",
        ),
    )
    text = (
        "A point mass that rises with its lift, and the aircraft of `encounter`, which rolls: "
        "its wing averages waves shorter than its span."
    )
    return Check("Aircraft in turbulence", text, rows)


def regulations(effort):
    """Numbers of the standards, in SI units by hand."""
    gust = Gust("up", 50.0, 200.0, design_gust_speed(0.0, 50.0))
    profile = gust.velocity(np.array([225.0, 250.0, 275.0]), 0.0, 0.0, 0.0)[2]
    burst = Microburst(15.0, 600.0, 60.0, 0.0)
    r, z = np.meshgrid(np.linspace(500, 900, 401), np.linspace(30, 100, 141))
    outflow = burst.velocity(r, 0.0, z, 0.0)[0]
    where = np.unravel_index(outflow.argmax(), outflow.shape)
    cs, mil, nasa = "CS 25.341(a)", "MIL-F-8785C, 3.7", "NASA TM-100632"
    peak = 17.07 * (50 / 106.68) ** (1 / 6)
    rows = (
        Row("gust of 50 m at sea level, largest", cs, peak, profile[1], 0, 0.01, "m/s"),
        Row("the same half way up", cs, peak / 2, profile[0], 0, 0.01, "m/s"),
        Row(
            "gust of 350 ft at 15000 ft, true airspeed",
            f"{cs}, density 0.6292",
            44 * FOOT / 0.6292**0.5,
            design_gust_speed(15000 * FOOT, 350 * FOOT),
            0,
            0.01,
            "m/s",
        ),
        Row(
            "alleviation factor at sea level, 40000 ft, R1 = 0.85, R2 = 0.8",
            cs,
            0.8171,
            flight_profile_alleviation(0.0, 12192.0, 0.85, 0.8),
            0,
            1e-4,
        ),
        Row(
            "rms at 300 ft, moderate",
            mil,
            1.5433,
            mil_f_8785c(91.44, "moderate")[0],
            0,
            1e-3,
            "m/s",
        ),
        Row("rms at 7500 ft, severe", mil, 7.193, mil_f_8785c(2286.0, "severe")[0], 0, 2e-3, "m/s"),
        Row("microburst, largest outflow", nasa, 15.0, float(outflow.max()), 0, 0.03, "m/s"),
        Row("its radius over that of the downdraft", nasa, 1.1212, r[where] / 600, 0, 2e-3),
        Row("its height", nasa, 60.0, z[where], 0, 1.0, "m"),
    )
    return Check(
        "Gusts, standards, microburst",
        "The functions of the gusts and of the microburst against numbers in their sources.",
        rows,
    )


CHECKS = (statistics, divergence, aircraft, regulations)
