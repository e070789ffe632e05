"""The command line. Detects a command that does not do what its help says, help without an example,
bad input that ends in a traceback, in more than one line, in another exit code than 2 or in a file
left behind, and pictures that other programs cannot open."""

import gc
import json
import re
import shutil
import signal
import subprocess
import sys
from importlib.metadata import entry_points, version
from importlib.resources import files
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
import xarray as xr

from lidar_mi.atmosphere.scattering import read_table
from lidar_mi.cli import app as cli
from lidar_mi.experiment.stages import backscatter as backscatter_chain
from lidar_mi.io.exr import read_layers, read_scan

SCENES = Path(str(files("lidar_mi.scenes")))

TINY = """\
name: tiny
wake:
  vortex_pair: {circulation: 150, separation: 16 m, core_radius: 2 m, width: 30 m, height: 20 m}
render: {samples_per_beam: 4, max_order: 1}
retrieval: {methods: [cc]}
"""


@pytest.fixture(scope="module", autouse=True)
def free_scenes():
    """Scenes hold reference cycles, and every live one takes part in later kernels."""
    yield
    gc.collect()
    gc.collect()


@pytest.fixture
def there(tmp_path, monkeypatch):
    """A folder to work in, with an experiment and a small scene; names stay short in messages."""
    (tmp_path / "tiny.yaml").write_text(TINY)
    scene = (SCENES / "slab.xml").read_text()
    scene = scene.replace('value="219"', 'value="21"').replace('value="139"', 'value="17"')
    (tmp_path / "slab.xml").write_text(scene)
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def lidar_mi(monkeypatch, capsys):
    """Runs the command in this process: exit code, output, error output."""

    def call(*arguments):
        monkeypatch.setattr(sys, "argv", ["lidar-mi", *map(str, arguments)])
        with pytest.raises(SystemExit) as stop:
            cli.main()
        out, err = capsys.readouterr()
        return stop.value.code or 0, out, err

    return call


@pytest.fixture
def quick(monkeypatch):
    """Runs without figures and texture sweep: the demo has them."""
    monkeypatch.setattr(backscatter_chain.figures, "draw_all", lambda *_: [])
    monkeypatch.setattr(backscatter_chain, "TEXTURE_SWEEP", ())


def shell(*arguments, **options):
    return subprocess.run(
        [sys.executable, "-m", "lidar_mi.cli.app", *map(str, arguments)],
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
        **options,
    )


def words_of(text):
    """The text without box lines and line breaks."""
    return " ".join(re.sub(r"[│╭╮╰╯─┃━┏┓┗┛]", " ", text).split())


def files_in(folder):
    return {p.relative_to(folder): p.stat().st_mtime_ns for p in folder.rglob("*")}


def write_exr(path, names=("R", "G", "B"), shape=(17, 21), **header):
    channels = {name: np.full(shape, 0.5, np.float32) for name in names}
    OpenEXR.File({"compression": OpenEXR.ZIP_COMPRESSION, **header}, channels).write(str(path))


# ---------------------------------------------------------------- help


def test_the_command_is_installed():
    (script,) = [s for s in entry_points(group="console_scripts") if s.name == "lidar-mi"]
    assert script.load() is cli.main


def test_version_in_a_fresh_process():
    done = shell("--version")
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.strip() == f"lidar-mi {version('lidar-mi')}"


def test_help_names_every_command(lidar_mi):
    code, out, _ = lidar_mi("--help")
    assert code == 0
    for command in ("run", "check", "render", "retrieve", "info", "aerosol", "doctor"):
        assert re.search(rf"^│ {command} ", out, re.MULTILINE)


@pytest.mark.parametrize(
    "command", ["run", "check", "render", "retrieve", "info", "aerosol", "doctor"]
)
def test_help_teaches_by_example(lidar_mi, command):
    code, out, _ = lidar_mi(command, "--help")
    assert code == 0
    assert re.search(rf"Examples?: .*lidar-mi {command}", words_of(out))


