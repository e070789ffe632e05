"""Files of lines of sight of Doppler lidars. Unit tier.

Detects: a value, sign, unit, time or direction that differs from the file's; a line or a gate that
gets lost; a fault of a file that is passed over without a word or ends in a traceback; flags on
good values or none on bad ones.
"""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from hypothesis import given, settings
from hypothesis import strategies as st

import lidar_mi as lm
from lidar_mi.experiment.describe import sections
from lidar_mi.flags import LineFlag
from lidar_mi.io.lines_of_sight.dataset import scan_kind
from lidar_mi.io.netcdf import write_netcdf
from tests.support import line_files as made

REAL = Path(__file__).parents[3] / "shared" / "data" / "lines_of_sight"


@pytest.fixture
def known():
    return made.lines()


def write(kind, path, known, **options):
    """A file of a kind, with the names that reading it needs."""
    if kind == "halo":
        path.write_bytes(made.halo_text(known, **options).encode())
    elif kind == "csv":
        path.write_text(made.csv_text(known, **options))
        return {"names": {"radial_velocity": "v_r", "snr": "CNR"}}
    else:
        getattr(made, f"write_{kind}")(path, known, **options)
    return {}


KINDS = {
    "halo": ".hpl",
    "csv": ".csv",
    "arm": ".cdf",
    "windcube": ".nc",
    "cfradial1": ".nc",
    "cfradial2": ".nc",
}


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_holds_the_same_lines(kind, known, tmp_path):
    path = tmp_path / f"a{KINDS[kind]}"
    found = lm.read_lines_of_sight(path, **write(kind, path, known))
    assert dict(found.sizes) == {"time": 6, "range": 20}
    assert np.abs((found["time"].values - known.time).astype("int64")).max() < 1e5  # 0.1 ms
    np.testing.assert_allclose(found["range"], known.range)
    np.testing.assert_allclose(found["azimuth"], known.azimuth, atol=0.005)
    np.testing.assert_allclose(found["elevation"], known.elevation, atol=0.005)
    np.testing.assert_allclose(found["radial_velocity"], known.velocity, atol=1e-4)
    np.testing.assert_allclose(found["snr"], known.snr, rtol=1e-4, atol=1e-6)
    if kind not in ("arm", "csv"):
        np.testing.assert_allclose(found["spectral_width"], known.width, atol=1e-4)
    assert found["radial_velocity"].attrs["units"] == "m s-1"
    assert found["radial_velocity"].attrs["standard_name"].endswith("away_from_instrument")
    assert found.attrs["scan"] == "ppi"
    valid = (found["flag"] == 0).values
    if kind in ("halo", "arm"):
        assert valid[:, 3:].all() and not valid[:, :3].any()
    elif kind == "windcube":
        assert valid.sum() == valid.size - 1 and found["flag"][0, -1] == LineFlag.REJECTED
    else:
        assert valid.all()
    assert found.attrs["remarks"] == ""


def test_written_data_sets_are_read_again(known, tmp_path):
    path = tmp_path / "a.hpl"
    write("halo", path, known)
    first = lm.read_lines_of_sight(path)
    write_netcdf(first, tmp_path / "b.nc")
    again = lm.read_lines_of_sight(tmp_path / "b.nc", blind_range=90.0)
    for name in ("radial_velocity", "snr", "spectral_width", "flag", "azimuth", "pitch", "time"):
        np.testing.assert_array_equal(again[name], first[name])


# --- Halo Photonics --------------------------------------------------------------------------


def test_a_ray_that_the_header_promises_and_the_file_lacks_is_remarked(known, tmp_path):
    path = tmp_path / "a.hpl"
    write("halo", path, known, promised=9)
    found = lm.read_lines_of_sight(path)
    assert found.sizes["time"] == 6
    assert found.attrs["remarks"] == "a.hpl: the header promises 9 rays, the file has 6"


