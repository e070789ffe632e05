"""Scan patterns: times and places by closed forms, what they ask of a scanner, what is refused.

Detects: a beam at another's time or place, a pattern that does not cover its field, a load that
differs from the analytic one by 1e-3, a smallest duration that is refused itself or is not the
smallest.
"""

import math
import re

import numpy as np
import pytest
from pydantic import ValidationError

from lidar_mi.errors import InputError
from lidar_mi.instrument.scan_timing import Directions, ScanTiming

Y, Z = np.linspace(-20, 20, 41), np.linspace(-10, 10, 21)
FAR = 500.0


def by_film(schedule, values):
    """Values in film order as (rows, columns), from the top left."""
    return values.reshape(len(Z), len(Y))


def test_raster_and_serpentine_by_hand():
    """Three columns, two rows: dwell (1.0 - 0.1) / 6 = 0.15 s, the turn after three beams."""
    y, z = np.array([-1.0, 0.0, 1.0]), np.array([0.0, 2.0])
    starts = np.array([0.075, 0.225, 0.375, 0.625, 0.775, 0.925]) - 0.5
    for pattern, last_row in (("raster", starts[3:]), ("serpentine", starts[:2:-1])):
        found = ScanTiming(pattern=pattern, duration=1.0, dead_time=0.1).schedule(y, z, FAR)
        assert found.time == pytest.approx([*starts[:3], *last_row], abs=1e-15)
        assert found.places.tolist() == [[1, 2], [0, 2], [-1, 2], [1, 0], [0, 0], [-1, 0]]
        assert found.duration == 1.0 and found.beam_rate == pytest.approx(1 / 0.15)


def test_slow_columns_are_slow_rows_of_the_turned_image():
    rows = ScanTiming(pattern="serpentine", duration=1.0, dead_time=0.01)
    columns = rows.model_copy(update={"slow": "columns"})
    down = columns.schedule(Y, Z, FAR)
    across = rows.schedule(Z, Y, FAR)
    assert by_film(down, down.time) == pytest.approx(across.time.reshape(len(Y), len(Z)).T)


@pytest.mark.parametrize("pattern", ["raster", "serpentine"])
def test_a_beam_rate_is_a_duration(pattern):
    by_rate = ScanTiming(pattern=pattern, beam_rate=1e4, dead_time=0.002).schedule(Y, Z, FAR)
    assert by_rate.duration == pytest.approx(Y.size * Z.size / 1e4 + 20 * 0.002)
    by_time = ScanTiming(pattern=pattern, duration=by_rate.duration, dead_time=0.002)
    same = by_time.schedule(Y, Z, FAR)
    assert same.time == pytest.approx(by_rate.time) and same.beam_rate == pytest.approx(1e4)


@pytest.mark.parametrize("pattern", ["raster", "serpentine"])
def test_no_duration_sends_all_at_once(pattern):
    timing = ScanTiming(pattern=pattern, duration=0)
    found = timing.schedule(Y, Z, FAR)
    assert timing.is_instant and not found.time.any()
    assert math.isinf(found.beam_rate)


@pytest.mark.parametrize(
    ("pattern", "cycles", "by_angle"),
    [("lissajous", (7, 5), False), ("lissajous", (4, 9), True), ("risley", (5, -3), False)],
)
def test_curves_lie_in_their_field_and_fill_it(pattern, cycles, by_angle):
    timing = ScanTiming(pattern=pattern, duration=2.0, cycles=cycles)
    found = timing.schedule(Y, Z, FAR, by_angle=by_angle)
    assert found.time[[0, -1]] == pytest.approx([-1 + 1 / 861, 1 - 1 / 861])
    assert np.diff(found.time) == pytest.approx(2 / 861)
    y, z = found.places.T
    if pattern == "risley":
        assert np.hypot(y, z).max() == pytest.approx(10, rel=0.01)
    else:
        assert abs(y).max() == pytest.approx(20, rel=0.01)
        assert abs(z).max() == pytest.approx(10, rel=0.01)
    if pattern == "lissajous":
        # sinusoids spend asin(1/2) / (pi / 2) of their time within half of the field
        assert np.mean(abs(y) < 10) == pytest.approx(1 / 3, abs=0.01)


