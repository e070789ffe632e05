"""Names of metrics, made here alone: ``source.method.quantity`` and the like."""

import re
from enum import StrEnum


class Source(StrEnum):
    """What winds are retrieved from, and what metrics of them begin with."""

    EXTINCTION = "extinction"
    WITHOUT_TEXTURE = "extinction_without_texture"
    BLURRED = "extinction_blurred"
    BACKSCATTER = "backscatter"
    NOISY = "backscatter_noisy"


EXACT = (Source.EXTINCTION, Source.WITHOUT_TEXTURE)
"""Sources that no instrument has measured."""

RENDERED = (Source.BACKSCATTER, Source.NOISY)
"""Sources that are images of the lidar; the second one behind a detector."""


def wind_key(source: str, method: str, quantity: str) -> str:
    """Of the winds that a method retrieves from a source."""
    return f"{source}.{method}.{quantity}"


def ring_key(method: str, centre: str, averaged: int, quantity: str) -> str:
    """Of the line-of-sight velocities that a method reads from averages of so many images."""
    return f"doppler.{method}.centre_{centre}.averaged_{averaged}.{quantity}"


def bound_key(centre: str, averaged: int) -> str:
    """Of the least standard deviation that line-of-sight velocities can have (Cramer-Rao)."""
    return ring_key("bound", centre, averaged, "std")


def budget_key(method: str, quantity: str) -> str:
    """Of the error budget of a method's winds; quantities as of `error_budget.error_budget`."""
    return f"error_budget.{method}.{quantity}"


def sweep_key(rms: float, quantity: str) -> str:
    """Of the winds at a relative rms of the sub-grid texture."""
    return f"texture_sweep.{round(100 * rms)}_percent.{quantity}"


def vortex_key(origin: str, quantity: str) -> str:
    """Of the vortex pair of an origin: the truth, the images or the wind vectors."""
    return f"vortex.{origin}.{quantity}"


def timing_key(step: str) -> str:
    """Of the time that a step takes, s."""
    return f"timing.{step}_s"


# Former names as patterns, and what stands there today: metrics.json of older runs has the former.
_RENAMED = (
    (r"\.reduced_variance_(u|v|w|v_los)$", r".normalised_error_variance_\1"),
    (r"\.found_fraction$", ".retrieved_fraction"),
    (r"\bsensor\.good_fraction$", "sensor.valid_fraction"),
    (r"\bsensor\.lines_read$", "sensor.lines_retrieved"),
    (r"\bsensor\.error_budget\.between_lines\.", "sensor.error_budget.sampling."),
    (r"(\berror_budget\..+)\.share(_[uvw])?$", r"\1.fraction\2"),
    (r"(\bvortex\..+)\.flow_error$", r"\1.model_error"),
)


def current_name(key: str) -> str:
    """The name that a metric has today, of whichever one it had when it was written."""
    for former, current in _RENAMED:
        key = re.sub(former, current, key)
    return key
