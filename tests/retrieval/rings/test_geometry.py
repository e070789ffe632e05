"""Where a tilted camera and a distorting lens put pixels, against rays and planes in numpy.

Detects: tilts that are exchanged or of the wrong sign, a distortion inverted to first order only,
an axis that is not in its place, derivatives of another sign or size, and limits not checked.
"""

import math

import numpy as np
import pytest
import torch
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation

from lidar_mi.errors import InputError
from lidar_mi.retrieval.rings.geometry import Geometry, by_tilt_and_distortion, straightened

FOCAL, AXIS, HALF = 10000.0, (121.0, 97.5), 155.0
PLACES = np.random.default_rng(1).uniform((0, 0), (240, 195), (30, 2))


def geometry(**changes):
    return Geometry(FOCAL, AXIS, HALF, **changes)


def ideal(tilt=(0.0, 0.0), distortion=0.0):
    """The ray through every pixel of the turned camera, in the plane one focal length away."""
    u = PLACES - AXIS
    # a side is farther away where its tilt is positive
    turn = Rotation.from_euler("x", tilt[1]) * Rotation.from_euler("y", -tilt[0])
    point = turn.apply(np.column_stack([u, np.zeros(len(u))])) + np.array([0, 0, FOCAL])
    flat = point[:, :2] * FOCAL / point[:, 2:]
    found = []
    for place in flat:
        distorted = np.hypot(*place) / HALF
        r = brentq(lambda r, d=distorted: r * (1 + distortion * r**2) - d, 0, 2, xtol=1e-14)
        found.append(place * r / distorted)
    return np.array(found) + AXIS


def straight(**changes):
    x, y = (torch.from_numpy(part.copy()) for part in PLACES.T)
    return np.column_stack(straightened(geometry(**changes), x, y))


@pytest.mark.parametrize("tilt", [(0.02, 0.0), (0.0, -0.03), (0.3, 0.2)])
@pytest.mark.parametrize("distortion", [0.0, 0.02, -0.05])
def test_pixels_lie_where_their_rays_meet_the_ideal_plane(tilt, distortion):
    found = straight(tilt=tilt, distortion=distortion)
    np.testing.assert_allclose(found, ideal(tilt, distortion), atol=1e-7)


def test_the_ideal_camera_changes_nothing():
    assert geometry().ideal and not geometry(distortion=1e-9).ideal
    np.testing.assert_array_equal(straight(), PLACES)


@pytest.mark.parametrize(
    "name, changes",
    [
        ("tilt_x", {"tilt": (1e-5, 0.0)}),
        ("tilt_y", {"tilt": (0.0, 1e-5)}),
        ("distortion", {"distortion": 1e-6}),
    ],
)
def test_derivatives_are_differences(name, changes):
    """Of r^2 from a centre beside the axis; to first order in the field's angle, 1 %."""
    centre = (119.0, 99.0)
    step = max(np.abs(np.ravel(list(changes.values()))))
    r2 = ((straight(**changes) - centre) ** 2).sum(1) - ((PLACES - centre) ** 2).sum(1)
    x, y = (torch.from_numpy(part) for part in (PLACES - centre).T)
    found = dict(
        zip(
            ("tilt_x", "tilt_y", "distortion"),
            by_tilt_and_distortion(geometry(), centre, x, y),
            strict=True,
        )
    )[name].numpy()
    np.testing.assert_allclose(found, r2 / step, atol=0.01 * np.abs(r2 / step).max())


@pytest.mark.parametrize(
    "changes, message",
    [
        ({"tilt": (math.pi / 6, 0.0)}, "tilt: .* expected less than 30 degrees"),
        ({"tilt": (0.0, math.nan)}, "tilt"),
        ({"distortion": 0.1}, "distortion: 0.1 is not allowed"),
        ({"distortion": math.nan}, "distortion"),
    ],
)
def test_limits(changes, message):
    with pytest.raises(InputError, match=message):
        geometry(**changes)