def test_examples_of_the_help_can_be_typed(there, lidar_mi, quick):
    """Those of run and render, with the files they name; an option that is gone would fail."""
    (there / "my.yaml").write_text(TINY)
    code, *_ = lidar_mi(
        "run", "my.yaml", "-o", "outputs/calm", "--set", "wake.texture.rms=0", "--set", "seed=7"
    )
    assert code == 0
    _, out, _ = lidar_mi("run", "--help")
    assert "run my.yaml -o outputs/calm --set wake.texture.rms=0 --set seed=7" in words_of(out)
    _, out, _ = lidar_mi("render", "--help")
    typed = re.search(r"Example: lidar-mi (render .*?\.exr)", words_of(out))[1]
    assert lidar_mi(*typed.split())[0] == 0
    assert (there / "slab.exr").is_file()


# ---------------------------------------------------------------- run and info


def test_run_writes_where_it_is_told_and_says_so(there, lidar_mi, quick):
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


def test_run_folder_is_named_after_the_experiment(there, lidar_mi, quick):
    assert lidar_mi("run", "tiny.yaml")[0] == 0
    assert (there / "outputs" / "tiny" / "wind.nc").is_file()
    code, _, err = lidar_mi("run", "tiny.yaml")
    assert code == 0 and "using 2 of 2 pictures" in err
    code, _, err = lidar_mi("run", "tiny.yaml", "--set", "seed=2")
    assert code == 2 and "--overwrite" in err
    assert lidar_mi("run", "tiny.yaml", "--set", "seed=2", "--overwrite")[0] == 0


def test_check_tells_what_a_run_would_do(there, lidar_mi):
    """Numbers that follow from the file by hand; nothing is written."""
    changes = ("scan.range=210 m", "platform.speed=70 m/s", "platform.dt=0.2 s")
    before = files_in(there)
    code, out, err = lidar_mi("check", "tiny.yaml", *(w for c in changes for w in ("--set", c)))
    assert code == 0, err
    said = words_of(out)
    assert "beams 61 x 41, 0.5 m apart" in said  # 30 m x 20 m
    assert "gates 1, from 210 to 212.5 m" in said
    assert "warning time 3 s at 70 m/s" in said
    assert "fastest wind windows follow 8.75 m/s, here" in said  # (16 - 8)/2 - 1/2 pixels in dt
    assert "extinction 0.1 to 0.1 1/km" not in said and "texture, rms 10%" in said
    assert files_in(there) == before


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
        "500.0 m",
        "scan.gate_count",
        "seed",
        "spheroids",
    ):
        assert word in out
    assert f"{demo.metrics['backscatter.cc.rmse_v']:.2f}" in out
    assert f"{demo.metrics['true_wind.rms_w']:.2f}" in out and "no skill" in out


def test_info_on_a_picture_and_on_winds(demo, lidar_mi):
    code, out, _ = lidar_mi("info", demo.folder / "image_t1.exr")
    assert code == 0
    for word in ("gate000.S0_stderr", "219 x 139", "float32", "wavelength", "samples_per_beam"):
        assert word in out
    code, out, _ = lidar_mi("info", demo.folder / "wind.nc")
    assert code == 0
    for word in ("v_true", "m s-1", "CF-"):
        assert word in out


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


def test_doctor_ends_as_its_findings_say(lidar_mi):
    code, out, _ = lidar_mi("doctor")
    assert "LLVM" in out and "mitsuba" in out.lower()
    assert code == int("FAILED" in out)


# ---------------------------------------------------------------- render and retrieve


