"""Methods of retrieval by name, as experiments, files and metrics write them."""

from enum import StrEnum


class ImageMethod(StrEnum):
    """From two images to the cross-flow wind (v, w)."""

    CC = "cc"
    WS = "ws"
    MULTIPASS = "multipass"
    VARIATIONAL = "variational"
    VORTEX_FIT = "vortex_fit"


MOST_ACCURATE_FIRST = (
    ImageMethod.VARIATIONAL,
    ImageMethod.MULTIPASS,
    ImageMethod.CC,
    ImageMethod.WS,
)
"""Methods that retrieve vectors, by their errors on exactly advected images."""


class VolumeMethod(StrEnum):
    """From two volumes to the wind in three dimensions (u, v, w)."""

    CORRELATION = "correlation"
    VARIATIONAL = "variational"


class RingMethod(StrEnum):
    """From an image of rings to the velocity along the line of sight.

    ``annular`` and ``pixels`` are maximum-likelihood fits. The others find peaks, as the paper
    does: ``ca`` centre of area, ``ml`` midpoint lines, ``sg`` Savitzky-Golay filter.
    """

    ANNULAR = "annular"
    PIXELS = "pixels"
    CA = "ca"
    CA_R2 = "ca_r2"
    ML = "ml"
    SG = "sg"


class RingCentre(StrEnum):
    """Whether the centre of the rings is fitted or given."""

    FREE = "free"
    KNOWN = "known"
