"""Latency of the estimator of an encounter: slab after slab, against the cold methods.

A pair drifts and decays from slab to slab; every slab has its own texture, exactly advected, and 63
lines of sight through it. The estimator starts from the pair expected from the last slab, as in
flight.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple, cast

import numpy as np

from lidar_mi.atmosphere.vortices.vortex import Vortex, velocity
from lidar_mi.atmosphere.vortices.wake_path import WakeAlongPath
from lidar_mi.encounter.lidar.combination import Completion
from lidar_mi.encounter.lidar.computer import Cores
from lidar_mi.encounter.lidar.doppler import DopplerScans, LineFrames, Midway, doppler_scans
from lidar_mi.encounter.lidar.estimator import Estimator
from lidar_mi.encounter.lidar.line_speeds import LineSpeeds
from lidar_mi.encounter.lidar.slab_winds import FirstImage, without_old_garbage
from lidar_mi.encounter.lidar.slabs import gates_of
from lidar_mi.retrieval.threads import threads_for
from lidar_mi.retrieval.vortices.pair import VortexPairFit
from lidar_mi.schema.reading import load_experiment

from .cases import CIRCULATION, CORE_RADIUS, DT, SEPARATION, Pair, drifting_pair_images
from .report import Comparison, Row, row

NOISE, RATE = 0.03, 10.0
MEAN_WIND = (1.5, 0.2)
SLABS_A_TURN = 20
# The first slab is from nothing, and delays the second one.
UNTIMED = 2
# One in so many slabs is estimated from nothing as well.
COLD = 10
# Of the slabs, m; where the lines of sight start half way between two scans.
DISTANCE = 147.5
MIDWAY = Midway(np.zeros(3), np.array([75.0, 0.0, 0.0]))
# Of them, what precedes the second image, but for the lines: from nothing there is none.
BEFORE = ("vortices_before", "wind_before")
PARTS = ("lines", *BEFORE, "vortices", "wind", "combination", "total")
# Growth of the expected pair's errors from slab to slab, as by a track: m^2/s, ln m, m, m, m/s.
UNFORESEEN = np.array([8.0, 0.03, 0.15, 0.15, 8.0, 0.03, 0.15, 0.15, 0.1, 0.1])


class Slab(NamedTuple):
    """Images of a slab, and the frames of the Doppler lidar."""

    images: Pair
    frames: LineFrames


class Timed(NamedTuple):
    """A slab's wind, pair and lines, and the time by part, s."""

    wind: Any
    pair: VortexPairFit
    lines: Any
    seconds: Mapping[str, float]


class Still(NamedTuple):
    """The wind of a pair at rest, uniform along x."""

    vortices: Sequence[Vortex]

    def wind(self, x, y, z, time):
        v, w = velocity(self.vortices, y, z)
        return 0 * v, v + MEAN_WIND[0], w + MEAN_WIND[1]


@threads_for(0)  # threads of what makes the images would linger beside the estimator
def compare(repeats: int = 5, columns: int = 219, rows: int = 139) -> Comparison:
    """Latency and errors over 20 times ``repeats`` slabs, after two that are not timed."""
    number = SLABS_A_TURN * repeats
    # vectors as far apart as in the shipped flight, whose pixels are twice as large
    experiment = load_experiment("encounter_sensor", retrieval={"stride": 8})
    scans = cast(DopplerScans, doppler_scans(experiment, gates_of(experiment)))
    # two processes, as on two cores; "from nothing" all in this one
    estimator = Estimator(experiment, processes=2, speeds=LineSpeeds(scans))
    without_old_garbage()
    warm, scratch = [], []
    last, cores = None, Cores()
    for k in range(number + UNTIMED):
        images = slab(k, number, columns, rows)
        given = Slab(images, scans.frames(_still(images), k, DISTANCE, 0.0, MIDWAY))
        found, cores = timed(estimator, given, last and expected(last), cores)
        last = found.pair if found.pair.success else None
        if k < UNTIMED:
            continue
        warm.append(found)
        if k % COLD == 0:
            # one that has learnt nothing
            cold = Estimator(experiment, speeds=LineSpeeds(scans))
            scratch.append((images, timed(cold, given, None, Cores())[0], found))
    case = f"{columns} x {rows} px"
    lines = []
    for part in PARTS:
        now, then = (
            [t.seconds[part] for t in those if part in t.seconds]
            for those in (warm, [t for _, t, _ in scratch])
        )
        lines += _latency(case, part, now, () if part in BEFORE else then)
    lines += _errors(scratch)
    started = np.mean([t.pair.from_start for t in warm])
    latency = np.quantile([t.seconds["total"] for t in warm], 0.99)
    work = np.mean([sum(t.seconds.get(part, 0.0) for part in PARTS[:-1]) for t in warm])
    return Comparison(
        "Real time: two images and 63 ring images to wind and vortices, from slab to slab",
        "from the expected pair",
        "from nothing",
        tuple(lines),
        (
            f"{number} slabs, two before them not counted; noise of {NOISE:.0%} of the mean. Found "
            f"from the start: {started:.0%}. From nothing, the pair by matched filters: every "
            f"{COLD}th slab.",
            f"Requirement: {RATE:g} slabs a second, {1e3 / RATE:.0f} ms. 99 % of the slabs took at "
            f"most {1e3 * latency:.0f} ms ({_verdict(latency)}). All parts of a slab together took "
            f"{1e3 * work:.0f} ms in the mean, of {2e3 / RATE:.0f} ms that two cores have.",
            "Wind and combination in one process, vortices and lines in another. Before the second "
            "image: what concerns the first image and the expected pair, and the lines, whose ring "
            "images come half a period before it. A process that is still busy then, with this "
            "slab or the last one, is late: that is in the total.",
            "Errors: of the same slabs by both, against the true pair and wind.",
        ),
    )


