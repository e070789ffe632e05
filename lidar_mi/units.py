"""Numbers with units at the edge, SI floats inside.

Each type here is a ``float`` for pydantic models that also reads text with a unit, such as
``"532 nm"``, ``"2 mrad"`` or ``"1.8 / km"``, and turns it into SI. Plain numbers are SI already,
except angles and energies, which must say their unit (degrees and radians, joules and
millijoules are too easily confused). Quantities
are shown to people as they wrote them (`Given`).
"""

import functools
import math
import re
import tokenize
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, cast

from pydantic import GetCoreSchemaHandler, SerializationInfo
from pydantic_core import CoreSchema, PydanticCustomError, core_schema

if TYPE_CHECKING:
    import pint

_FACTORS = {
    "m": {"m": 1.0, "km": 1e3, "cm": 1e-2, "mm": 1e-3, "um": 1e-6, "nm": 1e-9, "pm": 1e-12},
    "rad": {"rad": 1.0, "mrad": 1e-3, "urad": 1e-6, "deg": math.pi / 180},
    "rad/s": {"rad/s": 1.0, "deg/s": math.pi / 180},
    "rad/s^2": {"rad/s^2": 1.0, "deg/s^2": math.pi / 180},
    "m/s": {"m/s": 1.0},
    "s": {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9},
    "J": {"J": 1.0, "mJ": 1e-3, "uJ": 1e-6},
    "1/m": {"1/m": 1.0, "/m": 1.0, "1/km": 1e-3, "/km": 1e-3},
    "1/m/sr": {"1/m/sr": 1.0, "/m/sr": 1.0},
    "m^2": {"m^2": 1.0},
    "m^2/s": {"m^2/s": 1.0},
    "Hz": {"Hz": 1.0, "kHz": 1e3, "MHz": 1e6, "GHz": 1e9},
    "K": {"K": 1.0, "mK": 1e-3},
    "W/m^3/sr": {"W/m^2/sr/nm": 1 / 1e-9},
    "": {"%": 1e-2},
    "byte": {"MB": 1e6, "GB": 1e9},
}
"""Multiples of SI units that experiments are written in; pint, which takes a fifth of a second to
be loaded, reads all others."""
# not of bytes, whose base unit is the bit for pint
_OF_UNIT = {
    text: factor
    for unit, multiples in _FACTORS.items()
    if unit != "byte"
    for text, factor in multiples.items()
}
# one number, then a unit: pint alone reads "0,1 m" as 1 m and "500 m 3" as 1500 m
_TEXT = re.compile(r"""([-+]?(?:(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?|inf|nan))\s*([^\n,;#"']*)""")
# A unit's text as far as pint gets to see it: pint computes what it reads, 9**9**9 for ever.
_LONGEST = 100
_NAME = r"(?:[^\W\d_]|[%°])[\w⁻]*+"
_NUMBER = r"(?:\d{1,20}(?:\.\d{0,20})?|\.\d{1,20})(?:[eE][-+]?\d{1,2})?(?![\w.])"
_POWER = r"\s*(?:\*\*|\^)\s*(?:[-+]?\d{1,2}|\([-+]?\d{1,2}\))(?![\d.]|\s*+\^|\s*+\*\*)"
_PARTS = re.compile(rf"(?:\s*+(?:(?:{_NAME}|{_NUMBER})(?:{_POWER})?|[*·/()](?!\*)))*\s*+")
# what reaches us through pint from Python's tokenizer and arithmetic; some of its own are these
_BAD_UNIT = (
    tokenize.TokenError,
    ArithmeticError,
    AssertionError,
    AttributeError,
    SyntaxError,
    TypeError,
    ValueError,
)


@functools.cache
def registry() -> "pint.UnitRegistry[float]":
    """All units that pint knows; made on first use."""
    import pint

    return pint.UnitRegistry()


def to_si(value: object, unit: str, example: str) -> float:
    """``value`` as a float in the SI unit ``unit``.

    Raises ValueError: the text is no quantity, or its unit is no multiple of ``unit``.
    """
    if isinstance(value, bool) or not isinstance(value, int | float | str):
        raise ValueError(f"{value!r} is not allowed; expected a quantity such as '{example}'")
    kind = {"rad": "an angle", "J": "an energy", "": "a number"}.get(unit, f"a quantity in {unit}")
    asked = unit.startswith("rad") or unit == "J"
    if not isinstance(value, str):
        if asked and value != 0:
            raise ValueError(f"{value!r} has no unit; expected {kind} such as '{example}'")
        try:
            return float(value)
        except OverflowError:
            raise ValueError(f"{value!r} is not allowed; expected a smaller number") from None
    wrong = ValueError(f"{value!r} is not allowed; expected {kind}, such as '{example}'")
    match = _TEXT.fullmatch(value.strip()) if len(value) <= _LONGEST else None
    if not match:
        raise wrong
    number, text = float(match[1]), match[2]
    if not text:
        if asked and number != 0:
            raise ValueError(f"{value!r} has no unit; expected {kind} such as '{example}'")
        return number
    factor = _FACTORS.get(unit, {}).get(re.sub(r" */ *", "/", text))
    if factor is not None:
        return number * factor
    units = registry()
    from pint import PintError

    try:
        given = units.parse_units(_bounded("1" + text if text.startswith("/") else text))
        return float(units.Quantity(number, given).to(unit or "dimensionless").magnitude)
    except (PintError, *_BAD_UNIT):
        raise wrong from None