@pytest.mark.parametrize(("width", "tilt"), [(True, False), (False, True), (False, False)])
def test_columns_that_halo_files_may_lack(known, tmp_path, width, tilt):
    path = tmp_path / "a.hpl"
    write("halo", path, known, width=width, tilt=tilt)
    found = lm.read_lines_of_sight(path)
    assert ("spectral_width" in found) == width and ("pitch" in found.coords) == tilt
    np.testing.assert_allclose(found["radial_velocity"], known.velocity, atol=1e-4)
    if tilt:
        assert float(found["roll"][0]) == -0.51


def test_hours_go_on_over_midnight_and_360_degrees_are_north(known, tmp_path):
    path = tmp_path / "a.hpl"
    known.azimuth[0] = 360.0
    hours = np.mod(23.999 + known.seconds / 3600, 24)
    assert (np.diff(hours) < 0).sum() == 1
    write("halo", path, known, start="20210624 23:59:50.00", hours=hours)
    found = lm.read_lines_of_sight(path)
    steps = np.diff(found["time"].values).astype("int64") / 1e9
    np.testing.assert_allclose(steps, 2.0, atol=1e-3)
    assert str(found["time"].values[-1]).startswith("2021-06-25T00:00")
    assert float(found["azimuth"][0]) == 0.0 and found.attrs["remarks"] == ""


def test_overlapping_gates_begin_at_every_sample(known, tmp_path):
    path = tmp_path / "a.hpl"
    write("halo", path, known, scan="VAD - overlapping", length=90.0, points=30)
    np.testing.assert_allclose(lm.read_lines_of_sight(path)["range"], 45 + 3.0 * np.arange(20))


@settings(max_examples=40, deadline=None, derandomize=True)
@given(st.data())
def test_truncated_or_damaged_halo_files_give_a_line_or_what_can_be_read(tmp_path_factory, data):
    """Whatever is read before the cut is as it was; what is missing is flagged and remarked."""
    known = made.lines(3, 8)
    text = made.halo_text(known)
    cut = data.draw(st.integers(0, len(text) - 1))
    junk = data.draw(st.sampled_from(["", "*", "nan nan", "\x1b[31m", "9 x y z", "\r\n\r\n1e999"]))
    path = tmp_path_factory.mktemp("cut") / "a.hpl"
    path.write_text(text[:cut] + junk, newline="")
    try:
        found = lm.read_lines_of_sight(path)
    except lm.InputError as error:
        assert "a.hpl" in str(error) and len(str(error)) < 300
        return
    # the last ray and its last gate may be cut within a number
    whole = text[:cut].count("\r\n") - made.halo_text(known).split("****")[0].count("\r\n") - 1
    rays = whole // 9
    np.testing.assert_allclose(
        found["radial_velocity"].values[:rays], known.velocity[:rays], atol=1e-4
    )
    assert whole >= 26 or found.attrs["remarks"]
    missing = ~np.isfinite(found["radial_velocity"].values)
    assert ((found["flag"].values & LineFlag.MISSING) > 0)[missing].all()


def test_gates_that_are_missing_within_a_file_are_flagged(known, tmp_path):
    text = made.halo_text(known).splitlines()
    first = next(k for k, line in enumerate(text) if line.startswith("****")) + 1
    del text[first + 5]  # gate 4 of ray 1
    text[first + 30] = text[first + 30][:4] + "*" * 6 + text[first + 30][11:]
    (tmp_path / "a.hpl").write_text("\n".join(text))
    found = lm.read_lines_of_sight(tmp_path / "a.hpl")
    assert found.sizes["time"] == 6 and int((found["flag"].values & 1).sum()) == 2
    assert "1 of 6 rays have fewer than 20 gates" in found.attrs["remarks"]
    assert "1 gates are no numbers" in found.attrs["remarks"]


# --- NetCDF ----------------------------------------------------------------------------------


