"""The standard atmosphere against the printed tables of ICAO Doc 7488."""

import math

import pytest

from lidar_mi.atmosphere.air.standard_atmosphere import standard_atmosphere
from lidar_mi.errors import InputError


@pytest.mark.parametrize(
    ("altitude", "pressure", "temperature", "density"),
    [
        (0.0, 101325.0, 288.150, 1.22500),
        (8500.0, 33154.0, 232.974, 0.495757),
        (15000.0, 12111.8, 216.650, 0.194755),
        (30000.0, 1197.03, 226.509, 0.0184101),
    ],
)
def test_tables(altitude, pressure, temperature, density):
    assert standard_atmosphere(altitude) == pytest.approx(
        (pressure, temperature, density), rel=1e-5
    )


@pytest.mark.parametrize("altitude", [90000.0, -6000.0, math.nan])
def test_altitudes_without_one_are_refused(altitude):
    with pytest.raises(InputError, match=r"altitude: .*expected -5000 to 80000 m"):
        standard_atmosphere(altitude)