def split_quantity(value: object) -> tuple[float, str]:
    """A number and the text of its unit, "150 m" as (150.0, "m"); a plain number has none.

    Raises ValueError: it is neither a number nor text that begins with one.
    """
    if isinstance(value, int | float) and not isinstance(value, bool):
        return float(value), ""
    text = value.strip() if isinstance(value, str) and len(value) <= 2 * _LONGEST else ""
    match = _TEXT.fullmatch(text)
    if not match:
        raise ValueError(f"{value!r} is not allowed; expected a quantity such as '150 m'")
    return float(match[1]), match[2].strip()


def _bounded(text: str) -> str:
    """Text of a unit, if it is names and small numbers, with powers of two digits."""
    if len(text) > _LONGEST or not _PARTS.fullmatch(text):
        raise ValueError(f"{text!r} is not a unit")
    return text


class Given(float):
    """A number in its SI unit that remembers the text it was given as, "9 deg".

    Any arithmetic makes a plain float of it.
    """

    text: str

    @classmethod
    def of(cls, number: float, text: str) -> "Given":
        """The number of a text."""
        given = cls(number)
        given.text = text
        return given


AS_GIVEN = {"as_given": True}
"""Context of pydantic's ``model_dump`` in which JSON has quantities as they were given."""


@dataclass(frozen=True)
class Unit:
    """The SI unit of a key's values: its place is in the annotation of their type."""

    symbol: str
    example: str

    def __get_pydantic_core_schema__(
        self, source: Any, handler: GetCoreSchemaHandler
    ) -> CoreSchema:
        """Reads quantities with ``to_si``; JSON has the unit beside the number."""
        return core_schema.no_info_wrap_validator_function(
            self._read,
            handler(source),
            serialization=core_schema.plain_serializer_function_ser_schema(
                self._written, info_arg=True, when_used="json"
            ),
        )

    def _read(self, value: Any, checked: Callable[[float], float]) -> float:
        if isinstance(value, Given):
            return value
        number = checked(to_si(value, self.symbol, self.example))
        has_unit = isinstance(value, str) and split_quantity(value)[1]
        return Given.of(number, " ".join(value.split())) if has_unit else number

    def _written(self, value: float, info: SerializationInfo) -> float | str:
        if isinstance(value, Given) and (info.context or {}).get("as_given"):
            return value.text
        return f"{value!r} {self.symbol}" if self.symbol else value


@dataclass(frozen=True)
class Within:
    """Where a key's values lie, in its SI unit, and why nowhere else.

    Both ends are allowed unless ``ends`` opens one, as in "[)". ``or_infinite`` also allows
    infinity, where that is an idealisation of its own.
    """

    low: float
    high: float
    why: str
    ends: str = "[]"
    or_infinite: bool = False

    def __get_pydantic_core_schema__(
        self, source: Any, handler: GetCoreSchemaHandler
    ) -> CoreSchema:
        """Refuses what lies outside, as a fault of the type ``out_of_range``."""
        return core_schema.no_info_after_validator_function(self._checked, handler(source))

    def _checked(self, value: float) -> float:
        if not self.holds(value):
            raise PydanticCustomError(
                "out_of_range",
                "{value} is not allowed; expected {words}",
                {"value": repr(value), "words": self.words()},
            )
        return value

    def holds(self, value: float) -> bool:
        """Whether a value is allowed."""
        if self.or_infinite and value == math.inf:
            return True
        above = value > self.low if self.ends[0] == "(" else value >= self.low
        return above and (value < self.high if self.ends[1] == ")" else value <= self.high)

    def words(self, unit: str = "", scale: float = 1.0) -> str:
        """What is allowed: "1e-06 to 10 m (from the mode of a fibre to the largest telescope)".

        ``scale`` is that of the unit: 1000 for mrad.
        """
        ends = (self.low * scale, self.high * scale) if scale != 1 else (self.low, self.high)
        low, high = (
            str(end) if isinstance(end, int) else f"{end:.{6 if scale == 1 else 3}g}"
            for end in ends
        )
        low = f"above {low}" if self.ends[0] == "(" else low
        high = f"below {high}" if self.ends[1] == ")" else high
        infinite = " or inf" if self.or_infinite else ""
        return f"{low} to {high} {unit}".strip() + f"{infinite} ({self.why})"


def quantity(text: str) -> float:
    """A default as text with its unit: a float after validation (``validate_default``)."""
    return cast(float, text)


