"""Conventions that instruments write: sign, tilt, time, units, numbers instead of measurements.

Physics: written with a known wind in one convention, read as that wind, or said in one line. Every
test fails if the reader takes the convention for its own.
"""

import numpy as np
import pytest
import xarray as xr

import lidar_mi as lm
from lidar_mi.flags import LineFlag
from lidar_mi.io.lines_of_sight.flags import repeated
from lidar_mi.io.lines_of_sight.scan import toward_in_words

RANGES = 105 + 30.0 * np.arange(26)
HEAD = "time [s],azimuth [deg],elevation [deg],range [m],radial_velocity [m/s]"
WIND = np.array([6.0, -3.0, 0.0])


def line(azimuth, wind=WIND, elevation=60.0):
    a, e = np.deg2rad(azimuth), np.deg2rad(elevation)
    unit = np.stack([np.sin(a) * np.cos(e), np.cos(a) * np.cos(e), np.sin(e) + 0 * a], -1)
    return unit @ np.asarray(wind)


def vad(seed=3, lines=12, wind=WIND):
    speed = line(np.arange(lines) * 360 / lines, wind)[:, None]
    return speed + 0.1 * np.random.default_rng(seed).standard_normal((lines, RANGES.size))


def table(path, velocity, head=HEAD, times=None, more=""):
    times = 4 * np.arange(len(velocity)) if times is None else times
    rows = [
        f"{t},{360 * k / len(velocity)},60,{r},{v:.3f}{more}"
        for k, (t, line) in enumerate(zip(times, velocity, strict=True))
        for r, v in zip(RANGES, line, strict=True)
    ]
    path.write_text(head + "\n" + "\n".join(rows))
    return path


def netcdf(path, velocity, words=None, **more):
    xr.Dataset(
        {
            "radial_velocity": (("time", "range"), velocity, {"units": "m/s", **(words or {})}),
            "azimuth": ("time", 360 / len(velocity) * np.arange(len(velocity)), {"units": "deg"}),
            "elevation": ("time", np.full(len(velocity), 60.0), {"units": "deg"}),
            **more,
        },
        {
            "time": ("time", 4.0 * np.arange(len(velocity)), {"units": "seconds since 2024-01-05"}),
            "range": ("range", RANGES, {"units": "m"}),
        },
    ).to_netcdf(path, engine="h5netcdf")
    return path


def assert_wind(lines, wind=WIND, least=0.95):
    found = lm.fit_winds_to_lines(lines)
    valid = (found["flag"] == 0).values
    assert valid.mean() >= least
    for name, true in zip("uvw", wind, strict=True):
        off = (found[name] - true).values[valid] / found[f"{name}_stderr"].values[valid]
        assert np.mean(np.abs(off) > 4) <= 0.01
    return found


@pytest.mark.parametrize(
    "words, toward",
    [
        ("Doppler velocity, positive towards the lidar", True),
        ("negative away from instrument", True),
        ("motion toward the radar is positive", True),
        ("positive for motion away from the lidar; negative toward it", False),
        ("approaching targets have positive velocities", True),
        ("radial velocity", None),
        ("velocity toward or away from the lidar", None),
        ("positive toward the lidar. In raw files, positive away", None),
    ],
)
def test_words_of_the_sign(words, toward):
    assert toward_in_words(words) is toward


def test_sign_in_words_is_used_and_said(tmp_path):
    words = {"comment": "negative away from instrument"}
    path = netcdf(tmp_path / "a.nc", -vad(), words)
    lines = lm.read_lines_of_sight(path)
    assert "the sign is reversed" in lines.attrs["remarks"]
    assert_wind(lines)
    # whoever knows better has the last word
    again = lm.read_lines_of_sight(path, names={"radial_velocity": "+radial_velocity"})
    np.testing.assert_allclose(again["radial_velocity"], -lines["radial_velocity"])
    commented = "# radial velocities are positive toward the lidar\n" + HEAD
    lines = lm.read_lines_of_sight(table(tmp_path / "a.csv", -vad(), commented))
    assert "comment" in lines.attrs["remarks"]
    assert_wind(lines)


def test_words_that_contradict_the_standard_name_are_a_question(tmp_path):
    words = {
        "standard_name": "radial_velocity_of_scatterers_away_from_instrument",
        "long_name": "positive toward the lidar",
    }
    lines = lm.read_lines_of_sight(netcdf(tmp_path / "a.nc", vad(), words))
    assert "which is right?" in lines.attrs["remarks"] and "'-radial" in lines.attrs["remarks"]
    assert_wind(lines)


@pytest.mark.parametrize("pitch, roll", [(3.0, 0.0), (0.3, 0.0), (0.0, -2.0), (-1.0, 1.5)])
def test_tilt_is_applied(tmp_path, pitch, roll):
    # the beam of a platform: about the right axis by the pitch after the front axis by the roll
    azimuth, (p, r) = np.deg2rad(np.arange(24) * 15), np.deg2rad([pitch, roll])
    up = np.sin(np.deg2rad(60))
    beam = np.stack([np.sin(azimuth) / 2, np.cos(azimuth) / 2, up + 0 * azimuth])
    about_front = [[np.cos(r), 0, np.sin(r)], [0, 1, 0], [-np.sin(r), 0, np.cos(r)]]
    about_right = [[1, 0, 0], [0, np.cos(p), -np.sin(p)], [0, np.sin(p), np.cos(p)]]
    beam = np.array(about_right) @ np.array(about_front) @ beam
    wind = np.array([6.0, -10.0, 0.0])
    noise = 0.1 * np.random.default_rng(3).standard_normal((24, RANGES.size))
    head = HEAD + ",pitch [deg],roll [deg]"
    path = table(tmp_path / "a.csv", (wind @ beam)[:, None] + noise, head, more=f",{pitch},{roll}")
    lines = lm.read_lines_of_sight(path)
    assert "are applied" in lines.attrs["remarks"]
    found = assert_wind(lines, wind)
    assert float(found["w_stderr"].median()) < 0.1


