"""Standard errors of all Stokes components, and of the depolarisation ratio by their covariance.

Detects: a standard error that is 6 % off, components that are exchanged, a covariance of the wrong
sign or of other components, sums that depend on the number of passes.
"""

import mitsuba as mi
import numpy as np
import pytest
from scipy.stats import chi2

import lidar_mi as lm
from lidar_mi.instrument.products import (
    depolarization_image,
    depolarization_stderr,
    linear_depolarization,
)
from lidar_mi.io.exr import read_scan
from lidar_mi.rendering.scene import render_file

pytestmark = pytest.mark.usefixtures("variant")

SEEDS, BEAMS, SAMPLES = 50, (8, 6), 400
ANGLES = {"azimuth_min_deg": -2.0, "azimuth_max_deg": 2.0}
VIEW = {**ANGLES, "elevation_min_deg": -1.0, "elevation_max_deg": 1.0, "fov_half_mrad": 10.0}
# what two-sided tests leave of correct standard errors: 4 standard deviations
LEVEL = 6e-5


def images(world, stokes, phase, samples=SAMPLES, seeds=SEEDS, **integrator):
    """Quantities over seeds and beams of a dense slab, two orders."""
    if not mi.is_polarized:
        pytest.skip("unpolarised variants have no S1")
    medium = world.homogeneous(0.02, phase)
    sensor = world.lidar(BEAMS, (505.0, 515.0), laser={"stokes": stokes}, **VIEW)
    slab = world.box((500.0, -50.0, -50.0), (520.0, 50.0, 50.0), medium)
    scene = world.scene(sensor, {"max_order": 2, "covariance": True, **integrator}, slab=slab)
    names = scene.integrator().quantities()
    found = np.stack([np.array(mi.render(scene, spp=samples, seed=s)) for s in range(seeds)])
    found = found.reshape(seeds, -1, len(names)).astype(float)
    return {name: found[..., k] for k, name in enumerate(names)}


def assert_stated(values, stated):
    """The scatter over seeds is the stated one: chi-square of all beams, two-sided."""
    freedom = values.shape[1] * (len(values) - 1)
    ratio = values.var(0, ddof=1).mean() / (stated**2).mean()
    low, high = chi2.ppf([LEVEL / 2, 1 - LEVEL / 2], freedom) / freedom
    assert low < ratio < high, (ratio, low, high)


@pytest.mark.slow
@pytest.mark.parametrize("phase", ["rayleigh_polarized", {"type": "hg", "g": 0.6}])
def test_of_each_component(world, phase):
    found = images(world, "1, 0.3, 0.5, 0.7", phase)
    for component in ("S0", "S1", "S2", "S3"):
        # light that is not polarised has no scatter either
        if found[f"{component}_stderr"].any():
            assert_stated(found[component], found[f"{component}_stderr"])
        else:
            assert phase != "rayleigh_polarized" and component != "S0"
            assert not found[component].any()


def test_of_the_depolarisation_ratio(world):
    found = images(world, "1, 1, 0, 0", {"type": "rayleigh_polarized", "depolarization": 0.1})
    names = ("S0", "S1", "S0_stderr", "S1_stderr", "S0_S1_correlation")
    stated = depolarization_stderr(*(found[name] for name in names))
    assert_stated(linear_depolarization(found["S0"], found["S1"]), stated)
    # without the covariance it would be several times as large
    alone = depolarization_stderr(*(found[name] for name in names[:4]), 0.0)
    assert np.median(alone / stated) > 2


@pytest.mark.slow
def test_of_analog_samples(world):
    found = images(world, "1, 0.3, 0.5, 0.7", "rayleigh_polarized", 4000, estimator="analog")
    for component in ("S0", "S1", "S2", "S3"):
        assert_stated(found[component], found[f"{component}_stderr"])


def test_a_rendered_file_has_them(tmp_path):
    out = tmp_path / "slab.exr"
    image = render_file(lm.scene_file("slab"), out, samples=16)
    found = read_scan(out)
    for name in ("S1_stderr", "S2_stderr", "S3_stderr", "S0_S1_correlation"):
        np.testing.assert_array_equal(found[name], image[name])
        assert "Monte Carlo" in found[name].attrs["long_name"]
    ratio = depolarization_image(found)["depolarization_stderr"]
    assert ratio.attrs["stderr_is_bound"] == 0
    # single scattering of one kind: far below the bound that S0's error alone allows
    known = found.drop_vars(["S1_stderr", "S0_S1_correlation"])
    bound = depolarization_image(known)["depolarization_stderr"]
    assert bound.attrs["stderr_is_bound"] == 1
    assert (ratio < bound).all()
