"""All orders in a dense slab against a simulation without common code."""

import math
import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import cache

import numpy as np

from . import figures
from .report import SIGMAS, Check, Row, mean_and_error, spread
from .scenes import batches, grid, layer, medium, scene
from .transport_reference import Case, simulate

TITLE = "Multiple scattering"
INTRODUCTION = (
    "A slab of 100 m and optical thickness 2 in a vacuum, 500 m away, in ten gates of 10 m, with "
    "six orders of scattering. In its last gates multiple scattering exceeds single scattering. "
    "The reference is [an analog simulation](../../validation/transport_reference.py) in numpy, "
    "with double precision, its own Stokes algebra and no code in common with the plugins. "
    "Standard errors of both sides are from independent batches."
)
REFERENCE = "independent simulation (numpy)"

RAYLEIGH = Case()
FORWARD = Case(asymmetry=0.7, albedo=0.95, fov_half=20e-3)
ORDERS, BATCHES = 6, 64
SAMPLES = {RAYLEIGH: 6_000_000, FORWARD: 16_000_000}  # of the reference
RENDERED = {"gated": 4_000_000, "analog": 8_000_000}


@cache
def reference(case: Case, samples: int) -> np.ndarray:
    """Batches of the independent simulation, (batches, gates, orders, 2)."""
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        runs = pool.map(
            lambda seed: simulate(case, samples // BATCHES, ORDERS, seed)[0], range(BATCHES)
        )
        return np.stack(list(runs))


def dense(case: Case, estimator: str, interior: dict | None = None, orders: int = ORDERS):
    """The same slab for the renderer."""
    phase = "rayleigh_polarized" if case.asymmetry is None else {"type": "hg", "g": case.asymmetry}
    return scene(
        (case.gates[0], case.gates[-1]),
        {"slab": layer(*case.slab, interior or medium(case.extinction, phase, case.albedo))},
        laser={
            "beam_radius": case.beam_radius,
            "beam_cut": 100.0,
            "divergence_full_mrad": 2e3 * case.divergence_half,
        },
        integrator={"estimator": estimator, "max_order": orders, "orders": True},
        gate_count=len(case.gates) - 1,
        gate_kind="spherical",
        aperture_radius=case.aperture,
        fov_half_mrad=1e3 * case.fov_half,
    )


def rendered(case, estimator, seed, samples, interior=None, number=BATCHES):
    """Batches of I by order (batches, gates, orders), and of I and Q (batches, gates)."""
    found = batches(dense(case, estimator, interior), seed, samples, number)
    found = {name: values[..., 0, 0] for name, values in found.items()}
    by_order = np.stack([found[f"order{k}.S0"] for k in range(1, ORDERS + 1)], -1)
    return by_order, found["S0"], found["S1"]


def difference(name, ours, other, reference=REFERENCE):
    """A row from batches of both sides."""
    (got, error), (expected, other_error) = mean_and_error(ours), mean_and_error(other)
    return Row(name, reference, expected, got, math.hypot(error, other_error))


def scores(ours, other):
    """z-scores of batches of both sides, element by element."""
    (got, error), (expected, other_error) = mean_and_error(ours), mean_and_error(other)
    return (got - expected) / np.hypot(error, other_error)


def depolarisation(i, q):
    """Ratio and its batches: linear in the deviations of the batches from their mean."""
    mean_i, mean_q = i.mean(0), q.mean(0)
    ratio = (mean_i - mean_q) / (mean_i + mean_q)
    slope = 2 / (mean_i + mean_q) ** 2
    return ratio + slope * (mean_q * (i - mean_i) - mean_i * (q - mean_q))


def _compare(case, label, effort):
    other = reference(case, SAMPLES[case] * effort.scale)
    rows, images = [], {}
    for number, (estimator, samples) in enumerate(RENDERED.items()):
        by_order, i, q = rendered(case, estimator, 100 + number, samples * effort.scale)
        images[estimator] = by_order, i, q
        rows.append(
            difference(f"{estimator}: all gates and orders", i.sum(1), other[..., 0].sum((1, 2)))
        )
        rows += [
            difference(
                f"{estimator}: order {k + 1}, all gates",
                by_order[..., k].sum(1),
                other[:, :, k, 0].sum(1),
            )
            for k in range(ORDERS)
        ]
        rows.append(
            difference(f"{estimator}: last gate, all orders", i[:, -1], other[:, -1, :, 0].sum(1))
        )
        rows.append(
            spread(
                f"{estimator}: gate by gate", REFERENCE, scores(i, other[..., 0].sum(2)), BATCHES
            )
        )
        if case.asymmetry is None:
            ratio = depolarisation(i, q)
            expected = depolarisation(*np.moveaxis(other.sum(2), -1, 0))
            rows.append(
                difference(
                    f"{estimator}: depolarisation ratio, last gate", ratio[:, -1], expected[:, -1]
                )
            )
            rows.append(
                spread(
                    f"{estimator}: depolarisation, gate by gate",
                    REFERENCE,
                    scores(ratio, expected),
                    BATCHES,
                )
            )
    caption = _draw_orders(effort.folder / f"orders_{label}.png", case, images["gated"][0], other)
    drawn = [(f"orders_{label}.png", caption)]
    if case.asymmetry is None:
        place = effort.folder / f"depolarisation_{label}.png"
        _draw_depolarisation(place, case, images, other)
        drawn.append((place.name, "Linear depolarisation ratio of all orders together."))
    return tuple(rows), tuple(drawn)


def _draw_orders(place, case, ours, other):
    range_ = (np.array(case.gates[1:]) + case.gates[:-1]) / 2
    with figures.figure(place, (7, 4)) as axis:
        for k in range(ORDERS):
            expected, other_error = mean_and_error(other[:, :, k, 0])
            got, error = mean_and_error(ours[..., k])
            colour = f"C{k}"
            lower = np.maximum(expected - 2 * other_error, 1e-14)
            axis.plot(range_, expected, color=colour, linewidth=0.8, alpha=0.6)
            axis.fill_between(
                range_, lower, expected + 2 * other_error, color=colour, alpha=0.35, linewidth=0
            )
            axis.errorbar(range_, got, 2 * error, fmt=".", color=colour, label=f"order {k + 1}")
        axis.plot(range_, other[..., 0].sum(2).mean(0), color=figures.REFERENCE, label="sum")
        axis.set(yscale="log", xlabel="range, m", ylabel="received / emitted energy")
        axis.set_ylim(bottom=other[:, :, -1, 0].mean(0)[1:].min() / 3)
        axis.legend(frameon=False, ncols=2, fontsize=8)
    return "Order by order: points rendered (gated), lines and bands the reference; 2 sigma each."


def _draw_depolarisation(place, case, images, other):
    range_ = (np.array(case.gates[1:]) + case.gates[:-1]) / 2
    expected, error = mean_and_error(depolarisation(*np.moveaxis(other.sum(2), -1, 0)))
    with figures.figure(place) as axis:
        axis.fill_between(
            range_,
            expected - 2 * error,
            expected + 2 * error,
            color="0.75",
            label="independent simulation, 2 sigma",
        )
        for (estimator, (_, i, q)), colour, shift in zip(
            images.items(), (figures.OURS, figures.OTHER), (-0.7, 0.7), strict=True
        ):
            got, own = mean_and_error(depolarisation(i, q))
            axis.errorbar(range_ + shift, got, 2 * own, fmt=".", color=colour, label=estimator)
        axis.set(xlabel="range, m", ylabel="linear depolarisation ratio", ylim=(0, None))
        axis.legend(frameon=False)


def molecules(effort):
    """The dense case with Rayleigh scattering, intensity and depolarisation."""
    rows, drawn = _compare(RAYLEIGH, "rayleigh", effort)
    return Check(
        "Dense slab of molecules",
        "Extinction 0.02 / m, albedo 1, Rayleigh scattering of light polarised along e_h; "
        "Gaussian beam of 0.1 m radius and 1 mrad half divergence, telescope 0.5 m, field of "
        "view 50 mrad half.",
        rows,
        drawn,
    )


def forward_peak(effort):
    """The dense case with a forward-peaked phase function."""
    rows, drawn = _compare(FORWARD, "forward", effort)
    return Check(
        "Dense slab of forward scatterers",
        "The same with Henyey-Greenstein g = 0.7, albedo 0.95, field of view 20 mrad half.",
        rows,
        drawn,
    )


def majorants(effort):
    """The slab as a grid: null collisions with any majorant."""
    other = reference(RAYLEIGH, SAMPLES[RAYLEIGH] * effort.scale)
    low, high = (500.0, -1000.0, -1000.0), (600.0, 1000.0, 1000.0)
    rows = []
    for factor in (1, 4, 20):
        values = np.full((20, 20, 2), RAYLEIGH.extinction)
        values[-1, -1, -1] *= factor  # 900 m from the beam
        by_order, i, _ = rendered(
            RAYLEIGH, "gated", 200 + factor, 640_000 * effort.scale, grid(values, low, high), 32
        )
        name = f"majorant x {factor}"
        rows.append(
            difference(
                f"{name}: all gates, orders above one",
                by_order[..., 1:].sum((1, 2)),
                other[:, :, 1:, 0].sum((1, 2)),
            )
        )
        rows.append(spread(f"{name}: gate by gate", REFERENCE, scores(i, other[..., 0].sum(2)), 32))
    return Check(
        "Any majorant",
        "The dense slab of molecules as a grid. One distant voxel raises the majorant of the "
        "whole grid, which must not change the result.",
        tuple(rows),
    )


def sharpness(effort):
    """The reference is as accurate as stated: a standard error of at most 1 % in every gate."""
    rows = []
    for name, case in (("molecules", RAYLEIGH), ("forward scatterers", FORWARD)):
        mean, error = mean_and_error(reference(case, SAMPLES[case] * effort.scale)[..., 0].sum(2))
        rows.append(
            Row(
                f"{name}: largest standard error of the reference in a gate",
                "at most 1 %",
                0.0,
                (error / mean).max(),
                tolerance=0.01,
            )
        )
    # in closed form: the beam's single scattering, all of it in view
    case = replace(RAYLEIGH, divergence_half=1e-9, fov_half=0.2)
    found = np.stack([simulate(case, 20_000, 1, 500 + k)[0][:, 0, 0] for k in range(BATCHES)])
    range_ = (np.arange(500, 600, 0.01) + 0.005).reshape(10, -1)
    expected = (
        0.02
        * 3
        / (8 * math.pi)
        * math.pi
        * 0.25
        * np.exp(-0.04 * (range_ - 500))
        / range_**2
        * 0.01
    ).sum(1)
    got, error = mean_and_error(found)
    rows.append(
        Row(
            "the reference's own single scattering, all gates",
            "lidar equation",
            expected.sum(),
            got.sum(),
            mean_and_error(found.sum(1))[1],
            1e-5 * expected.sum(),
        )
    )
    rows.append(
        spread("the same, gate by gate", "lidar equation", (got - expected) / error, BATCHES)
    )
    return Check(
        "The reference itself",
        "Whether the comparisons above, which pass within "
        f"{SIGMAS} sigma, would detect a wrong reference.",
        tuple(rows),
    )


CHECKS = (molecules, forward_peak, majorants, sharpness)
