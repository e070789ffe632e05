"""The benchmarks, tiny. Detects an inverted ratio, a missing peer that crashes, a peer's failure
that costs the other tables, a peer scene that is not the air the lidar equation describes, a wrong
place or sign of a vector.

How fast anything is, is not tested: that depends on the machine.
"""

import inspect
import io
import json
import math
import os
import sys
from concurrent.futures import ThreadPoolExecutor
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from rich.console import Console
from scipy.integrate import quad

ROOT = Path(__file__).resolve().parents[2]
if not (ROOT / "benchmarks").is_dir():
    pytest.skip("the benchmarks are part of the source tree", allow_module_level=True)
sys.path.insert(0, str(ROOT))

from benchmarks import __main__ as command
from benchmarks import cases, fringes, gpu, measure, methods, page, report, transient, velocimetry
from lidar_mi.atmosphere.vortices.vortex import velocity


def lines(comparison):
    return {(line.case, line.quantity): line for line in comparison.rows}


# --- tables and JSON


def test_ratio_is_the_factor_by_which_we_are_better():
    time = report.row("case", "time", "s", [1.0, 2.0, 4.0], [8.0, 8.0, 8.0], "lower")
    assert (time.ours, time.other, time.ratio, time.ratio_range) == (2, 8, 4, (2, 8))
    rate = report.row("case", "rate", "", [3.0], [6.0], "higher")
    assert (rate.ratio, rate.ratio_range) == (0.5, None)
    once = report.row("case", "error", "", [2.0], [4.0, 6.0], "lower")
    assert (once.ratio, once.ratio_range) == (2.5, (2, 3))
    alone = report.row("case", "memory", "GB", [1.0])
    assert alone.other is None and alone.ratio is None
    with pytest.raises(ValueError):
        report.row("case", "time", "s", [1.0, 2.0], [1.0, 2.0, 3.0], "lower")


# --- a peer that is missing or breaks


@pytest.mark.parametrize(
    ("module", "package"), [(transient, "mitransient"), (velocimetry, "openpiv")]
)
def test_missing_peer_is_a_row_with_the_command_to_type(module, package, monkeypatch):
    monkeypatch.setattr(report, "find_spec", lambda name: None if name == package else name)
    found = module.compare(1)
    assert found.rows == () and found.reason == f"skipped: pip install {package}"
    out = io.StringIO()
    report.show(found, Console(width=100, file=out))
    assert found.reason in out.getvalue()


def test_command_continues_after_a_failure_and_reports_it(monkeypatch, tmp_path, capsys):
    good = report.Comparison("Good", "we", "they", (report.row("a", "b", "", [1.0], [2.0]),))

    def compare(name):
        def fail(repeats):
            raise RuntimeError("peer broke")

        return SimpleNamespace(compare=fail if name.endswith("transient") else lambda _: good)

    monkeypatch.setattr(command, "import_module", compare)
    monkeypatch.setattr(command, "fresh_process", lambda: ThreadPoolExecutor(1))
    out = tmp_path / "benchmarks.json"
    assert command.main(["transient", "velocimetry", "-o", str(out)]) == 1
    printed = capsys.readouterr().out
    assert "peer broke" in printed and "Good" in printed
    written = json.loads(out.read_text())["comparisons"]
    assert "peer broke" in written["transient"]["reason"]
    assert len(written["velocimetry"]["rows"]) == 1
    assert command.main(["velocimetry", "-o", str(out)]) == 0


def test_all_comparisons_make_the_page_and_those_named_do_not(monkeypatch, tmp_path):
    """Ratios, absent peers, device and versions below the mark; what is above it stays."""
    made = (report.row("a | b", "time", "s", [2.0, 2.0], [3.0, 5.0], "lower", "remark"),)
    found = {
        "rings": report.Comparison("Rings", "we", "they", made, ("A note.",)),
        "gpu": report.Comparison("GPU", "we", "they", reason="skipped: none"),
    }

    def compare(name):
        return SimpleNamespace(compare=lambda repeats, **_: found[name.split(".")[1]])

    written = tmp_path / "performance.md"
    written.write_text(f"# By hand\n\n{page.MARK}\nold\n")
    monkeypatch.setattr(page, "PAGE", written)
    monkeypatch.setattr(page, "QUICK", {name: page.QUICK[name] for name in found})
    monkeypatch.setattr(command, "import_module", compare)
    monkeypatch.setattr(command, "fresh_process", lambda: ThreadPoolExecutor(1))
    out = ["-o", str(tmp_path / "benchmarks.json")]
    assert command.main(["rings", "--quick", *out]) == 0
    assert written.read_text().endswith("old\n")
    assert command.main(["--quick", *out]) == 0
    text = written.read_text()
    assert text.startswith(f"# By hand\n\n{page.MARK}\n") and "old" not in text
    assert "| a / b | time, s | 2 | 4 | 2 | 1.5 to 2.5 | remark |" in text
    for part in ("### Rings", "A note.", "Skipped: none.", "make bench ARGS=--quick", "torch 2"):
        assert part in text, part
    assert f"{os.cpu_count()} cores" in text and "- GPU: " in text


