"""``lidar-mi retrieve``: the time step that headers state, the numbers printed, completion.

Detects: a step or an order of images taken on trust where the files contradict it; statistics that
are not those of the file written; pixels that are not those of the wind in metres; a picture that
is missing or replaces an input; names that a shell does not complete. System tier.
"""

import re

import numpy as np
import pytest
import xarray as xr
from PIL import Image
from scipy.ndimage import gaussian_filter

from lidar_mi.cli import options
from lidar_mi.cli.export import complete_format
from lidar_mi.io.exr import label_scan, read_scan, write_scan
from lidar_mi.io.image_times import steps_of
from tests.support.command_line import shell, words_of

OPTIONS = "--stride", "4", "-o", "w.nc"


@pytest.fixture
def here(tmp_path, monkeypatch):
    """Air that moves by 2 pixels of 0.5 m to port in 0.1 s, from a telescope at 70 m/s."""
    monkeypatch.chdir(tmp_path)
    rng = np.random.default_rng(1)
    air = 1 + 0.5 * gaussian_filter(rng.normal(size=(40, 60)), 1.5)
    axes = {"gate": [0], "z": 0.5 * np.arange(40), "y": 0.5 * np.arange(48)}
    for number, start in enumerate((6, 4, 2)):
        image = air[:, start : start + 48] + 0.02 * rng.normal(size=(40, 48))
        names = "S0", "S1", "S2", "S3", "S0_stderr"
        layers = {name: (("gate", "z", "y"), image[None]) for name in names}
        about = {"telescope_position": 7.0 * number, "platform_speed": 70.0, "dt": 0.1}
        layers["S0_stderr"] = ("gate", "z", "y"), 0.02 * image[None]
        layers |= {"Y": (("z", "y"), image)}
        scan = label_scan(xr.Dataset(layers, axes, about))
        write_scan(tmp_path / f"{number}.exr", scan)
        write_scan(tmp_path / f"silent{number}.exr", scan.drop_attrs(deep=False))
        timed = scan.assign_attrs(reference_time=0.25 * number)
        write_scan(tmp_path / f"timed{number}.exr", timed)
    return tmp_path


def test_steps_are_those_of_the_headers(here):
    assert steps_of(["0.exr", "1.exr", "2.exr"]) == [0.1, 0.1]
    assert steps_of(["1.exr", "0.exr"]) == [-0.1]
    assert steps_of(["timed0.exr", "timed1.exr"]) == [0.25]  # by the clock of each scan
    assert steps_of(["0.exr", "silent1.exr"]) is None


def test_order_is_not_judged_where_the_gates_followed_the_air(tmp_path):
    """A platform at rest whose gates go along with a wind of 12 m/s: its way is -1.2 m."""
    for number in (0, 1):
        names = "S0", "S1", "S2", "S3", "S0_stderr"
        layers = {name: (("gate", "z", "y"), np.ones((1, 2, 3))) for name in names}
        about = {"telescope_position": -1.2 * number, "platform_speed": 0.0, "dt": 0.1}
        data = xr.Dataset(
            layers | {"Y": (("z", "y"), np.ones((2, 3)))},
            {"gate": [0], "z": [0.0, 1], "y": [0.0, 1, 2]},
            about,
        )
        write_scan(tmp_path / f"{number}.exr", label_scan(data))
    assert steps_of([tmp_path / "0.exr", tmp_path / "1.exr"]) == [0.1]


def test_time_step_and_statistics(here, lidar_mi):
    code, out, _ = lidar_mi("retrieve", "0.exr", "1.exr", *OPTIONS)
    assert code == 0 and "dt 0.1 s, by the headers" in words_of(out)
    wind = xr.load_dataset("w.nc")
    assert wind.attrs["dt"] == 0.1
    valid = wind["flag"] == 0
    np.testing.assert_allclose(wind["v"].where(valid).mean(), 10, atol=0.2)
    for row, number in (
        ("mean", lambda a: a.mean()),
        ("rms", lambda a: float((a**2).mean()) ** 0.5),
    ):
        printed = re.search(rf"^│ {row} +│ +(\S+) +│ +(\S+) +│", out, re.MULTILINE).groups()
        true = [float(number(wind[n].where(valid))) for n in ("v", "w")]
        np.testing.assert_allclose([float(p) for p in printed], true, rtol=6e-3)
    printed = re.search(r"^│ mean stated error +│ +(\S+)", out, re.MULTILINE)[1]
    error = float(wind["v_stderr"].where(valid).mean())
    np.testing.assert_allclose(float(printed), error, rtol=6e-3)
    assert f"{float(valid.mean()):.1%} valid" in out


