"""Bad input on the command line. Detects input that ends in a traceback, in more than one line, in
another exit code than 2 or in a file left behind."""

import re
from importlib.resources import files
from pathlib import Path

import numpy as np
import OpenEXR
import pytest

from tests.support.command_line import files_in, shell

SCENES = Path(str(files("lidar_mi.scenes")))


def write_exr(path, names=("R", "G", "B"), shape=(17, 21), **header):
    channels = {name: np.full(shape, 0.5, np.float32) for name in names}
    OpenEXR.File({"compression": OpenEXR.ZIP_COMPRESSION, **header}, channels).write(str(path))


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
            says=["lidar.beam_radius", "-0.1 m", "1e-06 to 10 m"],
        ),
        bad(
            "run",
            "tiny.yaml",
            "--set",
            "scan.aim=angles",
            "--set",
            "scan.columns=0",
            says=["scan.columns", "0", "1 to 10000000"],
        ),
        bad("run", "tiny.yaml", "--set", "no_equals", says=["no_equals", "KEY=VALUE"]),
        bad(
            "run", "tiny.yaml", "--set", "retrieval.search=60", says=["search", "60 px", "41 x 61"]
        ),
        bad("run", "tiny.yaml", "-m", "llvm_mono", says=["render.variant", "llvm_mono", "llvm_ad"]),
        bad("run", "slab.xml", says=["slab.xml", "scene", "lidar-mi render slab.xml"]),
        bad("run", "tiny.yaml", "--set", "scan.range=1e9", says=["scan.range", "100000"]),
        bad("run", "none.yaml", says=["none.yaml", "no such file", "wake_backscatter"]),
        bad("run", "text.exr", says=["text.exr", "a picture, not an experiment"]),
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
        bad("render", "slab.xml", "-o", "a.tif", says=["-o a.tif", ".exr or .png"]),
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
        bad(
            "run", "tiny.yaml", "--device", "gpu", says=["--device: gpu is not", "auto, cpu, cuda"]
        ),
        bad(
            "run",
            "tiny.yaml",
            "--set",
            "device=gpu",
            says=["device: 'gpu' is not", "'auto', 'cpu'"],
        ),
        bad("info", "slab.xml", says=["expected .exr, .nc, .hpl or .csv", "run folder"]),
        bad(
            "check",
            "tiny.yaml",
            "--set",
            "wake.spacing=2 mm",
            says=["wake.spacing", "nodes, which memory"],
        ),
        *(
            bad("check", "tiny.yaml", "--set", f"wake.extinction.{change}", says=[says])
            for change, says in (
                # per metre
                ("background=0.39", "background: 390 / km is not allowed; expected less than max"),
                ("background=0.41", "maximum, 1.8 / km: is 0.41 / km meant?"),
                ("background=2 / km", "background: 2 / km is not allowed; expected less than max"),
                ("maximum=0.05 / km", "maximum: 0.05 / km is not allowed; expected more than bac"),
            )
        ),
        bad("check", "wake_senor", says=["wake_senor: no such file", "did you mean wake_sensor?"]),
        bad("check", "wake.yaml", says=["text.nc", "not NetCDF"]),
        bad("info", "smog", says=["smog", "no such file", "molecules", "spheroids"]),
        bad("info", "tiny.yaml", "--wavelength", "532 nm", says=["--wavelength", "tiny.yaml"]),
        bad("info", "dust", "--altitude", "1 km", says=["--altitude", "dust", "molecules"]),
        bad("info", "dust", "--wavelength", "green", says=["--wavelength", "'green'", "532 nm"]),
        bad("info", "dust", "--wavelength", "355 nm", says=["355 nm", "'dust'", "532 to 1064"]),
        bad("info", "molecules", "--altitude", "99 km", says=["altitude", "99000", "80000"]),
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


@pytest.mark.slow
def test_bad_input_in_a_fresh_process(there):
    done = shell("run", "tiny.yaml", "--set", "scan.range=-5 m")
    assert done.returncode == 2
    assert done.stdout == ""
    (line,) = done.stderr.splitlines()
    expected = "expected 0.1 to 100000 m (from a wind tunnel to the top of the atmosphere)"
    assert line == f"lidar-mi: tiny.yaml: scan.range: -5 m is not allowed; {expected}"


LONG = "a" * 300
"""A name that no file system takes."""


@pytest.mark.parametrize(
    "arguments",
    [
        ("check", LONG),
        ("check", f"{LONG}.yaml"),
        ("info", LONG),
        ("render", f"{LONG}.xml"),
        ("rings", f"{LONG}.png"),
        ("retrieve", f"{LONG}.exr", "rgb.exr", "--dt", "0.1"),
        ("check", "tiny.yaml", "--set", f"name={LONG}"),
        ("check", "wake.yaml", "--set", f"wake.file={LONG}.nc"),
        ("check", "tiny.yaml", "--set", f"scattering={{phase: table, table: {LONG}.txt}}"),
    ],
    ids=lambda arguments: " ".join(one.replace(LONG, "LONG") for one in arguments),
)
def test_names_that_are_too_long(there, lidar_mi, arguments):
    before = files_in(there)
    code, _, err = lidar_mi(*arguments)
    (line,) = [line for line in err.splitlines() if line.startswith("lidar-mi: ")]
    assert code == 2 and "Traceback" not in err and len(line) <= 300
    assert files_in(there) == before
