"""Variables of data sets, as xarray takes them, with the attributes that CF asks for."""

from typing import Any

Variable = tuple[str | tuple[str, ...], Any, dict[str, str]]
"""Dimensions, values, attributes."""


def variable(
    dims: str | tuple[str, ...], values: Any, units: str, long_name: str, **more: str
) -> Variable:
    """A variable on ``dims`` with its unit and its name in words."""
    return dims, values, {"units": units, "long_name": long_name, **more}
