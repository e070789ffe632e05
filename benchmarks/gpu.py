"""A GPU beside the processor: the same images, the plugins' tests, and how much faster it is.

`python -m benchmarks gpu -n 2` needs no network and ends within ten minutes. Without a GPU it says
why it is skipped.
"""

import os
import re
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np
import torch
import xarray as xr

from lidar_mi.instrument.lidar import BackscatterLidar
from lidar_mi.instrument.scan import Scan, ScanPlan, plan_scans
from lidar_mi.rendering.backscatter import ScanRenderer, extrude
from lidar_mi.rendering.phase import ScatteringAir
from lidar_mi.rendering.settings import RenderSettings
from lidar_mi.rendering.variant import has_cuda, use_variant
from lidar_mi.retrieval.vortices.image_fit import fit_vortices
from lidar_mi.retrieval.wind.options import WindowSizes
from lidar_mi.retrieval.wind.pair import retrieve_wind

from .cases import DT, Pair, vortex_pair_images
from .measure import in_turns
from .report import Comparison, Row, row

ROOT = Path(__file__).resolve().parents[1]
KINDS = ("mono_polarized", "mono", "rgb", "spectral_polarized", "spectral")
METHODS = ("variational", "multipass", "cc", "ws", "vortex_fit")
TESTS_S = 240.0
"""Time that the plugins' tests may take."""
NOISE = 0.02
_OFF = 1e-3
"""Relative difference of a beam beyond which its paths differ by more than rounding."""


def compare(
    repeats: int = 2,
    columns: int = 219,
    rows: int = 139,
    samples: Sequence[int] = (64, 1024, 16384),
    few: int = 256,
    kinds: Sequence[str] = KINDS,
    methods: Sequence[str] = METHODS,
    tests: Sequence[str] = ("tests/plugins",),
) -> Comparison:
    """Images by z-score, tests of plugins, million samples a second, time of a retrieval."""
    title = f"A GPU beside the processor, {columns} x {rows} beams and pixels"
    reason = absent()
    if reason:
        return Comparison(title, "GPU", "processor", reason=f"skipped: {reason}")
    pair = vortex_pair_images(NOISE, 1, columns, rows)
    lines = [
        *(line for kind in kinds for line in images(pair, kind, few)),
        *(line for path in tests for line in tested(path)),
        *rates(pair, samples, repeats),
    ]
    if torch.cuda.is_available():
        lines += retrievals(pair, methods, repeats)
    notes = (
        f"GPU: {named()}. Processor: {os.cpu_count()} cores, {torch.get_num_threads()} threads.",
        "z-scores: of beams rendered with other random numbers on both, by their standard errors; "
        "the variance is that of Student's t.",
    )
    if not torch.cuda.is_available():
        notes += ("Retrieval: skipped, this torch does not compute with CUDA.",)
    return Comparison(title, "GPU", "processor", tuple(lines), notes)


def absent() -> str:
    """Why there is no GPU that renders; empty: there is one."""
    return "" if has_cuda() else "no NVIDIA GPU with a driver that is new enough"


def named() -> str:
    """The GPU and its driver, as the driver's tool names them."""
    query = ["nvidia-smi", "--query-gpu=name,driver_version,memory.total", "--format=csv,noheader"]
    try:
        done = subprocess.run(query, check=True, capture_output=True, text=True, timeout=20)
    except (OSError, subprocess.SubprocessError):
        return torch.cuda.get_device_name() if torch.cuda.is_available() else "unknown"
    return "; ".join(done.stdout.strip().splitlines())


def renderer_of(
    pair: Pair, variant: str, samples: int, order: int
) -> tuple[Callable[[int], xr.Dataset], ScanPlan]:
    """Renders the pair's first image as extinction, 1 / km on average, with a seed."""
    use_variant(variant)
    y, z = (pair.first[axis].values for axis in ("y", "z"))
    (plan,) = plan_scans(Scan(), y, z, (0.0,))
    lidar = BackscatterLidar()
    air = extrude(1e-3 * pair.first.clip(min=0.1), plan, lidar)
    settings = RenderSettings(variant=variant, samples_per_beam=samples, max_order=order)
    phase = {"type": "rayleigh_polarized"}
    scene = ScanRenderer(air, plan, lidar, ScatteringAir(1e-4, phase, 1.0), settings)

    def render(seed: int) -> xr.Dataset:
        use_variant(variant)
        return scene.render(air, plan, seed)

    return render, plan


