"""Scan geometry: where beams go, which ranges they record. Detects 1 um at 500 m."""

import math

import numpy as np
import pytest
from pydantic import ValidationError

from lidar_mi.errors import InputError
from lidar_mi.instrument.scan import Scan, ScanPlan, plan_scans

Y = np.arange(-54.5, 54.6, 0.5)
Z = np.arange(-34.5, 34.6, 0.5)


def plan(**changes):
    values = {
        "y": Y,
        "z": Z,
        "gate_start": 500.0,
        "gate_stop": 502.5,
        "gate_kind": "planar",
        "gate_count": 1,
        "position": 0.0,
    }
    return ScanPlan(**(values | changes))


def test_grid_beams_hit_the_same_nodes_of_the_air_at_both_times():
    """The telescope has moved on by 15 m: in the air's frame the beams' targets stay."""
    first, second = plan_scans(Scan(), Y, Z, (0.0, 15.0))
    for scan, start in ((first, 500.0), (second, 485.0)):
        assert (scan.gate_start, scan.gate_stop) == (start, start + 2.5)
        rays = scan.directions().reshape(139, 219, 3)
        assert np.linalg.norm(rays, axis=-1) == pytest.approx(1, abs=1e-15)
        hit = rays / rays[..., :1] * scan.centre
        # as a pilot reads a page: largest z in the top row, largest y in the left column
        assert hit[0, 0] == pytest.approx([start + 1.25, 54.5, 34.5], abs=1e-9)
        assert hit[-1, -1] == pytest.approx([start + 1.25, -54.5, -34.5], abs=1e-9)
        assert np.abs(hit[..., 1] - Y[::-1]).max() < 1e-9
        assert np.abs(hit[..., 2] - Z[::-1, None]).max() < 1e-9
        assert scan.position + scan.centre == 501.25


def test_angles_are_equidistant_and_given_for_each_time():
    first, second = plan_scans(Scan(aim="angles"), Y, Z, (0.0, 15.0))
    for scan, azimuth, elevation in ((first, 6.2, 3.9), (second, 6.4, 4.1)):
        found = np.degrees(np.arctan(scan.y / scan.centre))
        assert found == pytest.approx(np.linspace(-azimuth, azimuth, 219))
        found = np.degrees(np.arctan(scan.z / scan.centre))
        assert found == pytest.approx(np.linspace(-elevation, elevation, 139))
    # the paper's rounded angles miss each other: that is why images are resampled
    assert abs(first.y[-1] - second.y[-1]) < 0.7 and abs(first.y[-1] - second.y[-1]) > 0.05


def test_single_column_points_straight_ahead():
    (scan,) = plan_scans(Scan(aim="angles", columns=1, rows=1), Y, Z, (0.0,))
    assert scan.directions().tolist() == [[1, 0, 0]]


def test_obliquity_is_one_over_the_cosine_to_x():
    """Ascending axes, where directions descend."""
    scan = plan()
    x = scan.directions()[:, 0].reshape(139, 219)[::-1, ::-1]
    assert scan.obliquity() == pytest.approx(1 / x, rel=1e-14)


@pytest.mark.parametrize("count", [1, 5])
def test_planar_gates_are_planes(count):
    scan = plan(gate_count=count)
    middle = scan.ranges() / scan.obliquity()
    step = 2.5 / count
    expected = 500 + step * (np.arange(count) + 0.5)
    assert middle == pytest.approx(np.broadcast_to(expected[:, None, None], middle.shape))
    assert scan.gate_length() / scan.obliquity() == pytest.approx(step)


@pytest.mark.parametrize("count", [1, 5])
def test_spherical_gates_have_equal_ranges(count):
    scan = plan(gate_kind="spherical", gate_count=count)
    step = 2.5 / count
    expected = 500 + step * (np.arange(count) + 0.5)
    assert scan.ranges() == pytest.approx(
        np.broadcast_to(expected[:, None, None], (count, 139, 219))
    )
    assert scan.gate_length() == pytest.approx(np.full((139, 219), step))


def test_a_telescope_that_reaches_the_slab_is_refused():
    with pytest.raises(ValueError, match=r"scan\.range: 500 m is not allowed; expected more than"):
        plan_scans(Scan(), Y, Z, (0.0, 500.0))


@pytest.mark.parametrize("distance", [math.nan, math.inf, -math.inf])
def test_distances_that_are_none_are_refused(distance):
    with pytest.raises(InputError, match=r"travelled: .* expected finite distances"):
        plan_scans(Scan(), Y, Z, (0.0, distance))


@pytest.mark.parametrize(
    "bad",
    [
        {"range": 0},
        {"range": "-500 m"},
        {"range": "500 mrad"},
        {"range": math.inf},
        {"range": math.nan},
        {"thickness": "0 m"},
        {"thickness": math.inf},
        {"gates": "conical"},
        {"gate_count": 0},
        {"gate_count": 10_001},
        {"gate_count": 1.5},
        {"columns": 0},
        {"rows": 0},
        {"azimuth_half": ("0 deg", "6.4 deg")},
        {"azimuth_half": ("-6.2 deg", "6.4 deg")},
        {"elevation_half": ("3.9 deg", "90 deg")},
        {"azimuth_half": ("6.2 deg",)},
        {"azimuth_half": (6.2, 6.4)},
        {"aim": "planes"},
        {"spacing": 1},
    ],
)
def test_bad_values_are_refused(bad):
    with pytest.raises(ValidationError) as error:
        Scan(**bad)
    assert error.value.errors()[0]["loc"][0] == next(iter(bad))


def test_one_half_angle_is_that_of_both_scans():
    both = Scan(azimuth_half="9 deg", elevation_half="100 mrad")
    assert both.azimuth_half == pytest.approx((np.radians(9), np.radians(9)))
    assert both.elevation_half == pytest.approx((0.1, 0.1))
