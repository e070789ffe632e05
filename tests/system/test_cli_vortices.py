"""``lidar-mi vortices``. System tier.

Detects: vortices that differ from those in Python, a figure or table that is not written, a remark
that is not told, an input that ends in more than a line.
"""

import numpy as np
import pytest
import xarray as xr

import lidar_mi as lm
from lidar_mi.assessment.figures.line_vortices import draw_line_vortices
from tests.support import figure_rules
from tests.support.command_line import in_process, words_of
from tests.support.line_wakes import Family, drawn, slices


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Two slices as tables, one of which has a line twice."""
    path = tmp_path_factory.mktemp("scans")
    one = drawn(Family(sigma=0.2, heights=(70.0, 100.0)), 7, slices(2, 11, count=2))
    for number in (0, 1):
        lines = one.lines.isel(time=np.flatnonzero(one.lines["sweep"] == number))
        rows = ["time [s],azimuth [deg],elevation [deg],range [m],radial_velocity [m/s]"]
        seconds = (lines["time"].values - np.datetime64("2000-01-01")) / np.timedelta64(1, "s")
        for k, second in enumerate(seconds):
            where = f"{second:.3f},90,{float(lines['elevation'][k]):.4f}"
            speeds = lines["radial_velocity"].values[k]
            rows += [
                f"{where},{r:.0f},{v:.4f}"
                for r, v in zip(lines["range"].values, speeds, strict=True)
            ]
        (path / f"rhi_{number}.csv").write_text("\n".join(rows))
    return path


@pytest.mark.slow
def test_vortices_of_two_scans(folder, tmp_path):
    files = [folder / f"rhi_{k}.csv" for k in (0, 1)]
    done = in_process(
        "vortices", *files, "--gate-length", "30 m", "--noise", "0.08 m/s", cwd=tmp_path
    )
    assert done.returncode == 0, done.stderr
    words = words_of(done.stdout)
    assert "2 of 2 scans show a wake, 2 have a valid fit." in words
    expected = lm.fit_vortices_to_lines(lm.read_lines_of_sight(files), gate_length=30.0, noise=0.08)
    with xr.open_dataset(tmp_path / "vortices.nc") as found:
        for name in ("y", "z", "circulation", "y_tracked", "circulation_tracked_stderr"):
            np.testing.assert_allclose(found[name], expected[name], rtol=1e-5)
        assert found["flag"].attrs["flag_meanings"].startswith("no_wake no_fit outside")
    assert (tmp_path / "vortices.png").stat().st_size > 10_000
    figure = draw_line_vortices(lm.read_lines_of_sight(files), expected)
    assert len(figure.axes) == 4 and figure_rules.faults(figure) == []
    table = in_process("vortices", files[0], "-o", "v.csv", "--noise", "0.08 m/s", cwd=tmp_path)
    assert table.returncode == 0, table.stderr
    head = (tmp_path / "v.csv").read_text().splitlines()[0]
    assert "circulation [m2 s-1]" in head and "flag in words" in head


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("missing.csv",), "missing.csv: No such file or directory"),
        (("rhi_0.csv", "--span", "wide"), "--span: 'wide' is not allowed"),
        (("rhi_0.csv", "--span", "-3 m"), "span: -3.0 is not allowed"),
        (("rhi_0.csv", "--false-alarm", "2"), "false_alarm: 2.0 is not allowed"),
        (("rhi_0.csv", "-o", "rhi_0.csv"), "rhi_0.csv: is an input"),
        (("rhi_0.csv", "-o", "v.txt"), "v.txt: .txt is not allowed; expected .nc or .csv"),
        (("rhi_0.csv", "--name", "azimuth"), "--name: 'azimuth' is not allowed"),
    ],
)
def test_bad_input_is_one_line(folder, arguments, message):
    done = in_process("vortices", *arguments, cwd=folder)
    assert done.returncode == 2 and message in words_of(done.stderr)
    assert done.stderr.count("\n") <= 2


@pytest.mark.parametrize(
    ("name", "elevation", "code", "message"),
    [
        ("stare", np.full(40, 90.0), 2, "scan 0 looks in one direction; expected an RHI"),
        ("calm", 3 + 0.3 * np.arange(40), 1, "no valid vortices, number of scans 1 (flags: no_w"),
    ],
)
def test_a_scan_without_vortices_says_why(tmp_path, name, elevation, code, message):
    random, rows = np.random.default_rng(0), ["time,azimuth,elevation,range,radial_velocity"]
    for k, degrees in enumerate(elevation):
        rows += [
            f"{0.1 * k:.1f},90,{degrees},{r},{0.1 * random.standard_normal():.3f}"
            for r in range(405, 900, 30)
        ]
    (tmp_path / f"{name}.csv").write_text("\n".join(rows))
    done = in_process("vortices", f"{name}.csv", cwd=tmp_path)
    assert done.returncode == code and message in words_of(done.stderr)
    # a scan without a wake has its score and false-alarm probability in the file
    assert (tmp_path / "vortices.nc").exists() == (name == "calm")
