"""The sentence about the loads of an aircraft that rises."""

from collections.abc import Mapping

from lidar_mi.assessment.digits import three
from lidar_mi.assessment.metrics.encounter import MODES

_ADVERBS = {
    "off": "without control",
    "autopilot": "with the autopilot",
    "feedforward": "with the lidar",
    "perfect": "with perfect preview",
}


def loads_answer(metrics: Mapping[str, float]) -> list[str]:
    """Largest changes of the load factor."""
    key = "encounter.{}.largest_load_increment"
    increments = {mode: metrics[key.format(mode)] for mode in MODES if key.format(mode) in metrics}
    if not increments:
        return []
    parts = [f"{three(value)} {_ADVERBS[mode]}" for mode, value in increments.items()]
    return [f"The load factor changes by up to {', '.join(parts)}."]