def _still(images: Pair) -> WakeAlongPath:
    return cast(WakeAlongPath, Still(images.vortices))


def slab(number: int, of: int, columns: int, rows: int) -> Pair:
    """Images of a slab with the pair at that time: it drifts, descends and decays."""
    seconds = number / RATE
    later = seconds - of / RATE / 2
    y, z = 0.75 * later, -0.8 * later
    decay = np.exp(-seconds / 60.0)
    vortices = [
        Vortex(side * CIRCULATION * decay, CORE_RADIUS, y + side * SEPARATION / 2, z, "lamb_oseen")
        for side in (1, -1)
    ]
    return drifting_pair_images(vortices, MEAN_WIND, NOISE, number, columns, rows)


def expected(last: VortexPairFit) -> VortexPairFit:
    """The last pair with errors grown by what may change until the next slab."""
    return replace(last, covariance=last.covariance + np.diag(UNFORESEEN**2))


def timed(
    estimator: Estimator, slab: Slab, start: VortexPairFit | None, cores: Cores
) -> tuple[Timed, Cores]:
    """A slab's estimates, and how long the cores still work after its second image."""
    first, second = slab.images.first, slab.images.second
    complete = Completion(0.0, 0.0, "known", MIDWAY.place, (0.0, 0.0), DISTANCE, None)
    found = estimator.pair_of(
        FirstImage(first, DT, NOISE, expected=start), second, frames=slab.frames, complete=complete
    )
    after = cores.after(0.0, DT, found.seconds)
    seconds = {**found.seconds, "total": max(after)}
    # the next second image comes a period later
    return Timed(found.wind, found.pair, found.lines, seconds), Cores(*(t - DT for t in after))


def _latency(case: str, part: str, warm: Sequence[float], cold: Sequence[float]) -> list[Row]:
    lines = []
    for name, of in (("median", np.median), ("99 %", _nearly_all)):
        now, then = ([1e3 * float(of(values))] if values else [] for values in (warm, cold))
        lines.append(row(case, f"{part.replace('_', ' ')}, {name}", "ms", now, then, "lower"))
    return lines


def _nearly_all(values: Sequence[float]) -> float:
    return float(np.quantile(values, 0.99))


def _errors(slabs: list[tuple[Pair, Timed, Timed]]) -> list[Row]:
    """Rms errors by both, of the same slabs."""
    measures: dict[str, tuple[str, Callable[[Pair, Timed], float]]] = {
        "circulation error": ("m2/s", lambda images, t: _off(images, t.pair, 0)),
        "place error": ("m", lambda images, t: _off(images, t.pair, 2)),
        "wind error": ("m/s", _wind_off),
        "line error": ("m/s", lambda images, t: _lines_off(t)),
    }
    lines = []
    for name, (unit, of) in measures.items():
        then, now = (
            [float(np.sqrt(np.mean([of(s[0], s[k]) ** 2 for s in slabs])))] for k in (1, 2)
        )
        lines.append(row("same slabs", name, unit, now, then, "lower"))
    return lines


def _off(images: Pair, pair: VortexPairFit, parameter: int) -> float:
    """Rms error of a parameter of both vortices."""
    true = [(v.circulation, np.log(v.core_radius), v.y, v.z) for v in images.vortices]
    off = [pair.parameters[4 * k + parameter] - true[k][parameter] for k in (0, 1)]
    return float(np.sqrt(np.mean(np.square(off))))


def _wind_off(images: Pair, found: Timed) -> float:
    wind = found.wind
    true = [images.v.interp(y=wind["y"], z=wind["z"]), images.w.interp(y=wind["y"], z=wind["z"])]
    square = sum((wind[name] - field) ** 2 for name, field in zip("vw", true, strict=True)) / 2
    return float(square.where(wind["flag"] == 0).mean() ** 0.5)


def _lines_off(found: Timed) -> float:
    """Rms error of the speeds along the lines of sight."""
    off = found.lines["v_los"] - found.lines["v_los_true"]
    return float((off**2).mean() ** 0.5)


def _verdict(seconds: float) -> str:
    return "met" if seconds <= 1 / RATE else "not met"
