"""Permissible exposures and hazard distances.

Detects a wrong digit, exponent or boundary in the tables of exposure limits (compared with the
accessible emission limits that the same standard prints, exposure times area of the aperture, to
their two digits, and with limits of neighbouring ranges, which meet to 2 %), a wrong rule for pulse
trains (worked by hand), and a wrong hazard distance (published example, ray sums over the
aperture).
"""

import math

import numpy as np
import pytest

from lidar_mi.errors import InputError
from lidar_mi.instrument.doppler import DopplerLidar
from lidar_mi.instrument.eye_safety import (
    PulsedBeam,
    PulseLimit,
    ViewingAid,
    assess_pulses,
    exposure_at,
    hazard_distance,
    limiting_aperture,
    permissible_exposure,
    permissible_pulse,
    scan_hazard_distance,
    time_base,
)
from lidar_mi.instrument.lidar import BackscatterLidar

NM = 1e-9


# single exposures


@pytest.mark.parametrize(
    ("wavelength", "duration", "diameter", "emission"),
    [
        # class 1 of IEC 60825-1:2014, table 3: J (watts times the duration)
        (266, 1e-8, 1e-3, 2.4e-5),
        (266, 1e4, 1e-3, 2.4e-5),
        (310, 1.0, 1e-3, 7.9e-7 * 10 ** (0.2 * 15)),
        (355, 1e-8, 1e-3, 4.4e-3 * 1e-2),
        (355, 100.0, 1e-3, 7.9e-3),
        (355, 1e4, 1e-3, 7.9e-6 * 1e4),
        (532, 5e-12, 7e-3, 3.8e-8),
        (532, 1e-8, 7e-3, 7.7e-8),
        (532, 0.25, 7e-3, 7e-4 * 0.25**0.75),
        (633, 100.0, 7e-3, 3.9e-4 * 100),
        (440, 100.0, 7e-3, 3.9e-5 * 100),
        (905, 5e-12, 7e-3, 3.8e-8),
        (905, 1e-8, 7e-3, 7.7e-8 * 10**0.41),
        (905, 1e-3, 7e-3, 7e-4 * 10**0.41 * 1e-3**0.75),
        (905, 100.0, 7e-3, 3.9e-4 * 10**0.41 * 100),
        (1064, 1e-8, 7e-3, 7.7e-7),
        (1064, 1e-3, 7e-3, 3.5e-3 * 1e-3**0.75),
        (1064, 100.0, 7e-3, 3.9e-4 * 5 * 100),
        (1450, 1e-8, 1e-3, 8e-4),
        (1450, 0.1, 1e-3, 4.4e-3 * 0.1**0.25),
        (1550, 1e-8, 1e-3, 8e-3),
        (1550, 100.0, 3.5e-3, 1e-2 * 100),
        (2000, 1e-8, 1e-3, 8e-4),
        (10600, 1e-8, 1e-3, 8e-5),
    ],
)
def test_exposure_times_aperture_is_the_emission_limit(wavelength, duration, diameter, emission):
    """Both tables are printed with two digits: 5 %."""
    found = permissible_exposure(wavelength * NM, duration) * math.pi / 4 * diameter**2
    assert found == pytest.approx(emission, rel=0.05)
    assert limiting_aperture(wavelength * NM, duration) == pytest.approx(diameter, rel=1e-9)


def test_the_exposures_of_a_lidar():
    """Table A.1 as printed, pulses of 10 ns."""
    assert permissible_exposure(532e-9, 10e-9) == pytest.approx(2e-3)
    assert permissible_exposure(355e-9, 10e-9) == pytest.approx(5600 * 0.01)
    assert permissible_exposure(1064e-9, 10e-9) == pytest.approx(2e-2)
    assert permissible_exposure(1550e-9, 10e-9) == pytest.approx(1e4)


@pytest.mark.parametrize(
    ("wavelength", "times"),
    [
        (266, [1e-9]),
        (305, [1e-9, 10]),
        (355, [1e-9, 10, 1e3]),
        (532, [5e-6, 10]),
        (440, [10, 100]),
        (900, [5e-6, 10]),
        (1064, [13e-6, 10]),
        (1450, [1e-9, 1e-3, 10]),
        (1550, [1e-9, 10]),
        (3000, [1e-9, 1e-7, 10]),
    ],
)
def test_ranges_of_time_meet(wavelength, times):
    """The standard's rounded constants leave steps of at most 6 % (18 t^(3/4) at 5 us: 1.9e-3)."""
    for t in times:
        before, after = (permissible_exposure(wavelength * NM, t * f) for f in (1 - 1e-9, 1 + 1e-9))
        assert after == pytest.approx(before, rel=0.06)


