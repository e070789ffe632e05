"""`lidar-mi rings` on series of frames and on lamps: system test.

Detects: a page or plane that is taken for another, a mean of frames that is none, a table whose
columns or frames are lost, a gap of other lines, and frames that end in a traceback.
"""

import csv
import re
import sys

import numpy as np
import pytest
from PIL import Image

from lidar_mi.cli import app as cli
from lidar_mi.io.images import read_frames
from tests.support import figure_rules
from tests.support.ring_frames import Frame

ARGON, THORIUM, GAP = 487.986e-9, 487.873e-9, 0.885e-3
LAMP = Frame(
    shape=(200, 230),
    centre=(110.2, 102.8),
    spacing=6000.0,
    fraction=(2 * GAP / ARGON % 1, 2 * GAP / THORIUM % 1),
    height=(1.0, 0.2),
    ratio=(1.0, THORIUM / ARGON),
)


def exposures(number=2):
    return [LAMP.exposure(np.random.default_rng(k), photons=300.0) for k in range(number)]


def write_pages(path, frames):
    pages = [Image.fromarray(frame.astype(np.uint16)) for frame in frames]
    pages[0].save(path, save_all=True, append_images=pages[1:])


@pytest.fixture
def call(tmp_path, monkeypatch, capsys):
    """The command in a folder of its own: exit code, what it printed, its error."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "300")

    def called(*arguments):
        monkeypatch.setattr(sys, "argv", ["lidar-mi", "rings", *map(str, arguments)])
        with pytest.raises(SystemExit) as stop:
            cli.main()
        return stop.value.code or 0, *capsys.readouterr()

    return called


def test_frames_of_cubes_and_pages(tmp_path):
    """Pages of 16 bit and planes of a cube are the frames, in their order."""
    fits = pytest.importorskip("astropy.io.fits")
    frames = np.random.default_rng(1).integers(0, 60_000, (3, 20, 30)).astype(np.uint16)
    write_pages(tmp_path / "a.tif", frames)
    fits.PrimaryHDU(frames).writeto(tmp_path / "a.fits")
    fits.PrimaryHDU(frames[0].astype("f4")).writeto(tmp_path / "one.fits")
    Image.fromarray(frames[0]).save(tmp_path / "one.png")
    for name in ("a.tif", "a.fits"):
        np.testing.assert_array_equal(read_frames(tmp_path / name), frames)
    for name in ("one.fits", "one.png"):
        np.testing.assert_array_equal(read_frames(tmp_path / name), frames[:1])


@pytest.mark.slow
def test_the_gap_of_a_lamp(call):
    """The mean of two frames: 0.885 mm within 4 of the standard errors that are printed."""
    write_pages("lamp.tif", exposures())
    lines = ("--wavelength", "487.986 nm", "487.873 nm")
    with figure_rules.judged_figures() as found:
        code, out, err = call("lamp.tif", "--average", *lines, "--gap", "0.9 mm", "0.2 mm")
    assert code == 0, err
    assert found == {"lamp_rings": []}
    gap, std = map(float, re.search(r"gap[^\d]*([\d.]+) ± ([\d.]+) mm", out).groups())
    assert abs(gap - 0.885) < 4 * std < 0.02
    assert np.asarray(Image.open("lamp_rings.png")).std() > 10
    code, _, err = call(
        "lamp.tif", "--frame", 0, *lines, "--gap", "1.4 mm", "0.1 mm", "-o", "b.png"
    )
    assert code == 2 and "none from 1.3 to 1.5 mm agrees with the fractional orders" in err
    assert err.count("\n") == 1


@pytest.mark.slow
def test_a_series_as_a_table(call):
    """Two frames and one without rings: a row for each, in the table and in the file."""
    noise = np.random.default_rng(5).normal(100, 5, LAMP.shape).round()
    write_pages("series.tif", [*exposures(), noise])
    code, out, err = call("series.tif", "--all", "-o", "series.csv")
    assert code == 0, err
    with open("series.csv") as file:
        assert file.readline().startswith("# software: lidar-mi ")
        rows = list(csv.DictReader(file))
    assert [row["file"] for row in rows] == [f"series.tif[{k}]" for k in range(3)]
    for row in rows[:2]:
        off = float(row["spacing"]) - LAMP.spacing
        assert abs(off) < 5 * float(row["spacing_std"])
        assert f"{float(row['centre_x']):.1f}" == "110.2" and row["fraction_1"] != "nan"
    assert rows[2]["spacing"] == "nan" and rows[2]["note"]
    assert rows[2]["note"].split()[0] in out


@pytest.mark.slow
def test_refused(call):
    write_pages("two.tif", exposures())
    Image.fromarray(exposures(1)[0][:180].astype(np.uint16)).save("low.png")
    Image.fromarray(exposures(1)[0].clip(max=250).astype(np.uint16)).save("full.png")
    pages = [Image.fromarray(np.full(size, 7, np.uint8)) for size in ((40, 50), (40, 51))]
    pages[0].save("sizes.tif", save_all=True, append_images=pages[1:])
    r = np.hypot(*np.mgrid[-80:80, -90:90])
    Image.fromarray((200 * np.exp(-(((r - 50) / 9) ** 2))).astype(np.uint8)).save("ring.png")
    lines = ("--wavelength", "487.986 nm", "487.873 nm")
    for arguments, message in (
        (("two.tif",), "two.tif: 2 frames; expected --frame N, --average or --all"),
        (("two.tif", "--frame", 2), "--frame: 2 is not allowed; expected 0 to 1 of two.tif"),
        (("two.tif", "--frame", -1), "--frame: -1 is not allowed; expected 0 to 1 of two.tif"),
        (("two.tif", "--frame", 0, "--all"), "--frame, --average, --all: more than one"),
        (("two.tif", "low.png", "--all"), "low.png: 230 x 180 px; expected 230 x 200 px"),
        (("sizes.tif", "--all"), "sizes.tif: page 1 is 51 x 40 px; expected 50 x 40 px"),
        (("full.png",), "full.png: images[0]: saturated"),
        (("full.png", "--average"), "full.png[0]: images[0]: saturated"),
        (("full.png", "--all"), "full.png[0]: images[0]: saturated"),
        (("ring.png",), "ring.png: rings: 1 detected; expected at least 2"),
        (("two.tif", "--all", "-o", "a.png"), "a.png: a table of frames; expected a name that"),
        (("two.tif", "--all", *lines), "--wavelength: not allowed with --all"),
        (("two.tif", "--gap", "1 mm", "1 um"), "--gap: without --wavelength"),
        (("low.png", "--wavelength", "1 s", "2 m"), "--wavelength: '1 s' is not allowed"),
        (("low.png", "--wavelength", "487 nm", "487 nm"), "low.png: wavelength: 4.87e-07 m twice"),
        (("two.tif", "--frame", 0, *lines, "--gap", "1 mm", "-1 mm"), "nominal: 0.001 m within"),
        (("low.png", "--spacing", "-3"), "spacing: -3"),
    ):
        code, _, err = call(*arguments)
        assert code == 2 and message in err, (arguments, err)
        assert err.count("\n") == 1, err
