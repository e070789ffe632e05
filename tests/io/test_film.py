"""Animations: frames that come back as they went in, one size, a clock.

Detects lost, reordered or recoloured frames, a wrong duration, files of frames that do not fit.
"""

import sys
from io import BytesIO

import numpy as np
import pytest
from PIL import Image

from lidar_mi.errors import InputError
from lidar_mi.io.film import as_mp4, frame_as_webp, write_gif


def frames(count=5):
    """Squares of one grey each."""
    return [np.full((20, 30, 3), 40 * k + 10, np.uint8) for k in range(count)]


def test_gif_has_all_frames_in_their_order(tmp_path):
    write_gif(tmp_path / "a.gif", frames(), 0.25)
    with Image.open(tmp_path / "a.gif") as found:
        assert found.n_frames == 5 and found.info["loop"] == 0
        for k in range(5):
            found.seek(k)
            assert found.info["duration"] == 250 and found.size == (30, 20)
            # of a palette of 64 colours taken from every frame
            assert abs(np.asarray(found.convert("RGB")).astype(int) - (40 * k + 10)).max() <= 6


def test_frame_is_lossy_and_small():
    rows = np.linspace(0, 255, 300).astype(np.uint8)
    frame = np.repeat(np.tile(rows, (200, 1))[..., None], 3, 2)
    content = frame_as_webp(frame)
    with Image.open(BytesIO(content)) as found:
        back = np.asarray(found.convert("RGB")).astype(int)
    assert abs(back - frame).mean() < 3 and len(content) < frame.size / 30


def test_frames_of_two_sizes_are_refused(tmp_path):
    for wrong in ([], [*frames(), np.zeros((5, 5, 3), np.uint8)]):
        with pytest.raises(InputError, match="frames of one size expected"):
            write_gif(tmp_path / "a.gif", wrong, 0.1)


def test_video_has_the_frames_at_their_times():
    av = pytest.importorskip("av")
    tall = [np.full((32, 48, 3), 40 * k + 20, np.uint8) for k in range(5)]
    with av.open(BytesIO(as_mp4(tall, 0.04))) as found:
        shown = list(found.decode(video=0))
        assert found.streams.video[0].average_rate == 25
    assert [frame.time for frame in shown] == pytest.approx([0, 0.04, 0.08, 0.12, 0.16])
    for frame, given in zip(shown, tall, strict=True):
        # lossy: by 3 grey levels of a plane image
        assert abs(frame.to_ndarray(format="rgb24").astype(int) - given).max() <= 3


def test_video_of_odd_frames_is_refused():
    with pytest.raises(InputError, match="even numbers of rows and columns"):
        as_mp4([np.zeros((21, 30, 3), np.uint8)], 0.04)


def test_without_pyav_there_is_no_video(monkeypatch):
    monkeypatch.setitem(sys.modules, "av", None)
    assert as_mp4(frames(), 0.04) is None
