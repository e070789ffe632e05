"""The lidar stepped along a flight. Physics and system tier.

Detects: estimates beyond their stated errors, images of other air than the slab's, a step that
depends on earlier steps or on other lidars, kernels compiled at every step, bad input with a
traceback.
"""

import drjit as dr
import numpy as np
import pytest

import lidar_mi as lm
from lidar_mi.aircraft.pose import AircraftPose
from lidar_mi.encounter.lidar.virtual_lidar import LITTLE_OVERLAP, NO_EARLIER_SCAN
from lidar_mi.errors import InputError
from tests.support.encounters import both_lidars, small_encounter


@pytest.fixture(scope="module")
def flight():
    """Four scans of a lidar that only this fixture steps: estimates, images, lidar."""
    lidar = lm.VirtualLidar(small_encounter())
    steps = [(lidar.step(0.1 * number), lidar.images) for number in range(4)]
    return [estimate for estimate, _ in steps], [images for _, images in steps], lidar


def parameters(lidar, estimate):
    """True port and starboard vortex as `VortexPairFit.parameters` has them; no mean wind."""
    pair = lidar.wake.vortices(estimate.x, estimate.time)
    sides = [(v.circulation, np.log(v.core_radius), v.y, v.z) for v in pair]
    return np.array([*sides[0], *sides[1], 0.0, 0.0])


def same(first, second):
    return all(
        (getattr(first, name).values == getattr(second, name).values).all()
        for name in ("first", "second", "noise")
    )


def test_first_scan_has_no_estimate(flight):
    (first, second, *_), images, _ = flight
    assert first.flags == (NO_EARLIER_SCAN,) and first.wind is None and first.pair is None
    assert images[0] is None and second.pair.success and second.flags == ()


def test_times_and_places(flight):
    estimates, _, _ = flight
    for number, estimate in enumerate(estimates):
        assert estimate.time == pytest.approx(0.1 * number - 0.05)
        assert estimate.delivered == pytest.approx(0.1 * number + 0.12)
        assert estimate.x == pytest.approx(7.5 * (number - 1) + 151.25)


def test_vortices_within_stated_errors(flight):
    """Accepted fits of three slabs, without detector noise: 4 sigma of chi-square, 10 %, 1 m."""
    estimates, _, lidar = flight
    chi2 = []
    for estimate in estimates[1:]:
        if not estimate.pair.success:
            assert any("vortices: " in flag for flag in estimate.flags)
            continue
        miss = estimate.pair.parameters - parameters(lidar, estimate)
        chi2.append(miss @ np.linalg.solve(estimate.pair.covariance, miss))
        assert np.abs(miss[[0, 4]]).max() < 0.1 * 300
        assert np.abs(miss[[2, 3, 6, 7]]).max() < 1.0
    assert len(chi2) >= 2
    assert sum(chi2) < 10 * len(chi2) + 4 * np.sqrt(20 * len(chi2))


def test_samples_are_chosen_once_for_all_scans():
    """By the nominal pose, whatever the first one is; a larger fraction takes fewer."""
    settings = {"samples_per_beam": "auto"}
    one = lm.VirtualLidar(small_encounter(detector={}, render=settings))
    number = one._settings.samples_per_beam
    moved = lm.VirtualLidar(small_encounter(detector={}, render=settings))
    moved.step(0.0, AircraftPose(0.0, 1.0, 0.5))
    assert moved._settings.samples_per_beam == number > 2 * 16
    looser = small_encounter(detector={}, render=settings | {"monte_carlo_fraction": 1})
    assert lm.VirtualLidar(looser)._settings.samples_per_beam < number
    gates = one.gates.between + 1
    alone = lm.VirtualLidar(small_encounter(render=settings))
    assert alone._settings.samples_per_beam == 64 * gates


@pytest.mark.slow
@pytest.mark.parametrize("angle", [0, 10])
def test_stated_errors_over_a_flight(angle):
    """Ten slabs with detector noise, 10 numbers each: mean square of normalised errors about 1.

    Its expected scatter is sqrt(2 / 100) = 0.14 for 0 degrees. At 10 degrees the wind along the
    path, which the fit does not know, may double it. At most one fit may be lost.
    """
    lidar = lm.VirtualLidar(
        small_encounter(
            path={"crossing_angle": f"{angle} deg"},
            wake={
                "vortex_pair": {
                    "circulation": "300 m^2/s",
                    "separation": "30 m",
                    "core_radius": "3 m",
                    "width": "80 m",
                    "height": "50 m",
                }
            },
            render={"samples_per_beam": 64},
            detector={},
            seed=2,
        )
    )
    estimates = [lidar.step(0.1 * number) for number in range(11)][1:]
    misses = [e.pair.parameters - parameters(lidar, e) for e in estimates if e.pair.success]
    spread = [np.sqrt(np.diag(e.pair.covariance)) for e in estimates if e.pair.success]
    assert len(misses) >= 9
    squares = (np.array(misses) / spread) ** 2
    assert 0.4 < squares.mean() < (1.6 if angle == 0 else 2.5)
    assert (squares < 4).mean() > 0.85
    rms = np.sqrt((np.array(misses) ** 2).mean(0))
    assert rms[[0, 4]].max() < 0.06 * 300 and rms[[2, 3, 6, 7]].max() < 0.4


