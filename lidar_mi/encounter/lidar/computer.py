"""When the aircraft's computer has estimated a slab: two cores, each with a queue of one slab.

One core fits the vortices and reads the lines of sight, the other retrieves the wind and combines
it with the lines. What concerns the first image alone is done before the second one. A core that is
busy takes the newest slab when it is free; slabs that came before and were not begun are skipped.
"""

from collections.abc import Mapping
from typing import NamedTuple


class Cores(NamedTuple):
    """Times (s) until which the cores of vortices and wind work."""

    vortices: float = float("-inf")
    wind: float = float("-inf")

    def take(self, time: float, period: float) -> tuple[bool, bool]:
        """Whether each core takes the slab whose second image comes at a time (s).

        It does not if the next slab is there, a period (s) later, before it is free.
        """
        return self.vortices <= time + period, self.wind <= time + period

    def after(self, time: float, period: float, seconds: Mapping[str, float]) -> "Cores":
        """The cores with the work on this slab.

        time, period: of the second image, and from the first one to it, s. Lines are recorded half
            way.
        seconds: duration of the parts, as `SlabEstimate.seconds`; a core without a part does
            nothing.
        """
        parts = {name: seconds.get(name, 0.0) for name in PARTS}
        lines = max(self.vortices, time - period) + parts["vortices_before"]
        if "lines" in seconds:
            lines = max(lines, time - period / 2) + parts["lines"]
        fit = max(lines, time) + parts["vortices"]
        wind = max(self.wind, time - period) + parts["wind_before"]
        wind = max(wind, time) + parts["wind"]
        if "combination" in seconds:
            wind = max(wind, lines) + parts["combination"]
        return Cores(
            fit if "vortices" in seconds else self.vortices,
            wind if "wind" in seconds else self.wind,
        )


PARTS = ("lines", "vortices_before", "vortices", "wind_before", "wind", "combination")
"""Parts of an estimate."""
