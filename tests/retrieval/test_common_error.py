"""Errors that all vectors of an image pair share, by unknown pointing.

Fast: detects an error that is counted twice or lost, and one that spreads to what pointing does not
change. Slow: stated errors that cover 5 points more or less of random pointing errors than 68 and
95 %, and platforms whose known rotation leaves 0.02 m/s.
"""

from dataclasses import replace

import numpy as np
import pytest
import xarray as xr
from scipy.stats import norm

from lidar_mi.atmosphere.texture import gaussian_field
from lidar_mi.atmosphere.vortices.vortex import Vortex, velocity
from lidar_mi.errors import InputError
from lidar_mi.instrument.doppler import DopplerLidar
from lidar_mi.instrument.doppler_scan import DopplerScan, scan_wind
from lidar_mi.retrieval.combined.combine import combine
from lidar_mi.retrieval.common_error import (
    common_rotation,
    common_stderr,
    own_errors,
    with_common_error,
)
from lidar_mi.retrieval.images.gridding import on_nodes
from lidar_mi.retrieval.vortices.acceptance import no_fit
from lidar_mi.retrieval.vortices.image_fit import fit_vortices
from lidar_mi.retrieval.vortices.vector_fit import fit_vortices_to_wind
from lidar_mi.retrieval.wind.pair import retrieve_wind
from tests.support.flows import axes, data_array, plane_waves, texture
from tests.support.vortex_pairs import uneven, vector

RANGE, DT = 500.0, 0.1
METRES = {"units": "m"}


def vectors(v, w, stderr, y, z, correlation=0.3):
    shape = len(z), len(y)
    fields = {"v": v, "w": w, "v_stderr": stderr, "w_stderr": stderr, "vw_correlation": correlation}
    return xr.Dataset(
        {name: (("z", "y"), np.broadcast_to(f, shape) * 1.0) for name, f in fields.items()}
        | {"flag": (("z", "y"), np.zeros(shape, np.uint8))},
        coords={"z": ("z", z, METRES), "y": ("y", y, METRES)},
        attrs={"template": 4, "stride": 1},
    )


def test_what_is_shared_comes_off_again():
    y, z = axes(8, 6)
    own = vectors(1.0, 2.0, np.linspace(0.05, 0.4, 8), y, z)
    stated = with_common_error(own, 5.0)
    covariance = [f["vw_correlation"] * f["v_stderr"] * f["w_stderr"] for f in (own, stated)]
    np.testing.assert_allclose(*covariance, rtol=1e-12)
    np.testing.assert_allclose(stated["v_stderr"] ** 2 - own["v_stderr"] ** 2, 25.0)
    stderr = np.stack([stated["v_stderr"], stated["w_stderr"]])
    found, rho = own_errors(stderr, stated["vw_correlation"].values, common_stderr(stated))
    np.testing.assert_allclose(found[0], own["v_stderr"], rtol=1e-9)
    np.testing.assert_allclose(rho, own["vw_correlation"], rtol=1e-9)
    with pytest.raises(InputError, match="stderr: -1 m/s is not allowed"):
        with_common_error(own, -1)


def test_pair_fitted_to_vectors():
    """Only the mean wind, and what follows from it, is less certain."""
    y, z = axes(27, 21, 2.3)
    random = np.random.default_rng(1)
    at = np.meshgrid(y, z)
    v, w = (part + 0.3 * random.standard_normal(part.shape) for part in velocity(uneven(), *at))
    own = vectors(v, w, 0.3, y, z, 0.0)
    without, found = fit_vortices_to_wind(own), fit_vortices_to_wind(with_common_error(own, 2.0))
    assert found.success
    np.testing.assert_allclose(found.parameters, without.parameters, rtol=1e-6, atol=1e-6)
    more = found.covariance - without.covariance
    np.testing.assert_allclose(np.diag(more)[8:], 4.0, rtol=1e-3)
    np.testing.assert_allclose(more[:8, :8], 0, atol=1e-3)
    names = ("port_circulation", "separation", "descent_speed", "port_core_radius")
    for name in names:
        ratio = found.quantities[name].stderr / without.quantities[name].stderr
        assert ratio == pytest.approx(1, rel=1e-2), name
    assert found.quantities["drift_v"].stderr == pytest.approx(2.0, rel=0.02)
    assert vector(*uneven())[0] == pytest.approx(found.port.circulation, rel=0.1)


