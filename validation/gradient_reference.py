"""Gradients of images against central differences of images with the same random numbers.

A slab is a grid of voxels, which a lidar with a wide field of view sees through two gates: its near
and its far half. Differences are taken without Russian roulette and with bounds of the extinction
that stay those of the middle: the same random numbers then give the same paths, and the difference
of two images has the noise of a derivative.
"""

import contextlib
from collections.abc import Iterator, Sequence
from unittest import mock

import drjit as dr
import mitsuba as mi
import numpy as np

from plugins import path_sampling

from .scenes import box, grid, scene

LOW, HIGH = np.array([500.0, -9.0, -9.0]), np.array([530.0, 9.0, 9.0])
SHAPE = (3, 3, 6)
GATES = ("near", "far")
SIDE = 6
"""Beams along either axis of the image, all the same: the scatter of an image over them is that of
independent repetitions."""
KEY = "slab.interior_medium.sigma_t.data"
ORDERS = 3


def extinction(depth: float, varied: bool) -> np.ndarray:
    """Extinction coefficient of voxels (z, y, x), m^-1; the optical depth is along x."""
    values = np.full(SHAPE, depth / (HIGH - LOW)[0])
    return values * np.random.default_rng(7).uniform(0.4, 1.6, SHAPE) if varied else values


def loaded(values: np.ndarray, phase, albedo: object = 0.9, max_order: int = ORDERS, flow=None):
    """The scene of a slab of voxels, a vacuum around it.

    With a ``flow``, (z, y, x, 3) in m/s, beams meet the air 0.1 s after the state of the voxels.
    """
    medium = grid(values, LOW, HIGH, phase, 1.0) | {"albedo": albedo}
    if flow is not None:
        medium["sigma_t"] = {
            "type": "moving_volume",
            "data": mi.TensorXf(values[None]),
            "flow": mi.TensorXf(flow),
            "time_start": -0.1,
            "time_stop": -0.1,
            "to_world": mi.ScalarTransform4f().translate(LOW).scale(HIGH - LOW),
        }
    return scene(
        (LOW[0], HIGH[0]),
        {"slab": box(LOW, HIGH, medium)},
        (SIDE, SIDE),
        integrator={"max_order": max_order, "orders": True},
        gate_kind="spherical",
        gate_count=len(GATES),
        directions=mi.TensorXf(np.tile([[1.0, 0.0, 0.0]], (SIDE * SIDE, 1))),
        fov_half_mrad=12.0,
    )


def columns(image) -> np.ndarray:
    """Of an image: order1.S0, order2.S0, ... and S1, S2, S3 of all, (beams, gates, columns)."""
    image = np.array(image, float).reshape(SIDE * SIDE, len(GATES), -1)
    return np.concatenate([image[..., 5:], image[..., 1:4]], -1)


@contextlib.contextmanager
def same_paths(loaded) -> Iterator[None]:
    """Images of the same random numbers have the same paths, whatever the extinction."""
    integrator = loaded.integrator()
    mi.render(loaded, spp=4)  # reads the bounds
    fixed = mock.patch.object(integrator.bounds, "update", lambda *_: None)
    with fixed, mock.patch.object(path_sampling, "ROULETTE_FACTOR", 1e30):
        yield


def by_differences(
    loaded,
    key: str,
    places: Sequence[tuple[int, ...]],
    steps: Sequence[float],
    samples: int,
    seed: int,
) -> tuple[np.ndarray, np.ndarray]:
    """Derivatives (places, gates, columns) and their standard errors."""
    parameters = mi.traverse(loaded)
    middle = np.array(parameters[key])
    found = []
    with same_paths(loaded):
        for place, step in zip(places, steps, strict=True):
            ends = []
            for sign in (1, -1):
                values = middle.copy()
                values[place] += sign * step
                parameters[key] = type(parameters[key])(values)
                parameters.update()
                ends.append(columns(mi.render(loaded, spp=samples, seed=seed)))
            found.append((ends[0] - ends[1]) / (2 * step))
        parameters[key] = type(parameters[key])(middle)
        parameters.update()
    found = np.array(found)
    return found.mean(1), found.std(1, ddof=1) / SIDE


def by_replay(
    loaded, key: str, places: Sequence[tuple[int, ...]], samples: int, seeds: Sequence[int]
) -> tuple[np.ndarray, np.ndarray]:
    """The same from gradients, their standard errors from the scatter over seeds."""
    parameters, integrator = mi.traverse(loaded), loaded.integrator()
    chosen = tuple(np.transpose(places))
    most = integrator.max_order
    found = np.zeros((len(seeds), len(places), len(GATES), most + 3))
    counted = [(k, k, 0) for k in range(1, most + 1)] + [(1, most, s) for s in (1, 2, 3)]
    for column, (first, last, stokes) in enumerate(counted):
        integrator.lowest_order, integrator.max_order = first, last
        for gate in range(len(GATES)):
            for index, seed in enumerate(seeds):
                dr.enable_grad(parameters[key])
                dr.set_grad(parameters[key], 0)
                parameters.update()
                quantities = len(integrator.quantities())
                weights = np.zeros((SIDE, SIDE, len(GATES) * quantities), np.float32)
                # of 1: signals are about 1e-9
                weights[..., gate * quantities + stokes] = 1e9 / SIDE**2
                integrator.render_backward(
                    loaded, parameters, mi.TensorXf(weights), seed=seed, spp=samples
                )
                gradient = np.array(dr.grad(parameters[key]), float)
                found[index, :, gate, column] = gradient[chosen] / 1e9
    integrator.lowest_order, integrator.max_order = 1, most
    dr.disable_grad(parameters[key])
    return found.mean(0), found.std(0, ddof=1) / np.sqrt(len(seeds))
