"""Pulses and photons of a scan.

Detects a wrong product, an echo time without its way back, and a rounding that asks for one beam or
pulse too many or too few. Compared with sums done by hand.
"""

import math

import pytest

from lidar_mi.errors import InputError
from lidar_mi.instrument.doppler import DopplerLidar, photons
from lidar_mi.instrument.pulse_budget import pulse_budget, pulses_for_error


def test_the_papers_doppler_lidar():
    """63 directions, 10 slabs a second, 20 pulses of 70 mJ each: 12.6 kHz, 882 W."""
    lidar = DopplerLidar(range=56)
    found = pulse_budget(63, 10.0, 20, lidar.pulse_energy, 61.0, photons(lidar))
    assert found.pulses_per_second == 12_600
    assert found.average_power == pytest.approx(882)
    assert found.beams == 1
    assert found.photons_per_direction == pytest.approx(20 * 2.4e7, rel=0.02)


def test_the_papers_backscatter_lidar():
    """219 x 139 directions ten times a second, heard from 502.5 m after 3.35 us: two at a time."""
    found = pulse_budget(219 * 139, 10.0, 1, 1e-3, 502.5)
    assert found.pulses_per_second == 304_410
    assert found.echo_time == pytest.approx(3.3523e-6, rel=1e-4)
    assert found.beams == 2 and math.isnan(found.photons_per_direction)
    assert pulse_budget(219 * 139, 10.0, 1, 1e-3, 485.0).beams == 1


def test_echoes_that_just_fit():
    c = 299_792_458.0
    assert pulse_budget(100, 10.0, 1, 1e-3, c / 2 / 1000).beams == 1
    assert pulse_budget(100, 10.0, 1, 1e-3, c / 2 / 999.9).beams == 2


@pytest.mark.parametrize(
    ("one", "required", "pulses"), [(11.2, 2.5, 21), (2.0, 0.5, 16), (0.4, 0.5, 1)]
)
def test_pulses_for_an_error(one, required, pulses):
    assert pulses_for_error(one, required) == pulses


def test_bad_input_is_named():
    for call, start in (
        (lambda: pulse_budget(0, 10.0, 1, 1e-3, 100.0), "directions: 0 is not allowed"),
        (lambda: pulse_budget(9, 10.0, 1, -1e-3, 100.0), "pulse_energy: -0.001"),
        (lambda: pulse_budget(9, 10.0, 1, 1e-3, math.inf), "farthest: inf"),
        (lambda: pulses_for_error(1.0, 0.0), "required: 0.0 m/s"),
        (lambda: pulses_for_error(math.nan, 1.0), "error_of_one: nan m/s"),
    ):
        with pytest.raises(InputError) as error:
            call()
        assert str(error.value).startswith(start)


def test_pulses_sent_in_a_part_of_the_time_need_a_higher_rate_at_the_same_power():
    """A scan of 50 ms every 100 ms: twice the rate, and echoes overlap earlier."""
    even = pulse_budget(219 * 139, 10.0, 1, 1e-3, 485.0)
    part = pulse_budget(219 * 139, 10.0, 1, 1e-3, 485.0, sending=0.05)
    assert part.pulses_per_second == pytest.approx(2 * even.pulses_per_second)
    assert part.average_power == even.average_power and (even.beams, part.beams) == (1, 2)
