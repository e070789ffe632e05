"""Samples that are traced at once: by the memory of the device, fewer where it is full.

Detects: passes of another device's memory, images that change with them beyond rounding, full
memory that ends in a traceback.
"""

import os

import mitsuba as mi
import numpy as np
import pytest
import xarray as xr

from lidar_mi.errors import InputError
from lidar_mi.instrument.lidar import BackscatterLidar
from lidar_mi.instrument.scan import Scan, plan_scans
from lidar_mi.rendering.backscatter import ScanRenderer, extrude
from lidar_mi.rendering.memory import FRACTION, PER_SAMPLE, host_bytes, samples_at_once
from lidar_mi.rendering.passes import LEAST, within_memory
from lidar_mi.rendering.phase import ScatteringAir
from lidar_mi.rendering.settings import RenderSettings
from lidar_mi.system.memory import UNKNOWN_GPU, gpu_memory

CUDA = "cuda_ad_mono_polarized"
FULL = "jit_malloc(): out of memory! Could not allocate 4294967296 bytes (backend=CUDA, shared=0)."
"""As Dr.Jit says it."""


@pytest.fixture
def driver(tmp_path, monkeypatch):
    """A driver's tool that says what it is told; the arguments that it was called with."""

    def says(text, code=0):
        tool = tmp_path / "nvidia-smi"
        tool.write_text(f"#!/bin/sh\necho $@ > {tmp_path}/asked\necho '{text}'\nexit {code}\n")
        tool.chmod(0o755)
        monkeypatch.setenv("PATH", f"{tmp_path}{os.pathsep}/usr/bin{os.pathsep}/bin")
        return tmp_path / "asked"

    return says


def test_free_memory_of_the_gpu_that_renders(driver, monkeypatch):
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES", raising=False)
    asked = driver("81000")
    assert gpu_memory() == 81000 << 20 and "-i 0 " in asked.read_text()
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "2,0")
    assert gpu_memory() == 81000 << 20 and "-i 2 " in asked.read_text()


@pytest.mark.parametrize(("text", "code"), [("", 0), ("[N/A]", 0), ("no devices", 9)])
def test_a_driver_that_does_not_say(driver, monkeypatch, text, code):
    import torch

    driver(text, code)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert gpu_memory() == UNKNOWN_GPU
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "mem_get_info", lambda: (5 << 30, 8 << 30))
    assert gpu_memory() == 5 << 30


def test_samples_by_the_device(driver):
    """2^22 on a processor; of a GPU's free memory a quarter, below 2^28."""
    driver("16000")
    assert samples_at_once(None, None, CUDA) == int(FRACTION * (16000 << 20) / PER_SAMPLE)
    assert samples_at_once(None, 1e8, CUDA) == samples_at_once(None, None, CUDA)
    assert samples_at_once(1 << 20, None, CUDA) == 1 << 20
    assert samples_at_once(None, 1e11, "llvm_ad_mono") == 1 << 22
    driver("141000")
    assert samples_at_once(None, None, CUDA) == 1 << 28
    driver("1")
    assert samples_at_once(None, None, CUDA) == int(FRACTION * (1 << 20) / PER_SAMPLE)
    driver("0")
    assert samples_at_once(None, None, CUDA) == LEAST


def test_a_gpus_samples_are_not_in_the_machines_memory():
    settings = RenderSettings(samples_per_pass=2000)
    assert settings.given_per_pass == 2000 and RenderSettings().given_per_pass is None
    assert host_bytes(1e6, settings) == 2000 * PER_SAMPLE
    assert host_bytes(100, settings) == 100 * PER_SAMPLE
    assert host_bytes(1e6, RenderSettings(variant=CUDA)) == 0


def renderer(**settings):
    y, z = np.arange(-6, 6.1, 1.0), np.arange(-4, 4.1, 1.0)
    values = 1e-3 * (1 + np.random.default_rng(1).random((len(z), len(y))))
    (plan,) = plan_scans(Scan(), y, z, (0.0,))
    lidar = BackscatterLidar()
    air = extrude(xr.DataArray(values, {"z": z, "y": y}, ("z", "y")), plan, lidar)
    asked = RenderSettings(max_order=2, samples_per_beam=200, **settings)
    phase = {"type": "rayleigh_polarized"}
    return ScanRenderer(air, plan, lidar, ScatteringAir(1e-4, phase, 1.0), asked), air, plan


@pytest.mark.slow
@pytest.mark.usefixtures("variant")
def test_full_memory_makes_smaller_passes_of_the_same_image(monkeypatch):
    """The same random numbers: single precision apart."""
    scene, air, plan = renderer()
    expected = scene.render(air, plan, 5)
    render, sizes = mi.render, []

    def limited(scene, **how):
        sizes.append(scene.integrator().samples_per_pass)
        if sizes[-1] > 20_000:
            raise RuntimeError(FULL)
        return render(scene, **how)

    monkeypatch.setattr(mi, "render", limited)
    found = scene.render(air, plan, 5)
    assert sizes == [(1 << 22) >> shift for shift in (0, 2, 4, 6, 8)]
    for name in ("S0", "order2.S0"):
        scale = float(expected[name].mean())
        assert found[name].values == pytest.approx(
            expected[name].values, rel=2e-6, abs=1e-6 * scale
        )
    assert found["S0_stderr"].values == pytest.approx(expected["S0_stderr"].values, rel=1e-3)
    # the next image does not try again
    scene.render(air, plan, 6)
    assert sizes[5:] == [1 << 14]


class Integrator:
    """What `within_memory` needs of one."""

    samples_per_pass = 1 << 20


@pytest.mark.slow
def test_memory_that_stays_full_is_one_line():
    integrator = Integrator()

    def render():
        try:
            raise RuntimeError(FULL)
        except RuntimeError as error:
            # as Mitsuba passes on what its plugins raise
            raise RuntimeError("error while rendering") from error

    with pytest.raises(InputError) as error:
        within_memory(integrator, render)
    assert integrator.samples_per_pass == LEAST
    assert str(error.value).startswith("render: 1024 samples at once are not allowed; the memory")
    assert "device: cpu" in str(error.value) and "\n" not in str(error.value)


def test_other_errors_of_rendering_stay():
    integrator = Integrator()

    def render():
        raise RuntimeError("medium: 3 is not allowed; expected 2")

    with pytest.raises(RuntimeError, match="medium: 3"):
        within_memory(integrator, render)
    assert integrator.samples_per_pass == 1 << 20
