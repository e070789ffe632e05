"""Quantities with units. Detects a wrong factor, and text that is silently misread."""

import math
import pickle

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import BaseModel, ValidationError

from lidar_mi.units import (
    AS_GIVEN,
    Angle,
    Energy,
    Extinction,
    Length,
    Number,
    Speed,
    Time,
    registry,
    shown,
    to_si,
    usual,
)


class Quantities(BaseModel):
    length: Length = 0
    angle: Angle = 0
    speed: Speed = 0
    time: Time = 0
    energy: Energy = 0
    extinction: Extinction = 0
    number: Number = 0


SI = """
length: 500 m = 500; 532 nm = 532e-9; 0.5 um = 5e-7; 0.5 µm = 5e-7; 8.5km = 8500;  12 cm  = 0.12
length: 1e3 mm = 1; -3 m = -3; .5 m = 0.5; 5. m = 5; 1 ft = 0.3048; inf m = inf; 500 = 500
angle: 2 mrad = 2e-3; 6.2 deg = 0.10821041; 180 degree = 3.14159265; 1 rad = 1; 0 = 0
angle: 3 arcmin = 8.7266463e-4
speed: 150 m/s = 150; 540 km/h = 150; 100 knot = 51.4444; 150 m s^-1 = 150
time: 0.1 s = 0.1; 10 ns = 1e-8; 2 min = 120
energy: 70 mJ = 0.07
extinction: 1.8 / km = 1.8e-3; 0.1/km = 1e-4; 0.1 1/km = 1e-4; 0.1 km^-1 = 1e-4; 0.1 km**-1 = 1e-4
number: 0.5 = 0.5; 10 % = 0.1; 1e-2 = 0.01
"""


@pytest.mark.parametrize("line", SI.strip().splitlines())
def test_quantities_become_si(line):
    kind, _, cases = line.partition(": ")
    for case in cases.split("; "):
        text, _, expected = case.rpartition(" = ")
        found = getattr(Quantities(**{kind: text}), kind)
        assert found == pytest.approx(float(expected), rel=1e-6), text


@pytest.mark.parametrize(
    ("kind", "number"), [("length", 500), ("length", 0.25), ("angle", 0), ("extinction", 2.7e-5)]
)
def test_plain_numbers_are_in_si(kind, number):
    assert getattr(Quantities(**{kind: number}), kind) == number


@pytest.mark.parametrize(
    ("unit", "texts"),
    [
        ("m", ("m", "km", "cm", "mm", "um", "nm", "pm")),
        ("rad", ("rad", "mrad", "urad", "deg")),
        ("rad/s", ("rad/s", "deg/s", "deg / s")),
        ("rad/s^2", ("rad/s^2", "deg/s^2")),
        ("m/s", ("m/s", "m / s")),
        ("s", ("s", "ms", "us", "ns")),
        ("J", ("J", "mJ", "uJ")),
        ("1/m", ("1/m", "1 / km")),
        ("1/m/sr", ("1/m/sr",)),
        ("m^2", ("m^2",)),
        ("m^2/s", ("m^2/s",)),
        ("Hz", ("Hz", "kHz", "MHz", "GHz")),
        ("K", ("K", "mK")),
        ("W/m^3/sr", ("W/m^2/sr/nm",)),
        ("byte", ("MB", "GB")),
        ("", ("%",)),
    ],
)
@given(st.floats(1e-6, 1e6), st.integers(1, 17))
def test_usual_units_are_read_to_the_last_bit_as_pint_reads_them(unit, texts, number, digits):
    """Runs of before are resumed with the very same numbers."""
    number = float(f"{number:.{digits}g}")
    for text in texts:
        expected = registry().Quantity(number, text).to(unit or "dimensionless").magnitude
        assert to_si(f"{number!r} {text}", unit, "") == expected
        if unit != "byte":
            assert (
                shown(number, text) == f"{number / registry()(text).to_base_units().m:.4g} {text}"
            )


