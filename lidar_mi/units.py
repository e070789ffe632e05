"""Numbers with units at the edge, SI floats inside.

Each type here is a ``float`` for pydantic models that also reads text with a unit, such as
``"532 nm"``, ``"2 mrad"`` or ``"1.8 / km"``, and turns it into SI. Plain numbers are SI already,
except angles, which must say their unit (degrees and radians are too easily confused).
"""

from typing import Annotated

import pint
from pydantic import BeforeValidator, PlainSerializer

_UNITS = pint.UnitRegistry(autoconvert_offset_to_baseunit=True)


def to_si(value, unit: str, example: str) -> float:
    """``value`` as a float in the SI unit ``unit``.

    Raises
    ------
    ValueError
        The text is no quantity, or its unit is no multiple of ``unit``.
    """
    if isinstance(value, bool) or not isinstance(value, int | float | str):
        raise ValueError(f"{value!r} is not allowed; expected a quantity such as '{example}'")
    if not isinstance(value, str):
        if unit == "rad" and value != 0:
            raise ValueError(f"{value!r} has no unit; expected an angle such as '{example}'")
        return float(value)
    try:
        quantity = _UNITS.Quantity(value)
        if quantity.unitless and unit not in ("", "rad"):
            return float(quantity.magnitude)
        if quantity.unitless and unit == "rad" and quantity.magnitude != 0:
            raise ValueError(f"{value!r} has no unit; expected an angle such as '{example}'")
        return float(quantity.to(unit or "dimensionless").magnitude)
    except (pint.PintError, AttributeError, TypeError, SyntaxError, AssertionError):
        kind = f"a quantity in {unit}" if unit else "a number"
        raise ValueError(f"{value!r} is not allowed; expected {kind}, such as '{example}'") from None


def _quantity(unit: str, example: str):
    return Annotated[
        float,
        BeforeValidator(lambda value: to_si(value, unit, example)),
        PlainSerializer(lambda value: f"{value!r} {unit}" if unit else value, when_used="json"),
    ]


Length = _quantity("m", "500 m")
Angle = _quantity("rad", "2 mrad")
Speed = _quantity("m/s", "150 m/s")
Time = _quantity("s", "0.1 s")
Energy = _quantity("J", "1 mJ")
Extinction = _quantity("1/m", "1.8 / km")
Number = _quantity("", "0.5")
