"""Winds from scans of a Doppler lidar. Physics tier.

Detects: a component with the wrong sign or axis; standard errors that are too small or too large in
noise, shear, turbulence or with outliers; outliers that are used, or air that is taken for one; a
scan that tells no wind and gets one.
"""

from pathlib import Path

import numpy as np
import pytest
import xarray as xr

import lidar_mi as lm
from lidar_mi.flags import WindFlag
from tests.support import line_winds as made

REAL = Path(__file__).parents[4] / "shared" / "data" / "lines_of_sight"
RANGES = 120 + 30.0 * np.arange(10)
VAD = {"azimuth": 30.0 * np.arange(12), "elevation": 70.0, "seconds": 3.0 * np.arange(12)}
DBS = {"azimuth": [0, 180, 90, 270], "elevation": 70.0, "seconds": 4.0 * np.arange(4)}
PPI = {"azimuth": 6.0 * np.arange(60), "elevation": 35.0, "seconds": 0.5 * np.arange(60)}


@pytest.mark.parametrize("geometry", [VAD, PPI, DBS])
def test_a_uniform_wind_is_found(geometry):
    """u to the east, v to the north, w up: velocities of lines made by their definition."""
    lines, truth = made.scan(made.calm, ranges=RANGES, noise=0.0, **geometry)
    winds = lm.fit_winds_to_lines(lines)
    for k, name in enumerate("uvw"):
        np.testing.assert_allclose(winds[name][0], truth[:, k], atol=1e-6)
    np.testing.assert_allclose(
        winds["height"], RANGES * np.sin(np.deg2rad(geometry["elevation"])), atol=0.01
    )
    speed = np.hypot(*made.MEAN[:2])
    np.testing.assert_allclose(winds["wind_speed"], speed, rtol=1e-6)
    # to the east and the south: from the north west
    assert 270 < float(winds["wind_from_direction"][0, 0]) < 360
    assert (winds["flag"] == 0).all() and (winds["outliers"] == 0).all()


def test_beams_of_two_elevations_are_put_at_common_heights():
    azimuth, elevation = [0, 90, 180, 270, 0], [60.0, 60.0, 60.0, 60.0, 90.0]
    lines, _ = made.scan(made.sheared, azimuth, elevation, RANGES, 4.0 * np.arange(5), noise=0.0)
    winds = lm.fit_winds_to_lines(lines).isel(time=0)
    full = winds.where((winds["lines"] == 5) & (winds["flag"] == 0), drop=True)
    z = full["height"].values
    assert z.size >= 5
    np.testing.assert_allclose(full["w"], made.MEAN[2], atol=1e-3)
    # gates lie within half a step, 15 m, of the middle of their level
    expected = made.MEAN[0] + 3e-2 * z + 2e-5 * z**2
    np.testing.assert_allclose(full["u"], expected, atol=15 * (3e-2 + 4e-5 * z.max()))


def normalised(geometry, wind, seeds, outliers=0.0, **options):
    """Errors over standard errors (n, 3) of valid winds."""
    found = []
    for seed in range(seeds):
        lines, truth = made.scan(wind(5000 + seed), ranges=RANGES, seed=seed, **geometry)
        if outliers:
            random = np.random.default_rng(100 + seed)
            bad = random.random(lines["radial_velocity"].shape) < outliers
            lines["radial_velocity"].values[bad] = random.uniform(-19, 19, bad.sum())
        winds = lm.fit_winds_to_lines(lines, **options).isel(time=0)
        valid = winds["flag"].values == 0
        error = np.stack([winds[c].values - truth[:, k] for k, c in enumerate("uvw")], -1)
        stderr = np.stack([winds[f"{c}_stderr"].values for c in "uvw"], -1)
        found.append((error / stderr)[valid])
    return np.concatenate(found)


FAMILIES = {
    "calm": {"wind": lambda seed: made.calm},
    "shear": {"wind": lambda seed: made.sheared},
    "outliers": {"wind": lambda seed: made.calm, "outliers": 0.1},
    "turbulence": {"wind": lambda seed: made.turbulent(seed, 0.8, 120.0)},
    "large eddies": {"wind": lambda seed: made.turbulent(seed, 0.8, 400.0)},
    "Kolmogorov": {"wind": lambda seed: made.turbulent(seed, 0.8, 150.0, "kolmogorov")},
    "turbulence, outliers": {
        "wind": lambda seed: made.turbulent(seed, 0.8, 120.0),
        "outliers": 0.1,
    },
}


