"""Vortex cores in analytic flows and in the sample wake. Detects 0.1 m in a centre, one ring in a
core radius, 0.2 % in a circulation, a wrong sense of rotation, and vortices that are not there."""

from importlib.resources import files

import numpy as np
import pytest
import xarray as xr

from lidar_mi.atmosphere.vortices.cores import Core, find_cores, outside_cores, ring_averages
from lidar_mi.atmosphere.vortices.vortex import Vortex, pair_wake, vortex_pair
from lidar_mi.atmosphere.vortices.wake import centre, resample
from lidar_mi.io.wake_file import read_wake

Y, Z = np.linspace(-54.5, 54.5, 219), np.linspace(-34.5, 34.5, 139)
HALF_RING = 0.125  # rings are 0.25 m apart on this grid


def flow_of(*vortices):
    return pair_wake(vortices, Y, Z).isel(x=0)


def flow_from(v, w):
    shape = (len(Z), len(Y))
    return xr.Dataset(
        {
            "v": (("z", "y"), np.broadcast_to(v, shape)),
            "w": (("z", "y"), np.broadcast_to(w, shape)),
        },
        coords={"y": Y, "z": Z},
    )


def circulation_inside(r, circulation, core_radius, model):
    """2 pi r v_t of the two models, written down here on their own."""
    if model == "lamb_oseen":
        return circulation * (1 - np.exp(-1.2564 * r**2 / core_radius**2))
    return circulation * r**2 / (r**2 + core_radius**2)


@pytest.mark.parametrize("model", ["lamb_oseen", "burnham_hallock"])
@pytest.mark.parametrize("core_radius", [2.0, 3.0, 4.2])
@pytest.mark.parametrize("place", [(0.0, 0.0), (0.13, -0.21), (1.3, 7.77)])
def test_pair(model, core_radius, place):
    """Centres anywhere between nodes. The partner's flow is potential on the rings, so its mean
    swirl is zero; what is left is interpolation, 1e-4 of the circulation."""
    port, starboard = find_cores(flow_of(*vortex_pair(458.0, 47.1, core_radius, *place, model)))
    for core, side in ((port, 1), (starboard, -1)):
        assert core.y == pytest.approx(place[0] + side * 23.55, abs=0.1)
        assert core.z == pytest.approx(place[1], abs=0.1)
        assert core.radius == pytest.approx(core_radius, abs=HALF_RING + 1e-6)
        expected = circulation_inside(core.radius, side * 458.0, core_radius, model)
        assert core.circulation == pytest.approx(expected, rel=2e-3)


def test_a_passing_wind_changes_nothing():
    still = flow_of(*vortex_pair(458.0, y=0.13, z=-0.21))
    moving = still.assign(v=still["v"] + 12.0, w=still["w"] - 7.0)
    for before, after in zip(find_cores(still), find_cores(moving), strict=True):
        np.testing.assert_allclose(
            [after.y, after.z, after.radius], [before.y, before.z, before.radius], atol=1e-9
        )
        # cubic interpolation at equal angles: a uniform wind has no mean swirl
        assert after.circulation == pytest.approx(before.circulation, abs=1e-6)


@pytest.mark.parametrize("sense", [1, -1])
def test_one_vortex_has_no_partner(sense):
    """Its own potential flow must not look like a weak vortex of the other sense."""
    (core,) = find_cores(flow_of(Vortex(sense * 458.0, 3.0, 10.0, -5.0)))
    assert (core.y, core.z) == pytest.approx((10.0, -5.0), abs=0.1)
    assert np.sign(core.circulation) == sense


def test_the_stronger_of_two_of_one_sense():
    (core,) = find_cores(flow_of(Vortex(458.0, 3.0, 20.0, 0.0), Vortex(250.0, 3.0, -20.0, 0.0)))
    assert core.y == pytest.approx(20.0, abs=0.1)


@pytest.mark.parametrize(
    "v, w",
    [
        (10.0, 5.0),
        (0.0, 0.0),
        (0.05 * Z[:, None], 0.0),  # shear: vorticity everywhere, 0.05 s^-1, but no core
        (0.2 * Y, -0.2 * Z[:, None]),  # strain
    ],
    ids=["uniform", "calm", "shear", "strain"],
)
def test_flows_without_a_vortex(v, w):
    assert find_cores(flow_from(v, w)) == []


@pytest.mark.parametrize("seed", range(10))
def test_noise_is_no_vortex(seed):
    """White noise of 1 m/s: a ring of radius r averages about 2 pi r / 0.5 m values, so its
    circulation scatters by (2 pi r 0.5 m)^(1/2) m/s = 9 m^2/s at 25 m; 20 m^2/s are asked for."""
    noise = np.random.default_rng(seed).normal(size=(2, len(Z), len(Y)))
    assert find_cores(flow_from(*noise)) == []


