"""Settings of multi-pass correlation, frozen.

How much the errors change where a field is halved or doubled is in ``docs/settings.md``.
"""

from dataclasses import dataclass, field

from lidar_mi.retrieval.correlation.outliers import MEDIAN_EPSILON, MEDIAN_THRESHOLD
from lidar_mi.retrieval.images.settings import VOLUME_FILTER, FilterSettings


@dataclass(frozen=True)
class MultipassSettings:
    """Multi-pass correlation (`multipass.multipass`).

    Attributes
    ----------
    widths : tuple of float
        Standard deviations of the Gaussian windows of the passes, over the last one.
    sigma : float
        That of the last pass over the template.
    spacing : float
        Spacing of the windows in all passes but the last, in their standard deviations.
    gradient : float
        Standard deviation a priori of the displacement gradient, px per px: a gradient of -1
        would move the air of a window to one point.
    jump : float
        Vectors that differ by more from the pass before are flagged; px, or sigma if that is more.
    median_threshold, median_epsilon : float
        Median test between passes, dimensionless and px (2 and 0.1: Westerweel & Scarano 2005).
    continued : bool
        Whether the median test continues the field beyond the rim, see `outliers`.
    rebalanced : bool
        Whether brightness is fitted again in every pass, from what is valid in both images. Air
        that enters and leaves a volume changes the mean of its gates by 10 % of the texture.
    """

    widths: tuple[float, ...] = (1.8, 1.4, 1.0)
    sigma: float = 1 / 3
    spacing: float = 0.5
    gradient: float = 1.0
    jump: float = 2.0
    median_threshold: float = MEDIAN_THRESHOLD
    median_epsilon: float = MEDIAN_EPSILON
    continued: bool = False
    rebalanced: bool = False
    filter: FilterSettings = field(default_factory=FilterSettings)


VOLUME_MULTIPASS = MultipassSettings(
    spacing=1.0, continued=True, rebalanced=True, filter=VOLUME_FILTER
)
"""Of volumes: 1/8 as many windows between passes."""
