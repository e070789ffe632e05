"""Winds from files: detects frames taken for others, times of headers that are not used, remarks
that are lost, and options that Python users cannot reach.
"""

import numpy as np
import pytest
import tifffile
from scipy.ndimage import gaussian_filter

import lidar_mi as lm
from lidar_mi.errors import InputError

SHIFTS = (0, 2, 5)


@pytest.fixture
def stack(tmp_path):
    """Three frames of a texture that moves to the left by 2 and 3 pixels."""
    air = 1 + gaussian_filter(np.random.default_rng(4).normal(size=(40, 69)), 1.5)
    frames = np.stack([air[:, k : k + 64] for k in SHIFTS]).astype(np.float32)
    path = tmp_path / "stack.tif"
    tifffile.imwrite(path, frames, photometric="minisblack")
    return path


def test_pairs_of_a_stack(stack):
    winds = lm.retrieve_files(stack, pairs="all", pixels=True)
    assert winds.sizes["time"] == 2 and winds["v"].attrs["units"] == "px frame-1"
    moved = winds["v"].where(winds["flag"] == 0).mean(("z", "y")).values
    assert moved == pytest.approx(np.diff(SHIFTS), abs=0.1)
    assert winds.attrs["remarks"] == "" and winds.attrs["layer"] == ""


def test_chosen_frames_and_steps(stack):
    wind = lm.retrieve_files(stack, frame=(0, 2), dt=0.1, spacing=0.5, method="multipass")
    v = wind["v"].where(wind["flag"] == 0).mean().item()
    assert v == pytest.approx(5 * 0.5 / 0.1, rel=0.02)
    assert np.abs(wind.attrs["pixel_size"]) == pytest.approx([0.5, 0.5])


@pytest.mark.parametrize(
    "options, message",
    [
        ({}, "3 frames; expected frame with two of them"),
        ({"frame": (1,)}, "frame: one frame of"),
        ({"frame": (0, 1), "spacing": 1.0}, "dt: missing"),
        ({"frame": (0, 1), "pairs": "all"}, "frame, pairs: both"),
        ({"frame": (0, 1), "dt": 0.1, "pixels": True, "spacing": 1.0}, "pixels, spacing: both"),
        ({"frame": (0, 1, 2), "dt": 0.1, "spacing": 1.0, "method": "cc"}, "3 images are not"),
        ({"pairs": "every"}, "pairs: "),
    ],
)
def test_what_is_refused(stack, options, message):
    with pytest.raises(InputError, match=message):
        lm.retrieve_files(stack, **options)


def test_no_file_at_all():
    with pytest.raises(InputError, match="files: none"):
        lm.retrieve_files([])
