"""Vectors and lines of sight of a pair that drifts, each of its own time, brought to one.

Detects a sign, an axis or a zero of time that is wrong (0.2 to 0.6 m/s in a core), stated errors
that no longer hold (5 sigma), vectors from beyond the images, and times that are used in a steady
wind. The pair and its drift are in closed form.
"""

import numpy as np
import pytest
import xarray as xr

from lidar_mi.atmosphere.vortices.vortex import Vortex, velocity
from lidar_mi.errors import InputError
from lidar_mi.retrieval.combined.combine import combine
from lidar_mi.retrieval.combined.common_time import at_common_time, estimated_drift

RADIUS, SEPARATION, CIRCULATION = 3.0, 30.0, 400.0
PAIR = [
    Vortex(circulation=sign * CIRCULATION, y=sign * SEPARATION / 2, z=1.0, core_radius=RADIUS)
    for sign in (1, -1)
]
MEAN = (6.0, 1.0)
DRIFT = (MEAN[0], MEAN[1] - CIRCULATION / (2 * np.pi * SEPARATION))
Y, Z, MIDDLE = np.arange(-40, 40.1, 1.0), np.arange(-25, 25.1, 1.0), 0.05
KNOWN = {"window": 0.0, "u_std": 0.3, "u_length": 10.0, "u_power": 0.0, "u_exponent": 2.0}


def wind(y, z, time):
    """v and w of the pair, which is where it was made at the time MIDDLE."""
    within = y - DRIFT[0] * (time - MIDDLE), z - DRIFT[1] * (time - MIDDLE)
    return [part + mean for part, mean in zip(velocity(PAIR, *within), MEAN, strict=True)]


def vectors(stderr=0.05, seed=None):
    """Row by row, upwards, in 0.1 s."""
    y, z = np.meshgrid(Y, Z)
    time = MIDDLE + 0.1 * (z - Z[0]) / np.ptp(Z) - 0.05
    fields = dict(zip("vw", wind(y, z, time), strict=True))
    if seed is not None:
        random = np.random.default_rng(seed)
        fields = {n: f + stderr * random.standard_normal(f.shape) for n, f in fields.items()}
    even = np.full(y.shape, stderr)
    fields |= {"v_stderr": even, "w_stderr": even, "vw_correlation": 0 * even, "time": time}
    return xr.Dataset(
        {n: (("z", "y"), f) for n, f in fields.items()}
        | {"flag": (("z", "y"), np.zeros(y.shape, np.uint8))},
        coords={"y": ("y", Y, {"units": "m"}), "z": ("z", Z, {"units": "m"})},
        attrs={"template": 1, "stride": 1},
    )


def sights(std=0.05, seed=1, distance=60.0):
    """9 x 7 lines of air with u = 0, column by column in 0.1 s about the first image."""
    y, z = (a.ravel() for a in np.meshgrid(np.linspace(-28, 28, 9), np.linspace(-18, 18, 7)))
    ends = np.column_stack([np.full(y.shape, distance), y, z])
    reach = np.linalg.norm(ends, axis=1)
    direction = ends / reach[:, None]
    time = 0.1 * (y - y.min()) / np.ptp(y) - 0.05
    along = (direction[:, 1:] * np.transpose(wind(y, z, time))).sum(1)
    noise = std * np.random.default_rng([seed, 1]).standard_normal(len(y))
    return xr.Dataset(
        {
            "v_los": ("line", noise - along),
            "v_los_std": ("line", np.full(len(y), std)),
            "range": ("line", reach),
            "range_bin": ((), 0.0),
            "platform_velocity": ("axis", np.zeros(3)),
            "time": ("line", time),
        },
        coords={"direction": (("line", "axis"), direction)},
    )


def test_both_lidars_at_one_time():
    """u is 0: what lines and vectors of other times leave of a pair appears as u."""
    flow, scan = vectors(), sights(std=0.01)
    moved = combine(flow, scan, time=0.0, drift=DRIFT, **KNOWN)
    ignored = combine(flow, scan, time=0.0, **KNOWN)
    true = wind(*np.meshgrid(Y, Z), 0.0)
    inside = (moved["flag"] == 0) & (ignored["flag"] == 0)

    def rms(found, name, exact):
        return float(((found[name] - exact).where(inside) ** 2).mean()) ** 0.5

    assert rms(moved, "u", 0.0) < 0.02 and rms(ignored, "u", 0.0) > 5 * rms(moved, "u", 0.0)
    for name, exact in zip("vw", true, strict=True):
        assert rms(moved, name, exact) < 0.01 < 0.05 < rms(ignored, name, exact)
    assert float(moved["time"]) == 0.0 and moved.attrs["drift"] == list(DRIFT)


def test_stated_errors_hold_at_another_time():
    """v and w of noisy vectors, read between nodes, in 3 draws: 68 and 95 % or more.

    Splines between nodes average independent noise, so that errors are at most as stated.
    """
    true, off = wind(*np.meshgrid(Y, Z), MIDDLE), []
    for seed in range(3):
        flow, scan = vectors(0.2, seed), sights(0.1, seed)
        found = combine(flow, scan, time=MIDDLE, drift=DRIFT, **KNOWN)
        valid = (found["flag"] == 0).values
        for name, exact in zip("vw", true, strict=True):
            off.append(((found[name] - exact) / found[f"{name}_stderr"]).values[valid])
    off = np.abs(np.concatenate(off))
    assert (off < 1).mean() > 0.66 and (off < 1.96).mean() > 0.93
    assert 0.6 < (off**2).mean() < 1.1


