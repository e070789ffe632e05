"""The standard atmosphere: pressure, temperature and density by altitude."""

from typing import NamedTuple

from lidar_mi.errors import InputError

LOWEST, HIGHEST = -5000.0, 80000.0
"""Altitudes (m) of the ICAO standard atmosphere."""


class StandardAir(NamedTuple):
    """Pressure (Pa), temperature (K) and density (kg m^-3)."""

    pressure: float
    temperature: float
    density: float


def standard_atmosphere(altitude: float) -> StandardAir:
    """Air of the U.S. Standard Atmosphere 1976, which is that of ICAO Doc 7488 up to 80 km.

    altitude: geometric height above sea level in m, -5000 to 80 000.
    """
    from fluids.atmosphere import ATMOSPHERE_1976

    if not LOWEST <= altitude <= HIGHEST:
        raise InputError(f"altitude: {altitude!r} m is not allowed; expected -5000 to 80000 m")
    air = ATMOSPHERE_1976(float(altitude))
    return StandardAir(air.P, air.T, air.rho)