def test_lines_of_dbs_with_ranges_of_their_own(tmp_path):
    known = made.lines(5)
    known.elevation[4] = 90.0
    made.write_windcube(tmp_path / "a.nc", known, dbs=True, reference=False)
    found = lm.read_lines_of_sight(tmp_path / "a.nc")
    assert found.attrs["scan"] == "dbs" and found.sizes["range"] == 40
    for k in range(5):
        there = np.isfinite(found["radial_velocity"].values[k])
        np.testing.assert_allclose(
            found["radial_velocity"].values[k, there], known.velocity[k], rtol=1e-6
        )
        scale = np.sin(np.deg2rad(75)) if k == 4 else 1.0
        np.testing.assert_allclose(found["range"].values[there], known.range * scale, atol=0.006)
    assert ((found["flag"].values & LineFlag.MISSING) > 0).sum() == 100


def test_velocities_toward_the_lidar_change_their_sign(known, tmp_path):
    made.write_cfradial1(tmp_path / "a.nc", known, sign=-1)
    np.testing.assert_allclose(
        lm.read_lines_of_sight(tmp_path / "a.nc")["radial_velocity"], known.velocity, rtol=1e-6
    )
    (tmp_path / "b.csv").write_text(made.csv_text(known, sign=-1))
    names = {"radial_velocity": "-v_r", "snr": "CNR"}
    found = lm.read_lines_of_sight(tmp_path / "b.csv", names=names)
    np.testing.assert_allclose(found["radial_velocity"], known.velocity, atol=1e-5)


def test_rays_of_different_lengths_and_sweeps_of_cfradial_1(known, tmp_path):
    made.write_cfradial1(tmp_path / "a.nc", known, ragged=True, sweeps=2)
    found = lm.read_lines_of_sight(tmp_path / "a.nc")
    for k in range(6):
        count = 20 - k % 3
        np.testing.assert_allclose(
            found["radial_velocity"].values[k, :count], known.velocity[k, :count], rtol=1e-6
        )
        assert np.isnan(found["radial_velocity"].values[k, count:]).all()
    assert found["sweep"].values.tolist() == [0, 0, 0, 1, 1, 1]


def test_quality_bits_of_arm_reject_and_keep_the_value(known, tmp_path):
    known.velocity[2, 7] = 25.0  # beyond valid_max
    made.write_arm(tmp_path / "a.cdf", known, missing=[(2, 7)])
    found = lm.read_lines_of_sight(tmp_path / "a.cdf")
    assert float(found["radial_velocity"][2, 7]) == 25.0
    assert int(found["flag"][2, 7]) == LineFlag.REJECTED and int(found["flag"][2, 8]) == 0
    assert float(found["altitude"]) == 317.0


def test_names_of_other_files(known, tmp_path):
    made.write_cfradial1(tmp_path / "a.nc", known)
    with xr.open_dataset(tmp_path / "a.nc", decode_times=False) as data:
        other = data.rename(VR="my_speed", azimuth="bearing").load()
    del other["my_speed"].attrs["standard_name"]
    write_netcdf(other, tmp_path / "b.nc")
    with pytest.raises(lm.InputError, match="azimuth is missing; it has"):
        lm.read_lines_of_sight(tmp_path / "b.nc")
    names = {"azimuth": "bearing", "radial_velocity": "my_speed"}
    found = lm.read_lines_of_sight(tmp_path / "b.nc", names=names)
    np.testing.assert_allclose(found["radial_velocity"], known.velocity, rtol=1e-6)


@pytest.mark.slow
@settings(max_examples=25, deadline=None, derandomize=True)
@given(st.sampled_from(["arm", "windcube", "cfradial1", "cfradial2"]), st.integers(0, 2**31))
def test_damaged_netcdf_files_give_a_line_or_what_can_be_read(tmp_path_factory, kind, seed):
    folder = tmp_path_factory.mktemp("cut")
    path = folder / f"a{KINDS[kind]}"
    write(kind, path, made.lines(4, 6))
    content, random = bytearray(path.read_bytes()), np.random.default_rng(seed)
    if random.random() < 0.5:
        content = content[: random.integers(len(content))]
    for _ in range(random.integers(4)):
        if content:
            content[random.integers(len(content))] = random.integers(256)
    path.write_bytes(content)
    try:
        lm.read_lines_of_sight(path)
    except lm.InputError as error:
        assert len(str(error)) < 300


