"""Bent and linked vortices, decay and wakes of aircraft, against theory and published numbers."""

import math

import numpy as np

from lidar_mi.atmosphere.vortices.aircraft_wake import TYPES, wake_of
from lidar_mi.atmosphere.vortices.crow import crow_filaments
from lidar_mi.atmosphere.vortices.filament_table import FilamentTable
from lidar_mi.atmosphere.vortices.vortex import tangential_speed, velocity, vortex_pair
from lidar_mi.atmosphere.vortices.wake_decay import sarpkaya_decay_time
from tests.support.filaments import CUTOFFS, crow_growth, ring

from .report import Check, Row

TITLE = "Bent vortices"
INTRODUCTION = (
    "Filaments with the cores of both models: rings, Crow's instability, and a pair 47.1 m apart "
    "with cores of 3 m, waves 405 m long. No random error: tolerances are those of the nodes."
)

MODELS = ("lamb_oseen", "burnham_hallock")
B, WAVE, CORE = 47.1, 405.0, 3.0


def rings(effort):
    """Rings of 40 m and straight lines."""
    rows = []
    for model in MODELS:
        thin = ring(40.0, 0.4, model)
        for z in (0.0, 20.0, 150.0):
            expected = 40.0**2 / 2 / (40.0**2 + z**2) ** 1.5
            got = thin.velocity(np.array([[0.0, 0.0, z]]))[0, 2]
            rows.append(
                Row(
                    f"ring, {model}: velocity on the axis at {z:g} m, over Gamma, 1/m",
                    "R^2 / 2 (R^2 + z^2)^(3/2)",
                    expected,
                    float(got),
                    tolerance=5e-4 * expected,
                )
            )
        core = 0.25
        uniform = 2 * math.exp(-0.25) * CUTOFFS[model] * core
        expected = (math.log(8 * 40 / uniform) - 0.25) / (4 * math.pi * 40)
        one = ring(40.0, core, model)
        got = one.velocity(one.curves[0].places[:1])[0, 2]
        rows.append(
            Row(
                f"ring, {model}: its own speed, over Gamma, 1/m",
                "Kelvin 1867, cut-off of Crow 1970",
                expected,
                float(got),
                tolerance=2e-3 * expected,
            )
        )
        places = np.random.default_rng(2).uniform((-900, -60, -40), (900, 60, 40), (300, 3))
        found = crow_filaments(0.0, B, WAVE, CORE, model).velocity(places)
        straight = velocity(vortex_pair(1.0, B, CORE, model=model), places[:, 1], places[:, 2])
        error = np.abs(found[:, 1:].T - straight).max() / tangential_speed(CORE, 1.0, CORE, model)
        name = f"straight lines, {model}: largest difference over the largest swirl"
        rows.append(Row(name, "profile of the model", 0.0, float(error), tolerance=2e-5))
    return Check(
        "Rings and lines", "The kernels of Biot and Savart with both core models.", tuple(rows)
    )


def instability(effort):
    """The fastest symmetric wave at the cut-off of 0.063 separations."""
    rows = []
    for model in MODELS:
        rate, plane = crow_growth(8.6, 0.063 / CUTOFFS[model], model)
        rows += [
            Row(f"growth rate, {model}, of Gamma / 2 pi b^2", "Crow 1970", 0.83, rate, 0, 0.01),
            Row(f"plane, {model}", "Crow 1970", 48.0, plane, 0, 0.5, "degrees"),
        ]
    text = "Waves with a length of 8.6 separations: growth rate and plane follow from the "
    "velocity of slightly displaced lines."
    return Check("Crow's instability", text, tuple(rows))


def conservation(effort):
    """Divergence and circulation of waves and rings, and the table."""
    rows, random, h = [], np.random.default_rng(1), 0.1
    for amplitude, name in ((10.0, "waves of 10 m"), (40.0, "rings")):
        lines = crow_filaments(amplitude, B, WAVE, CORE)
        nodes = np.concatenate([curve.places for curve in lines.curves])
        places = nodes[random.integers(len(nodes), size=300)] + random.normal(0, CORE, (300, 3))
        gradient = np.empty((3, 3, 300))
        for axis in range(3):
            ahead, behind = (lines.velocity(places + s * h * np.eye(3)[axis]) for s in (1, -1))
            gradient[axis] = (ahead - behind).T / (2 * h)
        size = np.sqrt((gradient**2).sum((0, 1)))
        found = np.abs(np.einsum("iin->n", gradient)).max() / size.max()
        what = f"{name}: divergence over the gradient, largest"
        rows.append(Row(what, "continuity", 0.0, float(found), tolerance=5e-4))
        port = nodes[nodes[:, 1] > 0]
        middle = port[np.argmin(np.abs(port[:, 0] - WAVE / 4))]
        angle = 2 * np.pi * np.arange(256) / 256
        circle = np.stack([0 * angle, np.cos(angle), np.sin(angle)], axis=1)
        around = np.stack([0 * angle, -np.sin(angle), np.cos(angle)], axis=1)
        loop = (lines.velocity(middle + 12 * circle) * around).sum() * 12 * 2 * np.pi / 256
        rows.append(
            Row(f"{name}: line integral, over Gamma", "Stokes", 1.0, float(loop), tolerance=2e-5)
        )
        table = FilamentTable(lines, WAVE / 4)
        swirl = tangential_speed(CORE, 1.0, CORE)
        error = (table.velocity(places.T).T - lines.velocity(places)) / swirl
        what = f"{name}: table over the largest swirl, rms near the lines"
        rms = float(np.sqrt((error**2).mean()))
        rows.append(Row(what, "sum over the nodes", 0.0, rms, tolerance=2e-3))
    return Check(
        "Waves and rings", "Interpolated tables of the velocity, for cores of 3 m.", tuple(rows)
    )


def wakes(effort):
    """Decay, and the wake of an airliner."""
    left = math.exp(-40.0 / sarpkaya_decay_time(458.0, B, 7.87e-8))
    kind = TYPES["A343"]
    found = wake_of(kind.span, kind.landing_mass, 75.0, 1.19)
    lift = 1.19 * 75.0 * found.circulation * found.separation / 9.80665
    rows = (
        Row(
            "circulation left after 40 s at eps* = 0.01",
            "large eddy simulation, N* = 0.35",
            439 / 458,
            left,
            tolerance=0.05,
        ),
        Row("A343, separation", "the paper", 47.1, found.separation, 0, 0.5, "m"),
        Row("A343, lift over g", "Kutta and Joukowski", 190e3, lift, 0, 1.0, "kg"),
    )
    text = (
        "The simulation is that of the shipped wakes, in stratified air; Sarpkaya's law is for "
        "air without stratification."
    )
    return Check("Decay and aircraft", text, rows)


CHECKS = (rings, instability, conservation, wakes)