@pytest.mark.slow
def test_contradictions_are_said(here, lidar_mi):
    code, out, _ = lidar_mi("retrieve", "0.exr", "1.exr", "--dt", 100, *OPTIONS)
    assert code == 0 and "warning: dt is 100 s as given, but 0.1 s by the headers" in words_of(out)
    code, out, _ = lidar_mi("retrieve", "1.exr", "0.exr", "--dt", 0.1, *OPTIONS)
    assert code == 0 and "warning: by their headers (-0.1 s)" in words_of(out)
    code, out, _ = lidar_mi("retrieve", "0.exr", "1.exr", "--dt", 0.1, *OPTIONS)
    assert code == 0 and "warning" not in out
    for files, words in (
        (("1.exr", "0.exr"), "images in the order of their times"),
        (("silent0.exr", "silent1.exr"), "dt: missing"),
        (("0.exr", "1.exr", "timed2.exr", "--method", "cc"), "expected two, pairs all"),
        (("0.exr", "1.exr", "0.exr", "--pairs", "all"), "images in the order of their times"),
    ):
        code, _, err = lidar_mi("retrieve", *files, *OPTIONS)
        assert code == 2 and words in err and len(err.splitlines()) == 1


def test_many_images_pair_by_pair(here, lidar_mi):
    code, out, err = lidar_mi(
        "retrieve", *(f"{k}.exr" for k in range(3)), "--pairs", "all", *OPTIONS
    )
    assert code == 0 and "dt 0.1 s, by the headers" in words_of(out) and "images 1-2" in err
    winds = xr.load_dataset("w.nc")
    np.testing.assert_allclose(winds["time"], [0.05, 0.15])
    assert lidar_mi("retrieve", "1.exr", "2.exr", "--overwrite", *OPTIONS)[0] == 0
    alone = xr.load_dataset("w.nc")
    for name in ("v", "w", "v_stderr", "flag"):
        np.testing.assert_array_equal(winds[name][1], alone[name])
    mean = float(alone["v"].where(alone["flag"] == 0).mean())
    row = re.search(r"^│ ?1-2 +│ +(\S+) +│ +\S+ +│ +(\S+)", out, re.MULTILINE).groups()
    np.testing.assert_allclose([float(number) for number in row], [0.15, mean], rtol=6e-3)
    pairs = "--pairs", "0-2,1-2", "--overwrite"
    timed = [f"timed{k}.exr" for k in range(3)]
    code, out, _ = lidar_mi("retrieve", *timed, *pairs, *OPTIONS, "--search", 20)
    assert code == 0
    winds = xr.load_dataset("w.nc")
    np.testing.assert_allclose(winds["time"], [0.25, 0.375])
    np.testing.assert_allclose(winds["dt"], [0.5, 0.25])
    speed = winds["v"].where(winds["flag"] == 0).mean(("z", "y"))
    np.testing.assert_allclose(speed, 4, atol=0.1)  # 1 m in 0.25 s
    for pairs, words in (
        ("0-3", "pairs: 0-3 is not allowed; expected two of the images 0 to 2"),
        ("1-0", "the earlier first"),
        ("each", "--pairs: 'each' is not allowed"),
    ):
        code, _, err = lidar_mi("retrieve", *timed, "--pairs", pairs, "--overwrite", *OPTIONS)
        assert code == 2 and words in err and len(err.splitlines()) == 1


@pytest.mark.slow
def test_images_of_a_detector_come_first(here, lidar_mi):
    """Y_noisy before Y; which was taken is said; images of both kinds are not mixed unasked."""
    for number in (0, 1):
        scan = read_scan(f"{number}.exr")
        noisy = {"S0_noisy": scan["S0"], "S0_noise_std": scan["S0_stderr"], "Y_noisy": scan["Y"]}
        noisy["Y_noise_std"] = 0.02 * scan["Y"]
        write_scan(here / f"noisy{number}.exr", scan.assign(noisy))
    code, out, _ = lidar_mi("retrieve", "noisy0.exr", "noisy1.exr", *OPTIONS)
    assert code == 0 and "layer    Y_noisy, with the detector's noise (--layer Y" in out
    code, out, _ = lidar_mi("retrieve", "noisy0.exr", "noisy1.exr", "--layer", "Y", *OPTIONS)
    assert code == 0 and "Y_noisy" not in out
    code, _, err = lidar_mi("retrieve", "noisy0.exr", "1.exr", *OPTIONS)
    assert code == 2 and "1.exr: without the layer Y_noisy" in err
    assert "expected layer, such as Y" in err


@pytest.mark.slow
def test_thresholds_flag_more(here, lidar_mi):
    def valid(*more):
        code, *_ = lidar_mi("retrieve", "0.exr", "1.exr", "--method", "cc", *OPTIONS, *more)
        found = int((xr.load_dataset("w.nc")["flag"] == 0).sum())
        assert code == (found == 0)
        return found

    usual = valid()
    for option in ("--min-correlation", "--min-texture", "--min-isotropy"):
        assert valid(option, "0.95") < usual


