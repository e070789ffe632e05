"""Bad input on the command line. Detects input that ends in a traceback, in more than one line, in
another exit code than 2 or in a file left behind."""

import re
import shlex
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


RETRIEVE = "retrieve rgb.exr rgb.exr --dt 0.1 --layer G --spacing 1"
BAD = """
run tiny.yaml --set lidar.bean_radius=1 -> lidar.bean_radius | unknown key | beam_radius
run tiny.yaml --set "lidar.beam_radius=3 s" -> lidar.beam_radius | '3 s' | quantity in m
run tiny.yaml --set "lidar.beam_radius=-0.1 m" -> lidar.beam_radius | -0.1 m | 1e-06 to 10 m
run tiny.yaml --set scan.aim=angles --set scan.columns=0 -> scan.columns | 0 | 1 to 10000000
run tiny.yaml --set no_equals -> no_equals | KEY=VALUE
run tiny.yaml --set retrieval.search=60 -> search | 60 px | 41 x 61
run tiny.yaml -m llvm_mono -> render.variant | llvm_mono | llvm_ad
run slab.xml -> slab.xml | scene | lidar-mi render slab.xml
run tiny.yaml --set scan.range=1e9 -> scan.range | 100000
run none.yaml -> none.yaml | no such file | wake_backscatter
run text.exr -> text.exr | a picture, not an experiment
run wake.yaml -> text.nc | not NetCDF
run cut.yaml -> cut.nc | damaged
run tiny.yaml -o . -> is no run folder | -o DIR
run tiny.yaml -o tiny.yaml -> tiny.yaml | is no run folder
render none.xml -> none.xml | no such file
render tiny.yaml -> tiny.yaml | XML
render slab.xml -m llvm_mono -> variant | llvm_mono | llvm_ad_mono
render slab.xml -D range -> -D range | KEY=VALUE
render slab.xml -D height=3 -> slab.xml | height
render slab.xml -D range=far -> slab.xml | far
render slab.xml -D range=510 -> gate_stop | 502.5 | 510
render slab.xml -o none/a.exr -> none is no folder
render slab.xml -o a.tif -> -o a.tif | .exr or .png
render radius.xml -> laser.beam_radius | -0.1 | above 0
render unknown.xml -> unknown.xml | bean_radius
render misses.xml -D range=600 -D stop=602 -> gates | 600 | 499.5
render no_beams.xml -> film | 0 x 17 | 1 x 1
render camera.xml -> camera.xml | scanning_lidar
render path.xml -> path.xml | gated_volpath
retrieve none.exr rgb.exr --dt 0.1 -> none.exr | no such file
retrieve text.exr rgb.exr --dt 0.1 -> text.exr | OpenEXR
retrieve cut.exr cut.exr --dt 0.1 -> cut.exr | OpenEXR
retrieve rgb.exr rgb.exr --dt 0.1 --layer Y -> rgb.exr | 'Y' | B, G, R
retrieve rgb.exr rgb.exr --dt 0.1 --layer G -> rgb.exr | axes | --spacing
retrieve rgb.exr wide.exr --dt 0.1 --layer G --spacing 1 -> 21 x 17 | 31 x 17
retrieve rgb.exr rgb.exr --dt 0 --layer G --spacing 1 -> dt | 0
retrieve rgb.exr rgb.exr --dt 0.1 --layer G --spacing -1 -> spacing | -1
RETRIEVE --method piv -> method | piv | cc, ws
RETRIEVE --search 9 -> search | 9 | template + 2
RETRIEVE --device abacus -> device | abacus
RETRIEVE -o none/w.nc -> none/w.nc | none is no folder
info none -> none | no such file
info tiny.yaml -> tiny.yaml | expected lidar-mi check tiny.yaml
run tiny.yaml --device gpu -> --device: gpu is not | auto, cpu, cuda
run tiny.yaml --set device=gpu -> device: 'gpu' is not | 'auto', 'cpu'
info slab.xml -> expected .exr, .nc, .hpl or .csv | run folder
check tiny.yaml --set "wake.spacing=2 mm" -> wake.spacing | nodes, which memory
check tiny.yaml --set wake.extinction.background=0.39 -> 390 / km is not allowed; expected less
check tiny.yaml --set wake.extinction.background=0.41 -> maximum, 1.8 / km: is 0.41 / km meant?
check tiny.yaml --set "wake.extinction.background=2 / km" -> 2 / km is not allowed; expected less
check tiny.yaml --set "wake.extinction.maximum=0.05 / km" -> 0.05 / km is not allowed | more
check wake_senor -> wake_senor: no such file | did you mean wake_sensor?
check wake.yaml -> text.nc | not NetCDF
info smog -> smog | no such file | molecules | spheroids
info tiny.yaml --wavelength "532 nm" -> --wavelength | tiny.yaml
info dust --altitude "1 km" -> --altitude | dust | molecules
info dust --wavelength green -> --wavelength | 'green' | 532 nm
info dust --wavelength "355 nm" -> 355 nm | 'dust' | 532 to 1064
info molecules --altitude "99 km" -> altitude | 99000 | 80000
info numbers.txt -> numbers.txt | # name
aerosol smog -> aerosol | 'smog' | spheroids
aerosol soot --wavelength "5 um" -> wavelength | 5000 nm | 'soot'
aerosol soot --sigma 1.5 -> name | 'soot' | of its own
aerosol soot --name x --index black -> --index | 'black'
aerosol soot --name x --radius "2 kg" -> --radius | '2 kg'
aerosol soot -o none/a.txt -> none/a.txt | none is no folder
info text.nc -> text.nc | NetCDF
info text.exr -> text.exr | OpenEXR
info . -> no experiment.yaml | run folder
info foreign -> foreign/experiment.yaml | run folder
"""
"""Commands, and what their line says."""


@pytest.mark.parametrize("case", BAD.strip().splitlines())
def test_bad_input_is_one_line_and_leaves_nothing(there, lidar_mi, case):
    command, says = case.split(" -> ")
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

    code, out, err = lidar_mi(*shlex.split(command.replace("RETRIEVE", RETRIEVE)))

    assert code == 2
    line = err.splitlines()[-1]
    assert line.startswith("lidar-mi: ")
    assert err.count("lidar-mi: ") == 1 and "Traceback" not in out + err
    for word in says.split(" | "):
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
