"""Derivatives of a rendered image against those of the lidar equation."""

import drjit as dr
import mitsuba as mi
import numpy as np

from .gradients_of_orders import orders
from .lidar_equation import equation
from .report import Check, Row, mean_and_error
from .scenes import box, grid, scene

TITLE = "Gradients"
INTRODUCTION = (
    "The image is differentiable with respect to extinction, albedo, phase functions and the flow "
    "that carries the air. In a slab that varies only along the beam, single scattering has the "
    "derivatives of the lidar equation. Those of all orders are compared with differences of "
    "images."
)

KEY = "slab.interior_medium.sigma_t.data"
LOW, HIGH = 480.0, 520.0
CENTRES = LOW + 4 * (np.arange(10) + 0.5)
VALUES = 5e-3 * (1 + 0.5 * np.cos(np.arange(10)))
EDGES = np.array([500.0, 508.0])
SAMPLES, SEEDS = 400_000, 8


def signal(values):
    """Lidar equation for extinction that is linear between the cells' centres."""
    fine = np.linspace(LOW, HIGH, 400_001)
    extinction = np.interp(fine, CENTRES, values)
    step = fine[1] - fine[0]
    depth = np.concatenate([[0], np.cumsum((extinction[1:] + extinction[:-1]) / 2 * step)])
    breaks = [c for c in CENTRES if EDGES[0] < c < EDGES[1]]
    return equation(
        EDGES, lambda r: np.interp(r, CENTRES, values), lambda r: np.interp(r, fine, depth), breaks
    ).item()


def derivatives(effort):
    """Backward and forward mode."""
    low, high = (LOW, -20.0, -20.0), (HIGH, 20.0, 20.0)
    volume = np.broadcast_to(VALUES, (2, 2, 10))
    loaded = scene(
        (EDGES[0], EDGES[1]),
        {"slab": box(low, high, grid(volume, low, high))},
        gate_kind="spherical",
    )
    parameters = mi.traverse(loaded)
    scale = 1 / signal(VALUES)
    slopes = []
    for seed in range(SEEDS):
        dr.enable_grad(parameters[KEY])
        parameters.update()
        image = mi.render(loaded, parameters, spp=SAMPLES * effort.scale // SEEDS, seed=500 + seed)
        chosen = np.zeros(image.shape, np.float32)
        chosen[0, 0, 0] = scale
        dr.backward(dr.sum(image * mi.TensorXf(chosen)))
        slopes.append(np.array(dr.grad(parameters[KEY])).astype(float).sum((0, 1, 3)))
        dr.disable_grad(parameters[KEY])
    got, error = mean_and_error(slopes)
    rows = []
    for k, centre in enumerate(CENTRES):
        step = 1e-5 * (np.arange(10) == k)
        expected = scale * (signal(VALUES + step) - signal(VALUES - step)) / 2e-5
        rows.append(
            Row(
                f"d ln S / d E, plane of cells at {centre:g} m",
                "central differences of the lidar equation",
                expected,
                got[k],
                error[k],
                2e-5 * np.abs(expected).max() + 1e-4,
                "m",
            )
        )
    return Check(
        "Extinction grid",
        "Relative change of the signal of a gate from 500 to 508 m with the extinction of each "
        "of ten planes of cells (4 m thick, summed over the plane): attenuation in front of the "
        "gate, scattering and attenuation in it, no contribution behind it.",
        tuple(rows),
    )


CHECKS = (derivatives, orders)