def test_render_fills_in_the_scene(there, lidar_mi):
    code, out, _ = lidar_mi(
        "render",
        "slab.xml",
        "-s",
        8,
        "-D",
        "range=485",
        "-D",
        "stop=487.5",
        "--seed",
        3,
        "-m",
        "llvm_ad_mono",
        "-o",
        "near.exr",
    )
    assert code == 0 and "near.exr" in out
    scan = read_scan(there / "near.exr")
    assert scan.sizes == {"gate": 1, "z": 17, "y": 21}
    attributes = {
        "gate_start": 485.0,
        "gate_stop": 487.5,
        "samples_per_beam": 8,
        "seed": 3,
        "variant": "llvm_ad_mono",
        "max_order": 1,
        "estimator": "gated",
    }
    assert {key: scan.attrs[key] for key in attributes} == attributes
    # 6.2 and 3.9 degrees, in the middle of the gate
    assert scan["y"].values[-1] == pytest.approx(486.25 * np.tan(np.radians(6.2)), rel=1e-5)
    assert scan["z"].values[0] == pytest.approx(-486.25 * np.tan(np.radians(3.9)), rel=1e-5)


def test_rendered_slab_obeys_the_lidar_equation(there, lidar_mi):
    """Y = S0 r^2 / (A dr) = beta T^2 with beta = 3/(8 pi) 1.8 / km, there and back through 499.5 m
    of 0.1 / km and, to the middle of the gate, 1.75 m of slab, both longer where the beam is
    oblique. The mean over 357 beams of 64 photons scatters by less than 0.01 %; 0.1 % is asked."""
    assert lidar_mi("render", "slab.xml", "-s", 64)[0] == 0
    scan = read_scan(there / "slab.exr")  # beside the scene
    slope2 = (scan["z"] ** 2 + scan["y"] ** 2).values / 501.25**2
    oblique = np.sqrt(1 + slope2)
    depth = (1e-4 * 499.5 + 1.8e-3 * 1.75) * oblique
    theory = 3 / (8 * np.pi) * 1.8e-3 * np.exp(-2 * depth)
    assert (scan["Y"].values / theory).mean() == pytest.approx(1, abs=1e-3)


def test_scene_says_how_many_photons_when_the_command_does_not(there, lidar_mi):
    assert lidar_mi("render", "slab.xml", "-o", "a.exr")[0] == 0
    assert read_scan(there / "a.exr").attrs["samples_per_beam"] == 64


def test_retrieve_equals_the_run(demo, there, lidar_mi):
    """The same images by the two ways, with the noise that their files tell."""
    one, other = (demo.folder / f"image_t{k}.exr" for k in (1, 2))
    code, out, _ = lidar_mi("retrieve", one, other, "--dt", 0.1, "-o", "w.nc")
    assert code == 0 and "204 x 124 vectors" in out
    with xr.open_dataset("w.nc") as wind, xr.open_dataset(demo.folder / "wind.nc") as run:
        same = run.sel(source="backscatter", algorithm="cc")
        for name in ("v", "w", "y_vector"):
            np.testing.assert_array_equal(wind[name].values, same[name].values)
        # the noise comes with the pictures, so that flags agree too
        np.testing.assert_array_equal(wind["flag"].values, same["flag"].values)
        assert f"{float((wind['flag'] == 0).mean()):.1%} valid" in out


def test_retrieve_takes_any_picture_with_a_spacing(there, lidar_mi):
    """A random picture moved by 2 px to the left (+y) and 1 px down, 0.25 m a pixel, 0.5 s."""
    noise = np.random.default_rng(5).random((60, 70)).astype(np.float32)
    noise = (noise + np.roll(noise, 1, 0) + np.roll(noise, 1, 1) + 1).astype(np.float32)
    for name, picture in (("a", noise[5:45, 5:55]), ("b", noise[4:44, 7:57])):
        OpenEXR.File({}, {"G": np.ascontiguousarray(picture)}).write(f"{name}.exr")
    code, *_ = lidar_mi(
        "retrieve",
        "a.exr",
        "b.exr",
        "--dt",
        0.5,
        "--layer",
        "G",
        "--spacing",
        0.25,
        "--stride",
        3,
        "--method",
        "cc",
        "-o",
        "w.nc",
    )
    assert code == 0
    with xr.open_dataset("w.nc") as wind:
        valid = (wind["flag"] == 0).values
        assert valid.mean() > 0.9
        assert np.median(wind["v"].values[valid]) == pytest.approx(1.0, abs=0.05)
        assert np.median(wind["w"].values[valid]) == pytest.approx(-0.5, abs=0.05)


