"""Frames of lines of sight, from images without noise at a few speeds.

Detects: images between those speeds that are off by a tenth of their noise, frames whose number of
pulses or range has no effect, streams that repeat from line to line or scan to scan, and frames of
the laser that are not shared as they should.
"""

import numpy as np
import pytest
import torch
import xarray as xr

from lidar_mi.experiment.stages.line_frames import line_frames, line_images
from lidar_mi.experiment.stages.ring_images import ring_instrument
from lidar_mi.instrument.doppler import photons
from lidar_mi.instrument.fringe_camera import fringe_image
from lidar_mi.schema.doppler import Doppler

SPEEDS, RANGES = np.array([20.0, 63.0, 95.0]), np.array([56.0, 60.0, 56.0])


def doppler(every=1):
    return Doppler(
        camera={"width": 240, "height": 195, "pixel": "29.6 um"},
        ccd={"binning": 4},
        reference={"every": every},
        retrieval={"averaged": [1]},
        speckle_modes="inf",
    )


def recorded(every=1, pulses=4, scan=0, lines=(0, 1, 2)):
    lidar = doppler(every)
    rings = ring_instrument(lidar)
    images = line_images(lidar, rings, 15.0, 100.0)
    whole = xr.Dataset({"v_los_true": ("line", SPEEDS), "range": ("line", RANGES)})
    return (line_frames(lidar, rings, images, whole, list(lines), pulses, 3, scan), rings, lidar)


def test_frames_are_poisson_about_the_image_of_their_speed():
    """Of 46800 pixels each: chi-square is known to 0.7 %, the mean to 0.1 sigma of a pixel."""
    (air, laser, own), rings, lidar = recorded()
    dark = lidar.ccd.dark_current * lidar.ccd.integration_time * lidar.ccd.binning**2
    for frame, speed, distance in zip(air, SPEEDS, RANGES, strict=True):
        farther = lidar.lidar.model_copy(update={"range": float(distance)})
        light = photons(farther)
        mean = fringe_image(
            lidar.camera, lidar.etalon, rings.line, speed, light, lidar.lidar.counted
        )
        mean = 4 * (mean + rings.background + dark)
        # read noise and rounding of every pulse
        variance = mean + 4 * lidar.ccd.output_noise**2
        off = ((frame - mean) / variance.sqrt()).double()
        assert abs(float(off.mean())) < 4 / np.sqrt(off.numel())
        assert abs(float((off**2).mean()) - 1) < 4 * np.sqrt(2 / off.numel()) + 0.005
    assert own == [0, 1, 2] and len(laser) == 3


def test_lines_share_frames_of_the_laser():
    (_, laser, own), *_ = recorded(every=8)
    assert own == [0, 0, 1] and len(laser) == 2 and not torch.equal(*laser)


def test_streams_are_those_of_a_line_and_a_scan():
    first, again, other = (recorded(scan=scan)[0] for scan in (0, 0, 1))
    alone = recorded(lines=(1,))[0]
    assert torch.equal(first[0], again[0]) and torch.equal(first[1], again[1])
    assert torch.equal(alone[0][0], first[0][1]) and torch.equal(alone[1][0], first[1][1])
    assert not torch.equal(first[0][0], other[0][0]) and not torch.equal(first[1], other[1])
    assert not torch.equal(first[0][0], first[0][2])


@pytest.mark.parametrize("speed", [15.0, 41.0, 100.0])
def test_interpolated_images_are_those_of_the_speed(speed):
    """To 1e-6 of a crest: the noise of a thousand pulses is a hundred times larger."""
    lidar = doppler()
    rings = ring_instrument(lidar)
    images = line_images(lidar, rings, 15.0, 100.0)
    light, counted = photons(lidar.lidar), lidar.lidar.counted
    exact = fringe_image(lidar.camera, lidar.etalon, rings.line, speed, light, counted)
    found = images.at(speed)
    assert float((found - exact).abs().max()) < 1e-6 * float(exact.max())