def images(pair: Pair, kind: str, samples: int) -> Iterator[Row]:
    """Agreement of a variant of both backends, of one and of four orders."""
    for order in (1, 4):
        case = f"images in cuda_ad_{kind}, {order} order{'s' * (order > 1)}, {samples} samples"
        gpu, processor = (
            renderer_of(pair, f"{backend}_ad_{kind}", samples, order)[0]
            for backend in ("cuda", "llvm")
        )
        expected, same, other = processor(1), gpu(1), gpu(2)
        off = relative(same, expected)
        yield row(case, "same seed: median of relative differences", "", [float(np.median(off))])
        yield row(
            case, f"same seed: beams off by more than {_OFF:g}", "", [float((off > _OFF).mean())]
        )
        z = z_scores(other, expected)
        mean, variance = 1 / np.sqrt(z.size), (samples - 1) / (samples - 3)
        wide = variance * np.sqrt((2 + 6 / (samples - 5)) / z.size)
        note = f"expected 0 within {3 * mean:.2g}"
        yield row(case, "other seed: mean z-score", "", [float(z.mean())], note=note)
        note = f"expected {variance:.3f} within {3 * wide:.2g}"
        yield row(case, "other seed: variance of z-scores", "", [float(z.var())], note=note)


def relative(found: xr.Dataset, expected: xr.Dataset) -> np.ndarray:
    """Relative differences of the signals of all beams and gates."""
    a, b = (one["S0"].values.astype(float).ravel() for one in (found, expected))
    return np.abs(a - b) / np.abs(b).clip(min=1e-300)


def z_scores(found: xr.Dataset, expected: xr.Dataset) -> np.ndarray:
    """Differences of the signals over their standard errors, of independent samples."""
    a, b = (one["S0"].values.astype(float).ravel() for one in (found, expected))
    errors = [one["S0_stderr"].values.astype(float).ravel() for one in (found, expected)]
    return (a - b) / np.hypot(*errors)


def tested(path: str) -> Iterator[Row]:
    """How many tests of a folder pass in the variants of CUDA."""
    start = time.perf_counter()
    command = [sys.executable, "-m", "pytest", "-q", "-n0", "-m", "not slow", path]
    environment = os.environ | {"LIDAR_MI_TEST_BACKEND": "cuda"}
    said, note = "", ""
    try:
        done = subprocess.run(
            command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=TESTS_S
        )
        said = done.stdout
        failed = re.findall(r"^FAILED (\S+)", said, re.M)
        note = ", ".join(failed[:5])
    except subprocess.TimeoutExpired as error:
        said = error.stdout.decode(errors="replace") if isinstance(error.stdout, bytes) else ""
        note = f"not finished within {TESTS_S:g} s"
    for word in ("passed", "failed", "skipped"):
        count = re.search(rf"(\d+) {word}", said)
        yield row(f"{path} in cuda_ad_*", word, "", [float(count[1]) if count else 0.0], note=note)
    yield row(f"{path} in cuda_ad_*", "time", "s", [time.perf_counter() - start])


def rates(pair: Pair, samples: Sequence[int], repeats: int) -> Iterator[Row]:
    """Million samples a second of both, warm."""
    for order in (1, 4):
        for number in samples:
            sides = {
                backend: renderer_of(pair, f"{backend}_ad_mono_polarized", number, order)[0]
                for backend in ("cuda", "llvm")
            }
            found = in_turns(sides, repeats)
            million = 1e-6 * pair.first.size * number
            gpu, processor = ([million / t.seconds for t in one] for one in found.values())
            case = f"rendering, {order} order{'s' * (order > 1)}, warm"
            what = f"{number} samples per beam"
            yield row(case, what, "million samples/s", gpu, processor, better="higher")


def retrievals(pair: Pair, methods: Sequence[str], repeats: int) -> Iterator[Row]:
    """Time of a retrieval on both, and how far its winds differ."""
    for method in methods:
        sides = {name: retrieval(pair, method, name) for name in ("cuda", "cpu")}
        found = in_turns(sides, repeats)
        gpu, processor = ([t.seconds for t in one] for one in found.values())
        off = [
            float(np.nanmax(np.abs(a.result - b.result)))
            for a, b in zip(*found.values(), strict=True)
        ]
        note = f"winds differ by {max(off):.2g} m/s at most"
        yield row("retrieval of a pair", method, "s", gpu, processor, better="lower", note=note)


def retrieval(pair: Pair, method: str, device: str) -> Callable[[int], np.ndarray]:
    """Winds of the pair, or the parameters of its vortices."""

    def run(_turn: int) -> np.ndarray:
        images = pair.first, pair.second
        if method == "vortex_fit":
            return fit_vortices(*images, DT, NOISE, device=device).parameters
        windows = WindowSizes(stride=4)
        wind = retrieve_wind(*images, DT, method, windows=windows, noise=NOISE, device=device)
        return np.stack([wind["v"].values, wind["w"].values])

    return run
