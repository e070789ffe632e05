"""Numbers of MIL-F-8785C and CS-25 against the regulations' text. Unit tier.

Detects: feet taken for metres, knots for m/s, a jump between the low and the high model.
`validation.air` has design gusts and their alleviation.
"""

import pytest

from lidar_mi.atmosphere.air.standards import (
    CS_25_LENGTH,
    design_gust_speed,
    flight_profile_alleviation,
    mil_f_8785c,
    reference_gust_speed,
)
from lidar_mi.errors import InputError


@pytest.mark.parametrize(
    ("height", "level", "sigma", "length"),
    [
        # 0.1 of 15, 30 and 45 knots; L_w = h
        (91.44, "light", 0.7717, 91.44),
        (91.44, "moderate", 1.5433, 91.44),
        (304.8, "severe", 2.3150, 304.8),
        # figure 7 at 7500 ft: 6.7, 10.1 and 23.6 ft/s
        (2286.0, "light", 2.042, 762.0),
        (2286.0, "moderate", 3.078, 762.0),
        (2286.0, "severe", 7.193, 762.0),
        # half way from 1000 to 2000 ft: 5.063 ft/s, and 9.725 ft/s of 2000 ft
        (457.2, "moderate", (5.0634 + 9.725) / 2 * 0.3048, (304.8 + 762) / 2),
        (0.0, "light", 0.7717, 3.048),
    ],
)
def test_turbulence_of_mil_f_8785c(height, level, sigma, length):
    assert mil_f_8785c(height, level) == pytest.approx((sigma, length), rel=2e-4)


@pytest.mark.parametrize("height", [304.8, 609.6])
def test_no_jump_where_the_models_meet(height):
    below, above = (mil_f_8785c(height + one, "moderate") for one in (-1e-6, 1e-6))
    assert below == pytest.approx(above, rel=1e-6)


def test_length_of_cs_25():
    assert pytest.approx(762.0) == CS_25_LENGTH


@pytest.mark.parametrize(
    ("altitude", "speed"),
    [(0.0, 17.07), (2286.0, 15.24), (4572.0, 13.41), (18288.0, 6.36), (11430.0, 9.885)],
)
def test_reference_gust_speed(altitude, speed):
    assert reference_gust_speed(altitude) == pytest.approx(speed, abs=0.005)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: mil_f_8785c(100.0, "extreme"), r"turbulence\.level: 'extreme' is not known"),
        (lambda: design_gust_speed(0.0, 5.0), r"gust\.gradient: 5 m .* expected 9\.14 to 107 m"),
        (lambda: design_gust_speed(0.0, 50.0, 1.2), r"gust\.alleviation: 1\.2"),
        (lambda: flight_profile_alleviation(0.0, 1e4, 1.1), r"gust\.landing_weight: 1\.1"),
        (lambda: flight_profile_alleviation(0.0, -5.0), r"gust\.maximum_altitude: -5\.0"),
    ],
)
def test_what_is_refused(call, message):
    with pytest.raises(InputError, match=message):
        call()
