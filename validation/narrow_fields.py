"""Light of order two and three in fields of view of 0.05 to 20 mrad, and of bistatic lidars."""

import math
from dataclasses import replace
from itertools import product

import drjit as dr
import mitsuba as mi
import numpy as np

from .report import Check, Row, mean_and_error, spread
from .scenes import batches, layer, medium, scene
from .second_order import Bistatic, second_order

TITLE = "Narrow fields of view"
INTRODUCTION = (
    "A pencil beam, a telescope of finite size and a homogeneous slab. The reference is "
    "[a quadrature](../../validation/second_order.py) of the light scattered twice, in double "
    "precision and coordinates without singularity: errors of 1e-4. Where the field of view is "
    "narrow, the last vertex lies millimetres from the beam and the excess length of a path is a "
    "millionth of it: single precision that cancels would lose light here."
)
REFERENCE = "quadrature (numpy, scipy)"
QUADRATURE = 5e-4
"""Systematic uncertainty of the reference, relative."""

FIELDS = (0.05e-3, 0.1e-3, 0.25e-3, 0.5e-3, 1e-3, 5e-3, 20e-3)
PHASES = {"isotropic": 0.0, "g = 0.85": 0.85, "g = 0.95": 0.95, "Rayleigh": None}
# aperture (m), slab and gate (m): of a field of view any of these by turns
PLACES = (
    {"aperture": 0.02},
    {"aperture": 0.2},
    {"aperture": 0.5, "gate": (140.0, 148.0)},
    {"aperture": 0.1, "slab": (1000.0, 1200.0), "gate": (1050.0, 1060.0)},
    {"aperture": 0.3, "extinction": 0.01, "slab": (40.0, 60.0), "gate": (45.0, 50.0)},
)
BATCHES = 32


def pencil(case: Bistatic, estimator="gated", orders=2):
    """The same case for the renderer."""
    phase = {"type": "hg", "g": case.asymmetry}
    phase = "rayleigh_polarized" if case.asymmetry is None else phase
    across = [math.degrees(angle) for angle in case.tilt]
    place = mi.ScalarTransform4f().translate([case.origin[1], case.origin[2], 0.0])
    return scene(
        case.gate,
        {"slab": layer(*case.slab, medium(case.extinction, phase, case.albedo))},
        laser={
            "beam_radius": 1e-6,
            "divergence_full_mrad": 0.0,
            "to_world": place.rotate([0, 1, 0], across[0]).rotate([1, 0, 0], -across[1]),
        },
        integrator={"estimator": estimator, "max_order": orders, "orders": True},
        gate_kind="spherical",
        aperture_radius=case.aperture,
        fov_half_mrad=1e3 * case.fov_half,
    )


def _cases():
    """Each field of view with each phase function, places by turns."""
    for number, (field, (name, g)) in enumerate(product(FIELDS, PHASES.items())):
        place = PLACES[number % len(PLACES)]
        label = f"{1e3 * field:g} mrad, {name}, {place['aperture']:g} m"
        if "slab" in place:
            label += f", from {place['slab'][0]:g} m"
        yield number, label, Bistatic(fov_half=field, asymmetry=g, **place)


def _row(label, got, expected, error, tolerance=QUADRATURE):
    return Row(label, REFERENCE, 1.0, got / expected, error / expected, tolerance)


def _order_two(case, seed, samples):
    """Mean and error of I and Q of order two alone."""
    found = {k: v[:, 0, 0, 0] for k, v in batches(pencil(case), seed, samples, BATCHES).items()}
    # the laser's polarisation, or none, is that of order one
    first = found["order1.S0"] if case.asymmetry is None else 0
    return mean_and_error(np.stack([found["order2.S0"], found["S1"] - first], -1))