def test_limits_never_fall_with_time_and_irradiance_never_rises():
    """More time, more energy allowed, less power: but for the steps of rounding and of 10 ps."""
    times = np.geomspace(2e-11, 3e4, 400)
    for wavelength in (200, 300, 310, 355, 430, 480, 532, 700, 1049, 1051, 1300, 1390, 1600, 5000):
        exposure = np.array([permissible_exposure(wavelength * NM, t) for t in times])
        assert (np.diff(exposure) >= -0.06 * exposure[1:]).all(), wavelength
        power = exposure / times
        assert (np.diff(power) <= 0.06 * power[1:]).all(), wavelength


@pytest.mark.parametrize("edge", [302.5, 315, 400, 450, 700, 1050, 1150, 1200, 1250])
def test_ranges_of_wavelength_meet(edge):
    """Where the limit is one and the same for both, at 1 ms and 100 s."""
    for t, meets in ((1e-3, edge not in (302.5, 400)), (100.0, edge != 400)):
        below, above = (permissible_exposure((edge + d) * NM, t) for d in (-1e-5, 1e-5))
        # from 1050 nm: 90 for 5.01 * 18; 1200 nm: 8 for 7.94; 302.5 nm: 31.6 for 30
        if meets and not (edge == 1200 and t == 1e-3):
            assert above == pytest.approx(below, rel=0.06), (edge, t)


def test_the_front_of_the_eye_is_protected_up_to_1400_nm():
    """C7 grows to a million at 1400 nm; the skin's limit, 1000 J/m2 for 10 ns, stays."""
    assert permissible_exposure(1399e-9, 1e-8) == pytest.approx(200 * 5)
    assert permissible_exposure(1399e-9, 100.0) == pytest.approx(2000 * 5 * 100)
    assert permissible_exposure(1260e-9, 1e-8) == pytest.approx(2e-2 * (8 + 10**0.4))


# pulse trains


def test_a_single_pulse_is_a_train_of_one():
    limit = permissible_pulse(532e-9, 10e-9, 0.0, 0.25)
    assert limit == PulseLimit(2e-3, "single pulse", 1.0, 7e-3)


@pytest.mark.parametrize(
    ("rate", "seconds", "exposure", "rule"),
    [
        # a quarter second: 18 * 0.25^0.75 = 6.364 J/m2, C5 = 1
        (1e3, 0.25, 2e-3, "single pulse"),
        (2e4, 0.25, 6.3640e-0 / 5000, "average"),
        # ten seconds: 2000 pulses, C5 = 5 * 2000^-0.25 = 0.74767
        (200.0, 10.0, 2e-3 * 0.747674, "repeated pulses"),
        (50.0, 10.0, 2e-3, "single pulse"),
        # 100 s count as T2 = 10 s for C5 and as 1000 J/m2 for the average, 2.5e6 pulses
        (25e3, 100.0, 1000 / 2.5e6, "average"),
    ],
)
def test_trains_of_green_pulses_by_hand(rate, seconds, exposure, rule):
    limit = permissible_pulse(532e-9, 10e-9, rate, seconds)
    assert limit.exposure == pytest.approx(exposure, rel=1e-4) and limit.rule == rule
    assert limit.pulses == pytest.approx(rate * seconds)


def test_pulses_that_act_as_one():
    """1 MHz at 905 nm: 5 pulses within 5 us share 1.94e-3 C4, times C5 = 0.4 (2e6 groups)."""
    limit = permissible_pulse(905e-9, 5e-9, 1e6, 100.0)
    c4 = 10**0.41
    assert limit.rule == "average"
    assert limit.exposure == pytest.approx(10 * c4 / 1e6)
    few = permissible_pulse(905e-9, 5e-9, 1e6, 1e-4)  # 20 groups, C5 = 1
    assert few.exposure == pytest.approx(18 * c4 * 1e-4**0.75 / 100)


def test_long_pulses_have_no_c5():
    assert permissible_pulse(532e-9, 1e-3, 100.0, 10.0).exposure == pytest.approx(
        min(18 * 1e-3**0.75, 18 * 10**0.75 / 1000)
    )


def test_ultraviolet_dose_adds_up():
    """355 nm, 10 Hz for 3e4 s: 10 W/m2 * 3e4 s in 3e5 pulses, 1 J/m2 each."""
    limit = permissible_pulse(355e-9, 10e-9, 10.0, time_base(355e-9))
    assert limit.exposure == pytest.approx(1.0) and limit.rule == "average"
    assert limit.aperture == 1e-3
    # in 2 s: 20 pulses, 5600 * 2^0.25 / 20 is more than a pulse alone
    assert permissible_pulse(355e-9, 10e-9, 10.0, 2.0).rule == "single pulse"


