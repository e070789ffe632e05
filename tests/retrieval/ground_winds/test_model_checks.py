"""Winds where the model of uniform, unfolded velocities of a level lidar does not hold.

Physics: scans computed from a known wind. Detects errors of w, of the sign or of tens of m/s that
are stated as small, and checks that fire on clean scans.
"""

import numpy as np
import pytest

import lidar_mi as lm
from lidar_mi.flags import WindFlag
from lidar_mi.retrieval.ground_winds.folding import unfolded
from tests.support.line_winds import MEAN, directions, scan, turbulent

RANGES = 105 + 30.0 * np.arange(20)


def vad(wind, lines=24, elevation=60.0, ranges=RANGES, noise=0.1, seed=0):
    """A scan in the wind (3,), m/s; the mean of the support is taken off."""
    others = np.asarray(wind, float) - MEAN
    data, _ = scan(
        lambda places: np.broadcast_to(others, places.shape),
        360 / lines * np.arange(lines),
        elevation,
        ranges,
        np.arange(lines),
        noise,
        seed,
    )
    return data


def folded(data, nyquist):
    velocity = data["radial_velocity"]
    return data.assign(radial_velocity=(velocity + nyquist) % (2 * nyquist) - nyquist)


def errors(found, wind):
    """Normalised errors (n, 3) of the valid winds, and which are valid."""
    valid = (found["flag"] == 0).values
    off = [(found[c] - t).values[valid] for c, t in zip("uvw", wind, strict=True)]
    size = [found[f"{c}_stderr"].values[valid] for c in "uvw"]
    return np.stack(off, -1) / np.stack(size, -1), valid


@pytest.mark.slow
@pytest.mark.parametrize("stated", [True, False])
@pytest.mark.parametrize(
    "speed, lines, elevation, nyquist", [(28, 72, 10, 19.4), (28, 24, 30, 19.4), (24, 24, 45, 11)]
)
def test_folded_velocities_are_unfolded(stated, speed, lines, elevation, nyquist):
    for seed in range(3):
        towards = 2 * np.pi * seed / 3
        wind = np.array([speed * np.cos(towards), speed * np.sin(towards), 0.0])
        data = folded(vad(wind, lines, elevation, seed=seed), nyquist)
        if stated:
            data.attrs["nyquist_velocity"] = nyquist
        # a tenth of the gates sees noise
        random = np.random.default_rng(seed)
        noise = random.uniform(-nyquist, nyquist, data["radial_velocity"].shape)
        bad = random.random(noise.shape) < 0.1
        data = data.assign(radial_velocity=data["radial_velocity"].where(~bad, noise))
        found = lm.fit_winds_to_lines(data)
        off, valid = errors(found, wind)
        assert valid.mean() > 0.9 and np.mean(np.abs(off) > 4) <= 0.02
        remarks = found.attrs["remarks"]
        assert "velocities fold at" in remarks
        value = float(remarks.split("fold at ")[1].split()[0])
        assert abs(value - nyquist) < 0.1


def test_a_folded_wind_is_unfolded():
    wind = np.array([24.0, 0.0, 0.0])
    found = lm.fit_winds_to_lines(folded(vad(wind, 12, 45, RANGES[:6]), 11.0))
    off, valid = errors(found, wind)
    assert valid.all() and np.abs(off).max() < 4 and "fold at 11.0" in found.attrs["remarks"]


@pytest.mark.parametrize(
    "seeds", [range(1), pytest.param(range(1, 15), marks=pytest.mark.slow)], ids=["one", "more"]
)
def test_clean_and_noisy_scans_are_not_unfolded(seeds):
    """No false alarm in 90 searches: at most 3 % by the rule of three, 95 % confidence."""
    for seed in seeds:
        air = turbulent(seed, 1.2, 200.0)
        for noisy in (0.0, 0.2, 1.0):
            data, _ = scan(air, 15.0 * np.arange(24), 60, RANGES, np.arange(24), 0.1, seed)
            velocity = data["radial_velocity"].values
            random = np.random.default_rng(seed)
            bad = random.random(velocity.shape) < noisy
            velocity = np.where(bad, random.uniform(-19.4, 19.4, velocity.shape), velocity)
            line, gate = np.indices(velocity.shape)
            design = directions(15.0 * np.arange(24), np.full(24, 60.0))[line.ravel()]
            members = [np.flatnonzero(gate.ravel() == k) for k in range(len(RANGES))]
            for nyquist in (None, 19.4):
                assert unfolded(members, design, velocity.ravel(), nyquist) is None


def test_few_lines_that_may_fold_are_flagged():
    def dbs(u):
        azimuth, elevation = np.array([0.0, 90, 180, 270, 0]), np.array([60.0, 60, 60, 60, 90])
        velocity = directions(azimuth, elevation) @ np.array([u, 0.0, 0.0])
        data = vad([0, 0, 0], 5)
        noise = 0.1 * np.random.default_rng(1).standard_normal((5, RANGES.size))
        data = data.assign(radial_velocity=(("time", "range"), velocity[:, None] + noise))
        data = data.assign_coords(azimuth=("time", azimuth), elevation=("time", elevation))
        return folded(data.assign_attrs(nyquist_velocity=11.0), 11.0)

    # 24 m/s and 24 - 44 = -20 m/s have the same folded velocities
    found = lm.fit_winds_to_lines(dbs(24.0))
    assert not (found["flag"] == 0).any()
    assert (found["flag"].values & WindFlag.FOLDED).astype(bool).mean() > 0.8
    found = lm.fit_winds_to_lines(dbs(5.0))
    assert not (found["flag"].values & WindFlag.FOLDED).any()
    assert float(abs(found["u"] - 5).where(found["flag"] == 0).max()) < 1


def test_a_tilt_that_is_not_applied_is_in_the_error_of_w():
    """Lidars tilted by 0.5 and 3 degrees about any axis: variance of normalised errors.

    The error is the tilt times the wind along its axis: 1/2 on average over axes, to 0.07 for 24.
    """
    for tilt in (0.5, 3.0):
        normalised = []
        for seed in range(12):
            random = np.random.default_rng(seed)
            axis, t = random.uniform(0, 2 * np.pi), np.deg2rad(tilt)
            wind = np.array([6.0, -10.0, 0.0])
            # w of the lidar's own vertical
            seen = wind + np.array([0, 0, t * (wind[0] * np.sin(axis) + wind[1] * np.cos(axis))])
            data = vad(seen, 8, ranges=RANGES[:1], seed=seed).assign_attrs(tilt="not applied")
            pitch, roll = tilt * np.cos(axis), tilt * np.sin(axis)
            data = data.assign_coords(
                pitch=("time", np.full(8, pitch)), roll=("time", np.full(8, roll))
            )
            found = lm.fit_winds_to_lines(data)
            assert "are not applied: the error of w contains them" in found.attrs["remarks"]
            normalised.append(float(found["w"].mean() / found["w_stderr"].mean()))
        assert 0.25 < np.mean(np.square(normalised)) < 2
