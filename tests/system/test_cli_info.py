"""The commands info and aerosol. Detects numbers that are not those of the file or the scatterers,
and files that they cannot open."""

import sys
from importlib.resources import files
from pathlib import Path

import pytest
import xarray as xr

from lidar_mi.io.scattering_table import read_table
from tests.support.command_line import words_of

SCENES = Path(str(files("lidar_mi.scenes")))


def test_info_on_netcdf_3(there, lidar_mi):
    """The wake reader takes it, so info must, too."""
    xr.Dataset({"v": ("y", [1.0, 2.0], {"units": "m/s"})}).to_netcdf("old.nc", engine="scipy")
    code, out, _ = lidar_mi("info", "old.nc")
    assert code == 0 and "y 2" in out and "1 ... 2" in out


def test_info_on_a_run_folder(demo, lidar_mi):
    code, out, _ = lidar_mi("info", demo.folder)
    assert code == 0
    for word in (
        "wake_backscatter",
        "mitsuba",
        "wind.nc",
        "image_t2.exr",
        "figures/fig08",
        "scan.range",
        "500 m",
        "scan.gate_count",
        "seed",
        "spheroids",
    ):
        assert word in out
    assert f"{demo.metrics['backscatter.cc.rmse_v']:.2f}" in out
    assert f"{demo.metrics['true_wind.rms_w']:.2f}" in out and "no skill" in out


def test_info_on_an_image_and_on_winds(demo, lidar_mi):
    code, out, _ = lidar_mi("info", demo.folder / "image_t1.exr")
    assert code == 0
    for word in ("gate000.S0_stderr", "219 x 139", "float32", "wavelength", "samples_per_beam"):
        assert word in out
    code, out, _ = lidar_mi("info", demo.folder / "wind.nc")
    assert code == 0
    for word in ("v_true", "m s-1", "CF-"):
        assert word in out


@pytest.mark.slow
def test_info_on_a_run_that_was_stopped(there, lidar_mi, quick):
    lidar_mi("run", "tiny.yaml", "-o", "run")
    (there / "run" / "metrics.json").unlink()
    code, out, _ = lidar_mi("info", "run")
    assert code == 0 and "unfinished" in out
    with (there / "run" / "log.txt").open("a") as log:
        log.write("2030-01-01 12:00:00 failed: no light; expected some\n")
    _, out, _ = lidar_mi("info", "run")
    assert "failed: no light; expected some" in out and "go on" not in out


def test_info_on_named_scatterers(lidar_mi):
    """The aerosol of the paper as its table says, by name and by file; molecules as published
    (Bodhaine et al. 1999: 5.167e-27 cm2 and King factor 1.04899 at 532 nm, 2.759e-26 and 1.05289
    at 355 nm)."""
    table = read_table(SCENES / "aerosol_spheroids_532nm.txt")
    for name in ("spheroids", SCENES / "aerosol_spheroids_532nm.txt"):
        code, out, _ = lidar_mi("info", name)
        assert code == 0
        for shown in (
            "532 nm",
            f"{table.extinction:.4g} m^-1",
            f"{table.backscatter:.4g} m^-1 sr^-1",
            f"{table.lidar_ratio:.4g} sr",
            f"{table.albedo:.5g}",
            "2e+08 m^-3",
            f"{table.depolarization_ratio:.4g}",
        ):
            assert shown in out
    code, out, _ = lidar_mi("info", "molecules")
    assert code == 0 and "1.049 " in out and "5.1673e-31" in out and "1013.2 hPa" in out
    _, out, _ = lidar_mi("info", "molecules", "--wavelength", "355 nm", "--altitude", "8500 m")
    assert "1.0529 " in out and "2.7589e-30" in out and "331.5" in out


def test_aerosol_writes_a_table_that_info_reads(there, lidar_mi):
    pytest.importorskip("scatrs", reason="scatrs (extra 'particles') is not installed")
    code, out, _ = lidar_mi("aerosol", "soot", "--wavelength", "355 nm", "--nodes", 300)
    assert code == 0 and "aerosol_soot_355nm.txt" in out
    table = read_table("aerosol_soot_355nm.txt")
    assert (table.name, table.wavelength) == ("soot", pytest.approx(355e-9))
    assert f"{table.lidar_ratio:.4g} sr" in out and "300 sizes" in words_of(out)
    code, out, _ = lidar_mi(
        "aerosol",
        "spheres",
        "--name",
        "smoke",
        "--index",
        "1.6+0.02i",
        "--radius",
        "0.1 um",
        "--sigma",
        1.6,
        "--number-density",
        "1e9 / m^3",
        "--nodes",
        200,
        "-o",
        "smoke.txt",
    )
    assert code == 0
    smoke = read_table("smoke.txt")
    assert (smoke.name, smoke.number_density) == ("smoke", 1e9)
    assert "m = 1.6 + 0.02i, log-normal r 0.1 um sigma 1.6" in smoke.provenance
    assert lidar_mi("info", "smoke.txt")[1].count("smoke") >= 2


def test_a_missing_library_is_answered_with_the_line_to_type(there, lidar_mi, monkeypatch):
    monkeypatch.setitem(sys.modules, "scatrs.mie", None)
    code, _, err = lidar_mi("aerosol", "soot", "--wavelength", "355 nm")
    assert code == 2 and "pip install 'lidar-mi[particles]'" in err.splitlines()[-1]
    assert not list(there.glob("aerosol_*"))
