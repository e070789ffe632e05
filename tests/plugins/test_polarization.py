"""Reference axes and the rotation of Stokes vectors. Detects a wrong sign or angle, 1e-6."""

import mitsuba as mi
import numpy as np
import pytest
from lidar_mi.plugins.polarization import (
    horizontal_axis,
    rotate_stokes,
    scattering_angle,
    transverse,
)

pytestmark = pytest.mark.usefixtures("variant")


def test_horizontal_axis_is_horizontal_perpendicular_and_unit(optics):
    rng = np.random.default_rng(1)
    direction = optics.unit_vectors(rng, 500)
    axis = np.array(horizontal_axis(optics.vector3(direction))).T
    assert np.abs(axis[:, 2]).max() == 0
    assert np.abs((axis * direction).sum(1)).max() < 1e-6
    assert np.linalg.norm(axis, axis=1) == pytest.approx(1, abs=1e-6)
    # port for a beam straight ahead: (1, tan theta, tan phi) has theta positive towards +y
    assert np.array(horizontal_axis(mi.Vector3f(1, 0, 0))).ravel() == pytest.approx([0, 1, 0])


@pytest.mark.parametrize("up", [1.0, -1.0])
def test_horizontal_axis_of_vertical_light_is_y(up):
    assert np.array(horizontal_axis(mi.Vector3f(0, 0, up))).ravel() == pytest.approx([0, 1, 0])


def test_stokes_vector_referred_to_another_axis_is_that_of_the_same_field(optics):
    rng = np.random.default_rng(2)
    direction = optics.unit_vectors(rng, 300)
    field = optics.jones(rng, direction)
    one, other = optics.perpendicular(direction, rng), optics.perpendicular(direction, rng)
    about_one = optics.stokes(field, one, np.cross(direction, one))
    about_other = optics.stokes(field, other, np.cross(direction, other))
    turned = rotate_stokes(
        [mi.Float(component) for component in about_one.T],
        *(optics.vector3(v) for v in (direction, one, other)),
    )
    assert np.abs(np.array([np.array(t) for t in turned]).T - about_other).max() < 2e-6


def test_transverse_is_the_perpendicular_part(optics):
    rng = np.random.default_rng(3)
    direction, axis = optics.unit_vectors(rng, 100), optics.unit_vectors(rng, 100)
    found = np.array(transverse(optics.vector3(axis), optics.vector3(direction))).T
    part = axis - direction * (axis * direction).sum(1, keepdims=True)
    assert np.abs(found - optics.normalized(part)).max() < 1e-5


@pytest.mark.slow
@pytest.mark.parametrize("angle", [0.0, 1e-4, 1.0, np.pi - 1e-4, np.pi])
def test_scattering_angle_keeps_its_digits_at_both_ends(angle):
    """An arc cosine would be wrong by 3e-4 rad there."""
    wo = mi.Vector3f(float(np.sin(angle)), 0, float(np.cos(angle)))
    found = scattering_angle(mi.Vector3f(0, 0, 1), wo)
    assert np.array(found)[0] == pytest.approx(angle, abs=3e-7)
