"""The vortex pair behind an aircraft in flight, from its lift."""

import math
from typing import NamedTuple

from lidar_mi.errors import InputError

STANDARD_GRAVITY = 9.80665
"""m/s^2 (ISO 80000-3)."""

CORE = 0.05
"""Core radius over the span: the paper's 3 m behind a span of 60 m. Cores behind real aircraft
have been measured to be smaller, too (Delisi et al., AIAA paper 2003-3811)."""


class AircraftType(NamedTuple):
    """An aircraft as its manufacturer describes it."""

    name: str
    span: float
    """Wing span, m."""
    landing_mass: float
    """Maximum landing mass, kg."""


TYPES = {
    "A319": AircraftType("Airbus A319", 35.8, 62500),
    "A320": AircraftType("Airbus A320", 35.8, 66000),
    "A321": AircraftType("Airbus A321", 35.8, 77800),
    "A332": AircraftType("Airbus A330-200", 60.3, 182000),
    "A333": AircraftType("Airbus A330-300", 60.3, 188000),
    "A343": AircraftType("Airbus A340-300", 60.3, 190000),
    "A359": AircraftType("Airbus A350-900", 64.75, 205000),
    "A388": AircraftType("Airbus A380-800", 79.75, 386000),
    "B737": AircraftType("Boeing 737-700", 34.32, 58600),
    "B738": AircraftType("Boeing 737-800", 34.32, 66300),
    "B744": AircraftType("Boeing 747-400", 64.4, 260300),
    "B748": AircraftType("Boeing 747-8", 68.4, 312100),
    "B752": AircraftType("Boeing 757-200", 38.0, 92200),
    "B763": AircraftType("Boeing 767-300", 47.57, 136000),
    "B772": AircraftType("Boeing 777-200", 60.93, 213000),
    "B77W": AircraftType("Boeing 777-300ER", 64.8, 251300),
    "B788": AircraftType("Boeing 787-8", 60.12, 172000),
    "B789": AircraftType("Boeing 787-9", 60.12, 193000),
    "CRJ9": AircraftType("Bombardier CRJ900", 23.24, 33340),
    "E170": AircraftType("Embraer 170", 26.0, 32800),
    "E190": AircraftType("Embraer 190", 28.72, 43000),
}
"""Types by their ICAO designator (Doc 8643); spans and masses as of OpenAP 2.6 (Sun, Hoekstra and
Ellerbroek, Aerospace 7, 104, 2020), which has them from the manufacturers."""


class WakeOf(NamedTuple):
    """What an aircraft leaves behind, once rolled up."""

    circulation: float
    """m^2/s."""
    separation: float
    """m."""
    core_radius: float
    """m."""


def aircraft_type(designator: str) -> AircraftType:
    """An aircraft type by its ICAO designator."""
    if designator not in TYPES:
        raise InputError(f"{designator!r} is not known; allowed: {', '.join(TYPES)}")
    return TYPES[designator]


def wake_of(span: float, mass: float, speed: float, density: float) -> WakeOf:
    """The vortex pair of a wing with elliptic lift in level flight.

    b_0 = pi b / 4, Gamma = m g / (rho V b_0) (Gerz, Holzäpfel and Darracq, Prog. Aerosp. Sci. 38,
    2002), and a core radius of 5 % of the span. In m, kg, m/s (true airspeed) and kg/m^3.
    """
    separation = math.pi / 4 * span
    return WakeOf(mass * STANDARD_GRAVITY / (density * speed * separation), separation, CORE * span)