@pytest.mark.parametrize(
    "encoding, of",
    [
        ("MATLAB", lambda t: 719529 + t / 86400),
        ("LabVIEW", lambda t: 2082844800 + t),
        ("milliseconds", lambda t: 1000 * t),
        ("spreadsheets", lambda t: 25569 + t / 86400),
        ("Julian", lambda t: 2440587.5 + t / 86400),
    ],
)
def test_times_without_a_unit(tmp_path, encoding, of):
    true = 1704456000.0 + 4 * np.arange(12)
    head = HEAD.replace("time [s]", "time")
    path = table(tmp_path / "a.csv", vad(), head, [f"{of(t):.9f}" for t in true])
    lines = lm.read_lines_of_sight(path)
    assert encoding in lines.attrs["remarks"]
    # a day as float64 is known to 40 us
    off = lines["time"].values - true.astype("datetime64[s]")
    assert np.abs(off / np.timedelta64(1, "ms")).max() < 1


def test_times_that_are_no_time_are_refused(tmp_path):
    head = HEAD.replace("time [s]", "time")
    path = table(tmp_path / "a.csv", vad(), head, [f"{1e-5 * k:.6f}" for k in range(12)])
    with pytest.raises(lm.InputError, match="without a unit"):
        lm.read_lines_of_sight(path)


@pytest.mark.parametrize("units", [{"units": "dB"}, {"units": "decibels"}, {}])
def test_signal_in_decibels(tmp_path, units):
    cnr = (("time", "range"), np.full((12, RANGES.size), -5.0), units)
    lines = lm.read_lines_of_sight(netcdf(tmp_path / "a.nc", vad(), cnr=cnr))
    np.testing.assert_allclose(lines["snr"], 10**-0.5, rtol=1e-5)
    assert ("read as dB" in lines.attrs["remarks"]) == (not units)
    name = "snr [decibels]" if units else "snr"
    path = table(tmp_path / "a.csv", vad(), f"{HEAD},{name}", more=",-5")
    np.testing.assert_allclose(lm.read_lines_of_sight(path)["snr"], 10**-0.5, rtol=1e-5)


@pytest.mark.parametrize("wind", [WIND, np.array([12.0, 5.0, 0.0])])
def test_blocked_lines_and_fill_values(tmp_path, wind):
    blocked = vad(wind=wind)
    blocked[:5] = 0.0
    lines = lm.read_lines_of_sight(table(tmp_path / "a.csv", blocked))
    assert (lines["flag"][:5] == LineFlag.REPEATED).all() and (lines["flag"][5:] == 0).all()
    assert_wind(lines, wind)
    filled = vad(wind=wind)
    fill = np.random.default_rng(1).random(filled.shape) < 0.3
    filled[fill] = 0.0
    lines = lm.read_lines_of_sight(table(tmp_path / "b.csv", filled))
    flagged = (lines["flag"] == LineFlag.REPEATED).values
    assert flagged[fill].all() and flagged[~fill].mean() < 0.01
    assert_wind(lines, wind)


def test_measurements_are_not_repeated_numbers():
    # rounded to 0.04 m/s, as of a Halo lidar: calm air, a vertical stare, overlapping gates
    for seed in range(50):
        random = np.random.default_rng(seed)
        for speed in (0.05, 0.3, 3.0):
            air = speed * random.standard_normal((30, 100))
            smooth = np.cumsum(air, axis=1) / 10
            for velocity in (air, smooth):
                found = repeated(np.round(velocity / 0.038) * 0.038)
                assert not found.any()
    # without noise no line varies: nothing can be said
    assert not repeated(np.repeat(line(np.arange(0.0, 360, 7))[:, None], 20, 1)).any()


@pytest.mark.parametrize("samples", [None, 10.0])
def test_steps_of_overlapping_gates_are_corrected(tmp_path, samples):
    # gates of ten samples that begin at every sample, which the file states 30 m apart
    random, lines, gates = np.random.default_rng(5), 48, 3000
    kernel = np.ones(10) / 10
    rows = random.standard_normal((lines, gates + 9))
    noise = np.stack([np.convolve(row, kernel, "valid") for row in rows])
    near = np.arange(gates) < 300
    snr = 0.002 * noise + np.where(near, 1.0, 0.0)
    wind = line(7.5 * np.arange(lines))[:, None] + 0.1 * noise
    velocity = np.where(near, wind, 20 * random.uniform(-1, 1, noise.shape))
    path = tmp_path / "a.nc"
    xr.Dataset(
        {
            "radial_velocity": (("time", "range"), velocity, {"units": "m/s"}),
            "snr": (("time", "range"), snr, {"units": "1"}),
            "azimuth": ("time", 7.5 * np.arange(lines), {"units": "deg"}),
            "elevation": ("time", np.full(lines, 60.0), {"units": "deg"}),
        },
        {
            "time": ("time", 1.0 * np.arange(lines), {"units": "seconds since 2024-01-05"}),
            "range": ("range", 15 + 30.0 * np.arange(gates), {"units": "m"}),
        },
        {} if samples is None else {"samples_per_gate": str(samples)},
    ).to_netcdf(path, engine="h5netcdf")
    found = lm.read_lines_of_sight(path)
    np.testing.assert_allclose(found["range"], 15 + 3.0 * np.arange(gates), atol=0.01)
    assert found.attrs["remarks"].count("steps of 3 m are used") == 1
    given = lm.read_lines_of_sight(path, range_step=30.0)
    assert float(given["range"][1] - given["range"][0]) == 30.0