def test_both_images_show_the_air_of_the_slab(flight):
    """The first image is that of the texture at its first sighting, per unit of backscatter."""
    _, images, lidar = flight
    pair = images[2]
    y, z = np.meshgrid(pair.first["y"], pair.first["z"])
    depth = np.linspace(-1, 1, 9)
    # gates that the renderer fills linearly between planes, at all depths alike
    x = lidar.gates.slab(1) + 1.25 * depth
    seen = np.mean([lidar.air.texture.at(place, y, z) for place in x], 0)
    assert np.corrcoef(seen.ravel(), pair.first.values.ravel())[0, 1] > 0.9
    # from image to image the vortices turn air
    assert np.corrcoef(pair.second.values.ravel(), pair.first.values.ravel())[0, 1] < 0.9


def test_only_the_first_step_compiles(flight):
    """Kernels know how many lidars there are: a step after other tests settles that."""
    _, _, lidar = flight
    lidar.step(0.3)
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        lidar.step(0.4)
        lidar.step(0.5, AircraftPose(37.9, 0.4, -0.2))
        kernels = [k for k in dr.kernel_history() if k["type"] == dr.KernelType.JIT]
    assert len(kernels) > 0
    assert sum(not k["cache_hit"] for k in kernels) == 0


def test_a_scan_that_was_left_out():
    lidar = lm.VirtualLidar(small_encounter())
    lidar.step(0.0)
    assert lidar.step(0.2).flags == (NO_EARLIER_SCAN,)


def test_an_aircraft_beside_its_path():
    """Estimates stay in the path frame: vortices are where they are on the nominal path."""
    lidar = lm.VirtualLidar(small_encounter())
    lidar.step(0.0, AircraftPose(0.3, 2.3, -1.7, roll=0.3))
    estimate = lidar.step(0.1, AircraftPose(7.2, 3.1, -0.4))
    miss = estimate.pair.parameters - parameters(lidar, estimate)
    assert miss @ np.linalg.solve(estimate.pair.covariance, miss) < 10 + 4 * np.sqrt(20)
    assert np.abs(miss[[2, 3, 6, 7]]).max() < 1.0
    assert float(lidar.images.first["y"].mean()) == pytest.approx(2.3, abs=1.5)


def test_scans_of_places_far_apart():
    lidar = lm.VirtualLidar(small_encounter())
    lidar.step(0.0)
    estimate = lidar.step(0.1, AircraftPose(7.5, 200.0))
    assert estimate.flags == (LITTLE_OVERLAP,) and estimate.pair is None


def test_wind_where_a_method_gives_vectors():
    lidar = lm.VirtualLidar(
        small_encounter(retrieval={"methods": ["cc"], "stride": 2}, detector={})
    )
    lidar.step(0.0)
    estimate = lidar.step(0.1)
    wind, valid = estimate.wind, estimate.wind["flag"] == 0
    assert set(estimate.seconds) == {"wind_before", "wind", "vortices"}
    assert float(valid.mean()) > 0.5
    _, v, w = lidar.wake.wind(estimate.x, wind["y_vector"], wind["z_vector"], estimate.time)
    for found, true in ((wind["v"], v), (wind["w"], w)):
        assert float(abs(found - true).where(valid).median()) < 1.0


@pytest.mark.parametrize("t", [-0.1, 0.05, float("nan")])
def test_times_between_scans_are_refused(flight, t):
    with pytest.raises(InputError, match=r"^t: .* is not allowed; expected a multiple of"):
        flight[2].step(t)


def test_what_is_no_encounter_is_refused():
    with pytest.raises(InputError, match="encounter: missing"):
        lm.VirtualLidar("wake_sensor")
    with pytest.raises(InputError, match=r"^t: 'now' is not allowed; expected a number"):
        lm.VirtualLidar(small_encounter()).step("now")


@pytest.mark.slow
def test_both_lidars_give_three_components():
    """Two slabs: errors of u, v, w as stated, and the same again; v and w as without u but for it.

    Some 60 vectors a slab are correlated over windows of 8 m, some 8 of them independent: mean
    squares of normalised errors are known to 35 % of 1 for two slabs.
    """
    lidar, again = (lm.VirtualLidar(both_lidars(path={"crossing_angle": "20 deg"})) for _ in "ab")
    squares = {name: [] for name in "uvw"}
    for number in range(3):
        estimate, same = lidar.step(0.1 * number), again.step(0.1 * number)
        if not number:
            assert estimate.lines is None
            continue
        assert not any("both lidars" in flag for flag in estimate.flags)
        wind = estimate.wind
        valid = (wind["flag"] == 0).values
        assert valid.sum() > 20
        y, z = np.meshgrid(wind["y"].values, wind["z"].values)
        truth = lidar.wake.wind(np.full(y.shape, estimate.x), y, z, estimate.time)
        for name, true in zip("uvw", truth, strict=True):
            off = (wind[name].values - true) / wind[f"{name}_stderr"].values
            squares[name].append(np.mean(off[valid] ** 2))
            np.testing.assert_array_equal(wind[name], same.wind[name])
        assert set(estimate.seconds) == {"lines", "wind_before", "vortices", "wind", "combination"}
        assert estimate.lines.sizes["line"] == 12
    for name, found in squares.items():
        # standard errors of u are three times too large
        assert 0.05 < np.mean(found) < 1 + 4 * 0.35, name
