"""Wind from volumes with exactly known motion: random waves carried by flows in closed form.

Detects displacements off by more than 0.07 voxel,
standard errors wrong by a third, a bound that does not follow from the likelihood, and volumes that
no wind can be found from but are given one.
"""

import numpy as np
import pytest
import torch
import xarray as xr

from lidar_mi.errors import InputError
from lidar_mi.retrieval.velocimetry.quality import Flag
from lidar_mi.retrieval.velocimetry.volume import retrieve_wind_volume

SPACING, DT = 0.5, 0.1
CONTRAST, LENGTH = 0.1, 3.0


def waves(seed=0, number=300):
    """Random waves, together a texture with a Gaussian correlation of 3 voxels and rms 1."""
    rng = np.random.default_rng(seed)
    k = rng.standard_normal((number, 3)).astype(np.float32) / LENGTH
    phase = rng.uniform(0, 2 * np.pi, number).astype(np.float32)

    def texture(place):
        flat = place.reshape(3, -1).astype(np.float32)
        total = np.zeros(flat.shape[1], np.float32)
        for wave, start in zip(k, phase):
            total += np.cos(wave @ flat + start)
        return total.reshape(place.shape[1:]) * np.sqrt(2 / number)

    return texture


def nodes(shape):
    return np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij")).astype(float)


def volume(values):
    axes = {
        name: (name, SPACING * np.arange(n), {"units": "m"}) for name, n in zip("xzy", values.shape)
    }
    return xr.DataArray(values, axes, ("x", "z", "y"))


def carried(shape, back, noise, seed=0):
    """Two volumes dt apart; back(place, t) is where air was at mid-time, t from it in dt."""
    texture, rng = waves(seed), np.random.default_rng(seed + 1)
    return [
        volume(1 + CONTRAST * texture(back(nodes(shape), t)) + noise * rng.standard_normal(shape))
        for t in (-0.5, 0.5)
    ]


def errors(found, true):
    """Errors in voxels, by component, where true(place) gives voxels in dt, and reduced ones."""
    places = np.stack(np.meshgrid(*(found[a].values / SPACING for a in "xzy"), indexing="ij"))
    off, reduced = {}, {}
    for name, expected in zip(("u", "w", "v"), true(places)):
        off[name] = (found[name].values * DT / SPACING - expected)[found["flag"].values == 0]
        reduced[name] = (
            off[name] / (found[f"{name}_stderr"].values * DT / SPACING)[found["flag"].values == 0]
        )
    return off, reduced


def rms(values):
    return float(np.sqrt(np.mean(np.square(values))))


SHIFT = np.array([0.37, -1.21, 1.74])


@pytest.mark.parametrize("method", ["correlation", "variational"])
def test_rigid_shift(method):
    """Nothing bends: errors are those of the noise, 1 % of the mean, a tenth of the texture."""
    shape = (16, 24, 28)
    pair = carried(shape, lambda x, t: x - t * SHIFT[:, None, None, None], 0.01)
    found = retrieve_wind_volume(*pair, DT, method, noise=0.01)
    off, reduced = errors(found, lambda x: SHIFT[:, None, None, None] + 0 * x)
    assert (found["flag"] == 0).mean() > 0.9
    for name in "uvw":
        assert rms(off[name]) < 0.05, name
        # a flow that is found to be rigid has errors so small that what faces do counts
        assert rms(reduced[name]) < (1.5 if method == "correlation" else 3), name


@pytest.mark.parametrize("method", ["correlation", "variational"])
def test_solid_rotation_about_x(method):
    """15 degrees in dt: paths are arcs, whose chords are 0.3 % too short; with a drift along x."""
    shape, angle = (16, 28, 28), 0.26
    middle = np.array([7.5, 13.5, 13.5])[:, None, None, None]

    def back(x, t):
        _, z, y = x - middle
        c, s = np.cos(t * angle), np.sin(t * angle)
        return np.stack([x[0] - 0.4 * t, c * z - s * y, s * z + c * y]) + middle * [
            [[[0]]],
            [[[1]]],
            [[[1]]],
        ]

    def true(x):
        _, z, y = x - middle
        return np.stack([0.4 + 0 * z, angle * y, -angle * z])

    found = retrieve_wind_volume(*carried(shape, back, 0.01), DT, method, noise=0.01)
    off, _ = errors(found, true)
    assert (found["flag"] == 0).mean() > 0.85
    for name in "uvw":
        assert rms(off[name]) < 0.07, name
        assert abs(np.mean(off[name])) < 0.05, name


