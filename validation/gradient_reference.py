"""Gradients of images against central differences of images with the same random numbers.

A slab is a grid of voxels, which a lidar with a wide field of view sees through two gates: its near
and its far half. Differences are taken without Russian roulette and with bounds of the extinction
that stay what they are: the same random numbers then give the same paths, and the difference
of two images has the noise of a derivative. Gradients have other random numbers.
"""

import contextlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from unittest import mock

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.stats import norm, t

from plugins import path_sampling

from .scenes import box, grid, scene

LOW, HIGH = np.array([500.0, -9.0, -9.0]), np.array([530.0, 9.0, 9.0])
SHAPE = (3, 3, 6)
SIDE = 6
"""Beams along either axis of the image, all the same: the scatter of an image over them is that of
independent repetitions."""
GATES = ("near gate", "far gate")
ORDERS = 3
SPREAD = 0.2
"""By which bounds of the extinction are widened, of the largest one."""
POLARISED = (0.0, 1.0, -2.0, 3.0)
"""Weights of a column with S1, S2 and S3 of all orders."""
COLUMNS = ("order 1", "order 2", "order 3", "S1 - 2 S2 + 3 S3")
MEDIUM = "slab.interior_medium"


@dataclass(frozen=True)
class Derivatives:
    """Of the columns' values, (directions, gates, columns), and their standard errors.

    ``freedom`` is the number of repetitions less one from whose scatter the errors follow.
    """

    values: np.ndarray
    errors: np.ndarray
    freedom: int

    def of(self, chosen: slice) -> "Derivatives":
        """Those along some of the directions."""
        return Derivatives(self.values[chosen], self.errors[chosen], self.freedom)


def scores(found: Derivatives, expected: Derivatives) -> np.ndarray:
    """Differences as normal scores: of t with the degrees of freedom of Welch (1947).

    Columns that are 0 without error, of light that is not polarised, are left out.
    """
    variances = np.array([found.errors**2, expected.errors**2])
    total = variances.sum(0)
    kept = total > 0
    freedom = np.array([found.freedom, expected.freedom])
    welch = total[kept] ** 2 / (variances[:, kept] ** 2 / freedom[:, None]).sum(0)
    ratio = (found.values - expected.values)[kept] / np.sqrt(total[kept])
    assert (found.values == expected.values)[~kept].all()
    return np.sign(ratio) * norm.isf(t.sf(np.abs(ratio), welch))


def extinction(depth: float, varied: bool) -> np.ndarray:
    """Extinction coefficient of voxels (z, y, x), m^-1; the optical depth is along x."""
    values = np.full(SHAPE, depth / (HIGH - LOW)[0])
    return values * np.random.default_rng(7).uniform(0.4, 1.6, SHAPE) if varied else values


def loaded(values: np.ndarray, phase="rayleigh_polarized", flow=None, albedo=None):
    """The scene of a slab of voxels, a vacuum around it.

    Parameters
    ----------
    values, albedo : array (z, y, x)
        Of the voxels; without it, the albedo is 0.9.
    phase : str or dict
    flow : array (z, y, x, 3), optional
        Wind in m/s: beams meet the air 0.1 s after the state of the voxels.
    """
    place = mi.ScalarTransform4f().translate(LOW).scale(HIGH - LOW)
    medium = grid(values, LOW, HIGH, phase, 0.9)
    if albedo is not None:
        medium["albedo"] = grid(albedo, LOW, HIGH)["sigma_t"]
    if flow is not None:
        medium["sigma_t"] = {
            "type": "moving_volume",
            "data": mi.TensorXf(np.asarray(values, np.float32)[None]),
            "flow": mi.TensorXf(np.asarray(flow, np.float32)),
            "time_start": -0.1,
            "time_stop": -0.1,
            "to_world": place,
        }
    return scene(
        (LOW[0], HIGH[0]),
        {"slab": box(LOW, HIGH, medium)},
        (SIDE, SIDE),
        {"stokes": "1, 0.4, 0.5, 0.6"},
        {"max_order": ORDERS, "orders": True},
        gate_kind="spherical",
        gate_count=len(GATES),
        directions=mi.TensorXf(np.tile([[1.0, 0.0, 0.0]], (SIDE * SIDE, 1))),
        fov_half_mrad=12.0,
    )


def steps(shape: tuple[int, ...], sizes: Sequence[tuple[tuple[int, ...], float]]) -> np.ndarray:
    """Directions, each a step of a size at one place of an array."""
    directions = np.zeros((len(sizes), *shape))
    for direction, (place, size) in zip(directions, sizes, strict=True):
        direction[place] = size
    return directions


