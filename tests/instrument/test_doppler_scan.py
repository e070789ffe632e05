"""Where a Doppler scan looks and what it measures.

Detects a wrong sign or axis of direction, velocity or attitude, volumes that are weighted wrongly
(against adaptive quadrature, 1e-6, and random points in the volume, 4 sigma), noise of another size
(4 sigma), and fields that do not hold the scan.
"""

import math

import numpy as np
import pytest
import xarray as xr
from pydantic import ValidationError
from scipy import constants, integrate, special

from lidar_mi.errors import InputError
from lidar_mi.instrument.doppler import DopplerLidar
from lidar_mi.instrument.doppler_scan import (
    DopplerScan,
    PlatformErrors,
    pointed,
    scan_wind,
    sight_volumes,
)

LIDAR = DopplerLidar(range=76)
SCAN = DopplerScan()


def field(u=0.0, v=0.0, w=0.0, width=60.0, height=45.0, count=121):
    """A wind on (z, y); the components are numbers or functions of (y, z)."""
    y, z = np.linspace(-width, width, count), np.linspace(-height, height, count)
    place = np.meshgrid(y, z)
    values = {
        n: (("z", "y"), f(*place) if callable(f) else np.full((count, count), float(f)))
        for n, f in (("u", u), ("v", v), ("w", w))
    }
    return xr.Dataset(values, coords={"y": y, "z": z})


# directions


def test_directions_as_a_pilot_reads():
    lines = SCAN.directions()
    assert lines.shape == (63, 3) and np.allclose(np.linalg.norm(lines, axis=1), 1)
    azimuth = np.degrees(np.arctan2(lines[:, 1], lines[:, 0])).reshape(7, 9)
    elevation = np.degrees(np.arctan(lines[:, 2] / lines[:, 0])).reshape(7, 9)
    assert np.allclose(azimuth, np.linspace(21.5, -21.5, 9))
    assert np.allclose(elevation, np.linspace(14, -14, 7)[:, None])


def test_planar_and_spherical_gates():
    planar = SCAN.ranges(LIDAR) * SCAN.directions()[:, 0]
    assert np.allclose(planar, 76)
    assert np.allclose(DopplerScan(gates="spherical").ranges(LIDAR), 76)


# pointing


def test_jitter_has_its_size_and_no_mean():
    lines = np.repeat(SCAN.directions()[[5, 40]], 20_000, axis=0)
    moved = pointed(lines, PlatformErrors(jitter="1 mrad"), seed=3) - lines
    for part in (moved[:20_000], moved[20_000:]):
        for direction in ([0, 1, 0], [0, 0, 1]):
            across = np.array(direction) - lines[0] * (lines[0] @ direction)
            across = part @ across / np.linalg.norm(across)
            # an oblique direction sees the tilt about both axes
            assert abs(across.mean()) < 4e-3 / math.sqrt(20_000)
        total = (part**2).sum(1)
        assert total.mean() == pytest.approx(2e-6, rel=4 * math.sqrt(1 / 20_000))


# volumes


def test_uniform_wind_is_projected():
    """Against the platform's motion: positive toward the instrument."""
    found = scan_wind(field(3.0, -4.0, 5.0), SCAN, LIDAR, 0.0, 1, 150.0)
    expected = SCAN.directions() @ np.array([150.0 - 3, 4, -5])
    np.testing.assert_allclose(found.v_los_true, expected, rtol=1e-12)
    np.testing.assert_array_equal(found.v_los, found.v_los_true)


def test_weights_along_the_line_by_adaptive_quadrature():
    """Even bin, Gaussian pulse of 1.5 m (two-way), signal falling with the range."""
    lidar = DopplerLidar(range=56, extinction="2 / km")
    points, weights = sight_volumes([[1.0, 0, 0]], [56.0], lidar)
    sigma = constants.c / 2 * 10e-9 / math.sqrt(8 * math.log(2))

    def observed(r):
        inside = special.ndtr((r - 51) / sigma) - special.ndtr((r - 61) / sigma)
        return inside * math.exp(-2 * 2e-3 * r) / r**2

    for power in (1, 2, 3):
        mean = integrate.quad(lambda r, k=power: (r - 56) ** k * observed(r), 40, 72, epsabs=1e-14)[
            0
        ]
        mean /= integrate.quad(observed, 40, 72, epsabs=1e-14)[0]
        found = (weights[0] * (points[0, :, 0] - 56) ** power).sum()
        assert found == pytest.approx(mean, rel=2e-4)


