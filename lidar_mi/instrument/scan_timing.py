"""When each beam of a scan is sent and where it nominally goes: scan patterns and their limits.

A scan is one pass over a field of angles. Its reference time is the middle of its duration. Limits
of rate and acceleration are those of a scanner with one mirror for each axis.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Literal, NamedTuple, Self

import numpy as np
from pydantic import Field, model_validator

from lidar_mi.description import Description
from lidar_mi.errors import InputError
from lidar_mi.units import AngularAcceleration, AngularRate, Frequency, Time, Within

# Samples of a cycle in which the rate and acceleration of a curve are looked for: 2e-4 of them.
_SAMPLES = 256
_ROWS = ("raster", "serpentine")
_CURVES = ("lissajous", "risley")

_Cycles = Annotated[int, Within(-1000000, 1000000, "one beam a cycle in the largest scans")]


@dataclass(frozen=True)
class Directions:
    """A scanner's own table of directions.

    time (n,): s, ascending, from any zero.
    azimuth, elevation (n,): rad, positive to port and upwards; the direction is (1, tan azimuth,
        tan elevation).
    source: its file, for messages.
    """

    time: np.ndarray
    azimuth: np.ndarray
    elevation: np.ndarray
    source: str = "table"


class Load(NamedTuple):
    """Load of the scanner: rad/s and rad/s^2, the larger of both axes."""

    rate: float
    acceleration: float


@dataclass(frozen=True)
class Schedule:
    """Beams of a scan in film order.

    time (n,): middle of each beam's dwell, s, from the middle of the scan.
    places (n, 2): y and z where it nominally crosses the plane at the scan's distance, m.
    duration: s, from the begin of the first beam to the end of the last.
    beam_rate: beams a second between turns, Hz; infinite if all are sent at once.
    """

    time: np.ndarray
    places: np.ndarray
    duration: float
    beam_rate: float
    load: Load


class ScanTiming(Description):
    """When each beam of a scan is sent.

    ``raster`` and ``serpentine`` go over the nodes of the image row by row, always from the left or
    back and forth, at a constant rate, and turn in ``dead_time``. ``lissajous`` and ``risley`` send
    as many beams, evenly in time, along a curve over the same field: sinusoids in azimuth and
    elevation with ``cycles`` in a scan, or the sum of two deflections that rotate ``cycles`` times
    in a scan, over the largest circle in the field. ``table``: times and directions of a file.
    """

    pattern: Literal["raster", "serpentine", "lissajous", "risley", "table"] = Field(
        "serpentine", description="order of the beams"
    )
    duration: Annotated[Time, Within(0, 10000, "the life of a wake")] | None = Field(
        None, description="of a scan, with its turns, at most platform.dt; 0: all beams at once"
    )
    beam_rate: (
        Annotated[Frequency, Within(1e-4, 1e12, "from a beam in 3 h to one a picosecond")] | None
    ) = Field(None, description="beams a second between turns, in place of the duration")
    pulses_per_beam: Annotated[int, Within(1, 10000, "100 s of pulses at 100 Hz")] = Field(
        1, description="averaged"
    )
    dead_time: Annotated[Time, Within(0, 1000, "the life of a wake")] = Field(
        0.0, description="of a turn between two rows, with raster and serpentine"
    )
    slow: Literal["rows", "columns"] = Field(
        "rows",
        description="slow axis of raster and serpentine: row after row or column after column",
    )
    cycles: tuple[_Cycles, _Cycles] | None = Field(
        None,
        description="in azimuth and elevation (lissajous, above 0), or of both prisms (risley, of "
        "either sign), without a common divisor",
    )
    table: str | None = Field(
        None, description="CSV or NetCDF file of t, azimuth, elevation, with pattern: table"
    )
    max_rate: (
        Annotated[AngularRate, Within(1e-9, 1e9, "from the stars' to mirrors of a nanosecond")]
        | None
    ) = Field(
        None, description="largest angular rate of the scanner on each axis; default: unlimited"
    )
    max_acceleration: (
        Annotated[AngularAcceleration, Within(1e-12, 1e18, "mirrors of a nanosecond")] | None
    ) = Field(
        None,
        description="largest angular acceleration of the scanner on each axis; default: unlimited",
    )

    @model_validator(mode="after")
    def _keys_of_the_pattern(self) -> Self:
        pattern, given = self.pattern, (self.duration, self.beam_rate)
        for key, used, default in (
            ("cycles", _CURVES, None),
            ("table", ("table",), None),
            ("dead_time", _ROWS, 0.0),
            ("slow", _ROWS, "rows"),
        ):
            value = getattr(self, key)
            if pattern not in used and value != default:
                raise ValueError(
                    f"{key}: {value} is not allowed with pattern {pattern}; expected it with "
                    f"{' or '.join(used)}"
                )
            if pattern in used and default is None and value is None:
                raise ValueError(f"{key}: missing; pattern {pattern} needs it")
        if pattern == "table":
            if given != (None, None):
                key = "duration" if self.duration is not None else "beam_rate"
                raise ValueError(f"{key}: not allowed with pattern table, which has its own times")
        elif (self.duration is None) == (self.beam_rate is None):
            which = "neither is" if self.duration is None else "both are"
            raise ValueError(f"duration, beam_rate: {which} given; expected exactly one of them")
        if pattern in _CURVES and self.cycles:
            first, second = self.cycles
            least = 1 if pattern == "lissajous" else -math.inf
            if min(first, second) < least or first * second == 0 or math.gcd(first, second) > 1:
                sign = "above" if pattern == "lissajous" else "other than"
                raise ValueError(
                    f"cycles: {first}, {second} is not allowed with {pattern}; expected two "
                    f"numbers {sign} 0 without a common divisor, with which the curve would repeat "
                    "itself"
                )
            if pattern == "risley" and abs(first) == abs(second):
                raise ValueError(
                    f"cycles: {first}, {second} is not allowed with risley, whose curve would be a "
                    "circle or a line; expected different ones"
                )
        return self

    @property
    def is_instant(self) -> bool:
        """Whether all beams are sent at once, to the nodes of the image."""
        return self.pattern in _ROWS and self.duration == 0

    def schedule(
        self,
        y: np.ndarray,
        z: np.ndarray,
        distance: float,
        *,
        by_angle: bool = False,
        table: Directions | None = None,
    ) -> Schedule:
        """Times and places of all beams of one scan.

        y, z (columns,), (rows,) arrays: nodes of the image in the plane at ``distance``, m,
            ascending.
        distance: m.
        by_angle: whether a curve is even in angles rather than in places.
        table: with pattern ``table``.

        Raises InputError: turns longer than the duration, a table of another number of beams, a
        scanner beyond its limits: then with the smallest duration that is within them.
        """
        if self.pattern in _ROWS:
            schedule = self._rows(y, z, distance)
        elif self.pattern in _CURVES:
            schedule = self._along(self._curve(), y, z, distance, by_angle)
        else:
            schedule = self._tabulated(table, len(y) * len(z), distance)
        self._check_limits(schedule)
        return schedule

    def _rows(self, y: np.ndarray, z: np.ndarray, distance: float) -> Schedule:
        count = len(y) * len(z)
        lines, in_line = (len(z), len(y)) if self.slow == "rows" else (len(y), len(z))
        turns = (lines - 1) * self.dead_time
        if self.beam_rate is None:
            whole = self.duration or 0.0
            active = whole - turns
            if active < 0 or (active == 0 and turns > 0):
                raise InputError(
                    f"dead_time: {self.dead_time:g} s is not allowed; {lines - 1} turns take "
                    f"{turns:g} s, expected less than duration = {whole:g} s"
                )
        else:
            active = count / self.beam_rate
        dwell, duration = active / count, active + turns
        line, place = np.divmod(np.arange(count), in_line)
        # the middle of each dwell
        start = line * (in_line * dwell + self.dead_time) + (place + 0.5) * dwell
        if self.pattern == "serpentine":
            place = np.where(line % 2, in_line - 1 - place, place)
        # film order is by rows, whichever axis is slow
        film = line * in_line + place if self.slow == "rows" else place * lines + line
        time = np.empty(count)
        # the reference time is the middle of the scan
        time[film] = start - duration / 2
        vertical, lateral = np.meshgrid(z[::-1], y[::-1], indexing="ij")
        places = np.stack([lateral.ravel(), vertical.ravel()], -1)
        rate = 1 / dwell if dwell > 0 else math.inf
        load = self._rows_load(np.arctan(y / distance), np.arctan(z / distance), dwell)
        return Schedule(time, places, duration, rate, load)

    def _rows_load(self, azimuth: np.ndarray, elevation: np.ndarray, dwell: float) -> Load:
        """Along a line at a constant rate, from line to line by a turn of constant acceleration.

        A line of n beams D apart sweeps n D at the rate r = D / dwell. In the dead time d a
        serpentine reverses its rate, 2 r / d; a raster returns by n D and has r again, at up to
        r + 2 n D / d and 4 (r + n D / d) / d. The slow axis moves by its step S, from rest to rest,
        at up to 2 S / d and 4 S / d^2.
        """
        fast, slow = (azimuth, elevation) if self.slow == "rows" else (elevation, azimuth)
        dead = self.dead_time
        rate = _ratio(_largest(np.diff(fast)), dwell)
        acceleration = _ratio(_ratio(_largest(np.diff(fast, 2)), dwell), dwell)
        if len(slow) > 1:
            step = _largest(np.diff(slow))
            width = abs(fast[-1] - fast[0]) * len(fast) / max(1, len(fast) - 1)
            back = width if self.pattern == "raster" else 0.0
            change = 4 * (rate + _ratio(back, dead)) if back else 2 * rate
            rate = max(rate + 2 * _ratio(back, dead), 2 * _ratio(step, dead))
            acceleration = max(
                acceleration, _ratio(change, dead), 4 * _ratio(_ratio(step, dead), dead)
            )
        return Load(rate, acceleration)

    def _curve(self) -> Callable[[np.ndarray], np.ndarray]:
        """The curve over the unit square (lissajous) or circle (risley), by fractions of a scan."""
        first, second = self.cycles or (1, 1)
        if self.pattern == "risley":
            return lambda part: (_circle(first * part) + _circle(second * part)) / 2
        # half-way between the phases for which the curve runs back on itself
        phase = np.pi / 2 * (1 - (first - 1) / second)
        return lambda part: np.stack(
            [np.sin(2 * np.pi * first * part + phase), np.sin(2 * np.pi * second * part)], -1
        )

    def _along(
        self,
        curve: Callable[[np.ndarray], np.ndarray],
        y: np.ndarray,
        z: np.ndarray,
        distance: float,
        by_angle: bool,
    ) -> Schedule:
        count = len(y) * len(z)
        ends = np.array([[y[0], z[0]], [y[-1], z[-1]]])
        if by_angle:
            ends = np.arctan(ends / distance)
        middle, half = ends.mean(0), (ends[1] - ends[0]) / 2
        if self.pattern == "risley":
            half = np.full(2, half.min())

        def places(part: np.ndarray) -> np.ndarray:
            point = middle + half * curve(part)
            return distance * np.tan(point) if by_angle else point

        duration = count / self.beam_rate if self.beam_rate else self.duration or 0.0
        # beams in the middles of equal intervals
        part = (np.arange(count) + 0.5) / count
        fine = np.linspace(0, 1, _SAMPLES * max(map(abs, self.cycles or (1, 1))) + 1)
        angles = np.arctan(places(fine) / distance)
        load = _largest_rates(fine * duration, angles)
        rate = count / duration if duration > 0 else math.inf
        return Schedule((part - 0.5) * duration, places(part), duration, rate, load)

    def _tabulated(self, table: Directions | None, count: int, distance: float) -> Schedule:
        if table is None or len(table.time) != count:
            have = "no table" if table is None else f"{table.source} has {len(table.time)} beams"
            raise InputError(
                f"table: {have}; expected {count}, as many as the image has columns x rows"
            )
        angles = np.stack([table.azimuth, table.elevation], -1)
        if not np.abs(angles).max() < 1.5:
            raise InputError(
                f"table: an angle of {np.abs(angles).max():g} rad in {table.source} is not "
                "allowed; expected less than 1.5 rad, nearly across the scan's axis"
            )
        duration = float(table.time[-1] - table.time[0])
        time = table.time - (table.time[0] + table.time[-1]) / 2
        # n times have n - 1 intervals between them
        rate = (count - 1) / duration if duration > 0 else math.inf
        load = _largest_rates(table.time, angles)
        return Schedule(time, distance * np.tan(angles), duration, rate, load)

    def _check_limits(self, schedule: Schedule) -> None:
        """All times in proportion: rates are divided by the factor, accelerations by its square."""
        given = [
            (name, limit, load, power, unit)
            for name, limit, load, power, unit in (
                ("max_rate", self.max_rate, schedule.load.rate, 1.0, "deg/s"),
                (
                    "max_acceleration",
                    self.max_acceleration,
                    schedule.load.acceleration,
                    0.5,
                    "deg/s^2",
                ),
            )
            if limit is not None
        ]
        if not given:
            return
        if any(math.isinf(load) for _, _, load, _, _ in given):
            key = "dead_time" if self.pattern in _ROWS and self.duration != 0 else "duration"
            raise InputError(
                f"{key}: 0 s is not allowed with {given[0][0]}; expected more than 0 s, as a "
                "scanner takes time to turn"
            )
        factor, name, load, limit, unit = max(
            ((load / limit) ** power, name, load, limit, unit)
            for name, limit, load, power, unit in given
        )
        if factor <= 1 + 1e-9:
            return
        need = f"the scanner would need {math.degrees(load):.4g} {unit}, {name} is "
        need += f"{math.degrees(limit):.4g} {unit}"
        dead = _four_digits(factor * self.dead_time, math.ceil)
        aside = f" with a dead_time of {dead:g} s" if dead else ""
        if self.beam_rate is not None:
            wrong = f"beam_rate: {self.beam_rate:g} Hz is not allowed"
            allowed = f"at most {_four_digits(self.beam_rate / factor, math.floor):g} Hz{aside}"
        else:
            sending = (
                len(schedule.time) / schedule.beam_rate if self.dead_time else schedule.duration
            )
            turns = round((schedule.duration - sending) / self.dead_time) if self.dead_time else 0
            least = _four_digits(factor * sending + turns * dead, math.ceil)
            key = "table" if self.pattern == "table" else "duration"
            wrong = f"{key}: {schedule.duration:g} s is not allowed"
            allowed = f"at least {least:g} s{aside}"
        raise InputError(f"{wrong}; {need}; expected {allowed}")


def _four_digits(value: float, rounded: Callable[[float], int]) -> float:
    if value == 0:
        return 0.0
    unit = 10.0 ** (math.floor(math.log10(value)) - 3)
    # exact digits stay in spite of rounding
    slack = 1e-9 if rounded is math.floor else -1e-9
    return float(f"{rounded(value / unit + slack) * unit:.4g}")


def _ratio(change: float, time: float) -> float:
    if change == 0:
        return 0.0
    return change / time if time > 0 else math.inf


def _largest(changes: np.ndarray) -> float:
    return float(np.abs(changes).max(initial=0.0))


def _largest_rates(time: np.ndarray, angles: np.ndarray) -> Load:
    """From first and second differences of the angles, (n, 2), at the times."""
    if len(time) < 2:
        return Load(0.0, 0.0)
    if time[-1] == time[0]:
        return Load(math.inf, math.inf) if np.ptp(angles, axis=0).any() else Load(0.0, 0.0)
    rates = np.diff(angles, axis=0) / np.diff(time)[:, None]
    middles = (time[1:] + time[:-1]) / 2
    return Load(_largest(rates), _largest(np.diff(rates, axis=0) / np.diff(middles)[:, None]))


def _circle(turns: np.ndarray) -> np.ndarray:
    return np.stack([np.cos(2 * np.pi * turns), np.sin(2 * np.pi * turns)], -1)