@pytest.mark.parametrize("cycles", [(1, 2), (2, 1), (3, 2), (4, 3), (5, 3), (7, 5), (4, 9)])
def test_a_lissajous_curve_is_not_run_through_twice(cycles):
    """With a wrong phase it runs back on itself, and half of the beams repeat the others."""
    found = ScanTiming(pattern="lissajous", duration=1.0, cycles=cycles).schedule(Y, Z, FAR)
    unit = found.places / [20, 10]
    apart = np.linalg.norm(unit[:, None] - unit, axis=-1)
    apart[np.diag_indices(len(unit))] = np.inf
    step = np.linalg.norm(np.diff(unit, axis=0), axis=1).max()
    # of a curve that is run through twice every beam has one of another time within half a step
    time = abs(found.time[:, None] - found.time)
    time = np.minimum(time, 1 - time)
    twice = ((apart < step / 2) & (time > 0.02)).any(1)
    assert twice.mean() < 0.35


def test_what_a_serpentine_asks_of_its_scanner():
    """Reversing the rate r in the dead time d takes 2 r / d; a step of the slow axis 4 S / d^2."""
    timing = ScanTiming(pattern="serpentine", duration=1.0, dead_time=0.02)
    load = timing.schedule(Y, Z, FAR).load
    dwell = (1 - 20 * 0.02) / (41 * 21)
    rate, step = math.atan(1 / FAR) / dwell, math.atan(1 / FAR)
    assert load.rate == pytest.approx(rate, rel=1e-3)
    assert load.acceleration == pytest.approx(max(2 * rate / 0.02, 4 * step / 0.02**2), rel=1e-3)


def test_what_a_raster_asks_of_its_scanner():
    """It is back at the row's begin with its own rate: integrated along the turn's two halves."""
    dead = 0.02
    load = ScanTiming(pattern="raster", duration=1.0, dead_time=dead).schedule(Y, Z, FAR).load
    width = 41 * math.atan(1 / FAR)
    rate = width / ((1 - 20 * dead) / 21)
    time = np.linspace(0, dead, 100001)
    acceleration = np.where(time < dead / 2, -load.acceleration, load.acceleration)
    speed = rate + np.concatenate([[0], np.cumsum(acceleration[1:] * np.diff(time))])
    assert speed[-1] == pytest.approx(rate, rel=1e-3)
    assert -speed.min() == pytest.approx(load.rate, rel=1e-3)
    assert np.trapezoid(speed, time) == pytest.approx(-width, rel=1e-3)


def test_what_curves_ask_of_their_scanner():
    """A sinusoid of amplitude A and c cycles in T: 2 pi c A / T and its square over A."""
    amplitude = np.arctan(np.array([20, 10]) / FAR)
    angular = 2 * np.pi * np.array([7, 5]) / 2.0
    timing = ScanTiming(pattern="lissajous", duration=2.0, cycles=(7, 5))
    load = timing.schedule(Y, Z, FAR, by_angle=True).load
    assert load.rate == pytest.approx((amplitude * angular).max(), rel=1e-3)
    assert load.acceleration == pytest.approx((amplitude * angular**2).max(), rel=1e-3)
    # two prisms that deflect by A / 2 each, turning against each other, are in line at times
    timing = ScanTiming(pattern="risley", duration=2.0, cycles=(5, -2))
    load = timing.schedule(Y, Z, FAR, by_angle=True).load
    assert load.rate == pytest.approx(amplitude[1] / 2 * np.pi * 7, rel=1e-3)
    assert load.acceleration == pytest.approx(amplitude[1] / 2 * np.pi**2 * 29, rel=1e-3)


LIMITED = [
    {"pattern": "raster", "duration": 0.5, "dead_time": 0.003, "max_rate": 2.0},
    {"pattern": "serpentine", "duration": 0.5, "dead_time": 0.003, "max_acceleration": 100.0},
    {"pattern": "lissajous", "duration": 0.5, "cycles": (21, 20), "max_rate": 1.0},
    {"pattern": "risley", "duration": 0.5, "cycles": (21, 20), "max_acceleration": 100.0},
    {"pattern": "serpentine", "beam_rate": 1e5, "dead_time": 1e-4, "max_acceleration": 300.0},
]


@pytest.mark.parametrize("keys", LIMITED)
def test_the_smallest_duration_works_and_is_the_smallest(keys):
    keys = {
        k: f"{v} rad/s{'^2' * (k[4] == 'a')}" if k[:4] == "max_" else v for k, v in keys.items()
    }
    key = "beam_rate" if "beam_rate" in keys else "duration"
    with pytest.raises(InputError) as error:
        ScanTiming(**keys).schedule(Y, Z, FAR)
    message = str(error.value)
    assert message.startswith(f"{key}: {keys[key]:g} ") and "the scanner would need" in message
    number = float(re.search(r"expected at (?:least|most) (\S+)", message)[1])
    dead = re.search(r"dead_time of (\S+) s", message)
    allowed = keys | {key: number} | ({"dead_time": float(dead[1])} if dead else {})
    ScanTiming(**allowed).schedule(Y, Z, FAR)
    by = 0.995 if key == "duration" else 1 / 0.995
    shorter = allowed | {key: number * by}
    if dead:
        shorter["dead_time"] = allowed["dead_time"] * 0.995
    with pytest.raises(InputError, match="the scanner would need"):
        ScanTiming(**shorter).schedule(Y, Z, FAR)