def vortex_pair(shape, steps=8):
    """Two Lamb-Oseen vortices along x with a wavy wind along them: velocity and way back."""
    gamma, core, apart, height, width = 400.0 * DT / SPACING**2, 6.0, 34.0, *shape[1:]

    def velocity(x):
        total = np.zeros_like(x)
        total[0] = 0.2 + 0.3 * np.sin(2 * np.pi * x[2] / 40) * np.cos(2 * np.pi * x[1] / 30)
        for sign in (1, -1):
            dy = x[2] - (width - 1) / 2 - sign * apart / 2
            dz = x[1] - (height - 1) / 2
            square = np.maximum(dy**2 + dz**2, 1e-9)
            turn = sign * gamma / (2 * np.pi * square) * -np.expm1(-1.25643 * square / core**2)
            total[1] += turn * dy
            total[2] -= turn * dz
        return total

    def back(x, t):
        h = -t / steps
        for _ in range(steps):
            k1 = velocity(x)
            k2 = velocity(x + h / 2 * k1)
            k3 = velocity(x + h / 2 * k2)
            x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + velocity(x + h * k3))
        return x

    return velocity, back


@pytest.mark.slow
@pytest.mark.parametrize(("noise", "limit"), [(0.01, 0.045), (0.03, 0.08)])
def test_vortices_along_x(noise, limit):
    """Variational: better than correlation, with standard errors that hold."""
    shape = (24, 56, 80)
    velocity, back = vortex_pair(shape)
    pair = carried(shape, back, noise)
    level = {}
    for method in ("correlation", "variational"):
        found = retrieve_wind_volume(*pair, DT, method, noise=noise)
        off, reduced = errors(found, velocity)
        level[method] = {name: rms(off[name]) for name in off}
        assert (found["flag"] == 0).mean() > 0.9
    for name in "uvw":
        assert level["variational"][name] < limit, (name, level)
        assert level["correlation"][name] < 0.2, (name, level)
        assert 0.6 < rms(reduced[name]) < 1.35, (name, rms(reduced[name]))
    both = [rms([level[method][name] for name in "vw"]) for method in level]
    assert both[1] < 0.7 * both[0]


