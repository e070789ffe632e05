"""How the beam of a slice moves: clocks in whole seconds, over the zenith, step by step.

Physics: slices computed from a known pair. Detects scans that are cut where they are not, and
positions off by stated errors where the beam stands while the model moves it.
"""

import numpy as np
import pytest
from scipy.stats import norm, qmc

import lidar_mi as lm
from lidar_mi.retrieval.ground_vortices.scan_plane import plane_scans

HEAD = "time [s],azimuth [deg],elevation [deg],range [m],radial_velocity [m/s]"
HALTON = qmc.Halton(2, seed=0).random(256)
WITHIN = norm.ppf(HALTON[:, 0]) * 15 / 2.3548 + (HALTON[:, 1] - 0.5) * 15
"""Places within a gate and a pulse of 15 m."""


def rhi(path, seed, degrees, seconds, sweep=0.0, stamp="{:.3f}".format):
    """A pair of 350 m2/s; the beam moves through `sweep` degrees while it measures."""
    random, rows = np.random.default_rng(seed), [HEAD]
    offsets = (np.random.default_rng(7).permutation(256) + 0.5) / 256 - 0.5
    r = np.arange(450, 760, 15.0)[:, None]
    for e, t in zip(degrees, seconds, strict=True):
        a = np.deg2rad(e + sweep * offsets)
        y, z = (r + WITHIN) * np.cos(a), (r + WITHIN) * np.sin(a)
        v, w = 2.0 + 0 * y, 0 * y
        for s in (-1, 1):
            dy, dz = y - (600 + 20 * s + 2 * t), z - (100 - 350 / 2 / np.pi / 40 * t)
            q = dy**2 + dz**2
            g = s * 350 / 2 / np.pi / q * (1 - np.exp(-1.256 * q / 9))
            v, w = v - g * dz, w + g * dy
        speed = (v * np.cos(a) + w * np.sin(a)).mean(1) + 0.15 * random.standard_normal(len(r))
        rows += [f"{stamp(t)},90,{e:.2f},{x},{u:.3f}" for x, u in zip(r[:, 0], speed, strict=True)]
    path.write_text("\n".join(rows))
    return lm.read_lines_of_sight(path)


def errors(found):
    """Normalised errors of y and z, with the time of the vortices."""
    t = (found["time"].values[0] - np.datetime64("1970-01-01")) / np.timedelta64(1, "s")
    y, z = 600 + np.array([-20, 20]) + 2 * t, 100 - 350 / 2 / np.pi / 40 * t
    one = found.isel(scan=0)
    return [
        ((one[n] - true) / one[f"{n}_stderr"]).values for n, true in (("y", y), ("z", z + 0 * y))
    ]


@pytest.mark.slow
@pytest.mark.parametrize("sweep", [0.0, 1.0])
def test_a_beam_that_stands_is_told_from_one_that_sweeps(tmp_path, sweep):
    """Lines 1 degree apart, 10 m at 600 m. All valid, rms of the normalised errors below 2.

    The wrong one of both gave errors of up to 10. Measured: rms 1.4 where the beam stands, 1.9
    (largest 4.0) where it sweeps, as lines are further apart than the cores are wide.
    """
    off = []
    for seed in range(3):
        degrees = np.arange(3 + 0.15 * seed, 16)
        lines = rhi(tmp_path / "a.csv", seed, degrees, 0.4 * np.arange(degrees.size), sweep)
        found = lm.fit_vortices_to_lines(lines, pulse_length=15.0, gate_length=15.0)
        assert (found["flag"] == 0).all()
        off.append(errors(found))
    assert np.sqrt(np.mean(np.square(off))) < 2


@pytest.mark.parametrize("applied", [True, False])
def test_a_tilt_that_is_not_applied_is_remarked(tmp_path, applied):
    lines = rhi(tmp_path / "a.csv", 0, np.arange(3.0, 16), 0.4 * np.arange(13))
    lines = lines.assign_attrs(tilt="applied" if applied else "not applied").assign_coords(
        pitch=("time", np.full(13, 0.3)), roll=("time", np.full(13, 0.4))
    )
    remark = "pitch and roll of up to 0.50 degrees are not applied: 8.7 m of position per km"
    found = lm.fit_vortices_to_lines(lines, kind="single", false_alarm=1e-9)
    assert (remark in found.attrs["remarks"]) != applied


def test_a_scan_whose_name_says_so_stands(tmp_path):
    lines = rhi(tmp_path / "a.csv", 0, np.arange(3.0, 16), 0.4 * np.arange(13))
    for name, span in (("Stepped - overlapping", 0.0), ("csm", np.deg2rad(1.0))):
        (scan,), _ = plane_scans(lines.assign_attrs(scan_type=name), 0.1)
        assert scan.span == pytest.approx(span)


def test_times_in_whole_seconds_are_one_scan(tmp_path):
    degrees, seconds = 3 + 0.1 * np.arange(120), 0.04 * np.arange(120)
    lines = rhi(tmp_path / "a.csv", 0, degrees, seconds, 0.1, lambda t: f"{int(t + 1e-9)}")
    found = lm.fit_vortices_to_lines(lines, pulse_length=15.0, gate_length=15.0)
    assert found.sizes["scan"] == 1 and (found["flag"] == 0).all()
    np.testing.assert_allclose(np.abs(found["circulation"]), 350, rtol=0.05)
    # the lines are evenly spaced: their times are known to a few of them
    (scan,), _ = plane_scans(lines, 0.1)
    np.testing.assert_allclose(scan.time, seconds, atol=0.1)


def test_a_pause_of_a_coarse_clock_is_a_pause(tmp_path):
    degrees, seconds = np.tile(3 + 0.1 * np.arange(60), 1), 0.04 * np.arange(60)
    seconds = np.where(np.arange(60) < 30, seconds, seconds + 30)
    lines = rhi(tmp_path / "a.csv", 0, degrees, seconds, 0.1, lambda t: f"{int(t + 1e-9)}")
    assert len(plane_scans(lines, 0.1)[0]) == 2


def test_an_azimuth_that_turns_at_the_zenith_is_one_scan(tmp_path):
    rows = [HEAD]
    for k, angle in enumerate(np.arange(60.5, 120, 1.0)):
        azimuth, elevation = (90, angle) if angle < 90 else (270, 180 - angle)
        rows += [
            f"{0.1 * k:.1f},{azimuth},{elevation},{r},{0.1 * k:.2f}" for r in range(100, 900, 40)
        ]
    (tmp_path / "a.csv").write_text("\n".join(rows))
    (scan,), remarks = plane_scans(lm.read_lines_of_sight(tmp_path / "a.csv"), 0.1)
    assert not remarks and len(scan.angle) == 60
    np.testing.assert_allclose(np.abs(np.diff(scan.angle)), np.deg2rad(1.0), atol=1e-9)
