"""Mitsuba's tabulated phase functions within rounding of forward and backward."""

from collections.abc import Iterable

import drjit as dr

from .polarization import parts_of
from .variant_types import Medium, Vector

# below one by the rounding of a scalar product
LARGEST_COSINE = 1 - 2.0**-21


def has_tables(media: Iterable[Medium]) -> bool:
    """Whether a ``tabphase`` is in any medium: it gives nothing where a cosine exceeds one."""
    return any(
        part.class_name() == "TabulatedPhaseFunction"
        for medium in media
        for part in parts_of(medium.phase_function())
    )


def off_the_poles(incident: Vector, scattered: Vector) -> Vector:
    """A direction, shortened where its cosine with another one would be rounded beyond one."""
    cosine = dr.abs(dr.dot(incident, scattered))
    return dr.select(cosine > LARGEST_COSINE, scattered * (LARGEST_COSINE / cosine), scattered)
