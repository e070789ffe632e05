"""Paths of single scattering selected by their contribution, against paths drawn at random.

A pulse of 10 ns in the paper's scan: it is 1.5 m long, the gate and the slab of the wake 2.5 m.
Efficiency = 1 / (variance x time).
"""

import mitsuba as mi
import numpy as np

from .measure import in_turns
from .report import Comparison, row
from .scans import paper_scan

CANDIDATES, PULSE = 16, 10e-9


def compare(repeats: int = 5, samples: int = 64, columns: int = 219, rows: int = 139) -> Comparison:
    """Sixteen candidates and one, in single scattering and with all orders up to four."""
    lines = []
    for order in (1, 4):
        scan = paper_scan(columns, rows, pulse_duration=PULSE, max_order=order)
        scene = scan.scene()

        def render(candidates, scene=scene):
            def task(turn):
                scene.integrator().candidates = candidates
                return np.array(mi.render(scene, spp=samples, seed=turn), float)

            return task

        found = in_turns({"many": render(CANDIDATES), "one": render(1)}, repeats)
        case = f"orders up to {order}, {samples} samples per beam"
        time = {name: [seconds for seconds, _ in turns] for name, turns in found.items()}
        # standard errors follow the Stokes vector
        variance = {
            name: [np.mean(image[..., 4] ** 2) / np.mean(image[..., 0]) ** 2 for _, image in turns]
            for name, turns in found.items()
        }
        costs = {
            name: [v * t for v, t in zip(variance[name], time[name], strict=True)] for name in found
        }
        lines += [
            row(case, "time of an image", "s", time["many"], time["one"], "lower"),
            row(
                case, "relative variance of a pixel", "", variance["many"], variance["one"], "lower"
            ),
            row(case, "variance x time", "s", costs["many"], costs["one"], "lower"),
        ]
    return Comparison(
        f"Paths of single scattering by contribution ({columns} x {rows} beams, 10 ns)",
        f"{CANDIDATES} candidates",
        "one",
        tuple(lines),
        ("Variance: mean over the pixels, over the squared mean of the image.",),
    )
