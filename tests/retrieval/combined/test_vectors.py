"""Wind vectors from lines of sight.

Detects a wrong sign, a wind that is not exact where it is uniform (1e-9), covariances that differ
from the closed form for a cone (1e-9) or from another solver (1e-9), errors that are not what the
covariance says (variance of normalised errors and coverage within 4 sigma of 20 000 draws), an
error of pointing with another effect than geometry gives it (exact), and input that has no answer.
"""

import math

import numpy as np
import pytest
import xarray as xr

from lidar_mi.errors import InputError
from lidar_mi.flags import VectorFlag
from lidar_mi.instrument.doppler import DopplerLidar
from lidar_mi.instrument.doppler_scan import DopplerScan, PlatformErrors, scan_wind
from lidar_mi.retrieval.combined.vectors import (
    solve_lines,
    wind_along_lines,
    wind_from_neighbours,
    wind_from_triples,
)

LIDAR = DopplerLidar(range=76)
TRUE = np.array([3.0, -4.0, 5.0])


def ranged(distance):
    scan = scanned()
    return scan.assign(range=scan["range"] * 0 + distance)


def scanned(std=0.5, seed=1, speed=150.0, errors=None, noisy=True, **scan):
    y, z = np.linspace(-60, 60, 5), np.linspace(-45, 45, 5)
    wind = xr.Dataset(
        {n: (("z", "y"), np.full((5, 5), value)) for n, value in zip("uvw", TRUE, strict=True)},
        coords={"y": y, "z": z},
    )
    found = scan_wind(wind, DopplerScan(**scan), LIDAR, std, seed, speed, errors)
    return found if noisy else found.assign(v_los=found.v_los_true)


def cone(count, half):
    turn = 2 * np.pi * np.arange(count) / count
    return np.stack(
        [np.full(count, np.cos(half)), np.sin(half) * np.cos(turn), np.sin(half) * np.sin(turn)], -1
    )


def vectors(found):
    return np.stack([found[n].values for n in "uvw"], -1)


METHODS = {
    "triples": wind_from_triples,
    "neighbours": wind_from_neighbours,
    "all": lambda scan: wind_from_neighbours(scan, scan.sizes["line"]),
}


@pytest.mark.parametrize("method", METHODS)
def test_uniform_wind_is_exact_and_the_platforms_motion_removed(method):
    for speed in (0.0, 150.0):
        found = METHODS[method](scanned(noisy=False, speed=speed))
        np.testing.assert_allclose(
            vectors(found), np.broadcast_to(TRUE, (found.sizes["vector"], 3)), atol=1e-9
        )
        assert (found.flag == 0).all()
        if method != "triples":
            np.testing.assert_allclose(found.misfit, 0, atol=1e-18)


def test_wind_along_lines_is_direction_times_wind():
    scan = scanned(noisy=False)
    np.testing.assert_allclose(wind_along_lines(scan), scan.direction.values @ TRUE, atol=1e-12)


# geometry


def test_triangles_cover_the_scan_once():
    """9 x 7 directions: 8 x 6 cells of two triangles; areas add up; centres lie in the plane."""
    scan = scanned()
    found = wind_from_triples(scan)
    assert found.sizes["vector"] == 96
    place = (scan.range.values[:, None] * scan.direction.values)[found.lines.values]
    np.testing.assert_allclose(place.mean(1)[:, 1], found.y, atol=1e-12)
    np.testing.assert_allclose(found.x, 76.0)
    side1, side2 = (place[:, k, 1:] - place[:, 0, 1:] for k in (1, 2))
    area = abs(side1[:, 0] * side2[:, 1] - side1[:, 1] * side2[:, 0]).sum() / 2
    expected = (2 * 76) ** 2 * math.tan(math.radians(21.5)) * math.tan(math.radians(14))
    assert area == pytest.approx(expected)


# covariance