def order_two(effort) -> Check:
    rows, scores = [], []
    for number, label, case in _cases():
        mean, error = _order_two(case, 10 + number, 4_000_000 * effort.scale)
        expected = second_order(case, 19)
        rows.append(_row(label, mean[0], expected[0], error[0]))
        scores.append((mean[0] - expected[0]) / error[0])
        if case.asymmetry is None:
            rows.append(
                Row(
                    f"{label}: degree of polarisation",
                    REFERENCE,
                    expected[1] / expected[0],
                    mean[1] / mean[0],
                    math.hypot(*error) / mean[0],
                    QUADRATURE,
                )
            )
    rows.append(spread("all fields and phase functions", REFERENCE, scores, BATCHES))
    return Check(
        "Light scattered twice",
        "Half angle of the field of view, phase function, radius of the telescope. Fields, phase "
        "functions, telescopes and ranges are combined; obtained over expected.",
        tuple(rows),
    )


def analog(effort) -> Check:
    """Gated and analog estimators, where analog paths still find the field of view."""
    rows = []
    for number, (field, g) in enumerate([(1e-3, 0.0), (5e-3, 0.85), (20e-3, None)]):
        case = Bistatic(fov_half=field, asymmetry=g, aperture=0.5)
        found = {}
        for estimator, samples in (("gated", 4_000_000), ("analog", 40_000_000)):
            images = batches(
                pencil(case, estimator, 3), 60 + number, samples * effort.scale, BATCHES
            )
            found[estimator] = [mean_and_error(images[f"order{k}.S0"].ravel()) for k in (2, 3)]
        for order, ours, other in zip((2, 3), found["gated"], found["analog"], strict=True):
            label = f"{1e3 * field:g} mrad, order {order}: gated over analog"
            error = math.hypot(ours[1], other[1]) / other[0]
            rows.append(Row(label, "analog estimator", 1.0, ours[0] / other[0], error))
    return Check(
        "Gated and analog paths",
        "The analog estimator draws free flights and closes no path.",
        tuple(rows),
    )


def gradients(effort) -> Check:
    rows = []
    for number, (field, (name, g)) in enumerate(product((0.1e-3, 1e-3), PHASES.items())):
        case = Bistatic(fov_half=field, asymmetry=g, aperture=0.1)
        expected, _, slope = second_order(case, 19)
        expected *= slope / case.extinction
        found = [
            _by_extinction(case, 1000 * number + k, 100_000 * effort.scale) for k in range(BATCHES)
        ]
        mean, error = mean_and_error(found)
        rows.append(_row(f"{1e3 * field:g} mrad, {name}", mean, expected, error))
    return Check(
        "Derivative by the extinction",
        "Of the light scattered twice, in forward mode; obtained over expected.",
        tuple(rows),
    )


def _by_extinction(case, seed, samples):
    loaded = pencil(case)
    integrator, params = loaded.integrator(), mi.traverse(loaded)
    integrator.lowest_order = 2
    (key,) = (k for k in params.keys() if k.endswith("sigma_t.value.value"))
    dr.enable_grad(params[key])
    dr.set_grad(params[key], 1.0)
    params.update()
    image = integrator.render_forward(loaded, params, seed=seed, spp=samples)
    return float(np.array(image)[0, 0, 0])


def bistatic(effort) -> Check:
    base = Bistatic(fov_half=2e-3, aperture=0.2)
    rows = []
    for number, (label, case) in enumerate(
        {
            "0.5 m beside": replace(base, origin=(0.0, 0.5, 0.0)),
            "turned by 1 degree": replace(base, tilt=(math.radians(1.0), 0.0)),
            "0.3 m above, turned back": replace(
                base, origin=(0.0, 0.0, 0.3), tilt=(0.0, -0.3 / 115.0)
            ),
            "Rayleigh, 0.5 m above": replace(base, asymmetry=None, origin=(0.0, 0.0, 0.5)),
        }.items()
    ):
        mean, error = _order_two(case, 90 + number, 4_000_000 * effort.scale)
        rows.append(_row(label, mean[0], second_order(case, 19)[0], error[0]))
    return Check(
        "Laser beside the telescope",
        "Light scattered twice of a bistatic lidar, field of view 2 mrad (half angle). In the "
        "first two rows the beam itself is out of view.",
        tuple(rows),
    )


CHECKS = (order_two, analog, gradients, bistatic)