def test_every_comparison_of_a_quick_page_takes_its_arguments():
    for name, options in page.QUICK.items():
        inspect.signature(import_module(f"benchmarks.{name}").compare).bind(2, **options)
    assert set(page.QUICK) <= set(command.COMPARISONS)


# --- measuring


def test_sides_take_turns_after_one_untimed_call():
    calls = []
    tasks = {name: lambda turn, name=name: calls.append((name, turn)) or turn for name in "ab"}
    found = measure.in_turns(tasks, 2)
    assert calls == [("a", 2), ("b", 2), ("a", 0), ("b", 0), ("a", 1), ("b", 1)]
    assert [turn for _, turn in found["b"]] == [0, 1]
    assert all(seconds >= 0 for seconds, _ in found["a"])


@pytest.mark.skipif(not Path("/proc/self/status").is_file(), reason="no /proc here")
def test_memory_of_a_fresh_process_is_its_own():
    held = np.ones(50_000_000)  # 400 MB
    with measure.fresh_process() as process:
        other = process.submit(measure.peak_memory).result()
    assert measure.peak_memory() > held.nbytes
    assert 1e6 < other < held.nbytes


# --- the comparisons


@pytest.mark.parametrize("variant", [transient.VARIANT], indirect=True)
def test_our_side_of_the_peer_scene_follows_the_lidar_equation(variant):
    import mitsuba as mi

    directions = transient.scan_directions(3, 3)
    truth = transient.lidar_equation(transient.PEAK, directions[:, 0])

    def density(r):
        depth = transient.ENVIRONMENT * 484 + transient.PEAK * (r - 485)
        return math.pi / 4 * transient.PEAK * 3 / (8 * math.pi) * math.exp(-2 * depth) / r**2

    # the middle beam, by another quadrature
    assert truth[4] == pytest.approx(quad(density, 500, 502.5)[0], rel=1e-6)
    scene = transient._our_scene(transient.PEAK, 3, 3)
    image = np.array(mi.render(scene, spp=4096, seed=5), float).reshape(-1, 5)
    score = (image[:, 0] - truth) / image[:, 4]
    # 1e-5 of systematic difference: the aperture's finite size
    allowed = 4 + 2e-5 * truth / image[:, 4]
    assert (np.abs(score) < allowed).all()
    assert (image[:, 4] < 2e-4 * truth).all()


def test_errors_are_zero_for_the_true_wind_wherever_the_grids_begin():
    pair = cases.vortex_pair_images(columns=60, rows=40)

    def field(start, rows, columns, extra=0.0):
        z = float(pair.first.z[0]) + 0.5 * (start + np.arange(rows))
        y = float(pair.first.y[0]) + 0.5 * (start + np.arange(columns))
        z, y = np.meshgrid(z, y, indexing="ij")
        v, w = velocity(pair.vortices, y, z)
        return velocimetry.Field(w * 0.2, v * 0.2 + extra, start, 0.0)

    exact, shifted = field(3.5, 33, 53), field(7.5, 25, 45, extra=0.1)
    shifted.dz[3, 4] = np.nan
    errors, vectors = velocimetry.wind_errors(pair, exact, shifted)
    assert vectors == 25 * 45 - 1
    assert errors["everywhere", "v"] == pytest.approx((0, 0.5), abs=1e-9)
    assert errors["everywhere", "w"] == pytest.approx((0, 0), abs=1e-9)
    assert errors["beyond 2 core radii", "v"] == pytest.approx((0, 0.5), abs=1e-9)


# --- fringes