OTHER_KINDS = """
length: 500 s; 2 mrad; 5 %; 5 km/m; 5 m m; 20 degC
angle: 2 m; 2 Hz
speed: 150 m
time: 0.1 1/s
energy: 1 W
extinction: 1.8 km; 1.8 / km^2
number: 5 m; half
"""
NONE = """
  ; m; wide; 5 furlongitudes; '5' m; [5] m; 0,1 m; 500 m 3; 5 m + 3 cm; 1_000 m; 0x10 m; 5 m # or 6
(3 m; 3 (m; 1/0 m; 5 m/0; 10**10**3 m; 1 9**9**9 m; 1 9 ** 9 ^ 9 m; 1 (9**9)**9**9 m
1 km**99999999; __import__('os')
"""
"""Some are what a lenient reader takes for something else, or what pint would compute for ever."""
WRONG = [
    *(
        (line.partition(": ")[0], text)
        for line in OTHER_KINDS.strip().splitlines()
        for text in line.partition(": ")[2].split("; ")
    ),
    *(("length", text) for line in NONE[1:-1].splitlines() for text in line.split("; ")),
    *(("length", value) for value in ("", True, None, [5], {"m": 5}, "1 m\n2", 10**400)),
    *(("length", text) for text in ("1" * 100_000 + " m", "1 " + "a" * 90 + "!")),
]


@pytest.mark.parametrize(("kind", "text"), WRONG)
def test_anything_else_is_named_with_an_example(kind, text):
    with pytest.raises(ValidationError) as error:
        Quantities(**{kind: text})
    fault = error.value.errors()[0]
    assert fault["loc"] == (kind,)
    assert repr(text) in fault["msg"] and "expected a" in fault["msg"]


@pytest.mark.parametrize("text", [2, 2.0, "2", "-0.1"])
def test_an_angle_needs_its_unit(text):
    with pytest.raises(ValidationError, match="has no unit; expected an angle such as '2 mrad'"):
        Quantities(angle=text)


def test_written_quantities_are_read_again_exactly():
    one = Quantities(
        length=0.1 + 0.2,
        angle="6.2 deg",
        speed=1 / 3,
        time=1e-9,
        energy="0.07 J",
        extinction="1.8 / km",
        number=1e-30,
    )
    text = one.model_dump(mode="json")
    assert text["angle"].endswith(" rad") and text["extinction"].endswith(" 1/m")
    assert Quantities(**text) == one


def test_quantities_are_shown_as_they_were_given():
    """The unit and the digits of the user, and bit for bit the same number when read again."""
    one = Quantities(angle="9 deg", speed="140  knots", length=150)
    text = one.model_dump(mode="json", context=AS_GIVEN)
    assert (text["angle"], text["speed"], text["length"]) == ("9 deg", "140 knots", "150.0 m")
    assert one.speed == 140 * 1852 / 3600
    again = Quantities(**text)
    assert again == one == pickle.loads(pickle.dumps(one))
    assert (
        usual(again.angle, "rad") == usual(pickle.loads(pickle.dumps(one)).angle, "rad") == "9 deg"
    )
    assert shown(one.speed, "m/s") == "140 knots" and shown(one.length, "km") == "0.15 km"
    assert usual(2 * one.angle, "rad") == "18 deg"


@pytest.mark.parametrize(
    ("number", "unit", "text"),
    [
        (5.32e-07, "m", "532 nm"),
        (0.17453292519943295, "rad", "10 deg"),
        (0.002, "rad", "2 mrad"),
        (-0.05235987755982989, "rad", "-3 deg"),
        (0.012, "rad", "12 mrad"),
        (math.radians(0.3), "rad", "0.3 deg"),
        (0.0123456789, "rad", "0.707355 deg"),
        (350.0, "m^2/s", "350 m^2/s"),
        (0.001, "J", "1 mJ"),
        (0.1, "s", "0.1 s"),
        (1e-8, "s", "10 ns"),
        (1500.0, "m", "1500 m"),
        (25000.0, "Hz", "25 kHz"),
        (0.0, "rad", "0 rad"),
        (0.0, "m", "0 m"),
        (1.25, "", "1.25"),
    ],
)
def test_quantities_as_people_write_them(number, unit, text):
    assert usual(number, unit) == text
    if unit:
        assert to_si(text, unit, "1") == pytest.approx(number, rel=1e-5)
