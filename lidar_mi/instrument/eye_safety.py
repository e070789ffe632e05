"""Eye safety: what an eye may be exposed to, and from which distance a beam keeps to that.

Limits of IEC 60825-1:2014 (Ed. 3, annex A), which are those of ICNIRP 2013 (Health Physics 105,
271-295), for a small source: looking into a beam, which the eye focuses to a point (angular
subtense up to 1.5 mrad, C6 = 1), the worst case. They are limits for planning; a product is
classified by measurement.
"""

import math
from dataclasses import dataclass
from typing import Literal

import scipy

from lidar_mi.errors import InputError

Rule = Literal["single pulse", "average", "repeated pulses"]


@dataclass(frozen=True)
class PulseLimit:
    """Permissible exposure of the cornea to one pulse of a train.

    exposure: J m^-2, of every pulse.
    rule ("single pulse", "average" or "repeated pulses"): the one of the standard's three rules
        that decides.
    pulses: number of pulses in the time of exposure.
    aperture: diameter of the circle over which exposure is averaged, m.
    """

    exposure: float
    rule: Rule
    pulses: float
    aperture: float


@dataclass(frozen=True)
class ViewingAid:
    """Binoculars or a telescope used to look into the beam; default: 7 x 50.

    ``transmission`` 1 is the worst case; real ones pass 70 to 90 %.
    """

    magnification: float = 7.0
    objective: float = 0.05
    transmission: float = 1.0

    def __post_init__(self) -> None:
        _positive("viewing_aid.magnification", self.magnification, "")
        _positive("viewing_aid.objective", self.objective, " m")
        _positive("viewing_aid.transmission", self.transmission, "")


@dataclass(frozen=True)
class PulsedBeam:
    """A pulsed Gaussian beam where it leaves the instrument.

    wavelength: m.
    pulse_energy: J.
    pulse_duration: s.
    beam_radius, divergence_full: as of `exposure_at`.
    """

    wavelength: float
    pulse_energy: float
    pulse_duration: float
    beam_radius: float
    divergence_full: float


@dataclass(frozen=True)
class EyeSafety:
    """A pulsed beam's verdict.

    exposure_at_exit: J m^-2 a pulse where the beam leaves the instrument; safe from there on if not
        above ``limit.exposure``.
    hazard_distance: nominal ocular hazard distance, m; 0 if the beam is safe at its exit, inf if it
        never is.
    aided_hazard_distance: the same for a person with binoculars, m.
    """

    limit: PulseLimit
    exposure_at_exit: float
    hazard_distance: float
    aided_hazard_distance: float


def permissible_exposure(wavelength: float, duration: float) -> float:
    """Maximum permissible exposure (MPE) of the cornea, J m^-2, by light that lasts ``duration``.

    wavelength: m, 180 nm to 1 mm.
    duration: s, 1e-13 to 3e4. For a steady beam: the duration of exposure.

    Notes
    -----
    Table A.1. From 400 to 600 nm the lesser of the thermal and the photochemical limit, from 1250
    to 1400 nm not above the limit of the skin (the table's footnote), below 315 nm the lesser of C1
    and C2. Nanosecond pulses: 2e-3 J m^-2 in the visible (5e-3 before 2014), 5600 t^(1/4) from 315
    to 400 nm, 1e4 from 1500 to 1800 nm.
    """
    nm = _nanometres(wavelength)
    t = _duration("duration", duration)
    if nm < 400:
        return _ultraviolet(nm, t)
    return _retina(nm, t) if nm < 1400 else _infrared(nm, t)


