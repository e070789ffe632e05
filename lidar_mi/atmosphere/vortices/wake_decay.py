"""How fast the circulation of a wake decays in turbulence."""

import math

from lidar_mi.atmosphere.vortices.vortex import descent_speed
from lidar_mi.errors import InputError

# Circulation over that at age 0 is exp(-0.45 t / T) (Sarpkaya 2000, equation for C = 0.45).
_RATE = 0.45
# Time scales T* over dissipation rates eps* (Sarpkaya 2000): eps* T*^(4/3) = 0.7475 in strong,
# eps* = T*^(1/4) exp(-0.70 T*) in moderate, T* = 9.18 - 180 eps* in weak turbulence, 9 without.
_STRONG, _MODERATE, _WEAK = 0.2535, 0.0121, 0.001


def sarpkaya_time(dissipation: float) -> float:
    """Time scale T* of decay, in units of b / w_0, from eps* = (eps b)^(1/3) / w_0.

    Source: Sarpkaya, New model for vortex decay in the atmosphere, J. Aircraft 37, 53-61, 2000.
    """
    if dissipation > _STRONG:
        return float((0.7475 / dissipation) ** 0.75)
    if dissipation > _MODERATE:
        low, high = 2.0, 8.0
        # the law is monotone in T*: bisection to rounding
        for _ in range(60):
            middle = (low + high) / 2
            above = middle**0.25 * math.exp(-0.70 * middle) > dissipation
            low, high = (middle, high) if above else (low, middle)
        return (low + high) / 2
    return 9.18 - 180 * max(dissipation, _WEAK)


def sarpkaya_decay_time(circulation: float, separation: float, dissipation_rate: float) -> float:
    """Time in which the circulation of a pair falls to 1/e, s.

    Circulation (m^2/s) and separation (m) are those at age 0, the dissipation rate is in m^2/s^3.
    """
    if not dissipation_rate >= 0:
        raise InputError(
            f"dissipation rate: {dissipation_rate} m^2/s^3 is not allowed; expected at least 0"
        )
    speed = descent_speed(circulation, separation)
    scaled = (dissipation_rate * separation) ** (1 / 3) / speed
    return sarpkaya_time(scaled) * separation / speed / _RATE