@pytest.mark.parametrize("noise", [0.0, 0.2])
def test_drift_from_the_wind(noise):
    """That of the pair in closed form, the mean wind and its descent of 2.1 m/s."""
    v, w = estimated_drift(vectors(noise or 0.05, 1 if noise else None)).velocity
    assert v == pytest.approx(DRIFT[0], abs=0.1)
    assert w == pytest.approx(DRIFT[1], abs=0.25)


def test_drift_has_its_stated_error():
    """Over 60 draws of noise: the mean square over the stated one to 4 sigma, 0.27 to 1.73.

    Errors are independent, the stated ones the larger of two of this size: below 1 by up to 0.3.
    """
    exact = np.array(estimated_drift(vectors(1e-6)).velocity)
    found = [estimated_drift(vectors(0.2, seed)) for seed in range(60)]
    off = (np.array([one.velocity for one in found]) - exact) / [one.std for one in found]
    four = 4 * (2 / 60) ** 0.5
    assert np.all(1 - 0.3 - four < (off**2).mean(0)) and np.all((off**2).mean(0) < 1 + four)


def test_vortices_that_drift_apart():
    """One at rest, one that is carried with 2 m/s: a scatter of 1 m/s about the mean."""
    flow = vectors(1e-6)
    y = flow["y"]
    single = [velocity(PAIR[n : n + 1], *np.meshgrid(Y, Z)) for n in (0, 1)]
    weight = ((y > 0) * 2.0).broadcast_like(flow["v"]).values
    flow["v"][:] = single[0][0] + single[1][0] + weight
    flow["w"][:] = single[0][1] + single[1][1]
    found = estimated_drift(flow)
    assert found.velocity[0] == pytest.approx(1.0, abs=0.05)
    assert found.std[0] == pytest.approx(1.0, abs=0.05) and found.std[1] < 0.3


def test_a_drift_that_is_wrong_is_in_the_stated_errors():
    """Wrong by its standard error of 1 m/s along y or z: errors of vectors and lines are 1 sigma.

    To 10 %, where gradients are resolved. Without, the stated errors of 1 mm/s are those of the
    vectors.
    """
    flow, scan = vectors(0.001), sights(1e-3)
    scan["v_los"][:] = scan["v_los"] - 1e-3 * np.random.default_rng([1, 1]).standard_normal(63)
    grid = np.meshgrid(Y, Z)
    for axis in range(2):
        wrong, std = np.array(DRIFT), np.zeros(2)
        wrong[axis] += 1.0
        std[axis] = 1.0
        found, lines = at_common_time(flow, scan, 0.0, tuple(wrong), tuple(std))
        valid = (found["flag"] == 0).values
        for name, exact in zip("vw", wind(*grid, 0.0), strict=True):
            off, stated = (found[name].values - exact)[valid], found[f"{name}_stderr"].values[valid]
            large = stated > 0.05
            assert large.sum() > 50
            assert np.sqrt((off[large] ** 2).mean() / (stated[large] ** 2).mean()) == pytest.approx(
                1, abs=0.1
            )
        direction = lines["direction"].values
        places = lines["origin"].values + direction * lines["range"].values[:, None]
        along = (direction[:, 1:] * np.transpose(wind(*places.T[1:], 0.0))).sum(1)
        off, stated = lines["v_los"].values + along, lines["v_los_std"].values
        assert np.sqrt((off**2).mean() / (stated**2).mean()) == pytest.approx(1, abs=0.1)


def test_a_steady_wind_has_one_time():
    flow, scan = vectors(), sights()
    assert at_common_time(flow, scan, 7.0, (0.0, 0.0)) == (flow, scan)
    bare = combine(flow.drop_vars("time"), scan.drop_vars("time"), **KNOWN)
    assert "time" not in bare
    xr.testing.assert_identical(
        combine(flow, scan, **KNOWN).drop_vars("time").drop_attrs(), bare.drop_attrs()
    )


def test_vectors_beside_flagged_ones_are_flagged():
    flow = vectors()
    flow["flag"][25, 40] = 4
    found, _ = at_common_time(flow, sights(), MIDDLE + 0.1, (0.5, 0.5))
    assert (found["flag"].values[24:28, 39:43] > 0).sum() == 4
    assert np.isnan(found["v"].values[found["flag"] > 0]).all()


@pytest.mark.parametrize(
    ("flow", "time", "drift", "says"),
    [
        (vectors().drop_vars("time"), 0.0, (1.0, 0.0), "crossflow.time: missing"),
        (vectors(), np.nan, (1.0, 0.0), "time: nan is not allowed"),
        (vectors(), 0.0, (np.inf, 0.0), "drift: .* is not allowed"),
    ],
)
def test_bad_input(flow, time, drift, says):
    with pytest.raises(InputError, match=says):
        combine(flow, sights(), time=time, drift=drift)


def test_no_vorticity_no_drift():
    flow = vectors()
    flow["flag"][:] = 1
    with pytest.raises(InputError, match="no vorticity is known"):
        estimated_drift(flow)