@pytest.mark.parametrize("separator", [",", ";", "\t"])
def test_separators_of_tables_and_comments(known, tmp_path, separator):
    text = "# of a lidar\n" + made.csv_text(known).replace(",", separator)
    (tmp_path / "a.csv").write_text(text)
    found = lm.read_lines_of_sight(tmp_path / "a.csv", names={"radial_velocity": "v_r"})
    np.testing.assert_allclose(found["radial_velocity"], known.velocity, atol=1e-5)


# --- faults ----------------------------------------------------------------------------------


def test_ranges_in_kilometres(known, tmp_path):
    write("csv", tmp_path / "a.csv", known, km=True)
    names = {"radial_velocity": "v_r"}
    found = lm.read_lines_of_sight(tmp_path / "a.csv", names=names)
    np.testing.assert_allclose(found["range"], known.range, atol=0.006)
    text = (tmp_path / "a.csv").read_text().replace("[km]", "[m]")
    (tmp_path / "b.csv").write_text(text)
    with pytest.raises(lm.InputError, match=r"b.csv: range: up to 0.585 m, shorter than a pulse"):
        lm.read_lines_of_sight(tmp_path / "b.csv", names=names)


def test_degrees_beyond_a_turn_and_times_that_go_back_are_remarked(known, tmp_path):
    known.azimuth[1] += 720.0
    known.seconds[4] = 1.0
    write("halo", tmp_path / "a.hpl", known)
    found = lm.read_lines_of_sight(tmp_path / "a.hpl")
    assert (np.diff(found["time"].values) > np.timedelta64(0)).all()
    np.testing.assert_allclose(found["azimuth"], [0, 240, 60, 120, 180, 300])
    np.testing.assert_allclose(found["radial_velocity"][1], known.velocity[4], atol=1e-4)
    assert "azimuth: 780 degrees" in found.attrs["remarks"]
    assert "time goes back 1 times within a scan" in found.attrs["remarks"]


def test_scans_that_overlap_or_come_twice_are_kept_and_remarked(known, tmp_path):
    write("halo", tmp_path / "a.hpl", known)
    known.seconds += 5.0
    write("halo", tmp_path / "b.hpl", known)
    found = lm.read_lines_of_sight([tmp_path / "b.hpl", tmp_path / "a.hpl"])
    assert found.sizes["time"] == 12
    assert "scans overlap in time: a.hpl and b.hpl" in found.attrs["remarks"]
    twice = lm.read_lines_of_sight([tmp_path / "a.hpl", tmp_path / "a.hpl"])
    assert twice.sizes["time"] == 12
    assert "6 lines have the time and the direction of another" in twice.attrs["remarks"]


def test_lines_without_a_direction_are_remarked(known, tmp_path):
    known.azimuth[2] = np.nan
    made.write_windcube(tmp_path / "a.nc", known)
    found = lm.read_lines_of_sight(tmp_path / "a.nc")
    np.testing.assert_allclose(found["azimuth"], [0, 60, 180, 240, 300])
    assert "1 of 6 lines have no time or direction" in found.attrs["remarks"]
    known.azimuth[:] = np.nan
    made.write_windcube(tmp_path / "a.nc", known)
    with pytest.raises(lm.InputError, match="no line of sight, of 6, has a time"):
        lm.read_lines_of_sight(tmp_path / "a.nc")


