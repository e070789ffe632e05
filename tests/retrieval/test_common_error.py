"""Errors that all vectors of an image pair share, by unknown pointing.

Detects an error that is counted twice or lost, one that spreads to what pointing does not change,
and platforms whose known rotation leaves 0.02 m/s. `validation.timing` has unknown pointing.
"""

from dataclasses import replace

import numpy as np
import pytest
import xarray as xr

from lidar_mi.atmosphere.vortices.vortex import velocity
from lidar_mi.errors import InputError
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
