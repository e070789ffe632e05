"""A number that was measured."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Quantity:
    """A number with its standard error and what it is."""

    value: float
    stderr: float
    units: str
    long_name: str
