"""Pulses and photons of a scanning lidar for a number of directions and a rate of scans."""

import math
from dataclasses import dataclass

import scipy

from lidar_mi.errors import InputError


@dataclass(frozen=True)
class PulseBudget:
    """Pulses, power and photons of a scan.

    pulses_per_second: of all directions together, while they are sent, Hz.
    average_power: emitted light, W.
    echo_time: from a pulse's emission to its echo's arrival from the farthest range, s.
    beams: directions that must be measured simultaneously, as a receiver handles one echo at a
        time: 1 if pulses can follow each other.
    photons_per_direction: received from one range bin, of all pulses of a direction in one slab.
    """

    pulses_per_second: float
    average_power: float
    echo_time: float
    beams: int
    photons_per_direction: float


def pulse_budget(
    directions: int,
    slabs_per_second: float,
    pulses_per_direction: int,
    pulse_energy: float,
    farthest: float,
    photons_per_pulse: float = math.nan,
    sending: float | None = None,
) -> PulseBudget:
    """Pulses, power and beams for a scan.

    directions: of one slab.
    slabs_per_second: Hz.
    pulses_per_direction: averaged in one direction of one slab, see `pulses_for_error`.
    pulse_energy: J.
    farthest: end of the farthest range bin, m.
    photons_per_pulse: received from one range bin, see `lidar_mi.instrument.doppler.photons`; NaN:
        not known.
    sending: time in which the pulses of a slab are sent, without turns of the scanner, s. Default:
        all the time until the next slab.
    """
    for name, value in (
        ("directions", directions),
        ("slabs_per_second", slabs_per_second),
        ("pulses_per_direction", pulses_per_direction),
        ("pulse_energy", pulse_energy),
        ("farthest", farthest),
        ("sending", 1.0 if sending is None else sending),
    ):
        if not (value > 0 and math.isfinite(value)):
            raise InputError(f"{name}: {value} is not allowed; expected more than 0")
    mean = directions * slabs_per_second * pulses_per_direction
    rate = mean if sending is None else directions * pulses_per_direction / sending
    echo_time = 2 * farthest / scipy.constants.c
    return PulseBudget(
        pulses_per_second=rate,
        # over all time, turns of the scanner included
        average_power=mean * pulse_energy,
        echo_time=echo_time,
        # rounding must not make an echo that just fits require a second beam
        beams=max(1, math.ceil(rate * echo_time * (1 - 1e-12))),
        photons_per_direction=pulses_per_direction * photons_per_pulse,
    )


def pulses_for_error(error_of_one: float, required: float) -> int:
    """Pulses to average for a standard error, if those of single pulses are independent.

    (error of one / required)^2, rounded up: a bias does not average out.
    """
    for name, value in (("error_of_one", error_of_one), ("required", required)):
        if not (value > 0 and math.isfinite(value)):
            raise InputError(f"{name}: {value} m/s is not allowed; expected more than 0 m/s")
    # rounding must not require a further pulse
    return max(1, math.ceil((error_of_one / required) ** 2 * (1 - 1e-12)))