Length = Annotated[float, Unit("m", "500 m")]
Angle = Annotated[float, Unit("rad", "2 mrad")]
AngularRate = Annotated[float, Unit("rad/s", "500 deg/s")]
AngularAcceleration = Annotated[float, Unit("rad/s^2", "1e5 deg/s^2")]
Speed = Annotated[float, Unit("m/s", "150 m/s")]
Time = Annotated[float, Unit("s", "0.1 s")]
Energy = Annotated[float, Unit("J", "1 mJ")]
Extinction = Annotated[float, Unit("1/m", "1.8 / km")]
Backscatter = Annotated[float, Unit("1/m/sr", "3e-6 / m / sr")]
Area = Annotated[float, Unit("m^2", "0.13 m^2")]
Mass = Annotated[float, Unit("kg", "60000 kg")]
Inertia = Annotated[float, Unit("kg m^2", "6e5 kg m^2")]
Frequency = Annotated[float, Unit("Hz", "1 kHz")]
Shear = Annotated[float, Unit("1/s", "0.05 / s")]
SpectralRadiance = Annotated[float, Unit("W/m^3/sr", "0.3 W/m^2/sr/nm")]
Circulation = Annotated[float, Unit("m^2/s", "458 m^2/s")]
DissipationRate = Annotated[float, Unit("m^2/s^3", "1e-4 m^2/s^3")]
Temperature = Annotated[float, Unit("K", "10 K")]
Pressure = Annotated[float, Unit("Pa", "850 hPa")]
Memory = Annotated[float, Unit("byte", "8 GB")]
Number = Annotated[float, Unit("", "0.5")]


_PREFIXED = ("m", "s", "J", "W", "Hz")
_FEW, _MANY = 0.1, 1e4


def usual_unit(number: float, unit: str) -> tuple[float, str]:
    """Factor from SI to the unit in which people write quantities of this size, and the unit.

    Angles in degrees or milliradians, whichever takes fewer digits, or else in degrees from 0.5
    degrees on; lengths, times, energies, powers and frequencies with the prefix that leaves few
    digits, below 0.1 and from 10000 on.
    """
    if unit == "rad" and _in_degrees(number):
        return 180 / math.pi, "deg"
    if number and (unit == "rad" or (unit in _PREFIXED and not _FEW <= abs(number) < _MANY)):
        quantity = registry().Quantity(number, unit).to_compact()
        return float(quantity.magnitude) / number, f"{quantity.units:~}"
    return 1.0, unit


def _in_degrees(angle: float) -> bool:
    """Whether an angle (rad) was given in degrees, as far as its digits tell."""
    degrees = 180 / math.pi * angle
    few, many = (len(f"{abs(value):.6g}".strip("0.")) for value in (degrees, 1e3 * angle))
    return few < many or (few == many and abs(degrees) >= 0.5)


def usual(number: float, unit: str) -> str:
    """A quantity in SI units as it was given, or in its `usual_unit`, to six digits.

    Examples
    --------
    >>> usual(5.32e-07, "m"), usual(0.17453292519943295, "rad"), usual(350.0, "m^2/s")
    ('532 nm', '10 deg', '350 m^2/s')
    """
    if isinstance(number, Given):
        return number.text
    factor, unit = usual_unit(number, unit)
    return f"{factor * number:.6g} {unit}".strip()


def shown(number: float, unit: str) -> str:
    """A quantity in SI units as it was given, or in a unit, to four digits.

    Examples
    --------
    >>> shown(0.002, "mrad"), shown(Given.of(0.0017453292519943296, "0.1 deg"), "mrad")
    ('2 mrad', '0.1 deg')
    """
    if isinstance(number, Given):
        return number.text
    factor = _OF_UNIT.get(unit)
    if factor is None:
        factor = registry().Quantity(1.0, unit).to_base_units().magnitude
    return f"{number / factor:.4g} {unit}"


def parse_units(text: str) -> "pint.Quantity[float]":
    """A CF units string as a pint quantity: 'm s-1', 'km/h', 'kg m-3', '1', '%'.

    CF (UDUNITS) writes powers as digits behind a unit and products as a dot, pint does not.

    Raises ValueError: if it is not a unit.
    """
    text = str(text).strip()
    if len(text) > _LONGEST:
        raise ValueError(f"{text!r} is not a unit")
    products = re.sub(r"(?<=[^\W_])\.(?=[^\W\d_])", "*", text)
    powers = re.sub(r"(?<![\w.])([^\W\d_]+)\^?(-?\d+)(?!\w)", r"\1**\2", products)
    try:
        units = registry()
        return 1.0 * units.parse_expression(_bounded(powers or "1")) * units.dimensionless
    except Exception as error:  # pint lets its tokenizer's own exceptions through
        raise ValueError(f"{text!r} is not a unit") from error


def conversion(text: str, target: str) -> float:
    """Factor from a CF units string to another.

    Raises ValueError: the text is no unit, or none that converts to the other.
    """
    if text == target:
        return 1.0
    given, wanted = parse_units(text), parse_units(target)
    from pint import PintError

    try:
        return float(given.to(wanted.units).magnitude)
    except PintError as error:
        raise ValueError(f"{text!r} is no unit of {target}") from error
