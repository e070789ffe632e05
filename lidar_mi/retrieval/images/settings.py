"""Settings of the band limit of images and volumes, frozen.

How much the errors change where a field is halved or doubled is in ``docs/settings.md``.
"""

from dataclasses import dataclass


@dataclass(frozen=True)
class FilterSettings:
    """Band limit and interpolation of images or volumes (`band_limit`, `warping`).

    Attributes
    ----------
    margin : int
        Pixels by which images are continued, fading, beyond each edge. The influence of an edge on
        the interpolating spline decays by a factor 0.27 per pixel.
    nodes : int
        Spline nodes per pixel along each axis. On half-pixel nodes the shortest wave loses 2.8 %
        of its amplitude, on whole-pixel nodes all of it half way between (peak locking).
    smoothing : int
        Shells of wavenumber that each value of the power spectrum averages over; odd.
    threshold : float
        Standard errors by which a shell must exceed the noise to count as texture.
    antisymmetric : bool
        Continuation beyond the edges by point reflection at the edge, which keeps the slope, in
        place of mirroring, whose kink rings into thin volumes.
    sharpening : float
        Largest amplification of a wave that a known blur attenuated.
    """

    margin: int = 24
    nodes: int = 2
    smoothing: int = 5
    threshold: float = 2.0
    antisymmetric: bool = False
    sharpening: float = 4.0


VOLUME_FILTER = FilterSettings(margin=12, smoothing=1, antisymmetric=True)
"""Of volumes: one shell holds enough waves, and memory scales with the cube of the margin."""
