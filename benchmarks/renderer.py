"""Speed and memory of the renderer alone: the demo's two scans of the wake, polarised.

Every number is from a separate process, without scenes, kernels or memory of another measurement.
Kernels are cached on disk by Dr.Jit; the first process starts with an empty cache, the second with
the cache of the first.
"""

import math
import os
import tempfile
import time

import mitsuba as mi
import numpy as np

from .measure import fresh_process, in_turns, peak_memory
from .report import Comparison, row
from .scans import paper_scan

NOISE = 0.01
MANY = 1024


def compare(
    repeats: int = 5, columns: int = 219, rows: int = 139, samples: int = 64, many: int = MANY
) -> Comparison:
    """First scan, later scans, the scan at 1 % noise, memory."""
    cold, cached = [], []
    for _ in range(max(1, repeats // 2)):
        with tempfile.TemporaryDirectory() as cache:
            for starts in (cold, cached):
                with _cache(cache), fresh_process() as process:
                    starts.append(process.submit(first_scans, columns, rows, samples).result())
    with fresh_process() as process:
        warm = process.submit(warm_scans, repeats, columns, rows, samples).result()
    with fresh_process() as process:
        few = process.submit(memory, columns, rows, samples).result()
    with fresh_process() as process:
        most = process.submit(memory, columns, rows, many).result()

    size = f"{columns} x {rows} beams"
    start = "a new process, scene loading and rendering"
    each = f"warm, {samples} samples per beam"
    scan = f"warm, median standard error of {NOISE:.0%}"
    space = "peak memory of the process"
    rate = [1e-6 * columns * rows * samples / s for s in warm["seconds"]]
    return Comparison(
        f"The renderer ({size} of the textured wake, llvm_ad_mono_polarized)",
        "lidar-mi",
        "",
        (
            row(start, "first scan, nothing compiled before", "s", [s[0] for s in cold]),
            row(start, "first scan, kernels cached on disk", "s", [s[0] for s in cached]),
            row(
                start,
                "second scan (t2)",
                "s",
                [s[1] for s in cold],
                note="moved telescope, other air: no compilation",
            ),
            row(each, "samples per second", "million", rate),
            row(each, "time of the scan", "s", warm["seconds"]),
            row(scan, "samples per beam", "", [float(warm["need"])]),
            row(scan, "median standard error reached", "%", [100 * warm["reached"]]),
            row(scan, "time of the scan", "s", warm["need_seconds"]),
            row(space, "before rendering", "GB", [1e-9 * few[0]]),
            row(space, f"{samples} samples per beam", "GB", [1e-9 * few[1]]),
            row(
                space,
                f"{many} samples per beam",
                "GB",
                [1e-9 * most[1]],
                note=f"{1e-6 * many * columns * rows:.0f} million samples, in passes",
            ),
        ),
    )


def first_scans(columns: int, rows: int, samples: int) -> list[float]:
    """Seconds from the extinction to the first image, and from there to the second."""
    rendered = paper_scan(columns, rows).render(samples, seed=1)
    seconds = []
    for _ in range(2):
        start = time.perf_counter()
        next(rendered)
        seconds.append(time.perf_counter() - start)
    return seconds


def warm_scans(repeats: int, columns: int, rows: int, samples: int) -> dict:
    """Times of scans after the first, with ``samples`` and with as many as 1 % requires."""
    scene = paper_scan(columns, rows).scene()

    def render(count):
        return lambda turn: np.array(mi.render(scene, spp=count, seed=1 + turn)).reshape(
            columns * rows, -1
        )

    def noise(images):
        return float(np.median([image[:, 4] / image[:, 0] for _, image in images]))

    full = in_turns({"full": render(samples)}, repeats)["full"]
    need = max(2, math.ceil(samples * (noise(full) / NOISE) ** 2))
    enough = in_turns({"enough": render(need)}, repeats)["enough"]
    return {
        "seconds": [seconds for seconds, _ in full],
        "need": need,
        "need_seconds": [seconds for seconds, _ in enough],
        "reached": noise(enough),
    }


def memory(columns: int, rows: int, samples: int) -> tuple[float, float]:
    """Peak memory before and after both scans, bytes."""
    scan = paper_scan(columns, rows)
    before = peak_memory()
    for _ in scan.render(samples, seed=1):
        pass
    return before, peak_memory()


class _cache:
    """Dr.Jit's kernel cache of processes started in here."""

    def __init__(self, folder: str):
        self.folder = folder

    def __enter__(self):
        self.before = os.environ.get("DRJIT_CACHE_DIR")
        os.environ["DRJIT_CACHE_DIR"] = self.folder

    def __exit__(self, *_):
        if self.before is None:
            del os.environ["DRJIT_CACHE_DIR"]
        else:
            os.environ["DRJIT_CACHE_DIR"] = self.before