def test_retrieve_brings_scans_by_angles_onto_one_grid(there, lidar_mi):
    assert lidar_mi("render", "slab.xml", "-s", 4, "-o", "far.exr")[0] == 0
    assert (
        lidar_mi(
            "render", "slab.xml", "-s", 4, "-D", "range=485", "-D", "stop=487.5", "-o", "near.exr"
        )[0]
        == 0
    )
    code, *_ = lidar_mi(
        "retrieve", "far.exr", "near.exr", "--dt", 0.1, "--template", 4, "--search", 8, "-o", "w.nc"
    )
    assert code == 0
    with xr.open_dataset("w.nc") as wind:
        steps = np.diff(wind["y"].values)
        assert np.ptp(steps) < 1e-3 * steps.mean()
        # a homogeneous slab: nothing but noise to follow
        assert float((wind["flag"] == 0).mean()) < 0.02


# ---------------------------------------------------------------- bad input


def bad(*arguments, says):
    return pytest.param(arguments, says, id=" ".join(map(str, arguments[:5])))


@pytest.mark.parametrize(
    "arguments, says",
    [
        bad(
            "run",
            "tiny.yaml",
            "--set",
            "lidar.bean_radius=1",
            says=["lidar.bean_radius", "unknown key", "beam_radius"],
        ),
        bad(
            "run",
            "tiny.yaml",
            "--set",
            "lidar.beam_radius=3 s",
            says=["lidar.beam_radius", "'3 s'", "quantity in m"],
        ),
        bad(
            "run",
            "tiny.yaml",
            "--set",
            "lidar.beam_radius=-0.1 m",
            says=["lidar.beam_radius", "-0.1 m", "more than 0 m"],
        ),
        bad(
            "run",
            "tiny.yaml",
            "--set",
            "scan.aim=angles",
            "--set",
            "scan.columns=0",
            says=["scan.columns", "0", "at least 1"],
        ),
        bad("run", "tiny.yaml", "--set", "no_equals", says=["no_equals", "KEY=VALUE"]),
        bad(
            "run", "tiny.yaml", "--set", "retrieval.search=60", says=["search", "60 px", "41 x 61"]
        ),
        bad("run", "tiny.yaml", "-m", "llvm_mono", says=["render.variant", "llvm_mono", "llvm_ad"]),
        bad("run", "slab.xml", says=["slab.xml", "scene", "lidar-mi render slab.xml"]),
        bad("run", "tiny.yaml", "--set", "scan.range=1e9", says=["scan.range", "100000"]),
        bad("run", "none.yaml", says=["none.yaml", "no such file", "wake_backscatter"]),
        bad("run", "text.exr", says=["text.exr", "holds no keys"]),
        bad("run", "wake.yaml", says=["text.nc", "not NetCDF"]),
        bad("run", "cut.yaml", says=["cut.nc", "damaged"]),
        bad("run", "tiny.yaml", "-o", ".", says=["is no run folder", "-o DIR"]),
        bad("run", "tiny.yaml", "-o", "tiny.yaml", says=["tiny.yaml", "is no run folder"]),
        bad("render", "none.xml", says=["none.xml", "no such file"]),
        bad("render", "tiny.yaml", says=["tiny.yaml", "XML"]),
        bad("render", "slab.xml", "-m", "llvm_mono", says=["variant", "llvm_mono", "llvm_ad_mono"]),
        bad("render", "slab.xml", "-D", "range", says=["-D range", "KEY=VALUE"]),
        bad("render", "slab.xml", "-D", "height=3", says=["slab.xml", "height"]),
        bad("render", "slab.xml", "-D", "range=far", says=["slab.xml", "far"]),
        bad("render", "slab.xml", "-D", "range=510", says=["gate_stop", "502.5", "510"]),
        bad("render", "slab.xml", "-o", "none/a.exr", says=["none is no folder"]),
        bad("render", "radius.xml", says=["laser.beam_radius", "-0.1", "above 0"]),
        bad("render", "unknown.xml", says=["unknown.xml", "bean_radius"]),
        bad(
            "render",
            "misses.xml",
            "-D",
            "range=600",
            "-D",
            "stop=602",
            says=["gates", "600", "499.5"],
        ),
        bad("render", "no_beams.xml", says=["film", "0 x 17", "1 x 1"]),
        bad("render", "camera.xml", says=["camera.xml", "scanning_lidar"]),
        bad("render", "path.xml", says=["path.xml", "gated_volpath"]),
        bad("retrieve", "none.exr", "rgb.exr", "--dt", "0.1", says=["none.exr", "no such file"]),
        bad("retrieve", "text.exr", "rgb.exr", "--dt", "0.1", says=["text.exr", "OpenEXR"]),
        bad("retrieve", "cut.exr", "cut.exr", "--dt", "0.1", says=["cut.exr", "OpenEXR"]),
        bad(
            "retrieve",
            "rgb.exr",
            "rgb.exr",
            "--dt",
            "0.1",
            "--layer",
            "Y",
            says=["rgb.exr", "'Y'", "B, G, R"],
        ),
        bad(
            "retrieve",
            "rgb.exr",
            "rgb.exr",
            "--dt",
            "0.1",
            "--layer",
            "G",
            says=["rgb.exr", "axes", "--spacing"],
        ),
        bad(
            "retrieve",
            "rgb.exr",
            "wide.exr",
            "--dt",
            "0.1",
            "--layer",
            "G",
            "--spacing",
            "1",
            says=["21 x 17", "31 x 17"],
        ),
        bad(
            "retrieve",
            "rgb.exr",
            "rgb.exr",
            "--dt",
            "0",
            "--layer",
            "G",
            "--spacing",
            "1",
            says=["dt", "0"],
        ),
        bad(
            "retrieve",
            "rgb.exr",
            "rgb.exr",
            "--dt",
            "0.1",
            "--layer",
            "G",
            "--spacing",
            "-1",
            says=["spacing", "-1"],
        ),
        bad(
            "retrieve",
            "rgb.exr",
            "rgb.exr",
            "--dt",
            "0.1",
            "--layer",
            "G",
            "--spacing",
            "1",
            "--method",
            "piv",
            says=["method", "piv", "cc, ws"],
        ),
        bad(
            "retrieve",
            "rgb.exr",
            "rgb.exr",
            "--dt",
            "0.1",
            "--layer",
            "G",
            "--spacing",
            "1",
            "--search",
            "9",
            says=["search", "9", "template + 2"],
        ),
        bad(
            "retrieve",
            "rgb.exr",
            "rgb.exr",
            "--dt",
            "0.1",
            "--layer",
            "G",
            "--spacing",
            "1",
            "--device",
            "abacus",
            says=["device", "abacus"],
        ),
        bad(
            "retrieve",
            "rgb.exr",
            "rgb.exr",
            "--dt",
            "0.1",
            "--layer",
            "G",
            "--spacing",
            "1",
            "-o",
            "none/w.nc",
            says=["none/w.nc", "none is no folder"],
        ),
        bad("info", "none", says=["none", "no such file"]),
        bad("info", "tiny.yaml", says=["tiny.yaml", "expected lidar-mi check tiny.yaml"]),
        bad("info", "slab.xml", says=["slab.xml", "expected .exr, .nc, .txt", "run folder"]),
        bad(
            "check", "tiny.yaml", "--set", "wake.spacing=1 um", says=["wake.spacing", "1e+08 nodes"]
        ),
        bad("check", "wake_senor", says=["wake_senor: no such file", "did you mean wake_sensor?"]),
        bad("check", "wake.yaml", says=["text.nc", "not NetCDF"]),
        bad("info", "smog", says=["smog", "no such file", "molecules", "spheroids"]),
        bad("info", "tiny.yaml", "--wavelength", "532 nm", says=["--wavelength", "tiny.yaml"]),
        bad("info", "dust", "--altitude", "1 km", says=["--altitude", "dust", "molecules"]),
        bad("info", "dust", "--wavelength", "green", says=["--wavelength", "'green'", "532 nm"]),
        bad("info", "dust", "--wavelength", "355 nm", says=["355 nm", "'dust'", "532 to 1064"]),
        bad("info", "molecules", "--altitude", "99 km", says=["altitude", "99000", "81020"]),
        bad("info", "numbers.txt", says=["numbers.txt", "# name"]),
        bad("aerosol", "smog", says=["aerosol", "'smog'", "spheroids"]),
        bad("aerosol", "soot", "--wavelength", "5 um", says=["wavelength", "5000 nm", "'soot'"]),
        bad("aerosol", "soot", "--sigma", "1.5", says=["name", "'soot'", "of its own"]),
        bad("aerosol", "soot", "--name", "x", "--index", "black", says=["--index", "'black'"]),
        bad("aerosol", "soot", "--name", "x", "--radius", "2 kg", says=["--radius", "'2 kg'"]),
        bad("aerosol", "soot", "-o", "none/a.txt", says=["none/a.txt", "none is no folder"]),
        bad("info", "text.nc", says=["text.nc", "NetCDF"]),
        bad("info", "text.exr", says=["text.exr", "OpenEXR"]),
        bad("info", ".", says=["no experiment.yaml", "run folder"]),
        bad("info", "foreign", says=["foreign/experiment.yaml", "run folder"]),
    ],
)
def test_bad_input_is_one_line_and_leaves_nothing(there, lidar_mi, arguments, says):
    for name in ("text.nc", "text.exr"):
        (there / name).write_text("neither NetCDF nor OpenEXR")
    (there / "wake.yaml").write_text("name: wake\nwake: {file: text.nc}\n")
    (there / "cut.yaml").write_text("name: cut\nwake: {file: cut.nc, time: 40 s}\n")
    (there / "cut.nc").write_bytes((SCENES / "wake_slab_40s.nc").read_bytes()[:20_000])
    (there / "numbers.txt").write_text("0 1 1 1 1 0 0\n90 1 1 1 1 0 0\n180 1 1 1 1 0 0\n")
    write_exr("rgb.exr")
    write_exr("wide.exr", shape=(17, 31))
    (there / "cut.exr").write_bytes((there / "rgb.exr").read_bytes()[:400])
    (there / "foreign").mkdir()
    (there / "foreign" / "experiment.yaml").write_text("name: mine\n")
    scene = (there / "slab.xml").read_text()
    radius = 'name="beam_radius" value="0.1"'
    for name, old, new in (
        ("radius", radius, radius.replace("0.1", "-0.1")),
        ("unknown", radius, radius.replace("beam_radius", "bean_radius")),
        ("misses", '<ref id="environment" name="medium"/>', ""),
        ("no_beams", 'name="width" value="21"', 'name="width" value="0"'),
        (
            "path",
            re.search(r"<integrator.*</integrator>", scene, re.DOTALL)[0],
            '<integrator type="volpath"/>',
        ),
    ):
        assert old in scene
        (there / f"{name}.xml").write_text(scene.replace(old, new))
    (there / "camera.xml").write_text('<scene version="3.0.0"><sensor type="perspective"/></scene>')
    before = files_in(there)

    code, out, err = lidar_mi(*arguments)

    assert code == 2
    line = err.splitlines()[-1]
    assert line.startswith("lidar-mi: ")
    assert err.count("lidar-mi: ") == 1 and "Traceback" not in out + err
    for word in says:
        assert word in line
    assert files_in(there) == before