def light(loaded, samples: int, seed: int) -> np.ndarray:
    """The columns' values themselves, (gates, columns)."""
    return _columns(mi.render(loaded, spp=samples, seed=seed)).mean(0)


def by_differences(
    loaded, key: str, directions: np.ndarray, samples: int, seed: int
) -> Derivatives:
    """Derivatives along directions of the parameter ``key``, by central differences."""
    parameters = mi.traverse(loaded)
    middle = np.array(parameters[key])

    def image(values):
        parameters[key] = type(parameters[key])(np.asarray(values, np.float32))
        parameters.update()
        return _columns(mi.render(loaded, spp=samples, seed=seed))

    with _same_paths(loaded):
        found = [(image(middle + step) - image(middle - step)) / 2 for step in directions]
        image(middle)
    found = np.array(found)
    return Derivatives(found.mean(1), found.std(1, ddof=1) / SIDE, SIDE**2 - 1)


def by_replay(
    loaded, key: str, directions: np.ndarray, samples: int, seeds: Sequence[int]
) -> Derivatives:
    """The same from gradients in reverse mode, their errors from the scatter over seeds."""
    integrator = loaded.integrator()
    weights = [(k, k, (1.0, 0.0, 0.0, 0.0)) for k in range(1, ORDERS + 1)]
    weights.append((1, ORDERS, POLARISED))
    found = np.zeros((len(seeds), len(directions), len(GATES), len(COLUMNS)))
    flat = directions.reshape(len(directions), -1)
    for column, (first, last, stokes) in enumerate(weights):
        integrator.lowest_order, integrator.max_order = first, last
        for gate in range(len(GATES)):
            for index, seed in enumerate(seeds):
                gradient = backward(loaded, key, gate, stokes, samples, seed)
                found[index, :, gate, column] = flat @ gradient.ravel()
    integrator.lowest_order, integrator.max_order = 1, ORDERS
    return Derivatives(found.mean(0), found.std(0, ddof=1) / len(seeds) ** 0.5, len(seeds) - 1)


def backward(loaded, key: str, gate: int, stokes, samples: int, seed: int) -> np.ndarray:
    """Gradient of a weighted sum of Stokes components, the mean over beams, of one gate."""
    parameters, integrator = mi.traverse(loaded), loaded.integrator()
    dr.enable_grad(parameters[key])
    parameters.update()
    weights = np.zeros((SIDE, SIDE, len(GATES), len(integrator.quantities())), np.float32)
    # signals are about 1e-9: weights make gradients of about 1
    weights[:, :, gate, :4] = 1e9 / SIDE**2 * np.array(stokes)
    weights = mi.TensorXf(weights.reshape(SIDE, SIDE, -1))
    integrator.render_backward(loaded, parameters, weights, seed=seed, spp=samples)
    gradient = np.array(dr.grad(parameters[key]), float) / 1e9
    dr.disable_grad(parameters[key])
    parameters.update()
    return gradient


def forward(loaded, key: str, tangent: np.ndarray, samples: int, seed: int) -> np.ndarray:
    """Gradients of the image (beams, gates, Stokes) from those of a parameter."""
    parameters, integrator = mi.traverse(loaded), loaded.integrator()
    dr.enable_grad(parameters[key])
    dr.set_grad(parameters[key], type(parameters[key])(np.asarray(tangent, np.float32)))
    parameters.update()
    image = integrator.render_forward(loaded, parameters, seed=seed, spp=samples)
    dr.disable_grad(parameters[key])
    parameters.update()
    return np.array(image, float).reshape(SIDE**2, len(GATES), -1)[..., :4]


def _columns(image) -> np.ndarray:
    """Of an image the `COLUMNS`, (beams, gates, columns)."""
    image = np.array(image, float).reshape(SIDE**2, len(GATES), -1)
    return np.concatenate([image[..., 5:], image[..., :4] @ np.array(POLARISED)[:, None]], -1)


@contextlib.contextmanager
def _same_paths(loaded) -> Iterator[None]:
    """Images of the same random numbers have the same paths, whatever the extinction."""
    bounds = loaded.integrator().bounds
    loaded.integrator().render(loaded, spp=4)  # reads the bounds
    values = np.array(bounds.values).reshape(-1, 3)
    # wide enough for all that is changed: in a uniform block nothing would be looked up
    values += SPREAD * values[:, 2:] * np.array([-1.0, 0.0, 1.0])
    bounds.values = mi.Float(values.ravel())
    fixed = mock.patch.object(bounds, "update", lambda *_: None)
    with fixed, mock.patch.object(path_sampling, "ROULETTE_FACTOR", 1e30):
        yield
