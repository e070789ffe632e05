"""``lidar-mi winds``. System tier.

Detects: winds that differ from those in Python, a remark that is not told, a file that is replaced,
an input that ends in more than a line.
"""

import numpy as np
import pytest
import xarray as xr

import lidar_mi as lm
from lidar_mi.assessment.figures.wind_profile import draw_wind_profiles
from tests.support import figure_rules
from tests.support import line_files as made
from tests.support.command_line import in_process, words_of


@pytest.fixture
def scan(tmp_path):
    path = tmp_path / "vad.hpl"
    path.write_text(made.halo_text(made.lines(), promised=9))
    return path


def test_winds_of_a_scan(scan, tmp_path):
    done = in_process("winds", scan, "--noise", "0.02 m/s", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    words = words_of(done.stdout)
    assert "remark: vad.hpl: the header promises 9 rays, the file has 6" in words
    assert "17 of 17 winds are valid, of 1 profile. Shown: every 2nd of 17 heights" in words
    with xr.open_dataset(tmp_path / "winds.nc") as found:
        expected = lm.fit_winds_to_lines(lm.read_lines_of_sight(scan), noise=0.02)
        for name, known in zip("uvw", made.WIND, strict=True):
            np.testing.assert_allclose(found[name], expected[name], atol=1e-6)
            assert (np.abs(found[name] - known) < 5 * found[f"{name}_stderr"]).all()
    assert (tmp_path / "winds.png").stat().st_size > 10_000
    table = in_process("winds", scan, "-o", "winds.csv", "--interval", "1 min", cwd=tmp_path)
    assert table.returncode == 0, table.stderr
    assert (tmp_path / "winds.csv").read_text().startswith("time,height")


def test_no_figure_without_a_valid_wind(tmp_path):
    """Lines that are all vertical say nothing of the horizontal wind."""
    (tmp_path / "up.hpl").write_text(made.halo_text(made.lines(elevation=89.9)))
    done = in_process("winds", "up.hpl", cwd=tmp_path)
    assert done.returncode == 1, done.stderr
    reasons = "(flags: ill_conditioned 17, uncertain 17)"
    assert words_of(done.stderr) == f"lidar-mi: no valid wind of 17 {reasons}"
    assert "figure" not in done.stdout and "valid" not in done.stdout
    assert {path.name for path in tmp_path.iterdir()} == {"up.hpl", "winds.nc"}


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("missing.hpl",), "missing.hpl: No such file or directory"),
        (("vad.hpl", "--name", "azimuth"), "--name: 'azimuth' is not allowed; expected OURS="),
        (("vad.hpl", "--noise", "fast"), "--noise: 'fast' is not allowed"),
        (("vad.hpl", "-o", "vad.hpl"), "vad.hpl: is an input"),
        (("vad.hpl", "-o", "winds.txt"), "winds.txt: .txt is not allowed; expected .nc or .csv"),
        (
            ("vad.hpl", "--min-cnr", "90"),
            "vad.hpl: no height has three valid lines that are not in one plane (scan: ppi; 0",
        ),
        (
            ("stare.hpl",),
            "not in one plane (scan: stare; 102 of 120 velocities are valid); expected",
        ),
    ],
)
def test_bad_input_is_one_line(scan, tmp_path, arguments, message):
    (tmp_path / "stare.hpl").write_text(made.halo_text(made.lines(elevation=90.0)))
    done = in_process("winds", *arguments, cwd=tmp_path)
    assert done.returncode == 2 and message in words_of(done.stderr)
    assert done.stderr.count("\n") == 1 and not (tmp_path / "winds.nc").exists()


def test_many_profiles_are_drawn_as_maps():
    one = made.lines()
    data = xr.Dataset(
        {
            name: (("time", "height"), np.full((8, 5), value, float))
            for name, value in (
                ("u", 1),
                ("v", 2),
                ("w", 0.1),
                ("wind_speed", 2.2),
                ("wind_from_direction", 207),
                ("u_stderr", 0.1),
                ("v_stderr", 0.1),
                ("w_stderr", 0.1),
                ("uv_correlation", 0),
                ("flag", 0),
            )
        },
        {"time": one.time[0] + np.arange(8) * np.timedelta64(60, "s"), "height": np.arange(5.0)},
    )
    for some, panels in ((data, 6), (data.isel(time=[0]), 3)):
        figure = draw_wind_profiles(some)
        assert len(figure.axes) == panels and figure_rules.faults(figure) == []


@pytest.mark.slow
def test_winds_in_the_layout_of_actris(scan, tmp_path):
    """Under the names of doppy, flagged winds in those that are not screened alone."""
    done = in_process("winds", scan, "--layout", "actris", "-o", "w.nc", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    expected = lm.fit_winds_to_lines(lm.read_lines_of_sight(scan))
    valid = expected["flag"] == 0
    with xr.open_dataset(tmp_path / "w.nc", engine="h5netcdf") as found:
        for ours, theirs in (("u", "uwind"), ("v", "vwind")):
            np.testing.assert_allclose(found[f"{theirs}_raw"], expected[ours], atol=1e-6)
            np.testing.assert_allclose(found[theirs], expected[ours].where(valid), atol=1e-6)
            assert found[theirs].attrs["units"] == "m s-1"
        from_where = np.rad2deg(np.arctan2(-found["uwind"], -found["vwind"])) % 360
        np.testing.assert_allclose(found["wind_direction"], from_where, atol=1e-3)
        assert found["height"].attrs["units"] == "m" and found["time"].dtype.kind == "M"
