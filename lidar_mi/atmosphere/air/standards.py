"""Turbulence and gusts of the standards: MIL-F-8785C and CS-25.

MIL-F-8785C: Military Specification, Flying Qualities of Piloted Airplanes, 1980, section 3.7.
CS-25: EASA Certification Specifications for Large Aeroplanes, CS 25.341, the same as 14 CFR
25.341. Both are in feet and knots; everything here is SI.
"""

import math
from typing import Literal, get_args

import numpy as np
from scipy.constants import foot, knot

from lidar_mi.atmosphere.air.standard_atmosphere import standard_atmosphere
from lidar_mi.errors import InputError

Level = Literal["light", "moderate", "severe"]
LEVELS: tuple[str, ...] = get_args(Level)

CS_25_LENGTH = 2500 * foot
"""Length scale of continuous turbulence, CS 25.341(b)(2), m."""

GRADIENTS = (30 * foot, 350 * foot)
"""Range of gust gradients, CS 25.341(a)(3), m."""

# Wind at 20 ft above the ground, m/s (MIL-F-8785C, section 3.7.3.4).
_WIND_AT_20_FT = {"light": 15 * knot, "moderate": 30 * knot, "severe": 45 * knot}
# Heights (m) up to which the low-altitude model holds and from which the other one does.
_LOW, _HIGH = 1000 * foot, 2000 * foot
_HIGH_LENGTH = 2500 * foot
# Exceedance curves of figure 7 at 1e-2, 1e-3 and 1e-5: altitude, rms of turbulence, both in feet.
_ALTITUDES = np.array([500, 1750, 3750, 7500, 15000, 25000, 35000, 45000, 55000, 65000]) * foot
_EXCEEDED = {
    "light": (6.6, 6.9, 7.4, 6.7, 4.6, 2.7, 0.4, 0.0, 0.0, 0.0),
    "moderate": (8.6, 9.6, 10.6, 10.1, 8.0, 6.6, 5.0, 4.2, 2.7, 0.0),
    "severe": (15.6, 17.6, 23.0, 23.6, 22.1, 20.0, 16.0, 15.1, 12.1, 7.9),
}
# Reference gust velocity, m/s EAS, at altitudes in m (CS 25.341(a)(5)(i)).
_GUST_ALTITUDES = (0.0, 15000 * foot, 60000 * foot)
_GUST_SPEEDS = (56.0 * foot, 44.0 * foot, 20.86 * foot)


def mil_f_8785c(height: float, level: Level) -> tuple[float, float]:
    """Rms of one component (m/s) and length scale (m) of turbulence of von Karman's form.

    Up to 1000 ft: sigma_w = 0.1 W20 and L_w = h, those of the vertical component, with the wind W20
    at 20 ft of 15, 30 or 45 knots. From 2000 ft on: isotropic, 2500 ft, the rms exceeded with a
    probability of 1e-2, 1e-3 or 1e-5 (figure 7). In between both are interpolated linearly.

    height: above the ground, m; below 10 ft the values are those of 10 ft.
    level {"light", "moderate", "severe"}
    """
    if level not in LEVELS:
        raise InputError(f"turbulence.level: {level!r} is not known; expected {', '.join(LEVELS)}")
    height = max(height, 10 * foot)
    low = 0.1 * _WIND_AT_20_FT[level]
    if height <= _LOW:
        return low, height
    high = foot * float(np.interp(height, _ALTITUDES, _EXCEEDED[level]))
    if height >= _HIGH:
        return high, _HIGH_LENGTH
    at_2000 = foot * float(np.interp(_HIGH, _ALTITUDES, _EXCEEDED[level]))
    part = (height - _LOW) / (_HIGH - _LOW)
    return low + part * (at_2000 - low), _LOW + part * (_HIGH_LENGTH - _LOW)


def reference_gust_speed(altitude: float) -> float:
    """U_ref at speeds V_B to V_C, m/s equivalent airspeed (CS 25.341(a)(5)(i)); altitude in m."""
    return float(np.interp(altitude, _GUST_ALTITUDES, _GUST_SPEEDS))


def flight_profile_alleviation(
    altitude: float,
    maximum_altitude: float,
    landing_weight: float = 1.0,
    zero_fuel_weight: float = 1.0,
) -> float:
    """F_g of CS 25.341(a)(6): at sea level from weights and altitude, 1 at the highest altitude.

    F_g = (F_gz + F_gm)/2 with F_gz = 1 - Z_mo / 250000 ft and F_gm = sqrt(R2 tan(pi R1/4)); it
    grows linearly with the altitude to 1 at Z_mo.

    altitude, maximum_altitude: of the flight, and Z_mo at which the aeroplane operates; m.
    landing_weight, zero_fuel_weight: R1 and R2: the maximum weights over that of take-off, above 0,
        at most 1.

    Raises InputError: weights or a maximum altitude out of range.
    """
    for name, value in (("landing_weight", landing_weight), ("zero_fuel_weight", zero_fuel_weight)):
        if not 0 < value <= 1:
            raise InputError(
                f"gust.{name}: {value} is not allowed; expected a fraction of the take-off weight, "
                "above 0, at most 1"
            )
    if not 0 < maximum_altitude < 250000 * foot:
        raise InputError(
            f"gust.maximum_altitude: {maximum_altitude} m is not allowed; expected above 0, below "
            f"{250000 * foot:.0f} m"
        )
    by_altitude = 1 - maximum_altitude / (250000 * foot)
    by_weight = math.sqrt(zero_fuel_weight * math.tan(math.pi * landing_weight / 4))
    at_sea_level = (by_altitude + by_weight) / 2
    part = min(max(altitude, 0.0) / maximum_altitude, 1.0)
    return at_sea_level + part * (1 - at_sea_level)


def design_gust_speed(altitude: float, gradient: float, alleviation: float = 1.0) -> float:
    """U_ds = U_ref F_g (H / 350 ft)^(1/6) of CS 25.341(a)(4), as true airspeed, m/s.

    The altitude (m) is in the standard atmosphere; the gradient H is in m, F_g is the alleviation.

    Raises InputError: a gradient or an alleviation factor out of range.
    """
    low, high = GRADIENTS
    # a gradient in rounded metres is within the range in feet
    if not low - 0.2 <= gradient <= high + 0.5:
        raise InputError(
            f"gust.gradient: {gradient:g} m is not allowed with the speed of CS 25.341; expected "
            f"{low:.3g} to {high:.3g} m"
        )
    if not 0 < alleviation <= 1:
        raise InputError(
            f"gust.alleviation: {alleviation:g} is not allowed; expected above 0, at most 1"
        )
    equivalent = reference_gust_speed(altitude) * alleviation * (gradient / high) ** (1 / 6)
    density = [standard_atmosphere(h).density for h in (0.0, altitude)]
    return equivalent * math.sqrt(density[0] / density[1])
