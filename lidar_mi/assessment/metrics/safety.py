"""Eye safety of a scan as metrics."""

from dataclasses import asdict, dataclass

import numpy as np


@dataclass(frozen=True)
class ScanSafety:
    """Eye safety of the backscatter lidar's beams.

    permissible_exposure: of each pulse, J m^-2.
    hazard_distance, aided_hazard_distance: of one beam, unaided and with binoculars, m.
    scan_hazard_distance: of the whole scan, unaided, m.
    scan_power: average power of all beams, W.
    """

    permissible_exposure: float
    hazard_distance: float
    aided_hazard_distance: float
    scan_hazard_distance: float
    scan_power: float


def safety_metrics(safety: ScanSafety | None) -> dict[str, float]:
    """``safety.hazard_distance`` and so on; infinite distances are absent; None: no limits."""
    if safety is None:
        return {}
    numbers = asdict(safety)
    return {f"safety.{key}": value for key, value in numbers.items() if np.isfinite(value)}