def test_near_the_edge():
    """Seen as long as the peak of the swirl is; the edge then cuts the disc of the centroid."""
    for distance, tolerance in ((10.0, 0.01), (6.0, 0.02), (4.0, 0.05)):
        (core,) = find_cores(flow_of(Vortex(458.0, 3.0, 54.5 - distance, -5.0)))
        assert core.y == pytest.approx(54.5 - distance, abs=tolerance)
        assert core.radius == pytest.approx(3.0, abs=HALF_RING)
    for distance in (2.5, 1.0):
        assert find_cores(flow_of(Vortex(458.0, 3.0, 54.5 - distance, -5.0))) == []


def test_order_of_dims_does_not_matter():
    flow = flow_of(*vortex_pair(458.0, z=3.3))
    assert find_cores(flow.transpose("y", "z")) == find_cores(flow.transpose("z", "y"))


@pytest.mark.parametrize("spacing", [1.0, 0.5])
def test_sample_wake(spacing):
    """Published with the wake at 40 s: y = +-23.4 m and z = -60.4 m (means along the flight path;
    the plane shipped scatters about them), peak swirl 11 m/s at 4.0 to 4.5 m."""
    wake = read_wake(files("lidar_mi.scenes") / "wake_slab_40s.nc", 40.0)
    wake = centre(resample(wake, spacing), 0.0, -60.4).isel(x=0)
    port, starboard = find_cores(wake)
    for core, side in ((port, 1), (starboard, -1)):
        assert core.y == pytest.approx(side * 23.4, abs=0.5)
        assert core.z == pytest.approx(0.0, abs=0.5)
        assert 4.0 - spacing / 4 <= core.radius <= 4.5 + spacing / 4
        assert np.sign(core.circulation) == side
        swirl = abs(core.circulation) / (2 * np.pi * core.radius)
        assert swirl == pytest.approx(11.0, abs=0.5)


def test_outside_cores():
    cores = [Core(10.0, 0.0, 2.0, 100.0), Core(-10.0, 0.0, 3.0, -100.0)]
    y = np.array([10.0, 13.9, 14.1, -10.0, -15.9, -16.1, 0.0])
    far = outside_cores(y, np.zeros(7), cores)
    assert far.tolist() == [False, False, True, False, False, True, True]
    assert outside_cores(y, np.zeros(7), []).all()
    assert outside_cores(y, np.zeros(7), cores, radii=0.9)[1]


@pytest.mark.parametrize("model", ["lamb_oseen", "burnham_hallock"])
def test_rings_give_circulation_and_advecting_wind(model):
    """Circulation: the mean of its closed form. The partner and a wind of (3, -1) m/s carry it."""
    pair = vortex_pair(458.0, 47.1, 3.0, model=model)
    flow = flow_of(*pair)
    flow = flow.assign(v=flow["v"] + 3.0, w=flow["w"] - 1.0)
    radius = np.linspace(5, 15, 1001)
    fraction = circulation_inside(radius, 458.0, 3.0, model).mean()
    cores = [Core(o.y, o.z, o.core_radius, o.circulation) for o in pair]
    for core, other, side in zip(cores, cores[::-1], (1, -1), strict=True):
        rings = ring_averages(flow, core, [other])
        assert rings.circulation == pytest.approx(side * fraction, rel=2e-3)
        assert rings.v == pytest.approx(3.0, abs=0.01)
        # Burnham and Hallock's partner still has 0.4 % of its circulation beyond b0
        assert rings.w == pytest.approx(-1.0 - 458 / (2 * np.pi * 47.1), abs=0.02)


def test_rings_around_another_core_are_undetermined():
    flow = flow_of(*vortex_pair(458.0, 20.0))
    port, starboard = (Core(s * 10.0, 0.0, 3.0, s * 458.0) for s in (1, -1))
    assert ring_averages(flow, port, [starboard]) is None
    assert ring_averages(flow, port) is not None
    assert ring_averages(flow, Core(45.0, 0.0, 3.0, 458.0)) is None
    # 440 and 438 m^2/s, as the simulation's own file says
    path = files("lidar_mi.scenes").joinpath("wake_slab_40s.nc")
    wake = centre(resample(read_wake(path, 40.0), 0.5), None, None).isel(x=0)
    cores = find_cores(wake)
    for core, output in zip(cores, (440.0, -438.4), strict=True):
        others = [o for o in cores if o is not core]
        assert ring_averages(wake, core, others).circulation == pytest.approx(output, rel=5e-3)