def test_shells_complete_commands_and_experiments(here, monkeypatch):
    # the shell is named, not looked for among the parents of this process
    monkeypatch.setenv("_TYPER_COMPLETE_TEST_DISABLE_SHELL_DETECTION", "1")
    assert "complete" in shell("--show-completion", "bash").stdout
    (here / "wake_mine.yaml").write_text("")
    (here / "sub").mkdir()
    (here / "sub" / "mine.yaml").write_text("")
    (here / "puff_mine.xml").write_text("")
    run = options.complete_run
    assert {"wake_3d", "wake_sensor", "wake_mine.yaml"} <= set(run("wake_"))
    assert run("su") == ["sub/"] and run("sub/m") == ["sub/mine.yaml"]
    assert (
        not run("enc")
        and options.complete_flight("")
        == ("encounter encounter_sensor gust real_wakes wake_mine.yaml sub/").split()
    )
    assert options.complete_campaign("design") == ["design_map"]
    assert options.complete_scene("puff") == ["puff", "puff_mine.xml"]
    assert options.complete_contents("so") == ["soot"] and "0.exr" in options.complete_contents("")
    assert options.complete_method("v") == ["variational", "vortex_fit"]
    assert complete_format("") == ["vtk", "csv", "mat", "openfast", "control"]


@pytest.fixture
def photographs(tmp_path, monkeypatch):
    """Two PNG files without axes, the second moved by two pixels to the right."""
    monkeypatch.chdir(tmp_path)
    air = gaussian_filter(np.random.default_rng(2).normal(size=(40, 60)), 1.5)
    grey = np.interp(air, (air.min(), air.max()), (20, 230)).astype(np.uint8)
    for name, start in (("a.png", 6), ("b.png", 4)):
        Image.fromarray(grey[:, start : start + 48]).save(name)


@pytest.mark.slow
def test_pixels_are_those_of_the_wind_in_metres(photographs, lidar_mi):
    assert lidar_mi("retrieve", "a.png", "b.png", *OPTIONS)[0] == 2
    files = "retrieve", "a.png", "b.png", "--stride", "4"
    code, out, err = lidar_mi(*files, "--pixels", "-o", "px.nc")
    assert code == 0 and "v, px/frame" in out and "variational: 48 x 40 pixels" in err
    assert lidar_mi(*files, "--spacing", 0.5, "--dt", 0.1, "-o", "m.nc")[0] == 0
    assert lidar_mi(*files, "--pixels", "--dt", 0.1, "-o", "px_s.nc")[0] == 0
    pixels, metres, timed = (xr.load_dataset(name) for name in ("px.nc", "m.nc", "px_s.nc"))
    # y is to the left
    assert float(pixels["v"].median()) == pytest.approx(-2, abs=0.05)
    for name in ("v", "w", "v_stderr", "w_stderr"):
        one = pixels[name].values
        np.testing.assert_allclose(one, metres[name] * 0.1 / 0.5, rtol=1e-4, atol=1e-6)
        np.testing.assert_allclose(one, timed[name] * 0.1, rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(pixels["y"], metres["y"] / 0.5)
    units = [data["v"].attrs["units"] for data in (pixels, metres, timed)]
    assert units == ["px frame-1", "m s-1", "px s-1"] and pixels["y"].attrs["units"] == "px"
    code, _, err = lidar_mi(*files, "--pixels", "--spacing", 1)
    assert code == 2 and "pixels, spacing" in err


@pytest.mark.slow
def test_a_picture_of_the_vectors(photographs, lidar_mi, tmp_path):
    files = "retrieve", "a.png", "b.png", "--pixels", "--stride", "4"
    code, out, _ = lidar_mi(*files, "-o", "w.nc")
    assert code == 0 and "picture w.png" in words_of(out)
    with Image.open("w.png") as picture:
        # arrows and colours: a picture of one colour has nothing in it
        assert min(picture.size) > 100 and len(set(picture.convert("L").tobytes())) > 20
    options = "--colours", "vorticity", "--lines", "streamlines"
    assert lidar_mi(*files, "-o", "turns.nc", *options)[0] == 0
    assert (tmp_path / "turns.png").read_bytes() != (tmp_path / "w.png").read_bytes()
    before = (tmp_path / "a.png").read_bytes()
    code, _, err = lidar_mi(*files, "-o", "a.nc")
    assert code == 2 and "a.png: is an input" in err
    assert (tmp_path / "a.png").read_bytes() == before and not (tmp_path / "a.nc").exists()
    assert lidar_mi(*files, "-o", "plain.nc", "--no-picture")[0] == 0
    assert not (tmp_path / "plain.png").exists()
