"""What time costs the renderer: the demo's scan at once, beam by beam, and in air that moves.

All three scans have the same nodes, samples and kernels in their caches; they render in turns, each
in a process of its own.
"""

import contextlib
import time
from dataclasses import replace

import mitsuba as mi
import numpy as np

from lidar_mi.experiment.graph import call
from lidar_mi.experiment.truth.extinction import make_truth
from lidar_mi.experiment.truth.flows import flows_of
from lidar_mi.experiment.truth.in_time import air_in_time
from lidar_mi.instrument.beams import Beams
from lidar_mi.instrument.scan import ScanPlan
from lidar_mi.rendering.backscatter import extrude

from .measure import fresh_process
from .report import Comparison, row
from .scans import PaperScan, paper_scan

DURATION = 0.09
"""Of the timed scan, s, of 0.1 s from image to image."""
KINDS = ("at once", "timed", "moving")

_scene = None


def compare(
    repeats: int = 5, columns: int = 219, rows: int = 139, samples: int = 64, order: int = 1
) -> Comparison:
    """A timed scan against one at once, moving air against frozen air."""
    seconds: dict[str, list[float]] = {kind: [] for kind in KINDS}
    with contextlib.ExitStack() as stack:
        processes = {kind: stack.enter_context(fresh_process()) for kind in KINDS}
        prepared = {
            kind: process.submit(prepare, kind, columns, rows, samples, order).result()
            for kind, process in processes.items()
        }
        for turn in range(repeats):
            for kind, process in processes.items():
                seconds[kind].append(process.submit(render, turn).result())
    states, made = prepared["moving"]
    what = "time of the scan"
    return Comparison(
        f"Beams in time ({columns} x {rows} beams, {samples} samples per beam, "
        f"{'single scattering' if order == 1 else f'{order} orders'})",
        "in time",
        "without",
        (
            row("timed, against at once", what, "s", seconds["timed"], seconds["at once"], "lower"),
            row(
                "moving, against frozen air",
                what,
                "s",
                seconds["moving"],
                seconds["timed"],
                "lower",
            ),
            row("moving air", "its states, before the scan", "s", [made], note=f"{states} states"),
        ),
        ("Ratios below 1: what time costs. All scans warm.",),
    )


def prepare(kind: str, columns: int, rows: int, samples: int, order: int) -> tuple[int, float]:
    """Build a scene and render it once; number of its air's states, seconds to make them."""
    global _scene
    scan = paper_scan(columns, rows)
    plan, (field, _) = scan.plans[0], scan.fields
    experiment, states, made = scan.experiment, 1, 0.0
    if kind != "at once":
        plan = in_flight(plan, experiment.platform.speed)
    if kind == "moving":
        flows = flows_of(experiment, experiment.folder)
        truth = make_truth(experiment, flows=flows)
        start = time.perf_counter()
        air = call(
            air_in_time, experiment, truth=truth, flows=flows, which=0, times=plan.beams.time
        )
        made, states = time.perf_counter() - start, air.sizes["time"]
        nodes = air.isel(x=0).sel(y=plan.y, z=plan.z).transpose(..., "z", "y")
        field = extrude(nodes, plan, experiment.lidar, [plan])
    settings = experiment.render.model_copy(
        update={"samples_per_beam": samples, "max_order": order}
    )
    experiment = experiment.model_copy(update={"render": settings})
    _scene = PaperScan(experiment, (field,), (plan,)).scene()
    render(-1)
    return states, made


def render(turn: int) -> float:
    """Seconds to render this process's scan."""
    start = time.perf_counter()
    np.array(mi.render(_scene, seed=1 + turn))
    return time.perf_counter() - start


def in_flight(plan: ScanPlan, speed: float) -> ScanPlan:
    """The plan's nodes, row by row, from a telescope that flies towards them."""
    directions = plan.directions()
    count = len(directions)
    times = DURATION * ((np.arange(count) + 0.5) / count - 0.5)
    origin = np.zeros((count, 3))
    origin[:, 0] = plan.position + speed * times
    places = directions / directions[:, :1] * plan.centre
    towards = places - (origin - [plan.position, 0, 0])
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    return replace(plan, beams=Beams(times, origin, towards, origin, towards))
