"""Signals through random extinction fields against quadrature in plain numpy.

Detects: a transmittance whose weights underflow or have a heavy tail in any field, bounds of blocks
that a field exceeds, a filter, wrap mode, pose, scale or time taken wrongly, a standard error that
is wrong by 25 %, a second order that is wrong by 12 %. `make fuzz` draws further fields.
"""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from plugins.bounds import Bounds, locate
from validation import extinction_fields as fields

pytestmark = pytest.mark.usefixtures("variant")


def deviations(seeds):
    found = {}
    for seed in seeds:
        made = fields.field(seed)
        found[seed], *_ = fields.deviation(made, 8192, seed)
    return found


def assert_standard(found):
    """All within 5, and with the spread that a normal variable has within 5 sigma of it."""
    assert {seed: z for seed, z in found.items() if abs(z) > 5} == {}
    z = np.array(list(found.values()))
    assert abs(z.mean()) < 5 / np.sqrt(len(z))
    # where noise is less than rounding deviations are smaller
    assert z.std() < 1 + 5 / np.sqrt(2 * len(z))
    assert z.std() > 0.9 - 5 / np.sqrt(2 * len(z))


@pytest.mark.slow
def test_single_scattering():
    assert_standard(deviations(range(1000, 1200)))


def second_order(seeds):
    """Deviations of the sum of two orders in standard errors, and ratios of the second order."""
    found, ratios, weights = {}, [], []
    for seed in seeds:
        made = fields.widened(seed)
        single = fields.single_scattering(made)
        double, error = fields.double_scattering(made, 0.2, 20_000, seed)
        scene = fields.scene(made, 200.0, max_order=2, orders=True)
        image = np.array(mi.render(scene, spp=1 << 16, seed=seed), float).ravel()
        noise = np.hypot(image[4], error)
        found[seed] = (image[0] - single - double) / noise
        ratios.append((image[0] - single) / double)
        weights.append((double / noise) ** 2)
    return found, np.average(ratios, weights=weights), 1 / np.sqrt(np.sum(weights))


@pytest.mark.slow
def test_double_scattering():
    found, ratio, error = second_order(range(100, 112))
    assert {seed: z for seed, z in found.items() if abs(z) > 5} == {}
    assert error < 0.03
    assert abs(ratio - 1) < 4 * error, (ratio, error)


def layered(where, order=1, samples=4096):
    """Signal of a gate at 500 m behind a metre of optical depth 0.1, and its standard error."""
    extinction = np.full(500, 1e-4)
    if where is not None:
        extinction[where] = 0.1
    place = np.diag([500.0, 40, 40, 1])
    place[:3, 3] = 10, -20, -20
    made = fields.Field(
        kind="layers",
        states=extinction[None, None, None],
        place=place,
        margin=0.0,
        filter="nearest",
        wrap="clamp",
        scale=1.0,
        environment=0.0,
        gate=(500.0, 502.0),
        time=0.0,
    )
    scene = fields.scene(made, max_order=order)
    image = np.array(mi.render(scene, spp=samples, seed=1), float).ravel()
    return image[0], image[4]


@pytest.mark.slow
@pytest.mark.parametrize("where", [0, 200, 245, 488])
def test_a_thin_layer_anywhere_on_the_path(where):
    clear, clear_error = layered(None)
    signal, error = layered(where)
    truth = np.exp(-2 * (0.1 - 1e-4))
    assert abs(signal / clear - truth) < 4 * np.hypot(error, truth * clear_error) / clear
    # weights that varied by more than the optical depth of the layer would be inefficient
    assert error / signal < np.sqrt(2 * 0.1 / 4096)


@pytest.mark.parametrize("kind", ["gridvolume", "moving_volume"])
def test_blocks_bound_the_field(kind):
    """Values at random places, also beyond the grid, lie within the bounds of their blocks."""
    rng = np.random.default_rng(5)
    states = rng.random((2, 19, 23, 300)) ** 8
    states[..., 100:] *= 1e-3
    to_world = (
        mi.ScalarTransform4f().translate([50, -3, 2]).rotate([0.6, 0, 0.8], 40).scale([90, 7, 9])
    )
    for wrap in ("clamp", "repeat", "mirror"):
        volume = {"type": kind, "to_world": to_world}
        if kind == "gridvolume":
            grid = mi.VolumeGrid(states[0][..., None].astype(np.float32))
            volume |= {"grid": grid, "wrap_mode": wrap}
        else:
            data = mi.TensorXf(states.astype(np.float32))
            volume |= {"data": data, "time_start": 0.0, "time_stop": 1.0}
        medium = mi.load_dict({"type": "heterogeneous", "sigma_t": volume, "scale": 3.0})
        bounds = Bounds()
        bounds.update([medium], 0)
        local = rng.uniform(-0.2, 1.2, (3, 50_000))
        place = mi.Transform4f(to_world.matrix) @ mi.Point3f(local)
        pointer = dr.gather(mi.MediumPtr, mi.MediumPtr(medium), dr.zeros(mi.UInt32, 50_000))
        start, step, counts, first = bounds.enter(pointer, mi.Point3f(0), mi.Vector3f(place))
        least, mean, most = bounds.extinction(locate(start, step, counts, 1.0), counts, first)
        mei = dr.zeros(mi.MediumInteraction3f, 50_000)
        mei.p, mei.time, mei.medium = place, mi.Float(rng.random(50_000)), pointer
        value = medium.get_scattering_coefficients(mei)[2][0]
        assert dr.all((value >= least * (1 - 1e-5) - 1e-7) & (value <= most * (1 + 1e-5)))
        assert dr.all((mean >= least) & (mean <= most))
        # blocks are bounds worth having
        inside = dr.all((mi.Point3f(local) > 0) & (mi.Point3f(local) < 1))
        spread = dr.select(inside, most - least, 0)
        assert dr.sum(spread)[0] < 0.5 * 3.0 * dr.count(inside)[0]