# distances


def test_published_hazard_distance():
    """1 W, 1 mrad (63 % of the power), visible, a quarter second: 225 m."""
    limit = PulseLimit(18 * 0.25**0.75 / 0.25, "single pulse", 1.0, 7e-3)
    found = hazard_distance(1.0, limit, 1e-4, math.sqrt(2) * 1e-3)
    assert found == pytest.approx(225, rel=0.01)


def test_far_field_formula():
    """sqrt(8 Q / (pi H) - 4 w^2) / divergence; averaging over 7 mm of 0.5 m is 1e-4 of it."""
    limit = permissible_pulse(532e-9, 10e-9, 0.0, 0.25)
    expected = math.sqrt(8 * 1e-3 / (math.pi * 2e-3) - 4 * 0.1**2) / 2e-3
    assert hazard_distance(1e-3, limit, 0.1, 2e-3) == pytest.approx(expected, rel=2e-4)


def test_exposure_is_the_mean_over_the_aperture():
    """Midpoint sum of the Gaussian over the circle, beams wider and narrower than it."""
    half = 3.5e-3
    x = (np.arange(800) + 0.5) / 800 * 2 * half - half
    inside = x[:, None] ** 2 + x[None, :] ** 2 < half**2
    for radius in (2e-3, 5e-3, 0.1):
        beam = (
            2 / (math.pi * radius**2) * np.exp(-2 * (x[:, None] ** 2 + x[None, :] ** 2) / radius**2)
        )
        assert exposure_at(0.0, 3.0, radius, 1e-3, 2 * half) == pytest.approx(
            3 * beam[inside].mean(), rel=2e-3
        )


def test_at_the_hazard_distance_the_exposure_is_the_limit():
    """With and without air and binoculars; absorbing air brings it nearer, binoculars farther."""
    limit = permissible_pulse(532e-9, 10e-9, 200.0, 10.0)
    found = []
    for extinction in (0.0, 1e-3):
        for aid in (None, ViewingAid()):
            distance = hazard_distance(0.1, limit, 0.025, 0.5e-3, extinction, aid)
            at = exposure_at(distance, 0.1, 0.025, 0.5e-3, limit.aperture, extinction, aid)
            assert at == pytest.approx(limit.exposure, rel=1e-6)
            found.append(distance)
    assert found[2] < found[0] < found[1] and found[2] < found[3] < found[1]


def test_safe_at_the_exit_and_never_safe():
    eye_safe = assess_pulses(PulsedBeam(1550e-9, 1e-3, 10e-9, 0.05, 1e-3), 10.0)
    assert eye_safe.hazard_distance == eye_safe.aided_hazard_distance == 0
    assert eye_safe.exposure_at_exit == pytest.approx(2e-3 / (math.pi * 0.05**2), rel=2e-3)
    assert math.isinf(hazard_distance(0.1, permissible_pulse(532e-9, 1e-8, 0, 1), 0.01, 0.0))
    # in air that absorbs, a parallel beam is safe somewhere: ln(ratio) / extinction
    limit = permissible_pulse(532e-9, 1e-8, 0, 1)
    ratio = exposure_at(0, 0.1, 0.01, 0.0, 7e-3) / 2e-3
    assert hazard_distance(0.1, limit, 0.01, 0.0, 1e-4) == pytest.approx(math.log(ratio) / 1e-4)


def test_distances_of_the_default_lidars():
    """As the theory quotes them."""
    lidar, doppler = BackscatterLidar(), DopplerLidar()
    beam = float(lidar.radius_at(0)), lidar.divergence_full
    green = assess_pulses(PulsedBeam(lidar.wavelength, lidar.pulse_energy, 10e-9, *beam))
    assert green.hazard_distance == pytest.approx(558, abs=0.5)
    assert green.aided_hazard_distance == pytest.approx(3.9e3, abs=50)
    for wavelength in (355e-9, 1550e-9):
        invisible = PulsedBeam(wavelength, lidar.pulse_energy, 10e-9, *beam)
        train = assess_pulses(invisible, 20.0, 10.0)
        assert train.hazard_distance == train.aided_hazard_distance == 0
    beam = PulsedBeam(
        doppler.wavelength,
        doppler.pulse_energy,
        doppler.pulse_duration,
        doppler.beam_radius,
        doppler.divergence_full,
    )
    for rate, distance in ((0.0, 52), (200.0, 365)):
        found = assess_pulses(beam, rate, 10.0)
        assert found.hazard_distance == pytest.approx(distance, abs=0.5)


