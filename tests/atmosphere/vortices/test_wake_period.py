"""Simulated wakes as one period along their axis, of volumes known in closed form. Physics tier.

Detects: a volume that is not periodic but repeated, a mirror or a blend that jumps, moves cores, or
is reported with another divergence than it has; a volume too short that is accepted.
"""

import numpy as np
import pytest
import xarray as xr

from lidar_mi.atmosphere.vortices.wake_path import CROW_WAVELENGTH
from lidar_mi.atmosphere.vortices.wake_period import one_period
from lidar_mi.errors import InputError
from tests.support.wake_volumes import SEPARATION, crow_volume


def test_a_last_plane_that_repeats_the_first_is_left_out():
    flow = crow_volume(waves=2, amplitude=3.0)
    step = float(flow["x"][1] - flow["x"][0])
    closing = flow.isel(x=[0]).assign_coords(x=flow["x"].values[-1:] + step)
    for whole in (xr.concat([flow, closing], "x"), flow):
        found, how = one_period(whole)
        assert found.sizes["x"] == flow.sizes["x"] and how.how == "periodic"
        assert how.period == pytest.approx(2 * CROW_WAVELENGTH * SEPARATION)


@pytest.mark.parametrize(
    ("planes", "what"),
    [(slice(0, 20), "step"), (slice(0, 26), "curvature"), (slice(0, 3), "3 planes")],
)
def test_what_is_not_periodic_is_refused(planes, what):
    """A part of a wave; half a wave of it, which ends where it began, with a bend; too few."""
    # u changes its sign from half a wave to the next, a step
    flow = crow_volume(waves=1, amplitude=3.0).drop_vars("u")
    with pytest.raises(InputError, match=rf"wake\.depth: volume is not allowed.*{what}"):
        one_period(flow.isel(x=planes))


@pytest.fixture(scope="module")
def part():
    """40 % of a wave, 4 m from plane to plane."""
    return crow_volume(waves=1, amplitude=3.0).isel(x=slice(3, 24))


def test_a_mirror_has_the_flow_of_the_file_and_its_image(part):
    closed, how = one_period(part, "mirror", 8.0)
    step, count = float(part["x"][1] - part["x"][0]), part.sizes["x"]
    assert how.how == "mirror" and how.period == pytest.approx(2 * (count - 1) * step)
    for name in ("v", "w", "tracer"):
        values = part[name].values
        np.testing.assert_array_equal(closed[name].values[:count], values)
        np.testing.assert_array_equal(closed[name].values[count:], values[-2:0:-1])
    # at a distance from the mirrors u is the file's, and turned around in the image
    u = closed["u"].values
    np.testing.assert_allclose(u[2 : count - 2], part["u"].values[2 : count - 2])
    np.testing.assert_allclose(u[count + 1 : -1], -part["u"].values[-3:1:-1])
    assert not u[0].any() and not u[count - 1].any()
    np.testing.assert_allclose(np.diff(closed["x"]), step)


def test_a_blend_leads_from_the_end_to_the_start(part):
    closed, how = one_period(part, "blend", 12.0)
    count = part.sizes["x"]
    assert how.how == "blend" and closed.sizes["x"] == count - 3 and how.changed == (0, 1, 2)
    for name in ("u", "v", "w"):
        values, found = part[name].values, closed[name].values
        np.testing.assert_allclose(found[3:], values[3:-3])
        # halfway between start and end in the middle of the blend
        np.testing.assert_allclose(found[1], (values[1] + values[-2]) / 2, atol=1e-12)


def test_divergence_is_that_of_a_flow_known_in_closed_form():
    """u = a x, v = -a y: no divergence; a mirror takes u away where v stays, which leaves -a."""
    x, y, z = np.arange(12.0), np.arange(-6.0, 7), np.arange(-5.0, 6)
    places = np.meshgrid(x, y, z, indexing="ij")
    fields = {"u": 0.1 * places[0], "v": -0.1 * places[1], "w": 0.0 * places[2]}
    flow = xr.Dataset(
        {name: (("x", "y", "z"), a) for name, a in fields.items()}, {"x": x, "y": y, "z": z}
    )
    _, how = one_period(flow, "mirror", 3.0)
    assert how.divergence_before == pytest.approx(0.0, abs=1e-9)
    # by hand: u at the planes -1 to 4 (of the image and the file) is 0.1 times these
    weight = 0.5 * (1 - np.cos(np.pi * np.arange(12) / 3)).clip(0)
    weight[3:9] = 1
    weight[9:] = weight[2::-1]
    u = 0.1 * x * weight
    whole = np.concatenate([u, -u[-2:0:-1]])
    slope = (np.roll(whole, -1) - np.roll(whole, 1)) / 2
    beside = [k for k in range(22) if min(k % 11, 11 - k % 11) <= 3]
    total = np.mean((slope[beside] - 0.1) ** 2)
    square = np.mean(slope[beside] ** 2) + 0.01
    assert how.divergence == pytest.approx(np.sqrt(total / square))


@pytest.mark.parametrize("ends", ["mirror", "blend"])
def test_a_volume_too_short_is_refused(part, ends):
    message = r"encounter\.wake\.ends_length: 60 m is not allowed with a volume of 83\.35 m"
    with pytest.raises(InputError, match=message):
        one_period(part, ends, 60.0)
