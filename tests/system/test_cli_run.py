"""The commands run and check. Detects a command that does not do what its help says, a check that
writes or that forecasts another run, and an interrupt that leaves half of one."""

import json
import re
import signal
import subprocess
import sys

import pytest
import xarray as xr

from lidar_mi.io.exr import read_scan
from tests.support.command_line import files_in, words_of


def test_run_writes_into_the_given_folder_and_prints_it(there, lidar_mi, quick):
    code, out, err = lidar_mi(
        "run",
        "tiny.yaml",
        "-o",
        "here",
        "--set",
        "seed=5",
        "--set",
        "retrieval.stride=2",
        "-m",
        "llvm_ad_mono",
    )
    assert code == 0
    assert "here/report.html" in out and "here/wind.nc" in out
    assert "rendering scan 2 of 2" in err and "done" in err
    scan = read_scan(there / "here" / "image_t1.exr")
    assert (scan.attrs["seed"], scan.attrs["variant"]) == (5, "llvm_ad_mono")
    metrics = json.loads((there / "here" / "metrics.json").read_text())
    assert f"{metrics['backscatter.cc.rmse_v']:.2f}" in out
    assert not (there / "outputs").exists()


@pytest.mark.slow
def test_a_device_turns_variants_and_is_in_the_log(there, lidar_mi, quick):
    """Of a file that asks for CUDA, which need not be there."""
    cuda = ("--set", "render.variant=cuda_ad_mono_polarized")
    code, _, err = lidar_mi("run", "tiny.yaml", "--device", "cpu", "-o", "here", *cuda)
    assert code == 0, err
    said = "rendering in llvm_ad_mono_polarized, retrieval on cpu"
    assert said in err and said in (there / "here" / "log.txt").read_text()
    scan = read_scan(there / "here" / "image_t1.exr")
    assert scan.attrs["variant"] == "llvm_ad_mono_polarized"
    # an experiment that was run on its device is resumed
    code, _, err = lidar_mi("run", "tiny.yaml", "--device", "cpu", "-o", "here", *cuda)
    assert code == 0 and "using 2 of 2 images" in err


@pytest.mark.slow
def test_run_folder_is_named_after_the_experiment(there, lidar_mi, quick):
    assert lidar_mi("run", "tiny.yaml")[0] == 0
    assert (there / "outputs" / "tiny" / "wind.nc").is_file()
    code, _, err = lidar_mi("run", "tiny.yaml")
    assert code == 0 and "using 2 of 2 images" in err
    code, _, err = lidar_mi("run", "tiny.yaml", "--set", "seed=2")
    assert code == 2 and "--overwrite" in err
    assert lidar_mi("run", "tiny.yaml", "--set", "seed=2", "--overwrite")[0] == 0


def test_check_summarises_a_run(there, lidar_mi):
    """Numbers that follow from the file by hand; nothing is written."""
    changes = ["scan.range=210 m", "platform.speed=70 m/s", "platform.dt=0.2 s"]
    before = files_in(there)
    code, out, err = lidar_mi("check", "tiny.yaml", *(w for c in changes for w in ("--set", c)))
    assert code == 0, err
    output = words_of(out)
    assert "beams 61 x 41, 0.5 m apart" in output  # 30 m x 20 m
    assert "gates 1, from 210 to 212.5 m" in output
    assert "look-ahead time 3 s at 70 m/s" in output
    # (16 - 8)/2 - 1/2 pixels in dt
    assert "search region winds up to 8.75 m/s; largest here" in output
    assert "extinction 0.1 to 0.1 1/km" not in output and "texture, rms 10%" in output
    assert "not assessed: lidar.pulse_duration is 0" in output
    assert files_in(there) == before
    changes.append("lidar.pulse_duration=10 ns")
    code, out, err = lidar_mi("check", "tiny.yaml", *(w for c in changes for w in ("--set", c)))
    assert re.search(r"one beam safe beyond \d+ m, with binoculars beyond \d+ m", words_of(out))


def test_check_warns_of_winds_too_fast_to_follow(there, lidar_mi):
    _, calm, _ = lidar_mi("check", "tiny.yaml")
    _, fast, _ = lidar_mi("check", "tiny.yaml", "--set", "platform.dt=1 s")
    assert "larger retrieval.search" in words_of(fast) and "larger" not in words_of(calm)


def test_names_are_no_markup(there, lidar_mi):
    """Brackets and colons in files, folders and units stay as they are."""
    unit = {"units": "m/s", "long_name": "[/b] wind [m/s] :cloud:"}
    (there / "[b]x").mkdir()
    xr.Dataset({"v": ("y", [1.0, 2.0], unit)}, attrs={"title": "[red]x[/u]"}).to_netcdf(
        "[b]x/own.nc", engine="h5netcdf"
    )
    code, out, err = lidar_mi("info", "[b]x/own.nc")
    assert code == 0, err
    assert "[red]x[/u]" in out
    code, _, err = lidar_mi("run", "tiny.yaml", "-o", "[b]x")
    assert code == 2 and "[b]x: is no run folder" in err and "Traceback" not in err


@pytest.mark.slow
@pytest.mark.parametrize(
    ("number", "output"),
    [
        (signal.SIGINT, "stopped"),
        pytest.param(signal.SIGTERM, "stopped by SIGTERM", marks=pytest.mark.slow),
    ],
)
def test_a_signal_stops_cleanly_and_the_run_can_be_resumed(there, number, output):
    """In the middle of rendering, where Dr.Jit puts its own exception in the interrupt's place."""
    slow = (
        "run tiny.yaml -o run --set render.samples_per_beam=30000 --set "
        "render.samples_per_pass=20000"
    ).split()
    with subprocess.Popen(
        [sys.executable, "-m", "lidar_mi.cli.app", *slow],
        text=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        # a shell's background job inherits ignored interrupts
        preexec_fn=lambda: signal.signal(number, signal.SIG_DFL),
    ) as process:
        observed = []
        for line in process.stderr:
            observed.append(line)
            if "rendering scan 1" in line:
                break
        process.send_signal(number)
        _, err = process.communicate(timeout=60)
    assert process.returncode == 128 + number, observed
    assert err.splitlines()[-1] == f"lidar-mi: {output}; start it again to resume the run"
    assert "Traceback" not in err
    assert sorted(p.name for p in (there / "run").iterdir()) == ["experiment.yaml", "log.txt"]
