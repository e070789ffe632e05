"""The cases: twenty wakes of seven kinds, each at three levels of noise.

Every pair is rendered: 121 x 81 beams (changing air: 110 x 70), 0.1 s apart, 200 m ahead
(changing air: 500 m), with a detector's noise by day.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np

ENERGIES = {"low": "30 mJ", "middle": "3 mJ", "high": "1 mJ"}
"""Pulse energies: the least is noisiest."""

Defect = Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]


@dataclass(frozen=True)
class Case:
    """A wake: keys that differ from the common ones, and what the camera does to both images.

    ``turbulence`` is the rms (m/s) of plane turbulence that is added to the flow of the pair.
    """

    name: str
    kind: str
    seed: int
    base: str = "wake_backscatter"
    changes: dict[str, Any] = field(default_factory=dict)
    defect: Defect | None = None
    turbulence: float = 0.0


def settings(case: Case, energy: str) -> dict[str, Any]:
    """Keys of the experiment, dotted."""
    common = {
        "seed": case.seed,
        "wake.spacing": "1 m",
        "scan.range": "200 m",
        "platform.speed": "75 m/s",
        "lidar.pulse_energy": energy,
        "lidar.pulse_duration": "5 ns",
        "detector": {},
        "render.samples_per_beam": 64,
        "render.max_order": 1,
        "retrieval": {"methods": ["cc"], "stride": 8, "sources": "measured"},
    }
    return common | case.changes


def _pair(circulation: float, separation: float, core_radius: float) -> dict[str, Any]:
    return {
        "wake.file": None,
        "wake.time": None,
        "wake.vortex_pair": {
            "circulation": f"{circulation} m^2/s",
            "separation": f"{separation} m",
            "core_radius": f"{core_radius} m",
            "width": "120 m",
            "height": "80 m",
        },
    }


def _saturated(first: np.ndarray, second: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The brightest tenth of image 1 is at the end of the scale."""
    limit = np.quantile(first, 0.9)
    return np.minimum(first, limit), np.minimum(second, limit)


def _illuminated(first: np.ndarray, second: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Image 2 is brighter by 5 % on average, more so to the right."""
    return first, second * np.linspace(1.0, 1.1, second.shape[1])


# oblique beams take motion along them for motion across: the nearer, the more
FAR = {"scan.range": "500 m", "platform.speed": "150 m/s"}
PAIRS = ((350, 30, 2.5), (450, 47, 3), (250, 25, 2), (500, 50, 4))
CASES = (
    *(Case(f"plain_{k}", "plain", k, changes=_pair(*p)) for k, p in enumerate(PAIRS, 1)),
    *(
        Case(f"turbulence_{k}", "turbulence", 10 + k, changes=_pair(*PAIRS[0]), turbulence=rms)
        for k, rms in enumerate((0.3, 0.6, 1.2), 1)
    ),
    *(Case(f"changing_{k}", "changing air", 20 + k, "wake_changing", FAR) for k in (1, 2, 3)),
    *(
        Case(
            f"blurred_{k}",
            "blurred",
            30 + k,
            changes=_pair(*p) | {"lidar.divergence_full": "15 mrad", "lidar.fov_half": "20 mrad"},
        )
        for k, p in enumerate(PAIRS[:3], 1)
    ),
    *(
        Case(f"saturated_{k}", "saturated", 40 + k, changes=_pair(*p), defect=_saturated)
        for k, p in enumerate(PAIRS[:3], 1)
    ),
    *(
        Case(
            f"smooth_{k}", "little texture", 50 + k, changes=_pair(*p) | {"wake.texture.rms": 0.03}
        )
        for k, p in enumerate(PAIRS[:2], 1)
    ),
    *(
        Case(f"light_{k}", "illumination", 60 + k, changes=_pair(*p), defect=_illuminated)
        for k, p in enumerate(PAIRS[2:], 1)
    ),
)


def names() -> Iterator[tuple[Case, str, str]]:
    """Every case with its level of noise and the name of its pair."""
    for case in CASES:
        for level in ENERGIES:
            yield case, level, f"{case.name}_{level}"