@pytest.mark.slow
def test_stated_errors_hold_over_families_of_wind():
    """Of all families together 68 and 95 % are within 1 and 1.96 standard errors, to 5 points.

    Heights of one scan share their eddies: of each family a fifth of the numbers is independent.
    Of one family alone the length of the turbulence, which the lines hardly tell, moves them.
    """
    inside = []
    for name, family in FAMILIES.items():
        z = np.abs(normalised(VAD, seeds=16, **family))
        one, two = (z < 1).mean(), (z < 1.96).mean()
        inside.append((one, two))
        assert 0.55 < one < 0.86 and 0.88 < two <= 1.0, f"{name}: {one:.2f}, {two:.2f}"
    one, two = np.mean(inside, axis=0)
    assert one == pytest.approx(0.683, abs=0.05) and two == pytest.approx(0.95, abs=0.05)


@pytest.mark.slow
def test_stated_errors_hold_where_the_length_of_the_turbulence_is_known():
    z = normalised(PPI, lambda seed: made.turbulent(seed, 0.8, 400.0), 16, length_scale=400.0)
    assert (np.abs(z) < 1).mean() == pytest.approx(0.683, abs=0.1)
    assert (np.abs(z) < 1.96).mean() == pytest.approx(0.95, abs=0.05)


def test_five_beams_tell_air_from_outliers():
    """Of two residuals the smaller one is no spread; errors of 24 scans hold to 3 sigma."""
    beams = {"azimuth": [0, 90, 180, 270, 0], "elevation": [62.0, 62, 62, 62, 90.0]}
    beams["seconds"] = 2.0 * np.arange(5)
    z = np.abs(normalised(beams, lambda seed: made.turbulent(seed, 0.5, 120.0), 24))
    assert len(z) > 0.75 * 24 * len(RANGES)
    assert (z < 1).mean() == pytest.approx(0.683, abs=0.2)
    assert (z < 1.96).mean() == pytest.approx(0.95, abs=0.09)


def test_errors_from_stated_noise_alone():
    """Three beams have no residual: the error is that of the noise, exactly."""
    three = {"azimuth": [0, 120, 240], "elevation": 60.0, "seconds": 2.0 * np.arange(3)}
    lines, _ = made.scan(made.calm, ranges=RANGES, noise=0.1, **three)
    unknown = lm.fit_winds_to_lines(lines)
    assert (unknown["flag"] == WindFlag.ERROR_UNKNOWN).all() and np.isnan(unknown["u_stderr"]).all()
    winds = lm.fit_winds_to_lines(lines, noise=0.1)
    # of three beams around: s sqrt(2/3) / cos, s / (sqrt(3) sin)
    cos, sin = np.cos(np.deg2rad(60)), np.sin(np.deg2rad(60))
    np.testing.assert_allclose(winds["u_stderr"], 0.1 * np.sqrt(2 / 3) / cos, rtol=1e-5)
    np.testing.assert_allclose(winds["w_stderr"], 0.1 / np.sqrt(3) / sin, rtol=1e-5)
    # 600 numbers of 20 scans, three independent ones a height
    z = np.abs(normalised(three, lambda seed: made.calm, 20, noise=0.1))
    assert (z < 1).mean() == pytest.approx(0.683, abs=4 * np.sqrt(0.683 * 0.317 / z.size))


def test_stated_noise_is_the_least_error():
    """Velocities that agree better than their noise allows get no smaller error."""
    lines, _ = made.scan(made.calm, ranges=RANGES, noise=0.001, **VAD)
    small = lm.fit_winds_to_lines(lines)
    winds = lm.fit_winds_to_lines(lines, noise=0.2)
    bound = 0.2 * np.sqrt(2 / 12) / np.cos(np.deg2rad(70))
    assert (winds["u_stderr"] > 0.9 * bound).all() and (winds["u_stderr"] < 2 * bound).all()
    assert (small["u_stderr"] < 0.05 * bound).all()


def test_outliers_are_left_out_and_air_is_not():
    lines, truth = made.scan(made.turbulent(1), ranges=RANGES, **PPI)
    random = np.random.default_rng(2)
    bad = random.random((60, 10)) < 0.2
    velocity = lines["radial_velocity"].values
    clean = lm.fit_winds_to_lines(lines).isel(time=0)
    assert int(clean["outliers"].sum()) <= 6  # of 600
    velocity[bad] = random.uniform(-19, 19, bad.sum())
    winds = lm.fit_winds_to_lines(lines).isel(time=0)
    # what is uniform in +-19 m/s is within a few m/s of the truth now and then
    assert 0.65 * bad.sum() < int(winds["outliers"].sum()) < 1.02 * bad.sum() + 6
    for k, name in enumerate("uvw"):
        # lines that are left out, and those that cannot be told, move it by less than its error
        assert (np.abs(winds[name] - clean[name]) < winds[f"{name}_stderr"]).all()
        assert (np.abs(winds[name] - truth[:, k]) < 4 * winds[f"{name}_stderr"]).all()
    velocity[:, 3] = random.uniform(-19, 19, 60)
    assert int(lm.fit_winds_to_lines(lines)["flag"][0, 3]) & WindFlag.OUTLIERS


