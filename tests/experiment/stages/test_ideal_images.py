"""Images without noise of beams that have times and poses.

Detects: a beam that sees the air of another's time, true and reported places exchanged, a film that
is turned, air that is blurred where the beams have no width.
"""

from dataclasses import replace

import numpy as np
import pytest
import xarray as xr

from lidar_mi.experiment.stages.ideal_images import ideal_scan
from lidar_mi.instrument.beams import Beams
from lidar_mi.instrument.lidar import BackscatterLidar
from lidar_mi.instrument.scan import Scan, plan_scans

Y, Z = 0.5 * np.arange(-30, 31), 0.5 * np.arange(-20, 21)
U, WAVE = np.array([10.0, -7.0]), 8.0
TIMES = np.linspace(-0.05, 0.05, 9)


def waves(time, y, z):
    """Along y and along z, carried by the wind: closed form."""
    k = 2 * np.pi / WAVE
    return 1 + 0.4 * np.cos(k * (y - U[0] * time)) + 0.3 * np.sin(k * (z - U[1] * time))


def images(times=TIMES):
    values = [waves(time, Y[None, :], Z[:, None]) for time in times]
    axes = {"time": times} | {n: (n, a, {"units": "m"}) for n, a in (("z", Z), ("y", Y))}
    return xr.DataArray(np.stack(values), axes, ("time", "z", "y"))


def timed(plan, moved=(0.0, 0.0), told=(0.0, 0.0)):
    """Beams row by row from the top left whose true and reported places are off by y, z, m."""
    count = len(Y) * len(Z)
    time = np.linspace(-0.05, 0.05, count)
    ends = plan.directions() * (plan.centre / plan.directions()[:, :1])
    origin = np.zeros((count, 3))

    def to(off):
        way = ends + np.array([0.0, *off])
        return way / np.linalg.norm(way, axis=1, keepdims=True)

    return replace(plan, beams=Beams(time, origin, to(moved), origin, to(told)))


@pytest.fixture(scope="module")
def plan():
    return plan_scans(Scan(range="500 m"), Y, Z, [0.0])[0]


def test_a_raster_sees_the_air_of_every_beam_s_time(plan):
    scan = ideal_scan(images(), timed(plan))
    time = np.linspace(-0.05, 0.05, scan["Y"].size).reshape(len(Z), len(Y))[::-1, ::-1]
    assert scan["beam_time"].values == pytest.approx(time)
    # linear between states that are 0.125 m of 8 m apart: (2 pi 0.125 / 8)^2 / 8 of the amplitude
    assert scan["Y"].values == pytest.approx(waves(time, Y[None, :], Z[:, None]), abs=1e-3)
    assert scan["y"].attrs["units"] == "m"


def test_a_wrong_pose_displaces_the_image(plan):
    """Beams that go 0.3 m further to port than reported show air that seems 0.3 m to starboard."""
    scan = ideal_scan(images(), timed(plan, moved=(0.3, 0.1)))
    time = scan["beam_time"].values
    inner = (slice(3, -3), slice(3, -3))
    truth = waves(time, Y[None, :] + 0.3, Z[:, None] + 0.1)
    assert scan["Y"].values[inner] == pytest.approx(truth[inner], abs=2e-3)


def test_beams_beside_their_nodes_are_resampled_where_they_were_told_to_be(plan):
    off = (0.2, -0.15)
    scan = ideal_scan(images(), timed(plan, moved=off, told=off))
    inner = (slice(3, -3), slice(3, -3))
    truth = waves(scan["beam_time"].values, Y[None, :], Z[:, None])
    assert scan["Y"].values[inner] == pytest.approx(truth[inner], abs=0.01)


def test_a_beam_s_width_reduces_a_wave(plan):
    """A Gaussian beam of standard deviation s by exp(-(k s)^2 / 2), and linear air between nodes
    by sinc^2; see `blur_by_beam`."""
    lidar = BackscatterLidar(divergence_full="2 mrad")
    sigma, k = float(lidar.radius_at(plan.centre)) / 2, 2 * np.pi / WAVE
    assert 0.2 < sigma < 0.3
    left = np.exp(-((k * sigma) ** 2) / 2) * np.sinc(0.5 / WAVE) ** 2
    photograph = images([0.0]).isel(time=0, drop=True)
    scan = ideal_scan(photograph, plan, lidar)
    assert set(scan.data_vars) == {"Y"}
    inner = (slice(8, -8), slice(8, -8))
    truth = 1 + left * (waves(0, Y[None, :], Z[:, None]) - 1)
    assert scan["Y"].values[inner] == pytest.approx(truth[inner], abs=2e-3)