def test_bad_input_in_a_fresh_process(there):
    done = shell("run", "tiny.yaml", "--set", "scan.range=-5 m")
    assert done.returncode == 2
    assert done.stdout == ""
    (line,) = done.stderr.splitlines()
    assert line == "lidar-mi: tiny.yaml: scan.range: -5 m is not allowed; expected more than 0 m"


def test_a_missing_argument_is_a_usage_error(lidar_mi):
    code, _, err = lidar_mi("retrieve", "a.exr", "b.exr")
    assert code == 2 and "--dt" in err and "Traceback" not in err


def test_ctrl_c_stops_cleanly_and_the_run_goes_on(there):
    """In the middle of rendering, where Dr.Jit puts its own exception in the interrupt's place."""
    slow = [
        "run",
        "tiny.yaml",
        "-o",
        "run",
        "--set",
        "render.samples_per_beam=50000",
        "--set",
        "render.samples_per_pass=20000",
    ]
    with subprocess.Popen(
        [sys.executable, "-m", "lidar_mi.cli.app", *slow],
        text=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        # a shell's background job inherits ignored interrupts
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    ) as process:
        seen = []
        for line in process.stderr:
            seen.append(line)
            if "rendering scan 1" in line:
                break
        process.send_signal(signal.SIGINT)
        _, err = process.communicate(timeout=60)
    assert process.returncode == 130, seen
    assert err.splitlines()[-1] == "lidar-mi: stopped; a run goes on when started again"
    assert "Traceback" not in err
    assert sorted(p.name for p in (there / "run").iterdir()) == ["experiment.yaml", "log.txt"]