def permissible_pulse(
    wavelength: float,
    pulse_duration: float,
    repetition_rate: float,
    exposure_duration: float,
    burst: tuple[float, float] = (1, 0),
) -> PulseLimit:
    """Maximum permissible exposure by each pulse of a regular train, or of a train of bursts.

    The least of three (IEC 60825-1:2014, A.3): a pulse's own limit; the limit of the whole time,
    shared by the pulses in it; and, where light heats the retina (400 to 1400 nm), a pulse's limit
    times C5 = 5 N^(-1/4), from 0.4 to 1, for N > 600 pulses within the exposure, or 10 s of it. C5
    is 1 for pulses longer than T_i (5 us; 13 us from 1050 nm) and in exposures up to 0.25 s. Pulses
    within T_i of each other count as one.

    wavelength, pulse_duration: m, s.
    repetition_rate: pulses per second *that enter the same eye*, Hz; of a scan, those of one
        direction and of neighbours that overlap with it. 0: a single pulse. Of bursts the mean of
        all time.
    exposure_duration: s, see `time_base`.
    burst (pulses, rate): pulses that follow each other at a rate (Hz) above the mean, as those of
        one beam do.

    Raises InputError: a wavelength or time out of the standard's limits, a negative rate, pulses
    that overlap.
    """
    single = permissible_exposure(wavelength, pulse_duration)
    total = _duration("exposure_duration", exposure_duration)
    if not (math.isfinite(repetition_rate) and repetition_rate >= 0):
        raise InputError(f"repetition_rate: {repetition_rate} Hz is not allowed; expected >= 0 Hz")
    if repetition_rate * pulse_duration > 1:
        raise InputError(
            f"repetition_rate: {repetition_rate:g} Hz is not allowed with pulses of "
            f"{pulse_duration:g} s; expected at most {1 / pulse_duration:g} Hz"
        )
    pulses = max(1.0, repetition_rate * total)
    rules: list[tuple[float, Rule, float]] = [(single, "single pulse", pulse_duration)]
    if pulses > 1:
        average = permissible_exposure(wavelength, max(total, pulse_duration)) / pulses
        rules.append((average, "average", total))
        if 400 <= _nanometres(wavelength) < 1400:
            repeated = _repeated(wavelength, pulse_duration, repetition_rate, total, burst)
            rules.append((repeated, "repeated pulses", pulse_duration))
    exposure, rule, time = min(rules, key=lambda candidate: candidate[0])
    return PulseLimit(exposure, rule, pulses, limiting_aperture(wavelength, time))


def time_base(wavelength: float) -> float:
    """Duration of the exposure that is assessed, s (IEC 60825-1:2014, 4.3 e).

    0.25 s where the aversion response acts (400 to 700 nm), 3e4 s in the ultraviolet, else 100 s.
    Somebody before a moving aircraft is exposed for a shorter time: that time may be taken instead.
    """
    nm = _nanometres(wavelength)
    if nm < 400:
        return 3e4
    return 0.25 if nm <= 700 else 100.0


def limiting_aperture(wavelength: float, duration: float) -> float:
    """Diameter of the circle over which exposure is averaged, m: 7 mm (pupil), or 1 to 11 mm."""
    nm = _nanometres(wavelength)
    if nm < 400:
        return 1e-3
    if nm < 1400:
        return 7e-3
    if nm >= 1e5:
        return 11e-3
    return 1e-3 * min(max(1.0, 1.5 * duration**0.375), 3.5)


def exposure_at(
    distance: float,
    energy: float,
    beam_radius: float,
    divergence_full: float,
    aperture: float,
    extinction: float = 0.0,
    aid: ViewingAid | None = None,
) -> float:
    """Radiant exposure on the axis of a Gaussian beam, averaged over an aperture, J m^-2.

    distance: m, from where the beam leaves.
    energy: J, of a pulse.
    beam_radius, divergence_full: 1/e^2 radius at the exit, m, and full angle, rad. The squares of
        both add up, as in a waist at the exit. A beam cut at c has an axis brighter by 1 / (1 -
        exp(-2 c^2 / beam_radius^2)): give the radius of the Gaussian with its variance
        (`BackscatterLidar.radius_at` (0)), which is brighter still.
    aperture: diameter, m, see `limiting_aperture`.
    extinction: of the air, m^-1.
    aid: gathers the light of its objective, or of ``aperture`` times its magnification if that is
        less, into ``aperture``.
    """
    aid = aid or ViewingAid(1.0, aperture)
    entrance = min(aid.objective, aperture * aid.magnification) / 2
    square = beam_radius**2 + (divergence_full / 2 * distance) ** 2
    # far away the fraction is tiny: 1 - exp would lose its digits
    fraction = -math.expm1(-2 * entrance**2 / square)
    arrived = energy * math.exp(-extinction * distance) * aid.transmission * fraction
    return arrived / (math.pi / 4 * aperture**2)