TURN, TURN_ERROR = 0.02, 0.015  # rad/s


def turned_vectors(turn, noise, own, y, z):
    """A pair's wind and a rotation about the axis, from +y towards +z."""
    at = np.meshgrid(y, z)
    v, w = velocity(uneven(), *at)
    return vectors(v - turn * at[1] + noise[0], w + turn * at[0] + noise[1], own, y, z, 0.0)


def test_a_rotation_of_vectors_is_part_of_their_errors():
    y, z = axes(8, 6, 3.0)
    own = vectors(1.0, 2.0, 0.2, y, z)
    axis = (2.0, -1.0)
    found = with_common_error(own, 0.5, "known", TURN_ERROR, axis)
    # the same covariance from its definition: C = own + c^2 + s^2 g g^T, g = (-(z - z0), y - y0)
    g = np.stack(np.meshgrid(y - axis[0], z - axis[1]))[::-1] * np.array([-1, 1])[:, None, None]
    for index, name in enumerate("vw"):
        expected = 0.2**2 + 0.5**2 + (TURN_ERROR * g[index]) ** 2
        np.testing.assert_allclose(found[f"{name}_stderr"] ** 2, expected, rtol=1e-9)
    both = found["vw_correlation"] * found["v_stderr"] * found["w_stderr"]
    np.testing.assert_allclose(both, 0.3 * 0.2**2 + TURN_ERROR**2 * g.prod(0), rtol=1e-9)
    assert common_rotation(found) == (TURN_ERROR, axis)
    with pytest.raises(InputError, match="rotation: nan rad/s is not allowed"):
        with_common_error(own, 0.0, rotation=np.nan)


def test_what_a_turn_does_to_a_pair():
    """It is a gradient of the ambient wind: the mean wind at the pair alone follows it.

    A pair that was read has no `turned`.
    """
    y, z = axes(27, 21, 2.3)
    noise = 0.05 * np.random.default_rng(2).standard_normal((2, len(z), len(y)))
    still, turning = (
        fit_vortices_to_wind(turned_vectors(turn, noise, 0.5, y, z)) for turn in (0.0, TURN)
    )
    change = turning.parameters - still.parameters
    stderr = np.sqrt(np.diag(still.covariance))
    assert (np.abs(change[:8]) < 0.05 * stderr[:8]).all()
    np.testing.assert_allclose(change[8:], TURN * still.turned[8:], atol=0.05 * stderr[8:].max())
    middle = still.parameters[[2, 3]] / 2 + still.parameters[[6, 7]] / 2
    np.testing.assert_allclose(still.turned[8:], [-middle[1], middle[0]], atol=0.5)
    gradient = turning.ambient.gradient - still.ambient.gradient
    np.testing.assert_allclose(gradient, [0, -TURN, TURN, 0], atol=0.05 * TURN)
    found = still.with_common_error(0.0, 0.0, TURN_ERROR)
    more = np.diag(found.covariance - still.covariance)
    np.testing.assert_allclose(more, (TURN_ERROR * still.turned) ** 2, rtol=1e-6, atol=1e-12)
    # about another axis by the wind there
    moved = still.with_common_error(0.0, 0.0, TURN_ERROR, (10.0, 0.0))
    wind = np.sqrt(np.diag(moved.covariance - still.covariance)[9])
    assert wind == pytest.approx(TURN_ERROR * abs(still.turned[9] - 10.0), rel=1e-6)
    with pytest.raises(InputError, match=r"rotation_stderr: 0.015 rad/s is not"):
        replace(still, turned=None).with_common_error(0.0, 0.0, TURN_ERROR)
    # no fit at all stays one, with its reasons
    nothing = no_fit("lamb_oseen", "no vortex signature")
    assert nothing.with_common_error(0.0, 0.0, TURN_ERROR).reasons == nothing.reasons