def test_a_field_in_three_dimensions():
    """Linear in x, y and z: the wind at the volume's centre of signal."""
    x, y, z = np.linspace(60, 100, 9), np.linspace(-60, 60, 13), np.linspace(-45, 45, 7)
    gx, gy, gz = np.meshgrid(x, y, z, indexing="ij")
    wind = xr.Dataset(
        {
            "u": (("x", "y", "z"), 0.1 * gx),
            "v": (("x", "y", "z"), 0.2 * gy + 1),
            "w": (("x", "y", "z"), gz - 0.3 * gx),
        },
        coords={"x": x, "y": y, "z": z},
    )
    found = scan_wind(wind, SCAN, LIDAR, 0.0, 1)
    lines, ranges = SCAN.directions(), SCAN.ranges(LIDAR)
    points, weights = sight_volumes(lines, ranges, LIDAR)
    cx, cy, cz = np.einsum("lp,lpc->cl", weights, points)
    air = np.stack([0.1 * cx, 0.2 * cy + 1, cz - 0.3 * cx], -1)
    np.testing.assert_allclose(found.v_los, -(lines * air).sum(1), atol=1e-9)
    np.testing.assert_allclose(
        scan_wind(wind.transpose("z", "x", "y"), SCAN, LIDAR, 0.0, 1).v_los, found.v_los
    )


# noise and data set


def test_noise_has_its_size_and_its_seed():
    many = DopplerScan(columns=40, rows=40)
    std = np.linspace(0.1, 2.0, 1600)
    first, again, other = (scan_wind(field(), many, LIDAR, std, s) for s in (1, 1, 2))
    reduced = (first.v_los - first.v_los_true) / std
    assert abs(float(reduced.mean())) < 4 / 40
    assert float(reduced.var()) == pytest.approx(1, abs=4 * math.sqrt(2 / 1600))
    xr.testing.assert_identical(first, again)
    assert not np.allclose(first.v_los, other.v_los)


def test_data_set_survives_a_file(tmp_path):
    found = scan_wind(field(), SCAN, LIDAR, 0.5, 1, 150.0)
    file = tmp_path / "scan.nc"
    found.to_netcdf(file, engine="h5netcdf")
    with xr.open_dataset(file, engine="h5netcdf") as back:
        xr.testing.assert_identical(back.load(), found)
    assert all("units" in found[name].attrs for name in found.data_vars)


# bad input


@pytest.mark.parametrize(
    ("call", "start"),
    [
        (lambda: scan_wind(field(width=20), SCAN, LIDAR, 0.5, 1), "wind: y from -20 to 20 m"),
        (lambda: scan_wind(field(height=9), SCAN, LIDAR, 0.5, 1), "wind: z from -9 to 9 m"),
        (lambda: scan_wind(field().drop_vars("u"), SCAN, LIDAR, 0.5, 1), "wind.u: missing"),
        (lambda: scan_wind(field().isel(z=0), SCAN, LIDAR, 0.5, 1), "wind: dims ('y',)"),
        (lambda: scan_wind(field(), SCAN, LIDAR, -0.5, 1), "v_los_std: -0.5 m/s"),
        (lambda: sight_volumes([[1.0, 0, 0]], [4.0], LIDAR), "range_bin: 10 m"),
    ],
)
def test_bad_input_is_named(call, start):
    with pytest.raises(InputError) as error:
        call()
    assert str(error.value).startswith(start) and "\n" not in str(error.value)


@pytest.mark.parametrize(
    "bad", [{"columns": 0}, {"azimuth_half": "90 deg"}, {"gates": "round"}, {"rows": 2.5}]
)
def test_bad_descriptions(bad):
    with pytest.raises(ValidationError, match=next(iter(bad))):
        DopplerScan(**bad)