def test_a_few_lines_above_the_threshold_are_noise():
    lines, _ = made.scan(made.calm, ranges=RANGES, **VAD)
    flag = lines["flag"].values
    flag[:7, 6:] = 4  # 5 of 12 are left
    flag[:6, 5] = 4
    winds = lm.fit_winds_to_lines(lines).isel(time=0)
    assert (winds["flag"][:6] == 0).all()
    assert (winds["flag"][6:] == WindFlag.TOO_FEW_LINES).all() and np.isnan(winds["u"][6:]).all()


def test_profiles_of_scans_and_of_intervals():
    lines, _ = made.scan(made.calm, ranges=RANGES, **VAD)
    later = lines.assign_coords(time=lines["time"] + np.timedelta64(600, "s"))
    both = xr.concat(
        [one.assign_coords(sweep=("time", np.full(12, k))) for k, one in enumerate((lines, later))],
        "time",
    )
    winds = lm.fit_winds_to_lines(both)
    assert winds.sizes["time"] == 2
    assert float(np.diff(winds["time"].values)[0] / np.timedelta64(1, "s")) == 600
    assert lm.fit_winds_to_lines(both, interval=1200.0).sizes["time"] == 1
    assert lm.fit_winds_to_lines(both, interval=300.0).sizes["time"] == 2


def test_many_cycles_of_beams_are_one_profile():
    """Ten minutes of a DBS: averages are of beams of one direction, not of successive ones."""
    azimuth = np.tile([0, 90, 180, 270], 40)
    z, stderr = [], []
    for seed in range(6):
        lines, truth = made.scan(
            made.turbulent(seed), azimuth, 70.0, RANGES[:5], 4.0 * np.arange(160), seed=seed
        )
        winds = lm.fit_winds_to_lines(lines).isel(time=0)
        z += [
            (winds[c].values - truth[:, k]) / winds[f"{c}_stderr"].values
            for k, c in enumerate("uvw")
        ]
        stderr.append(float(winds["u_stderr"].mean()))
    # of 40 cycles of each component, far below 0.8 m/s / cos 70 degrees of one
    assert np.max(stderr) < 0.35
    assert 0.4 < np.mean(np.square(z)) < 2.2


def test_what_tells_no_wind_is_refused_or_flagged():
    stare, _ = made.scan(made.calm, np.zeros(9), 90.0, RANGES, 2.0 * np.arange(9))
    plane, _ = made.scan(made.calm, np.full(9, 30.0), np.linspace(5, 80, 9), RANGES, np.arange(9.0))
    for lines in (stare, plane):
        with pytest.raises(
            lm.InputError, match=r"not in one plane .* 90 of 90 velocities are valid"
        ):
            lm.fit_winds_to_lines(lines)
    noise, _ = made.scan(made.calm, ranges=RANGES[:3], noise=30.0, **VAD)
    assert (lm.fit_winds_to_lines(noise)["flag"].values & WindFlag.UNCERTAIN).all()
    narrow, _ = made.scan(made.calm, 0.4 * np.arange(12), 3.0, RANGES[:3], np.arange(12.0))
    assert (lm.fit_winds_to_lines(narrow)["flag"].values & WindFlag.ILL_CONDITIONED).all()
    flagged = stare.assign(flag=stare["flag"] + 1)
    with pytest.raises(lm.InputError, match="three valid lines"):
        lm.fit_winds_to_lines(flagged)
    with pytest.raises(lm.InputError, match="flag is missing"):
        lm.fit_winds_to_lines(stare.drop_vars("flag"))
    with pytest.raises(lm.InputError, match="noise: -1"):
        lm.fit_winds_to_lines(stare, noise=-1.0)


@pytest.mark.skipif(not REAL.is_dir(), reason="needs real files")
def test_real_ppi_has_its_known_wind():
    """At 550 m: u -1.10, v 3.46, w 0.11, residual 0.14 m/s by plain least squares."""
    (path,) = REAL.glob("*.cdf")
    # of the ranges of the file, of which the known wind is
    lines = lm.read_lines_of_sight(path, range_step=30.0, blind_range=450.0)
    winds = lm.fit_winds_to_lines(lines).isel(time=0)
    one = winds.sel(height=558.6, method="nearest")
    for name, known in (("u", -1.10), ("v", 3.46), ("w", 0.11), ("residual", 0.14)):
        assert float(one[name]) == pytest.approx(known, abs=0.01)
    assert int(one["flag"]) == 0 and 0.05 < float(one["u_stderr"]) < 0.2