def test_gates_without_any_value_are_remarked(known, tmp_path):
    known.velocity[:, 12:15] = np.nan
    write("cfradial1", tmp_path / "a.nc", known)
    found = lm.read_lines_of_sight(tmp_path / "a.nc")
    assert "3 gates, 375 to 435 m, have no value in any line" in found.attrs["remarks"]
    assert (found["flag"].values[:, 12:15] == LineFlag.MISSING).all()


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.hpl", "hello", "has no line that begins with ****"),
        ("a.hpl", "", "has no line that begins with ****"),
        ("a.csv", "a,b\n1,2\n", "column 'time' (time) is missing"),
        ("a.csv", "", "not a table"),
        ("a.grib", "x", ".grib is no kind of lines of sight"),
        ("a.nc", "x", "is not NetCDF"),
        (
            "a.csv",
            "time,azimuth,elevation,range,radial_velocity\n0,0,90,100,a\n",
            "radial_velocity: 'a' in row 1 is not allowed",
        ),
        (
            "a.csv",
            "time,azimuth,elevation,range,radial_velocity\n0,0,90,100,1\n0,0,90,100,2\n",
            "row 2: a second value for one line and gate",
        ),
    ],
)
def test_what_is_no_file_of_lines_says_so_in_a_line(tmp_path, name, content, message):
    path = tmp_path / name
    path.write_text(content)
    with pytest.raises(lm.InputError, match=re.escape(message)):
        lm.read_lines_of_sight(path)


def test_header_values_that_are_no_numbers(known, tmp_path):
    text = made.halo_text(known)
    for old, new, message in (
        ("gates:\t20", "gates:\tmany", "Number of gates: 'many'"),
        ("gates:\t20", "gates:\t0", "0 gates"),
        ("20210624 17:00:00.00", "yesterday", "Start time: 'yesterday'"),
    ):
        (tmp_path / "a.hpl").write_text(text.replace(old, new))
        with pytest.raises(lm.InputError, match=message):
            lm.read_lines_of_sight(tmp_path / "a.hpl")


def test_lidars_at_two_places_are_refused(known, tmp_path):
    made.write_arm(tmp_path / "a.cdf", known)
    made.write_cfradial1(tmp_path / "b.nc", known)
    with pytest.raises(lm.InputError, match=r"latitude: 36.605 and 47.1 degrees"):
        lm.read_lines_of_sight([tmp_path / "a.cdf", tmp_path / "b.nc"])
    with pytest.raises(lm.InputError, match="names: 'speed' is not known"):
        lm.read_lines_of_sight(tmp_path / "a.cdf", names={"speed": "v"})
    with pytest.raises(lm.InputError, match="range_step"):
        lm.read_lines_of_sight(tmp_path / "a.cdf", range_step=-1.0)


def test_info_says_what_a_file_is(known, tmp_path):
    write("halo", tmp_path / "a.hpl", known, promised=9)
    made.write_windcube(tmp_path / "b.nc", known)
    for name, kind, remark in (
        ("a.hpl", "Halo Photonics (hpl), ppi", "promises 9 rays"),
        ("b.nc", "WindCube, ppi", ""),
    ):
        (title, rows), *_ = sections(str(tmp_path / name))
        table = dict(rows)
        assert title == f"{tmp_path / name}: lines of sight, {kind}"
        assert table["lines"] == "6, 10 s" and table["range"] == "15 ... 585 m, 20 gates"
        assert table["azimuth"] == "0 ... 300 degrees" and table["elevation"] == "75 degrees"
        assert remark in table.get("remark", "")


# --- flags -----------------------------------------------------------------------------------


def test_weak_signals_and_near_gates_by_thresholds(known, tmp_path):
    known.snr[:, 10:] = 0.01
    known.snr[:, 15:] = 0.007
    made.write_cfradial1(tmp_path / "a.nc", known)
    flag = lm.read_lines_of_sight(tmp_path / "a.nc")["flag"].values
    assert (flag[:, :15] == 0).all() and (flag[:, 15:] == LineFlag.LOW_CNR).all()
    found = lm.read_lines_of_sight(tmp_path / "a.nc", min_cnr=-15.0, blind_range=100.0)
    assert (found["flag"].values[:, 10:] == LineFlag.LOW_CNR).all()
    assert (found["flag"].values[:, :3] == LineFlag.BLIND_RANGE).all()
    assert found.attrs["min_cnr"] == -15.0 and found.attrs["blind_range"] == 100.0


