"""Names of metrics, defined only here: ``source.method.quantity`` and so on."""

from collections.abc import Mapping
from enum import StrEnum


class Source(StrEnum):
    """Data that winds are retrieved from: first part of the names of their metrics."""

    EXTINCTION = "extinction"
    WITHOUT_TEXTURE = "extinction_without_texture"
    BLURRED = "extinction_blurred"
    BACKSCATTER = "backscatter"
    NOISY = "backscatter_noisy"


EXACT = (Source.EXTINCTION, Source.WITHOUT_TEXTURE)
"""Sources without an instrument."""

RENDERED = (Source.BACKSCATTER, Source.NOISY)
"""Sources that are images of the lidar; the second one behind a detector."""

OUTSIDE_CORES = "outside_cores."
"""Prefix to the quantity for errors beyond two core radii."""


def far_from_cores(metrics: Mapping[str, float], prefix: str, quantity: str) -> str:
    """`OUTSIDE_CORES` if it excludes any vector of u, v or w; else empty."""
    for component in "uvw":
        far = metrics.get(f"{prefix}{OUTSIDE_CORES}{quantity}{component}")
        if far is not None and far != metrics.get(f"{prefix}{quantity}{component}"):
            return OUTSIDE_CORES
    return ""


def wind_key(source: str, method: str, quantity: str) -> str:
    """Key of a method's winds from a source."""
    return f"{source}.{method}.{quantity}"


def ring_key(method: str, centre: str, averaged: int, quantity: str) -> str:
    """Key of a method's line-of-sight velocities from averages of a number of images."""
    return f"doppler.{method}.centre_{centre}.averaged_{averaged}.{quantity}"


REFERENCE_ERRORS = ("laser drift", "etalon drift", "bow and pupil", "wedge and pupil")
"""Causes of errors between the reference shot and the echo."""


def reference_key(cause: str) -> str:
    """Key of an error between the reference shot and the echo."""
    return f"doppler.reference.{cause.replace(' ', '_')}"


def bound_key(centre: str, averaged: int) -> str:
    """Key of the Cramer-Rao bound of line-of-sight velocities."""
    return ring_key("bound", centre, averaged, "std")


def budget_key(method: str, quantity: str) -> str:
    """Key of the error budget of a method's winds; quantities as in `error_budget`."""
    return f"error_budget.{method}.{quantity}"


def sweep_key(rms: float, quantity: str) -> str:
    """Key of the winds at a relative rms of the sub-grid texture."""
    return f"texture_sweep.{round(100 * rms)}_percent.{quantity}"


def vortex_key(origin: str, quantity: str) -> str:
    """Key of the vortex pair from the truth, the images or the wind vectors."""
    return f"vortex.{origin}.{quantity}"


def timing_key(step: str) -> str:
    """Key of the duration of a step, s."""
    return f"timing.{step}_s"


def has_no_skill(metrics: Mapping[str, float], source: Source, method: str) -> bool:
    """Whether a method says that most of its vectors are no better than zero wind."""
    return metrics.get(wind_key(source, method, "no_skill_fraction"), 0.0) > 0.5
