"""Numbers in reports, with significant digits."""

import math
from collections.abc import Sequence

_SUPERSCRIPT = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
_BLANK = "\N{NO-BREAK SPACE}"


def fixed(value: float) -> str:
    """Three digits, at most three decimals: for errors in a column, 0.122, -0.001, 11.2."""
    size = abs(value)
    decimals = min(3, max(0, 2 - math.floor(math.log10(size)))) if size > 0 else 0
    # a number that is rounded to 0 has no sign
    return f"{round(value, decimals) + 0.0:.{decimals}f}"


def three(value: float) -> str:
    """Three digits at most: 0.0044, 83800; powers of ten for numbers with more zeros."""
    text = f"{value:.3g}"
    if value and not 1e-4 <= abs(float(text)) < 1e6:
        mantissa, exponent = f"{value:.2e}".split("e")
        return f"{float(mantissa):g}{_BLANK}×{_BLANK}10{str(int(exponent)).translate(_SUPERSCRIPT)}"
    return f"{float(text):.10g}"


def percent(fraction: float) -> str:
    """A fraction as per cent, two digits at most below 10 %: 0.43 %, 72 %, 100 %."""
    value = 100 * fraction
    text = (
        f"{round(value) + 0}"
        if abs(value) >= 9.95 or value == 0
        else f"{float(f'{value:.2g}'):.10g}"
    )
    return f"{text} %"


def whole_percent(fraction: float) -> str:
    """A fraction as whole per cent, without a sign before 0."""
    return f"{round(100 * fraction) + 0} %"


def with_error(value: float, stderr: float) -> str:
    """A value and its standard error, to the second digit of the error: 0.65 ± 0.12."""
    digits = max(0, 1 - math.floor(math.log10(stderr))) if stderr > 0 else 3
    return f"{value:.{digits}f}{_BLANK}±{_BLANK}{stderr:.{digits}f}"


def in_row(values: Sequence[float | None], unit: str) -> list[str]:
    """Errors, or fractions with the unit %, as `fixed`; a dash where there is none."""
    scale = 100 if unit == "%" else 1
    return ["-" if value is None else fixed(scale * value) for value in values]