def test_a_building_is_a_hard_target_and_a_cloud_is_not(tmp_path):
    known = made.lines(elevation=3.0, gates=40)
    known.snr[2, 20] *= 100
    known.velocity[2, 20] = 0.05
    known.snr[3, 20] *= 100  # as bright, but it moves
    known.snr[4, 20:] *= 1.5  # more aerosol, at rest
    known.velocity[4, 20:] = 0.0
    made.write_cfradial1(tmp_path / "a.nc", known)
    flag = lm.read_lines_of_sight(tmp_path / "a.nc")["flag"].values
    hard = (flag & LineFlag.HARD_TARGET) > 0
    assert hard[2, 19:].all() and hard.sum() == 21
    steep = made.lines(elevation=75.0, gates=40)
    steep.snr[:, 20] *= 100
    steep.velocity[:, 20] = 0.05
    made.write_cfradial1(tmp_path / "b.nc", steep)
    assert (lm.read_lines_of_sight(tmp_path / "b.nc")["flag"] == 0).all()


def test_the_reflection_of_the_pulse_is_found_where_a_scan_shows_it(tmp_path):
    known = made.lines(8, elevation=60.0, gates=30)
    known.velocity[:, :2] = 0.15
    made.write_cfradial1(tmp_path / "a.nc", known)
    found = lm.read_lines_of_sight(tmp_path / "a.nc")
    # and the gate in which it mixes with the air
    assert (found["flag"].values[:, :3] == LineFlag.BLIND_RANGE).all()
    assert (found["flag"].values[:, 3:] == 0).all()
    assert "the first 3 gates, to 75 m, measure the same velocity" in found.attrs["remarks"]
    calm = made.lines(8, elevation=60.0, gates=30, wind=(0.0, 0.0, 0.3))
    made.write_cfradial1(tmp_path / "b.nc", calm)
    assert (lm.read_lines_of_sight(tmp_path / "b.nc")["flag"] == 0).all()


@pytest.mark.parametrize(
    ("azimuth", "elevation", "kind"),
    [
        ([10.0] * 5, [90.0] * 5, "stare"),
        ([0.0, 359.99, 0.01], [90.0, 90.01, 89.99], "stare"),
        (np.arange(0, 360, 45), [60.0] * 8, "ppi"),
        (np.arange(0, 40, 2), [3.0] * 20, "ppi"),
        ([30.0] * 40, np.arange(0, 20, 0.5), "rhi"),
        ([30.0] * 90 + [210.0] * 89, [*range(90), *range(89, 0, -1)], "rhi"),
        ([0, 90, 180, 270, 0], [75, 75, 75, 75, 90], "dbs"),
        ([0, 90, 180, 270], [75.0] * 4, "dbs"),
    ],
)
def test_how_a_lidar_scans(azimuth, elevation, kind):
    assert scan_kind(np.asarray(azimuth, float), np.asarray(elevation, float)) == kind


# --- real files ------------------------------------------------------------------------------

real = pytest.mark.skipif(not REAL.is_dir(), reason="needs real files")


@real
def test_real_halo_files():
    (vad,) = REAL.glob("soverato*.hpl")
    found = lm.read_lines_of_sight(vad)
    assert dict(found.sizes) == {"time": 2, "range": 400}
    assert "promises 6 rays, the file has 2" in found.attrs["remarks"]
    np.testing.assert_allclose(found["radial_velocity"][0, :3], [-0.5351, -26.7543, -0.2293])
    np.testing.assert_allclose(found["snr"][0, 3], 0.380099, atol=1e-6)
    assert float(found["azimuth"][0]) == 0.0 and float(found["roll"][0]) == -0.51
    widths = {}
    for path in REAL.glob("*Stare*.hpl"):
        found = lm.read_lines_of_sight(path)
        assert found.attrs["scan"] == "stare" and found.attrs["remarks"] == ""
        widths[path.name.split("-")[0]] = "spectral_width" in found
    assert widths == {"eriswil": False, "hyytiala": False, "warsaw": True}