def hazard_distance(
    energy: float,
    limit: PulseLimit,
    beam_radius: float,
    divergence_full: float,
    extinction: float = 0.0,
    aid: ViewingAid | None = None,
) -> float:
    """Nominal ocular hazard distance (NOHD), m: beyond it no pulse exceeds the limit.

    Parameters as in `exposure_at`; with ``aid`` the extended distance. 0 if the beam is safe where
    it leaves, inf if it never becomes so (no divergence, clear air).

    Notes
    -----
    Far from the aperture's size, without extinction, the distance is
    sqrt(8 Q / (pi H) - 4 w^2) / divergence (IEC TR 60825-14, with diameters at 1/e^2).
    """
    _positive("energy", energy, " J")
    _positive("beam_radius", beam_radius, " m")
    for name, value, unit in (
        ("divergence_full", divergence_full, "rad"),
        ("extinction", extinction, "1/m"),
    ):
        if not (math.isfinite(value) and value >= 0):
            raise InputError(f"{name}: {value} {unit} is not allowed; expected >= 0 {unit}")

    def excess(distance: float, absorbed: float = extinction) -> float:
        beam = (energy, beam_radius, divergence_full, limit.aperture, absorbed, aid)
        return exposure_at(distance, *beam) - limit.exposure

    if excess(0.0) <= 0:
        return 0.0
    if divergence_full == 0 and extinction == 0:
        return math.inf
    far = beam_radius / divergence_full if divergence_full else 1 / extinction
    # exposure falls with the distance: doubled until the root is inside
    while excess(far) > 0:
        far *= 2
    return float(scipy.optimize.brentq(excess, 0.0, far, xtol=1e-9 * far, rtol=1e-12))


def scan_hazard_distance(
    beam: PulsedBeam,
    spacing: float,
    beams: int,
    scan_rate: float,
    exposure_duration: float,
    burst: tuple[float, float] = (1, 0),
) -> float:
    """Distance from which an eye may look into a whole scan, m.

    Neighbouring beams, ``spacing`` (rad) apart in both directions, overlap near the common aperture
    of the scanner, and at any distance if they diverge by more than the spacing. An eye at the
    distance r receives the light of n pulses in every scan, n = (pi w^2 / 2) / (spacing r)^2 for
    the 1/e^2 radius w, between 1 and ``beams``, each taken as strong as the one that points at it.

    scan_rate: scans per second, Hz.
    exposure_duration: s.
    burst (pulses, rate): pulses of each beam in a scan, and their rate while they are sent, Hz.

    Raises InputError: as `permissible_pulse`; a spacing or number of beams that is not positive.

    Notes
    -----
    Where the limit of the whole time decides, r = sqrt(energy scan_rate time / MPE(time)) /
    spacing.
    """
    _positive("spacing", spacing, " rad")
    _positive("beams", beams, "")

    def excess(distance: float) -> float:
        radius2 = beam.beam_radius**2 + (beam.divergence_full / 2 * distance) ** 2
        overlap = min(max(1.0, math.pi / 2 * radius2 / (spacing * distance) ** 2), beams)
        # beams that overlap may follow each other
        pulses = burst[0] * overlap
        limit = permissible_pulse(
            beam.wavelength,
            beam.pulse_duration,
            scan_rate * pulses,
            exposure_duration,
            (pulses, burst[1]),
        )
        shape = (beam.beam_radius, beam.divergence_full)
        arrived = exposure_at(distance, beam.pulse_energy, *shape, limit.aperture)
        return arrived / limit.exposure - 1

    # limits have steps where rules change: search for the farthest unsafe distance
    places = [10 ** (k / 20) for k in range(-40, 140)]
    unsafe = [place for place in places if excess(place) > 0]
    if not unsafe:
        return 0.0
    if unsafe[-1] == places[-1]:
        return math.inf
    low, high = unsafe[-1], places[places.index(unsafe[-1]) + 1]
    while high / low > 1 + 1e-6:
        # by halves of the logarithm, as the places are spaced
        middle = math.sqrt(low * high)
        low, high = (middle, high) if excess(middle) > 0 else (low, middle)
    return high


def assess_pulses(
    beam: PulsedBeam,
    repetition_rate: float = 0.0,
    exposure_duration: float | None = None,
    extinction: float = 0.0,
    aid: ViewingAid | None = None,
    burst: tuple[float, float] = (1, 0),
) -> EyeSafety:
    """Eye safety of a beam; see `permissible_pulse` and `exposure_at`.

    ``exposure_duration`` is by default the standard's `time_base`, ``aid`` binoculars 7 x 50.
    """
    wavelength, energy = beam.wavelength, beam.pulse_energy
    total = time_base(wavelength) if exposure_duration is None else exposure_duration
    limit = permissible_pulse(wavelength, beam.pulse_duration, repetition_rate, total, burst)
    shape = (beam.beam_radius, beam.divergence_full)
    naked = hazard_distance(energy, limit, *shape, extinction)
    aided = hazard_distance(energy, limit, *shape, extinction, aid or ViewingAid())
    exit_exposure = exposure_at(0.0, energy, *shape, limit.aperture)
    return EyeSafety(limit, exit_exposure, naked, aided)


