"""Remarks on settings that are allowed and unlike those of any lidar, aircraft or wake so far."""

from collections.abc import Iterator
from typing import Any, NamedTuple

from lidar_mi.description import Description
from lidar_mi.units import usual


class Usual(NamedTuple):
    """Range of the usual values of a key, in its SI unit, and their examples."""

    key: str
    unit: str
    low: float
    high: float
    examples: str


_PULSES = "micropulse lidars have 5 uJ, the largest lidars of stations 1 J"
_DIVERGENCES = "from lidars in orbit to laser diodes of ceilometers and cars"
_RANGES = "lidars on aircraft look 30 m to 20 km ahead"
_DEPTHS = "from detectors of 10 GHz to those of ceilometers"
_TELESCOPES = "from 2 cm of a wind lidar to 4 m of an observatory's telescope"
# of the backscatter and of the Doppler lidar
_OF_A_LIDAR = (
    Usual("wavelength", "m", 240e-9, 11e-6, "from excimer to CO2 lasers"),
    Usual("pulse_energy", "J", 1e-8, 2.0, _PULSES),
    Usual("pulse_duration", "s", 1e-10, 1e-6, "from microchip lasers to coherent lidars"),
    Usual("beam_radius", "m", 5e-4, 0.5, "from a laser without expander to lidars in orbit"),
    Usual("divergence_full", "rad", 1e-5, 0.1, _DIVERGENCES),
    Usual("fov_half", "rad", 1e-5, 0.1, _DIVERGENCES),
)
USUAL = (
    *(
        values._replace(key=f"{section}.{values.key}")
        for section in ("lidar", "doppler.lidar")
        for values in _OF_A_LIDAR
    ),
    Usual("lidar.aperture_radius", "m", 5e-3, 2.0, _TELESCOPES),
    Usual("doppler.lidar.telescope_area", "m^2", 1e-4, 13.0, _TELESCOPES),
    Usual("scan.range", "m", 1.0, 3e4, _RANGES),
    Usual("doppler.lidar.range", "m", 1.0, 3e4, _RANGES),
    Usual("scan.thickness", "m", 0.01, 1e3, _DEPTHS),
    Usual("doppler.lidar.range_bin", "m", 0.01, 1e3, _DEPTHS),
    Usual("platform.speed", "m/s", 10.0, 700.0, "from gliders to supersonic airliners"),
    Usual("platform.dt", "s", 1e-4, 30.0, "from bursts of pulses to slow scans"),
    Usual("wake.vortex_pair.circulation", "m^2/s", 5.0, 1200.0, "an A380 at landing has 700 m^2/s"),
    Usual("wake.vortex_pair.separation", "m", 2.0, 90.0, "an A380 at landing has 63 m"),
    Usual("wake.vortex_pair.core_radius", "m", 0.05, 15.0, "1 to 5 % of the wing span, later 15 %"),
    Usual("wake.turbine.wind_speed", "m/s", 2.0, 35.0, "from cut-in to beyond cut-out"),
)
"""Ranges of all known instruments, aircraft and wakes; 0 and infinity are idealisations."""

# factors of likely wrong units: a prefix, a degree in place of a milliradian
_SLIPS = (1e-3, 1e3, 1e-6, 1e6, 1e-9)


def unusual(experiment: Description) -> Iterator[str]:
    """Keys that an experiment sets to a value outside `USUAL`, a line each, with the likely unit.

    experiment: with the sections that the keys name; those that it lacks are passed over.
    """
    for key, unit, low, high, examples in USUAL:
        value = _set_value(experiment, key)
        if value is None or value == 0 or value == float("inf") or low <= value <= high:
            continue
        slips = (value * slip for slip in _SLIPS)
        likely = next((slip for slip in slips if low <= slip <= high), None)
        question = f": is {usual(likely, unit)} meant?" if likely is not None else ""
        side = "more" if value > high else "less"
        yield (
            f"{key}: {usual(value, unit)} is {side} than known ones have, {usual(low, unit)} to "
            f"{usual(high, unit)} ({examples}){question}"
        )


def _set_value(section: Any, key: str) -> float | None:
    for part in key.split("."):
        if section is None or part not in section.model_fields_set:
            return None
        section = getattr(section, part)
    return section if isinstance(section, int | float) else None