@pytest.mark.parametrize("count", [3, 4, 7])
@pytest.mark.parametrize("degrees", [0.5, 3.0, 20.0, 60.0])
def test_a_cone_in_closed_form(count, degrees):
    """u to s / (sqrt(k) cos a), v and w to s sqrt(2 / k) / sin a, and nothing between them."""
    half, s = math.radians(degrees), 0.7
    _, covariance, _ = solve_lines(
        cone(count, half)[None], np.zeros((1, count)), np.full((1, count), s)
    )
    expected = np.diag(
        [s**2 / count / math.cos(half) ** 2] + [2 * s**2 / count / math.sin(half) ** 2] * 2
    )
    np.testing.assert_allclose(covariance[0], expected, rtol=1e-8, atol=1e-9 * expected.max())


def test_another_solver_gives_the_same():
    """Whitened least squares by numpy, one at a time, random lines and errors."""
    random = np.random.default_rng(2)
    lines = random.standard_normal((50, 6, 3))
    lines /= np.linalg.norm(lines, axis=-1, keepdims=True)
    along, std = random.standard_normal((50, 6)), random.uniform(0.1, 3, (50, 6))
    wind, covariance, chi_square = solve_lines(lines, along, std)
    for n in range(50):
        matrix = lines[n] / std[n, :, None]
        expected, residual, *_ = np.linalg.lstsq(matrix, along[n] / std[n])
        np.testing.assert_allclose(wind[n], expected, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(
            covariance[n], np.linalg.inv(matrix.T @ matrix), rtol=1e-9, atol=1e-9
        )
        assert chi_square[n] == pytest.approx(residual[0])


def test_the_papers_scan_cannot_tell_v_and_w():
    """Triples of 63 lines at 0.5 m/s each, the table's error of v_LOS: v and w beyond 2.5 m/s."""
    found = wind_from_triples(scanned(0.5))
    assert float(found.v_stderr.min()) > 2.5 and float(found.w_stderr.min()) > 2.5
    assert float(found.v_stderr.mean()) == pytest.approx(7.4, abs=0.05)
    assert float(found.u_stderr.mean()) == pytest.approx(1.9, abs=0.05)
    # two neighbours 5.4 degrees apart differ by their velocities' errors over the angle
    apart = 2 * math.tan(math.radians(21.5)) / 8
    assert float(found.v_stderr.min()) == pytest.approx(0.5 * math.sqrt(2) / apart, rel=0.2)


def test_errors_that_lines_share_enter_the_covariance():
    """Three lines determine the wind alone: M^-1 C M^-T, with any C."""
    scan = scanned(columns=3, rows=3)
    shared = 0.3**2 * (1 - np.eye(9))
    scan = scan.assign(v_los_covariance=(("line", "other_line"), shared))
    found = wind_from_triples(scan)
    lines = found["lines"].values[0]
    inverse = np.linalg.inv(scan["direction"].values[lines])
    expected = inverse @ (0.5**2 * np.eye(3) + shared[np.ix_(lines, lines)]) @ inverse.T
    stderr = [float(found[f"{name}_stderr"][0]) for name in "uvw"]
    np.testing.assert_allclose(stderr, np.sqrt(np.diag(expected)), rtol=1e-9)
    correlation = expected[0, 1] / np.sqrt(expected[0, 0] * expected[1, 1])
    assert float(found["uv_correlation"][0]) == pytest.approx(correlation, abs=1e-9)


# pointing


def test_an_attitude_error_turns_the_relative_wind():
    """All lines turned by R: the air's velocity relative to the platform comes out turned back."""
    errors = PlatformErrors(yaw="3 mrad", pitch="-2 mrad", roll="5 mrad")
    found = wind_from_neighbours(scanned(noisy=False, errors=errors), 63)
    cy, sy, cp, sp, cr, sr = (f(a) for a in (3e-3, 2e-3, 5e-3) for f in (math.cos, math.sin))
    # columns: where forward, port and up of the platform point; pitch nose down
    yaw = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
    pitch = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    roll = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    turn = yaw @ pitch @ roll
    platform = np.array([150.0, 0, 0])
    expected = platform - turn.T @ (platform - TRUE)
    np.testing.assert_allclose(vectors(found), np.broadcast_to(expected, (63, 3)), atol=1e-9)
    # to first order the platform's speed times the angle, to port for a yaw to port
    assert expected[1] - TRUE[1] == pytest.approx(150 * 3e-3, abs=0.05)


# bad input


def test_lines_without_a_velocity_are_flagged():
    scan = scanned()
    scan.v_los[31] = np.nan
    for found in (wind_from_triples(scan), wind_from_neighbours(scan, 5)):
        concerned = (found.lines == 31).any("corner")
        assert 1 < int(concerned.sum()) < 10
        np.testing.assert_array_equal(found.flag, VectorFlag.NO_VELOCITY * concerned)
        for name in ("u", "v_stderr", "uw_correlation"):
            np.testing.assert_array_equal(found[name].isnull(), concerned)


def test_neighbours_in_a_row_are_flagged():
    """In a scan three lines high and far apart, the nearest three stand beside each other."""
    found = wind_from_neighbours(scanned(rows=3, columns=9, azimuth_half="4 deg"), 3)
    assert (found.flag == VectorFlag.COPLANAR).any()
    flat = found.flag.values > 0
    assert np.isnan(vectors(found)[flat]).all() and np.isfinite(vectors(found)[~flat]).all()


@pytest.mark.parametrize(
    ("call", "start"),
    [
        (lambda: wind_from_triples(scanned(columns=2, rows=1)), "scan: 2 lines of sight are not"),
        (
            lambda: wind_from_triples(scanned(rows=1)),
            "scan.direction: all 9 lines lie in one plane",
        ),
        (lambda: wind_from_neighbours(scanned(), 2), "count: 2 is not allowed; expected 3 to 63"),
        (lambda: wind_from_neighbours(scanned(), 64), "count: 64"),
        (lambda: wind_from_triples(scanned().drop_vars("range")), "scan.range: missing"),
        (lambda: wind_from_triples(scanned(std=0.0)), "scan.v_los_std: not > 0"),
        (lambda: wind_from_triples(ranged(-76.0)), "scan.range: not > 0 m"),
        (lambda: wind_from_triples(ranged(np.nan)), "scan.range: not > 0 m"),
        (lambda: wind_from_neighbours(ranged(np.inf), 5), "scan.range: not > 0 m"),
        (
            lambda: wind_from_triples(scanned().assign_coords(direction=2 * scanned().direction)),
            "scan.direction: not of length 1",
        ),
        (
            lambda: wind_from_triples(scanned().assign_coords(direction=-scanned().direction)),
            "scan.direction: a line goes backward",
        ),
        (lambda: wind_from_triples(scanned().isel(axis=slice(2))), "scan.axis: 2 components"),
    ],
)
def test_bad_input_is_named(call, start):
    with pytest.raises(InputError) as error:
        call()
    assert str(error.value).startswith(start) and "\n" not in str(error.value)


def test_thin_triples_have_no_vector():
    """Lines of a regular scan that a rolling platform moves a little out of their rows: slivers
    along the rim, whose errors are many times those of the triples of the rows, are left out."""
    scan = scanned(rows=5, columns=5)
    regular = wind_from_triples(scan)
    assert regular.sizes["vector"] == 32  # two of every square of lines
    random = np.random.default_rng(3)
    moved = scan["direction"].values + 1e-4 * random.standard_normal((25, 3))
    moved /= np.linalg.norm(moved, axis=1, keepdims=True)
    found = wind_from_triples(scan.assign(direction=(("line", "axis"), moved)))
    assert found.sizes["vector"] == 32
    for name in ("u_stderr", "v_stderr", "w_stderr"):
        assert float(found[name].max()) < 1.2 * float(regular[name].max()), name
