"""Flags: why a value is not to be used, one bit a reason, as CF flag variables have them."""

import enum
from collections.abc import Mapping
from typing import Any

import numpy as np


class Flag(enum.IntFlag):
    """Why a vector is rejected, one bit per reason; 0 is a valid vector."""

    PEAK_ON_RIM = 1
    """Best match on the rim of the search range: the true one may lie outside. No displacement."""
    LOW_CORRELATION = 2
    """Correlation at the peak below the threshold (cross-correlation only)."""
    LOW_TEXTURE = 4
    """The template has too little structure in at least one direction (aperture problem)."""
    MEDIAN_OUTLIER = 8
    """Fails the normalised median test against its neighbours."""
    NO_SUBPIXEL_FIT = 16
    """A neighbour of the peak is not positive: the displacement is an integer."""
    NON_FINITE_INPUT = 32
    """NaN or infinity in the search region of one of the images. No displacement."""
    NO_MATCH = 64
    """No candidate could be compared (no contrast, no positive weight). No displacement."""
    REPLACED = 128
    """The previous pass found an outlier; this one began at its neighbours' median (multi-pass)."""
    UNRELATED = 256
    """The images around it correlate no better than unrelated textures (`relation`)."""
    SATURATED = 512
    """The template holds a saturated area at rest, or is saturated by a quarter (`rest`)."""
    AT_REST = 1024
    """Structure at rest or stray pixels in the template, or a pattern spoils all (`rest`).

    Or one of the images is the one before it, bit for bit."""
    NO_SKILL = 2048
    """The standard error approaches the wind's own spread."""
    RESAMPLED = 4096
    """What resampling of scattered beams lost exceeds the noise (`resampling_error`)."""
    ERROR_UNKNOWN = 8192
    """Too few valid vectors around it, or too few clearly textured, to state one (`bootstrap`)."""
    OTHER_MOTION = 16384
    """Another displacement explains the images around it better (`other_motions`)."""


class VectorFlag(enum.IntFlag):
    """Why a vector is rejected, one bit per reason; 0: valid."""

    COPLANAR = 1
    """The lines lie in one plane: the wind across it is undetermined. No vector."""
    NO_VELOCITY = 2
    """A line has no velocity. No vector."""


class CombinedFlag(enum.IntFlag):
    """Why a vector is rejected, one bit per reason; 0: valid."""

    NO_CROSSFLOW = 1
    """The images gave no valid vector here: u alone."""
    BEYOND_LINES = 2
    """Outside the lines of sight: u is extrapolated from the nearest."""


class LineFlag(enum.IntFlag):
    """Reasons not to use a velocity of a line of sight; 0: valid."""

    MISSING = 1
    """No value, or no such gate of this line."""
    BLIND_RANGE = 2
    """The outgoing pulse, or its reflection in the lidar, is in the gate."""
    LOW_CNR = 4
    """The signal is too weak."""
    HARD_TARGET = 8
    """A target that stands, such as a building, is in the gate or before it."""
    REJECTED = 16
    """The lidar's own software rejects the value."""
    REPEATED = 32
    """The same number in all gates of the line, or in many cells: no measurement."""


class WindFlag(enum.IntFlag):
    """Reasons not to use a wind; 0: valid."""

    TOO_FEW_LINES = 1
    """Fewer than three valid lines or than `MIN_FRACTION`, or lines in one plane."""
    ILL_CONDITIONED = 2
    """The lines hardly know one component: `MAX_CONDITION`."""
    OUTLIERS = 4
    """More than a third of the lines are outliers."""
    ERROR_UNKNOWN = 8
    """Neither residuals nor a stated noise give an error."""
    UNCERTAIN = 16
    """The standard error of the horizontal wind is above `MAX_STDERR`."""
    FOLDED = 32
    """Velocities fold, and another wind would give the same ones."""


class VortexFlag(enum.IntFlag):
    """Reasons not to use the vortices of a scan; 0: valid."""

    NO_WAKE = 1
    """Turbulence alone gives such a scan more often than the limit of false alarms."""
    NO_FIT = 2
    """The fit did not converge."""
    OUTSIDE = 4
    """A vortex is outside of the scan."""
    NOT_IDENTIFIED = 8
    """The error is half of the circulation, or half a gate in place."""
    MISFIT = 16
    """The residuals are larger than noise and turbulence explain."""
    AMBIGUOUS = 32
    """Vortices elsewhere are nearly as likely."""
    SAME_SENSE = 64
    """Both vortices turn the same way."""


REJECTED = "reasons to reject the vector"


def flag_attributes(flags: type[enum.IntFlag], text: str) -> dict[str, Any]:
    """CF attributes of a variable (uint16) that holds bits of ``flags``."""
    return {
        "long_name": f"{text}, 0 = valid",
        "standard_name": "quality_flag",
        "flag_masks": np.array([bit.value for bit in flags], dtype=np.uint16),
        "flag_meanings": " ".join(str(bit.name).lower() for bit in flags),
    }


def masks_of(attributes: Mapping[Any, Any]) -> dict[str, int]:
    """The bit of each meaning, from the CF attributes of a flag variable; empty without bits."""
    if "flag_masks" not in attributes:
        return {}
    names = str(attributes.get("flag_meanings", "")).split()
    masks = map(int, np.ravel(attributes["flag_masks"]))
    return dict(zip(names, masks, strict=True))
