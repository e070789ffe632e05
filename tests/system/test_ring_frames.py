"""Calibration and speeds from frames of one's own, by command. System tier.

The frames are made without the program (`validation.fringe_reference`): 16-bit TIFF, a camera that
is tilted, out of focus and distorting, hot pixels, other mirrors and another focal length than the
nominal ones, light that differs between laser and air. Detects a speed that is wrong by more than
its error, a calibration that does not survive its file, and bad input that ends in a traceback.
"""

import io
import sys
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import replace

import numpy as np
import pytest
import xarray as xr
from PIL import Image

from lidar_mi.cli.app import main
from lidar_mi.errors import InputError
from lidar_mi.experiment.ring_frames import doppler_of
from lidar_mi.io.exr import QUANTITIES, write_fringes
from tests.support.command_line import words_of
from validation.fringe_reference import (
    Defects,
    Instrument,
    Light,
    air_frame,
    exposures,
    laser_frame,
)

SPEED = 50.0
NOMINAL = """
name: mine
doppler:
  camera: {width: 240, height: 195, pixel: 29.6 um}
  ccd: {full_well: 1e6}
  lidar: {line_shape: rayleigh}
"""
"""Few large pixels: as many photons and the same rings as on the whole camera."""

DEFECTS = Defects(
    tilt=(0.008, -0.004),
    distortion=1e-3,
    defocus=1.0,
    focal_length=1.001,
    finesse=0.95,
    warming=0.3,
    laser=Light(slope=(0.03, 0.0)),
    air=Light(slope=(0.0, 0.05)),
    hot_pixels=20,
)


def called(*arguments):
    """Exit code of a command in this process, and all that it printed."""
    said = io.StringIO()
    with pytest.MonkeyPatch.context() as patch, redirect_stdout(said), redirect_stderr(said):
        patch.setattr(sys, "argv", ["lidar-mi", *map(str, arguments)])
        with pytest.raises(SystemExit) as stop:
            main()
    return stop.value.code or 0, words_of(said.getvalue())


def printed(*arguments):
    code, said = called(*arguments)
    assert code == 0, said
    return said


def failed(*arguments):
    code, said = called(*arguments)
    assert code == 2, said
    return said


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("frames")
    (folder / "mine.yaml").write_text(NOMINAL)
    instrument = Instrument().binned(4)
    laser = laser_frame(instrument, DEFECTS, 2.4e7)
    air = air_frame(instrument, DEFECTS, SPEED, 2.4e7)
    for name, mean, count in (("laser", laser, 8), ("reference", laser, 4), ("air", air, 4)):
        frames = exposures(mean, count, [3, len(name)], 5.0)
        pages = [Image.fromarray((f + 100.5).clip(0, 65535).astype(np.uint16)) for f in frames]
        pages[0].save(folder / f"{name}.tif", save_all=True, append_images=pages[1:])
    return folder


@pytest.fixture(scope="module")
def calibration(folder):
    path = folder / "etalon.nc"
    said = printed(
        "calibrate", folder / "laser.tif", "--instrument", folder / "mine.yaml", "-o", path
    )
    assert "camera tilt" in said and path.with_suffix(".png").is_file()
    return path


def test_speeds_agree_within_their_errors(folder, calibration):
    """Four frames each way: chi-square of the normalised errors to 1e-4 (23.5 for 4)."""
    for more in (["--reference", folder / "reference.tif"], []):
        out = folder / "v.nc"
        printed(
            *("v_los", "--signal", folder / "air.tif", "--calibration", calibration, *more),
            *("--instrument", folder / "mine.yaml", "-o", out),
        )
        with xr.open_dataset(out) as found:
            error = np.hypot(found["v_los_std"], found["v_los_systematic"])
            assert float(error.max()) < 0.2
            assert float((((found["v_los"] - SPEED) / error) ** 2).sum()) < 23.5
            assert (found["status"] == "").all()


def test_without_calibration_the_frames_are_refused(folder):
    said = failed("v_los", folder / "air.tif", "--instrument", folder / "mine.yaml")
    assert "no frame has a speed" in said


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["calibrate", "air.tif", "--set", "doppler.camera.width=200"], "200 x 195 px"),
        (["calibrate", "mine.yaml"], "mine.yaml"),
        (["v_los", "air.tif", "--calibration", "v.tif"], "v.tif"),
        (["v_los", "air.tif", "--reference", "laser.tif", "--reference", "air.tif"], "reference"),
    ],
)
def test_wrong_input_is_one_line(folder, calibration, arguments, message):
    paths = [folder / a if a.endswith((".tif", ".yaml")) else a for a in arguments]
    said = failed(*paths, "--instrument", folder / "mine.yaml")
    assert message in said and "Traceback" not in said


def test_a_rendered_image_names_its_unit(folder, tmp_path):
    """Relative energies instead of a camera's counts, which every fit would misread."""
    image = xr.Dataset(
        {name: (("y", "x"), np.zeros((195, 240), np.float32)) for name in QUANTITIES},
        attrs={"units": "Stokes: received energy over the energy sent through the stop; m"},
    )
    write_fringes(tmp_path / "fringes.exr", image)
    for command in ("v_los", "calibrate"):
        said = failed(command, tmp_path / "fringes.exr", "--instrument", folder / "mine.yaml")
        assert "received energy over the energy sent through the stop" in said
        assert "expected counts or photoelectrons of a camera" in said


MERCURY, GAP = 404.7708e-9, 13.7031234e-3


@pytest.mark.slow
def test_the_gap_from_two_lines(folder, tmp_path):
    """Of 3 um more than the nominal one: the whole order is printed, and a wrong line refused."""
    instrument = Instrument().binned(4)
    for wavelength in (instrument.wavelength, MERCURY):
        other = replace(instrument, wavelength=wavelength, gap=GAP, order=2 * GAP / wavelength)
        mean = laser_frame(other, replace(DEFECTS, warming=0.0), 2.4e7)
        pages = [
            Image.fromarray((f + 100.5).clip(0, 65535).astype(np.uint16))
            for f in exposures(mean, 3, 5, 5.0)
        ]
        path = tmp_path / f"{1e9 * wavelength:.0f}.tif"
        pages[0].save(path, save_all=True, append_images=pages[1:])
    given = "--instrument", folder / "mine.yaml", "--set", "doppler.etalon.order_fraction=null"
    both = "calibrate", tmp_path / "355.tif", "--line", f"404.7708 nm={tmp_path / '405.tif'}"
    said = printed(*both, *given, "-o", tmp_path / "etalon.nc")
    assert f"centre {int(2 * GAP / instrument.wavelength)}" in said and "13.7031" in said
    wrong = "--line", f"407.9 nm={tmp_path / '405.tif'}"
    said = failed(*both[:2], *wrong, *given, "-o", tmp_path / "wrong.nc")
    assert "line of 407.9 nm: its rings" in said and "Traceback" not in said
    said = failed(*both[:2], "--line", "404 nm", *given)
    assert "expected WAVELENGTH=FILE" in said
    said = failed(*both[:2], "--line", f"354.7 nm={tmp_path / '355.tif'}", *given)
    assert "the laser's own" in said


def test_an_instrument_without_a_doppler_lidar():
    with pytest.raises(InputError) as error:
        doppler_of("wake_backscatter", "--instrument")
    expected = "--instrument: experiment 'wake_backscatter' has no section doppler; expected one"
    assert str(error.value) == expected