def _ultraviolet(nm: float, t: float) -> float:
    # below 1 ns the table limits the irradiance
    if t < 1e-9:
        return 3e10 * t
    # C1; C2 is what it is compared with below 315 nm
    thermal = 5.6e3 * t**0.25 if t <= 10 else math.inf
    if nm < 315:
        return min(thermal, 30.0 if nm < 302.5 else 10 ** (0.2 * (nm - 295)))
    # 1e4 J m^-2 up to 1000 s, 10 W m^-2 beyond
    return min(thermal, max(1e4, 10 * t))


def _retina(nm: float, t: float) -> float:
    photochemical = math.inf
    if t > 10 and nm < 600:
        # C3 times 100 J m^-2 up to 100 s, 1 W m^-2 beyond
        photochemical = 10 ** (0.02 * max(0.0, nm - 450)) * max(100.0, t)
    c4, c7 = 10 ** (0.002 * (min(max(nm, 700.0), 1050.0) - 700)), _c7(nm)
    if nm >= 1050:
        c4 = 5.0  # 10^0.7 = 5.01, which the standard rounds
    factor = c4 * c7
    if t < 1e-11:
        thermal = 1e-3 * c7
    elif t <= _grouping_time(nm):
        thermal = (4.0 if nm >= 1050 else 2.0) * 1e-3 * factor
    else:
        thermal = factor * (18 * t**0.75 if t <= 10 else 10 * t)
    return min(thermal, photochemical, _skin(nm, t) if nm >= 1250 else math.inf)


def _c7(nm: float) -> float:
    if nm < 1150:
        return 1.0
    return 10 ** (0.018 * (nm - 1150)) if nm < 1200 else 8 + 10 ** (0.04 * (nm - 1250))


def _skin(nm: float, t: float) -> float:
    """Limit of the skin, 1250 to 1400 nm (table A.5; C4 = 5), J m^-2."""
    if t < 1e-9:
        return 1e12 * t
    if t < 1e-7:
        return 1e3
    return 5.5e4 * t**0.25 if t <= 10 else 1e4 * t


def _infrared(nm: float, t: float) -> float:
    if t > 10:
        return 1e3 * t
    if 1500 <= nm < 1800:
        return 1e13 * t if t < 1e-9 else 1e4
    # plateau of short pulses, and the start of the quarter-power law
    level, until = (1e3, 1e-3) if nm < 2600 else (1e2, 1e-7)
    if t < 1e-9:
        return level * 1e9 * t
    return level if t < until else 5.6e3 * t**0.25


def _grouping_time(nm: float) -> float:
    """T_i, s: pulses within it act as one."""
    return 5e-6 if nm < 1050 else 13e-6


def _repeated(
    wavelength: float, pulse: float, rate: float, total: float, burst: tuple[float, float]
) -> float:
    grouping = _grouping_time(_nanometres(wavelength))
    if pulse > grouping:
        return permissible_exposure(wavelength, pulse)
    counted = min(total, 10.0)  # T2 of a small source
    # pulses within T_i have together the limit of one that lasts T_i
    inside = max(rate * grouping, min(burst[0], burst[1] * grouping))
    if inside > 1:
        limit = permissible_exposure(wavelength, grouping) / inside
        number = rate * counted / inside
    else:
        limit, number = permissible_exposure(wavelength, pulse), rate * counted
    if total <= 0.25 or number <= 600:
        return limit
    return limit * max(0.4, 5 * number**-0.25)


def _nanometres(wavelength: float) -> float:
    if not 180e-9 <= wavelength <= 1e-3:
        raise InputError(f"wavelength: {wavelength:g} m is not allowed; expected 180 nm to 1 mm")
    # the table's edges are whole or half nanometres: 400e-9 * 1e9 must be 400
    return round(wavelength * 1e9, 6)


def _duration(name: str, value: float) -> float:
    if not 1e-13 <= value <= 3e4:
        raise InputError(f"{name}: {value:g} s is not allowed; expected 1e-13 to 3e4 s")
    return value


def _positive(name: str, value: float, unit: str) -> None:
    if not (math.isfinite(value) and value > 0):
        raise InputError(f"{name}: {value}{unit} is not allowed; expected more than 0{unit}")