# ---------------------------------------------------------------- other people's programs


def tool(name, package):
    path = shutil.which(name)
    if path is None:
        pytest.skip(f"{name} is not installed (Debian package {package})")
    return path


def test_exrheader_reads_the_pictures(demo):
    done = subprocess.run(
        [tool("exrheader", "openexr"), demo.folder / "image_t2.exr"],
        capture_output=True,
        text=True,
        check=True,
    )
    for line in (
        "gate000.S0, 32-bit floating-point",
        "gate000.S3, 32-bit",
        "gate000.S0_stderr, 32-bit",
        "Y, 32-bit floating-point",
        "compression (type compression): zip",
        "wavelength (type float): 5.32e-07",
        "gate_start (type float): 485",
        "seed (type int): 65537",
        'gate_kind (type string): "planar"',
        "y (type floatvector)",
        "(0 0) - (218 138)",
    ):
        assert line in done.stdout


def test_iinfo_reads_the_pictures(demo):
    done = subprocess.run(
        [tool("iinfo", "openimageio-tools"), "-v", demo.folder / "image_t1.exr"],
        capture_output=True,
        text=True,
        check=True,
    )
    channels = len(read_layers(demo.folder / "image_t1.exr")[1])
    assert re.search(rf"219 x +139, {channels} channel, float openexr", done.stdout)
    assert "gate_stop: 502.5" in done.stdout


def test_oiiotool_sees_the_same_values(demo):
    """An independent reader: largest apparent backscatter and the mean."""
    done = subprocess.run(
        [
            tool("oiiotool", "openimageio-tools"),
            demo.folder / "image_t1.exr",
            "--ch",
            "Y",
            "--printstats",
        ],
        capture_output=True,
        text=True,
        check=True,
    )
    picture = read_scan(demo.folder / "image_t1.exr")["Y"].values
    for name, value in (("Max", picture.max()), ("Avg", picture.mean(dtype=float))):
        shown = float(re.search(rf"Stats {name}: ([\d.e+-]+)", done.stdout)[1])
        assert shown == pytest.approx(float(value), rel=1e-3, abs=5e-7)
