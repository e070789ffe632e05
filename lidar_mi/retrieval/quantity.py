"""A scalar result of a retrieval."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Quantity:
    """A number with its standard error, unit and name."""

    value: float
    stderr: float
    units: str
    long_name: str
