"""A scalar result of a retrieval."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Quantity:
    """A number with its standard error, unit and name.

    ``per_rotation`` is its change per rad/s by which the image rotates about the origin between the
    scans (an unknown roll of the platform), 0 if there is none.
    """

    value: float
    stderr: float
    units: str
    long_name: str
    per_rotation: float = 0.0