def test_a_table_has_its_own_times():
    time = np.array([3.0, 3.1, 3.4, 3.5, 3.8, 4.0])
    azimuth, elevation = np.linspace(-0.1, 0.1, 6), np.linspace(0.05, -0.05, 6)
    table = Directions(time, azimuth, elevation, "mine.csv")
    timing = ScanTiming(pattern="table", table="mine.csv", max_rate="50 deg/s")
    found = timing.schedule(np.arange(3.0), np.arange(2.0), 100.0, table=table)
    assert found.time == pytest.approx(time - 3.5) and found.duration == 1.0
    assert found.places[:, 0] == pytest.approx(100 * np.tan(azimuth))
    assert found.places[:, 1] == pytest.approx(100 * np.tan(elevation))
    # 0.04 rad in 0.1 s
    assert found.load.rate == pytest.approx(0.4)
    with pytest.raises(InputError, match=r"^table: mine.csv has 6 beams; expected 9, as many"):
        timing.schedule(np.arange(3.0), np.arange(3.0), 100.0, table=table)
    slow = timing.model_copy(update={"max_rate": 0.2})
    with pytest.raises(InputError, match=r"^table: 1 s is not allowed; .*expected at least 2 s$"):
        slow.schedule(np.arange(3.0), np.arange(2.0), 100.0, table=table)


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({}, "duration, beam_rate: neither is given; expected exactly one of them"),
        ({"duration": 1, "beam_rate": 1e5}, "duration, beam_rate: both are given; expected ex"),
        ({"duration": 1, "cycles": (2, 3)}, "cycles: (2, 3) is not allowed with pattern serp"),
        ({"duration": 1, "table": "a.csv"}, "table: a.csv is not allowed with pattern serpentine"),
        ({"pattern": "lissajous", "duration": 1}, "cycles: missing; pattern lissajous needs it"),
        (
            {"pattern": "lissajous", "duration": 1, "cycles": (4, 6)},
            "cycles: 4, 6 is not allowed with lissajous; expected two numbers above 0 without",
        ),
        (
            {"pattern": "risley", "duration": 1, "cycles": (1, -1)},
            "cycles: 1, -1 is not allowed with risley, whose curve would be a circle or a line",
        ),
        (
            {"pattern": "lissajous", "duration": 1, "cycles": (3, 2), "dead_time": 0.01},
            "dead_time: 0.01 is not allowed with pattern lissajous; expected it with raster or",
        ),
        (
            {"pattern": "risley", "duration": 1, "cycles": (3, 2), "slow": "columns"},
            "slow: columns is not allowed with pattern risley",
        ),
        ({"pattern": "table"}, "table: missing; pattern table needs it"),
        (
            {"pattern": "table", "table": "a.csv", "beam_rate": 1e4},
            "beam_rate: not allowed with pattern table, which has its own times",
        ),
        ({"duration": -1}, "-1.0 is not allowed; expected 0 to 10000"),
        ({"duration": 1, "max_rate": 500}, "500 has no unit; expected a quantity in rad/s"),
    ],
)
def test_keys_that_do_not_fit_together(keys, message):
    with pytest.raises(ValidationError, match=re.escape(message)):
        ScanTiming(**keys)


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        (
            {"duration": 0.1, "dead_time": 0.01},
            "dead_time: 0.01 s is not allowed; 20 turns take 0.2 s, expected less than duration",
        ),
        (
            {"duration": 0.1, "max_rate": "9 rad/s"},
            "dead_time: 0 s is not allowed with max_rate; expected more than 0 s",
        ),
        (
            {"duration": 0, "pattern": "lissajous", "cycles": (3, 2), "max_rate": "9 rad/s"},
            "duration: 0 s is not allowed with max_rate; expected more than 0 s",
        ),
    ],
)
def test_times_that_do_not_fit_together(keys, message):
    with pytest.raises(InputError, match=f"^{re.escape(message)}"):
        ScanTiming(**keys).schedule(Y, Z, FAR)