def test_numpy_s_rings_are_the_renderer_s(variant):
    """Share of the light that passes, and where it goes; 4 sigma and the plates' 1e-3."""
    etalon, camera = fringes.Etalon(), fringes.FringeCamera(width=48, height=39, pixel=148e-6)
    line = fringes.backscatter_line(354.7e-9, 233.0, 33_000.0)
    paths = 1 << 20
    plain = fringes.plain_forward(np.random.default_rng(1), etalon, camera, line, paths)
    settings = fringes.FringeSettings(samples_per_pixel=64)
    scene = fringes.mi.load_dict(fringes.scene_dict(etalon, camera, line, settings))
    ours = np.array(fringes.mi.render(scene, seed=1), float)[..., 0]
    assert plain.sum() / ours.sum() == pytest.approx(1, abs=4 / (0.1 * paths) ** 0.5 + 2e-3)
    assert np.corrcoef(plain.ravel(), ours.ravel())[0, 1] > 0.98


def test_fringes_compare(variant):
    found = lines(fringes.compare(1, 48, 39, 4))
    error = found["single precision", "velocity error of the phase, rms"]
    assert error.ours < 0.01 and error.other > 1
    noise = found["from the camera", "noise of a pixel at 4 paths"]
    assert 0 < noise.ours and noise.ratio > 1
    rates = [line for (_, quantity), line in found.items() if quantity == "paths per second"]
    assert len(rates) == 4 and all(line.ours > 0 and line.other > 0 for line in rates)


def test_error_of_the_true_wind_is_zero_at_its_place():
    pair = cases.vortex_pair_images(columns=70, rows=50)
    dy, dz = (wind.values * cases.DT / cases.SPACING for wind in (pair.v, pair.w))
    assert methods.rms_errors(pair, methods.Field(dz, dy, 0.0, 0.0)) == pytest.approx((0, 0))
    off = methods.rms_errors(pair, methods.Field(dz, dy + 0.1, 0.0, 0.0))
    assert off == pytest.approx((0.5, 0.5))


# --- a GPU


def test_without_a_gpu_the_reason_is_said(monkeypatch):
    monkeypatch.setattr(gpu, "has_cuda", lambda: False)
    found = gpu.compare(1)
    assert found.rows == ()
    assert found.reason == "skipped: no NVIDIA GPU with a driver that is new enough"


@pytest.mark.slow
def test_a_gpu_beside_the_processor(monkeypatch):
    """The processor in its place: the same images, z-scores as expected, ratios of time."""
    renderer_of, retrieval = gpu.renderer_of, gpu.retrieval
    monkeypatch.setattr(gpu, "has_cuda", lambda: True)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(gpu, "named", lambda: "a GPU")
    monkeypatch.setattr(
        gpu, "renderer_of", lambda pair, name, *how: renderer_of(pair, f"llvm{name[4:]}", *how)
    )
    monkeypatch.setattr(gpu, "retrieval", lambda pair, method, _: retrieval(pair, method, "cpu"))
    found = gpu.compare(1, 40, 30, (8,), 64, ("mono",), ("cc", "vortex_fit"), tests=())
    assert found.reason == "" and "a GPU" in found.notes[0]
    for order in ("1 order", "4 orders"):
        case = f"images in cuda_ad_mono, {order}, 64 samples"
        rows = {line.quantity: line for line in found.rows if line.case == case}
        same = [line.ours for name, line in rows.items() if name.startswith("same seed")]
        assert same == [0, 0]
        for name, expected in (("mean z-score", 0.0), ("variance of z-scores", 63 / 61)):
            line = rows[f"other seed: {name}"]
            # three sigma, as its remark says; four here
            allowed = float(line.note.rsplit(" ", 1)[1]) * 4 / 3
            assert abs(line.ours - expected) < allowed and allowed < 0.3
    (rate,) = (line for line in found.rows if line.case == "rendering, 1 order, warm")
    assert rate.ratio == pytest.approx(rate.ours / rate.other)
    times = {line.quantity: line for line in found.rows if line.case == "retrieval of a pair"}
    assert set(times) == {"cc", "vortex_fit"}
    # `vortex_fit` is not reproducible to the last bit: 6e-7 at most
    off = [float(line.note.split("differ by ")[1].split()[0]) for line in times.values()]
    assert max(off) < 1e-5