def turned_images(turn, seed):
    """Air in a pair's wind, and the second image turned by what a roll of the platform does."""
    y, z = axes(101, 66, 0.8)
    nodes, angle = np.stack(np.meshgrid(y, z)), turn * DT
    turned = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    waves, images = plane_waves(seed, 4.0, 0.3), []
    random = np.random.default_rng([seed, 1])
    seen = (nodes, np.einsum("ab,bzy->azy", turned, nodes))
    for places, seconds in zip(seen, (-DT / 2, DT / 2), strict=True):
        for _ in range(8):
            middle = places - np.stack(velocity(uneven(), *places)) * seconds / 16
            places = places - np.stack(velocity(uneven(), *middle)) * seconds / 8
        noise = 0.01 * random.standard_normal(places[0].shape)
        images.append(data_array(texture(waves, *places) + noise, y, z))
    return images


def test_an_unknown_roll_is_not_a_circulation():
    """1.5 mrad between the scans, as of moving_platform with poor navigation: a gradient."""
    found = fit_vortices(*turned_images(TURN_ERROR, 1), DT, 0.01)
    assert found.success, found.reasons
    error = (found.parameters - vector(*uneven())) / np.sqrt(np.diag(found.covariance))
    assert (np.abs(error[:8]) < 3).all()
    np.testing.assert_allclose(found.ambient.gradient, [0, -TURN_ERROR, TURN_ERROR, 0], atol=0.005)


def rotated(pitch, yaw, roll, known, seed):
    """Wind of air at rest, with the beams of scan 2 rotated by small angles (rad)."""
    y, z = axes(70, 60)
    nodes = np.stack(np.meshgrid(y, z))
    waves = plane_waves(seed, 4.0, 0.5)
    places = nodes + np.stack([RANGE * yaw - roll * nodes[1], RANGE * pitch + roll * nodes[0]])
    images = [data_array(texture(waves, *at), y, z) for at in (nodes, places)]
    if known:
        reported = {
            f"{axis}_reported": data_array(part, y, z)
            for axis, part in zip("yz", places, strict=True)
        }
        images[1] = on_nodes(xr.Dataset({"Y": images[1]} | reported))["Y"]
    return retrieve_wind(*images, DT, "multipass", checks=False, standard_errors=False)


@pytest.mark.slow
def test_platform_that_rotates_between_the_scans():
    """Unknown: range times angle over dt, and a rotation by roll. Known: below 0.02 m/s.

    Mean over four textures, each of which alone leaves 0.02 m/s.
    """
    angles = 0.6e-3, -0.37e-3, 5e-3
    pitch, yaw, roll = angles
    known, unknown = ([rotated(*angles, told, seed) for seed in range(4)] for told in (True, False))
    # what is seen further to port appears further to starboard
    at = unknown[0]
    expected = {
        "v": -(RANGE * yaw - roll * at["z"]) / DT,
        "w": -(RANGE * pitch + roll * at["y"]) / DT,
    }
    for name, wrong in expected.items():
        mean = np.mean([float(wind[name].where(wind["flag"] == 0).mean()) for wind in known])
        assert abs(mean) < 0.02
        mean = np.mean([float((wind[name] - wrong).mean()) for wind in unknown])
        assert abs(mean) < 0.02 and float(abs(wrong).mean()) > 1.8


def drawn(members, seed):
    """Normal errors whose distribution is met exactly: quantiles in random order (members, 2)."""
    quantiles = norm.ppf((np.arange(members) + 0.5) / members)
    random = np.random.default_rng(seed)
    return np.stack([random.permutation(quantiles) for _ in range(2)], -1)


def covered(errors):
    """Fractions of normalised errors within 1 and 1.96."""
    errors = np.abs(np.concatenate([np.ravel(part) for part in errors]))
    errors = errors[np.isfinite(errors)]
    return np.mean(errors < 1), np.mean(errors < 1.96)