# bad input


@pytest.mark.parametrize(
    ("call", "start"),
    [
        (lambda: permissible_exposure(100e-9, 1.0), "wavelength: 1e-07 m is not allowed"),
        (lambda: permissible_exposure(532.0, 1.0), "wavelength: 532 m"),
        (lambda: permissible_exposure(532e-9, 0.0), "duration: 0 s"),
        (lambda: permissible_exposure(532e-9, math.nan), "duration: nan s"),
        (lambda: permissible_pulse(532e-9, 1e-8, -1.0, 1.0), "repetition_rate: -1.0 Hz"),
        (lambda: permissible_pulse(532e-9, 1e-3, 1e4, 1.0), "repetition_rate: 10000 Hz"),
        (lambda: permissible_pulse(532e-9, 1e-3, 1.0, 1e6), "exposure_duration: 1e+06 s"),
        (lambda: assess_pulses(PulsedBeam(532e-9, 0.0, 1e-8, 0.1, 1e-3)), "energy: 0.0 J"),
        (lambda: assess_pulses(PulsedBeam(532e-9, 1.0, 1e-8, 0.0, 1e-3)), "beam_radius: 0.0 m"),
        (
            lambda: assess_pulses(PulsedBeam(532e-9, 1.0, 1e-8, 0.1, -1e-3)),
            "divergence_full: -0.001 rad",
        ),
        (lambda: ViewingAid(magnification=0), "viewing_aid.magnification: 0"),
    ],
)
def test_bad_input_is_named(call, start):
    with pytest.raises(InputError) as error:
        call()
    assert str(error.value).startswith(start) and "\n" not in str(error.value)


# scans


def test_scan_whose_light_adds_up():
    """Infrared, 10 s: E rate t / (spacing r)^2 = 1e4 J/m^2 where beams overlap; 1e-3 J: 3.16 m."""
    scan = {"spacing": 1e-3, "beams": 30441, "scan_rate": 10, "exposure_duration": 10}
    for energy in (1e-3, 1e-2):
        found = scan_hazard_distance(PulsedBeam(1550e-9, energy, 1e-8, 0.08, 2e-3), **scan)
        assert found == pytest.approx(math.sqrt(energy * 100 / 1e4) / 1e-3, rel=0.01)


def test_scan_of_beams_far_apart_is_one_beam():
    """Green, single pulses decide: as `hazard_distance`, wherever no neighbour overlaps."""
    beam = PulsedBeam(532e-9, 1e-3, 1e-8, 0.08, 2e-3)
    one = assess_pulses(beam, 10, 10)
    wide = scan_hazard_distance(beam, 5e-3, 100, 10, 10)
    assert wide == pytest.approx(one.hazard_distance, rel=1e-4)


def test_weak_scan_is_safe_everywhere_and_none_without_spacing():
    weak = PulsedBeam(1550e-9, 1e-9, 1e-8, 0.08, 2e-3)
    assert scan_hazard_distance(weak, 1e-3, 100, 10, 10) == 0
    with pytest.raises(InputError, match=r"spacing: 0.0 rad is not allowed"):
        scan_hazard_distance(weak, 0.0, 100, 10, 10)


def test_pulses_of_a_burst_within_5_us_count_as_one():
    """IEC 60825-1:2014, A.3 c: the limit of 5 us for all of them together, 2 mJ/m^2 at 532 nm.

    8 pulses at 1 MHz, of which 5 come within it; at 100 kHz each has the limit by itself.
    """
    alone = permissible_pulse(532e-9, 10e-9, 80.0, 0.25)
    assert alone.exposure == pytest.approx(2e-3)
    assert permissible_pulse(532e-9, 10e-9, 80.0, 0.25, (8, 1e5)) == alone
    close = permissible_pulse(532e-9, 10e-9, 80.0, 0.25, (8, 1e6))
    assert close.exposure == pytest.approx(2e-3 / 5)
    few = permissible_pulse(532e-9, 10e-9, 30.0, 0.25, (3, 1e6))
    assert few.exposure == pytest.approx(2e-3 / 3)


def test_beams_that_follow_each_other_fast_act_together_near_the_scanner():
    scan = (PulsedBeam(532e-9, 1e-3, 10e-9, 0.1, 1e-3), 5e-4, 10_000, 10.0, 0.25)
    slow, fast = scan_hazard_distance(*scan), scan_hazard_distance(*scan, (1, 1e6))
    assert fast > slow
    # far below a pulse in 5 us it makes no difference
    assert scan_hazard_distance(*scan, (1, 1e4)) == slow