@real
def test_real_arm_file():
    (ppi,) = REAL.glob("*.cdf")
    found = lm.read_lines_of_sight(ppi)
    assert found.attrs["scan"] == "ppi" and dict(found.sizes) == {"time": 8, "range": 4000}
    # range_step of the file is 30 m, which would reach to 120 km
    assert "steps of 3 m are used" in found.attrs["remarks"]
    np.testing.assert_allclose(found["range"][[0, -1]], [15, 12012])
    blind = ((found["flag"].values & LineFlag.BLIND_RANGE) > 0).all(0)
    assert blind[found["range"] < 90].all() and not blind[found["range"] > 90].any()


def test_cfradial_is_read_by_its_documented_names(tmp_path):
    """By plain xarray, and back by the reader of others' files; of two sweeps, one is an RHI."""
    paths = [tmp_path / "a.hpl", tmp_path / "b.hpl"]
    circle = made.lines()
    slices = replace(
        circle,
        seconds=circle.seconds + 100,
        azimuth=np.full_like(circle.azimuth, 30.0),
        elevation=np.linspace(5.0, 40.0, circle.elevation.size),
    )
    for path, one in zip(paths, (circle, slices), strict=True):
        path.write_text(made.halo_text(one))
    lines = lm.read_lines_of_sight(paths)
    lm.write_cfradial(lines, tmp_path / "c.nc")
    with xr.open_dataset(tmp_path / "c.nc", engine="h5netcdf") as data:
        assert data.attrs["Conventions"].startswith("CF/Radial")
        modes = [one.decode() for one in data["sweep_mode"].values]
        assert modes == ["azimuth_surveillance", "rhi"]
        np.testing.assert_allclose(data["fixed_angle"], [circle.elevation[0], 30.0], atol=0.01)
        half = circle.azimuth.size
        assert data["sweep_start_ray_index"].values.tolist() == [0, half]
        assert data["sweep_end_ray_index"].values.tolist() == [half - 1, 2 * half - 1]
        velocity = data["radial_velocity"]
        assert velocity.attrs["standard_name"].endswith("_away_from_instrument")
        np.testing.assert_array_equal(velocity, lines["radial_velocity"])
        np.testing.assert_allclose(10 ** (data["snr"] / 10), lines["snr"], rtol=1e-5)
        assert (data["time"].values == lines["time"].values).all()
    back = lm.read_lines_of_sight(tmp_path / "c.nc")
    assert (
        back.attrs["kind"] == "CfRadial 1"
        and back["sweep"].values.tolist() == lines["sweep"].values.tolist()
    )
    for name in ("radial_velocity", "azimuth", "elevation", "range"):
        np.testing.assert_allclose(back[name], lines[name], atol=1e-5)
    with pytest.raises(lm.InputError, match="lines: azimuth is missing"):
        lm.write_cfradial(lines.drop_vars("azimuth"), tmp_path / "d.nc")


def test_a_lidar_that_moves_is_remarked_on(tmp_path):
    """A ship that sails north at 10 m/s: 1852 m are a minute of latitude."""
    known = made.lines()
    data = made._cfradial(known)
    way = 10.0 * known.seconds
    data["latitude"] = "time", 47.0 + way / 1852 / 60
    data["longitude"] = "time", np.full(way.size, 8.0)
    data.attrs = {"Conventions": "CF/Radial", "version": "1.4"}
    data.to_netcdf(tmp_path / "ship.nc", engine="h5netcdf")
    remarks = lm.read_lines_of_sight(tmp_path / "ship.nc").attrs["remarks"]
    assert f"the lidar moves by {way[-1] - way[0]:.0f} m (10 m/s): winds are off by" in remarks
    anchored = data.assign(latitude=data["latitude"] * 0 + 47.0)
    anchored.to_netcdf(tmp_path / "quay.nc", engine="h5netcdf")
    assert "moves" not in lm.read_lines_of_sight(tmp_path / "quay.nc").attrs["remarks"]
