"""Pixels whose standard error rests on one sample.

Detects: a share that is not that of the largest deviation, that depends on the number of passes or
on the signal's size, pixels that are not counted, a warning that is missing or is given too often.
"""

import warnings

import mitsuba as mi
import numpy as np
import pytest

import lidar_mi as lm
from lidar_mi.instrument.products import untrusted_pixels
from lidar_mi.io.exr import read_scan
from lidar_mi.rendering.scene import render_file

pytestmark = pytest.mark.usefixtures("variant")

BEAMS = (20, 15)
ANGLES = {
    f"{angle}_{end}_deg": sign * value
    for angle, value in (("azimuth", 4.0), ("elevation", 3.0))
    for end, sign in (("min", -1), ("max", 1))
}


def loaded(world, layer=None, environment=1e-3, **integrator):
    """Beams of a gate of 10 m; with ``layer``, it is empty but for 1 cm of that extinction."""
    shapes = {"environment": world.homogeneous(environment)}
    if layer:
        values = np.zeros((1, 1, 3000))
        values[..., 1400] = layer
        low, high = (490, -60, -60), (520, 60, 60)
        air = world.grid(values, low, high)
        air["sigma_t"]["filter_type"] = "nearest"
        shapes["slab"] = world.box(low, high, air, world.ENVIRONMENT)
    view = {"fov_half_mrad": 5.0, **ANGLES}
    sensor = world.lidar(BEAMS, (500.0, 510.0), environment=world.ENVIRONMENT, **view)
    return world.scene(sensor, {"shares": True, **integrator}, **shapes)


def rendered(scene, samples, seed=1):
    """S0, its standard error and the largest share of each beam."""
    image = np.array(mi.render(scene, spp=samples, seed=seed), float)
    return image[..., 0], image[..., 4], image[..., -1]


def test_of_two_samples_each_has_half(world):
    scene = loaded(world)
    _, _, share = rendered(scene, 2)
    # within the rounding of two samples that are nearly equal
    np.testing.assert_allclose(share, 0.5, atol=0.02)
    assert scene.integrator().untrusted == scene.integrator().lit == share.size


@pytest.mark.parametrize("samples_per_pass", [1 << 20, 3000])
def test_share_of_one_sample_in_a_layer_that_few_meet(world, samples_per_pass):
    """The numbers of samples in the layer are binomial; k equal ones have a share of 1 / k each."""
    scene = loaded(world, 1e-2, samples_per_pass=samples_per_pass)
    signal, error, share = rendered(scene, 500)
    lit = signal > 0
    # 500 samples meet the layer of a thousandth of the gate with a probability of 0.39
    assert abs(lit.mean() - 0.39) < 5 * np.sqrt(0.39 * 0.61 / lit.size)
    # k of n equal contributions: (mean over standard error)^2 is k (n - 1) / (n - k)
    ratio = (signal[lit] / error[lit]) ** 2
    number = np.round(500 * ratio / (499 + ratio))
    assert set(number) >= {1, 2}
    np.testing.assert_allclose(share[lit], (1 - number / 500) / number, rtol=0.02)
    assert scene.integrator().untrusted == (share >= 0.4999).sum()
    assert scene.integrator().lit == (signal > 0).sum()


def test_many_samples_of_uniform_air_are_trusted(world):
    scene = loaded(world)
    _, _, share = rendered(scene, 256)
    assert share.max() < 0.1
    assert scene.integrator().untrusted == 0


def test_analog_samples(world):
    """A gate that one of 100 free flights meets: of k that do each has a share of about 1 / k."""
    scene = loaded(world, estimator="analog")
    signal, _, share = rendered(scene, 400)
    assert (share[signal > 0] > 1 / 400).all() and (share <= 1).all()
    assert 0.2 < (share[signal > 0] > 0.4999).mean() < 0.9
    assert scene.integrator().untrusted == (share >= 0.4999).sum()


def test_errors_of_the_faintest_signals(world):
    """Signals of 1e-22, whose squares are below single precision, have the same relative errors."""
    found = [rendered(loaded(world, environment=sigma), 64) for sigma in (1e-5, 1e-17)]
    (bright, bright_error, _), (faint, faint_error, _) = found
    assert 0 < faint.max() < 1e-21
    np.testing.assert_allclose(faint_error / faint, bright_error / bright, rtol=0.02)


def test_a_warning_where_shares_are_not_asked_for(world):
    with pytest.warns(UserWarning, match="300 of 300 pixels that receive light one sample"):
        mi.render(loaded(world, shares=False), spp=2)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        mi.render(loaded(world), spp=2)
        mi.render(loaded(world, shares=False), spp=64)


def test_a_rendered_file_says_so(tmp_path):
    """The header's counts are those of the layer, and the sentence is theirs."""
    scene, out = lm.scene_file("slab"), tmp_path / "slab.exr"
    image = render_file(scene, out, samples=4)
    share, lit = image["S0_largest_share"].values, image["S0"].values > 0
    header = read_scan(out).attrs
    assert header["untrusted_pixels"] == (share[lit] >= 0.4999).sum() > 0.01 * lit.sum()
    assert header["lit_pixels"] == lit.sum()
    assert untrusted_pixels(image).startswith(f"in {header['untrusted_pixels']} of {lit.sum()} ")
    assert untrusted_pixels(render_file(scene, out, samples=64)) is None