def test_errors_reach_the_bound_of_a_known_shift():
    """A tiny case against the Fisher information, by differences of the texture itself.

    One rigid shift of both volumes, texture unknown: the differences of the volumes have twice the
    noise, so the information is that of sum |grad texture|^2 / (2 noise^2). A window of the
    correlation sees the Gaussian's share of it, has gradients to find as well, and can do no better.
    """
    shape, noise, step = (12, 12, 12), 0.01, 1e-2
    texture, places = waves(3, 120), nodes(shape)
    weight = np.exp(-((places - 5.5) ** 2).sum(0) / (2 * (8 / 3) ** 2))
    slopes = []
    for axis in range(3):
        move = step * np.eye(3)[axis][:, None, None, None]
        slopes.append((texture(places + move).astype(float) - texture(places - move)) / (2 * step))
    slopes = CONTRAST * np.stack(slopes)
    # least squares with these weights, its exact covariance, the gradients left out
    matrix = np.einsum("axyz,bxyz,xyz->ab", slopes, slopes, weight)
    square = np.einsum("axyz,bxyz,xyz->ab", slopes, slopes, weight**2)
    inverse = np.linalg.inv(matrix)
    bound = np.sqrt(2 * noise**2 * np.diag(inverse @ square @ inverse))
    all_of_it = np.sqrt(
        2 * noise**2 * np.diag(np.linalg.inv(np.einsum("axyz,bxyz->ab", slopes, slopes)))
    )
    rng, found, stated = np.random.default_rng(5), [], []
    shift = np.array([0.2, -0.3, 0.1])[:, None, None, None]
    clean = [1 + CONTRAST * texture(places - t * shift) for t in (-0.5, 0.5)]
    for _ in range(25):
        pair = [volume(values + noise * rng.standard_normal(shape)) for values in clean]
        wind = retrieve_wind_volume(*pair, DT, "correlation", stride=2, noise=noise)
        middle = wind.isel({a: wind.sizes[a] // 2 for a in "xzy"})
        found.append([float(middle[name]) * DT / SPACING for name in "uwv"])
        stated.append([float(middle[f"{name}_stderr"]) * DT / SPACING for name in "uwv"])
    spread = np.std(found, axis=0, ddof=1)
    # 25 draws tell a standard deviation to 14 %: 3 sigma, and what the filter gains
    assert (spread > 0.6 * bound).all() and (spread > all_of_it).all()
    assert (spread < 2 * bound).all(), (spread, bound)
    stated = np.sqrt(np.mean(np.square(stated), axis=0))
    assert (stated > 0.67 * spread).all() and (stated < 2 * spread).all(), (stated, spread)


def test_attenuation_and_brightness_are_no_wind():
    shape = (16, 20, 20)
    pair = carried(shape, lambda x, t: x - t * SHIFT[:, None, None, None], 0.002)
    decay = np.exp(-0.03 * np.arange(16))[:, None, None]
    dimmed = [pair[0] * decay, 3.0 * pair[1] * decay]
    plain, found = (
        retrieve_wind_volume(*p, DT, "correlation", noise=0.002) for p in (pair, dimmed)
    )
    good = (plain["flag"] == 0) & (found["flag"] == 0)
    for name in "uvw":
        off = ((found[name] - plain[name]) * DT / SPACING).where(good)
        assert float(np.abs(off).max()) < 0.02, name


@pytest.mark.parametrize("method", ["correlation", "variational"])
def test_what_holds_no_wind_is_flagged(method):
    shape = (10, 12, 14)
    rng = np.random.default_rng(0)
    flat = volume(np.ones(shape))
    found = retrieve_wind_volume(flat, flat, DT, method)
    assert (found["flag"].values & Flag.NO_MATCH).all() and found["u"].isnull().all()
    unrelated = [volume(1 + 0.1 * rng.standard_normal(shape)) for _ in range(2)]
    found = retrieve_wind_volume(*unrelated, DT, method)
    assert (found["flag"].values != 0).mean() > 0.95
    holed = carried(shape, lambda x, t: x, 0.01)
    holed[1][5, 6, 7] = np.nan
    found = retrieve_wind_volume(*holed, DT, method, stride=1)
    at = found.sel(x=5 * SPACING, z=6 * SPACING, y=7 * SPACING, method="nearest")
    assert int(at["flag"]) & Flag.NON_FINITE_INPUT and np.isnan(at["u"])


def test_result_is_a_cf_data_set():
    pair = carried((10, 12, 14), lambda x, t: x - t * 0.3, 0.01)
    found = retrieve_wind_volume(*pair, DT, "correlation")
    assert found["u"].dims == ("x", "z", "y") and found.attrs["Conventions"] == "CF-1.11"
    assert found["w"].attrs["standard_name"] == "upward_air_velocity"
    # windows of 8 of 10, 12, 14 voxels, every 4: their middles share what is left over
    np.testing.assert_allclose(found["z"] / SPACING, [3.5, 7.5])
    np.testing.assert_allclose(found["x"] / SPACING, [4.5])


ONE = volume(1 + 0.1 * np.random.default_rng(1).standard_normal((10, 10, 10)))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"volume1": ONE[:1], "volume2": ONE[:1]}, "volume1.x: 1 value, not at least two"),
        (
            {"volume1": ONE[:6], "volume2": ONE[:6]},
            "template: 8 voxels do not fit into the volume of 6",
        ),
        ({"volume2": ONE[:9]}, "volume2: sizes 10 x 10 x 10 and 9 x 10 x 10 voxels"),
        ({"volume2": ONE.assign_coords(x=ONE.x + 0.1)}, "volume2.x: "),
        ({"volume1": ONE.rename(x="a")}, "volume1: dims"),
        ({"volume1": ONE.drop_vars("y")}, "volume1.y: coordinate missing"),
        ({"volume1": ONE - 1.5}, "volume1: gates that are 0, negative"),
        ({"dt": 0.0}, "dt: 0.0 s"),
        ({"method": "cc"}, "method: 'cc' is not one of correlation, variational"),
        ({"template": 3}, "template: 3 voxels is not an integer >= 4"),
        ({"search": 9}, "search: 9 voxels is not an integer >= template + 2"),
        ({"stride": 0}, "stride: 0"),
        ({"min_correlation": 2.0}, "min_correlation: 2.0"),
        ({"noise": -1.0}, "noise: below 0"),
        ({"more": [ONE], "method": "correlation"}, "more: 1 volumes are not allowed"),
    ],
)
def test_bad_input_is_named(change, message):
    arguments = {"volume1": ONE, "volume2": ONE, "dt": DT} | change
    with pytest.raises(InputError) as error:
        retrieve_wind_volume(**arguments)
    assert message in str(error.value) and "\n" not in str(error.value)