@pytest.mark.slow
def test_coverage_of_vectors_from_images():
    """64 members with pitch and yaw of 0.1 mrad rms between the scans, of 3 % noise.

    Air of its own in each, in a wind of its own. 0.5 m/s by pointing, five times that by noise.
    """
    stderr, y, z = 1e-4, *axes(48, 40)
    nodes, errors = np.stack(np.meshgrid(y, z)), []
    for member, angle in enumerate(stderr * drawn(64, 7)):
        random = np.random.default_rng([member, 9])
        wind, waves = random.uniform(-8, 8, 2), plane_waves(100 + member, 3.0, 0.5)
        shift = np.reshape(RANGE * angle - DT * wind, (2, 1, 1))
        images = [
            data_array(texture(waves, *at) + 0.03 * random.standard_normal(nodes.shape[1:]), y, z)
            for at in (nodes, nodes + shift)
        ]
        found = retrieve_wind(*images, DT, "multipass", noise=0.03)
        found = with_common_error(found, RANGE * stderr / DT)
        for name, true in zip("vw", wind, strict=True):
            errors.append(((found[name] - true) / found[f"{name}_stderr"]).values)
    one, two = covered(errors)
    assert abs(one - 0.68) < 0.05 and abs(two - 0.95) < 0.05, (one, two)


@pytest.mark.slow
@pytest.mark.parametrize("offset", ["known", "free"])
def test_coverage_of_both_lidars_combined(offset):
    """64 members with pitch and yaw of 0.4 mrad rms between the scans: 2 m/s.

    Vortices and a turbulent u of their own in each, 63 lines of 0.3 m/s. v and w, and what
    the estimate leaves of the common error: within 5 points, and 2 standard errors
    where draws are few.
    """
    y, z = np.arange(-40.0, 40.1, 2.0), np.arange(-26.0, 26.1, 2.0)
    stderr, grid = 0.4e-3, np.meshgrid(y, z)
    common, own, errors, left = RANGE * stderr / DT, 0.3, {name: [] for name in "uvw"}, []
    lidar = DopplerLidar(range=f"{RANGE} m")
    directions = DopplerScan(azimuth_half="0.075 rad", elevation_half="0.046 rad")
    for member, pointing in enumerate(common * drawn(64, 8)):
        random = np.random.default_rng([member, 10])
        side, radius = random.uniform(10, 20), random.uniform(2, 5)
        pair = [Vortex(s * random.uniform(200, 450), radius, s * side, 0.0) for s in (1, -1)]
        v, w = np.add(velocity(pair, *grid), np.reshape(random.uniform(-5, 5, 2), (2, 1, 1)))
        gusts = gaussian_field(v.shape, (2.0, 2.0), 20.0, member)
        u = random.uniform(-5, 5) + random.uniform(0.5, 2) * gusts / gusts.std()
        fields = dict(zip("uvw", (u, v, w), strict=True))
        truth = xr.Dataset(
            {name: (("z", "y"), field) for name, field in fields.items()},
            {"z": ("z", z, METRES), "y": ("y", y, METRES)},
        )
        scan = scan_wind(truth, directions, lidar, 0.0, member, 75.0)
        noise = 0.3 * random.standard_normal(scan.sizes["line"])
        scan = scan.assign(
            v_los=scan["v_los_true"] + noise, v_los_std=("line", np.full(noise.size, 0.3))
        )
        measured = [
            part + shared + own * random.standard_normal(part.shape)
            for part, shared in zip((v, w), pointing, strict=True)
        ]
        flow = with_common_error(vectors(*measured, own, y, z, 0.0), common, offset)
        found = combine(flow, scan, window=0.0)
        for name, field in fields.items():
            errors[name].append(((found[name] - field) / found[f"{name}_stderr"]).values)
        if offset == "free":
            for name, shared in zip("vw", pointing, strict=True):
                error = float(found[f"{name}_offset"]) - shared
                left.append(error / float(found[f"{name}_common_stderr"]))
                assert float(found[f"{name}_common_stderr"]) < common
    check = [[*errors["v"], *errors["w"]]] + ([left] if offset == "free" else [])
    for part in check:
        one, two = covered(part)
        # what lines leave of the common error is one draw per member and component
        chance = 2 * (offset == "free") / np.sqrt(128)
        assert abs(one - 0.68) < 0.05 + chance * np.sqrt(0.68 * 0.32), one
        assert abs(two - 0.95) < 0.05 + chance * np.sqrt(0.95 * 0.05), two