def test_more_volumes_tell_more():
    """Four instead of two tell the same motion from ten times the squares of the times."""
    shape, noise, shift = (12, 16, 16), 0.05, 0.4 * SHIFT[:, None, None, None]
    texture, rng = waves(2), np.random.default_rng(2)
    stack = [
        volume(
            1 + CONTRAST * texture(nodes(shape) - t * shift) + noise * rng.standard_normal(shape)
        )
        for t in (-1.5, -0.5, 0.5, 1.5)
    ]
    level = []
    for more in ([], stack[2:]):
        first = stack[:2] if more else stack[1:3]
        off, _ = errors(
            retrieve_wind_volume(*first, DT, more=more, noise=noise), lambda x: shift + 0 * x
        )
        level.append(rms([rms(part) for part in off.values()]))
    assert level[1] < 0.6 * level[0] and level[1] < 0.06, level


def test_gradients_of_the_flow_have_their_transpose():
    """<curl and divergence of c, f> = <c, transpose of f>, with voxels of unlike sides."""
    from lidar_mi.retrieval.velocimetry.flow_spline import Axis
    from lidar_mi.retrieval.velocimetry.volume_variational import (
        Knots,
        _curl_and_divergence,
        _curl_and_divergence_pulled,
    )

    axes = [Axis(n, 3.0) for n in (9, 11, 14)]
    places = [torch.linspace(0, n - 1, 2 * n, dtype=torch.float64) for n in (9, 11, 14)]
    knots, spacing = Knots.at(axes, places), (0.5, 0.7, 1.1)
    draw = torch.Generator().manual_seed(0)
    c = torch.randn(3, *(a.knots for a in axes), generator=draw, dtype=torch.float64)
    f = torch.randn(4, *map(len, places), generator=draw, dtype=torch.float64)
    left = (_curl_and_divergence(knots, c, spacing) * f).sum()
    right = (c * _curl_and_divergence_pulled(knots, f, spacing)).sum()
    torch.testing.assert_close(left, right)
    # solid rotation about x by 0.3: vorticity 0.6 along x in space, and nothing else
    z, y = places[1][:, None] * spacing[1], places[2] * spacing[2]
    flow = torch.stack([0 * z * y, 0.3 * y / spacing[1] + 0 * z, -0.3 * z / spacing[2] + 0 * y])
    c = knots.fitted(flow[:, None].expand(-1, len(places[0]), -1, -1).contiguous())
    found = _curl_and_divergence(knots, c, spacing)
    torch.testing.assert_close(found[0].abs(), torch.full_like(found[0], 0.6), atol=1e-3, rtol=0)
    assert found[1:].abs().max() < 1e-3
