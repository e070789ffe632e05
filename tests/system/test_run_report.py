"""Figures and report of a run of the demo.

Detects: a blank or unreadable figure, images drawn mirrored or turned, a report that needs files or
the network, and numbers in it that are not those of the metrics."""

import base64
import io
from html.parser import HTMLParser
from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest
from matplotlib.image import imread as plt_imread
from PIL import Image
from scipy import ndimage

from lidar_mi.assessment.digits import percent
from lidar_mi.experiment.folder.run_folder import IMAGES
from lidar_mi.experiment.truth.extinction import make_truth
from lidar_mi.io.exr import read_scan
from tests.support.experiments import FIGURES

SCENES = Path(str(files("lidar_mi.scenes")))


def axes_in(path):
    """The images inside a figure file, largest two: blocks of pixels that are not white. A thin
    frame joins nothing to them, colour bars are smaller."""
    pixels = plt_imread(path)[..., :3]
    inked, _ = ndimage.label(ndimage.binary_opening((pixels < 0.97).any(-1), np.ones((9, 9))))
    blocks = ndimage.find_objects(inked)
    area = np.bincount(inked.ravel())[1:]
    largest = sorted(np.argsort(area)[-2:], key=lambda k: blocks[k][1].start)
    return [pixels[blocks[k]] for k in largest]


@pytest.mark.parametrize("name", sorted(FIGURES))
def test_figures_are_readable_and_not_blank(demo, name):
    pixels = plt_imread(demo.folder / "figures" / f"{name}.png")
    height, width = pixels.shape[:2]
    assert 900 <= width <= 2000 and 400 <= height <= 2000
    # ink in every quarter
    for rows in np.array_split(pixels[..., :3], 2, axis=0):
        for part in np.array_split(rows, 2, axis=1):
            assert part.std() > 0.05


@pytest.mark.parametrize(
    "figure, of", [("fig08_backscatter", "backscatter"), ("fig05_extinction", "extinction")]
)
def test_figures_have_the_pilot_s_view(demo, figure, of):
    """Brightness of the drawn images against the data: port (+y) on the left, up at the top.
    Mirrored either way or turned by 180 degrees they do not match."""
    if of == "backscatter":
        data = [read_scan(demo.folder / name)["Y"] for name in IMAGES]
    else:
        data = [make_truth(demo.experiment, SCENES).image(k) for k in (0, 1)]
    for drawn, field in zip(axes_in(demo.folder / "figures" / f"{figure}.png"), data, strict=True):
        brightness = drawn.sum(-1)  # cividis grows brighter with the value
        assert drawn.shape[1] / drawn.shape[0] == pytest.approx(219 / 139, rel=0.03)
        rows, columns = (
            ((np.arange(n) + 0.5) * size / n).astype(int)
            for n, size in zip(field.shape, brightness.shape, strict=True)
        )
        observed = brightness[np.ix_(rows, columns)].ravel()
        values = field.transpose("z", "y").values
        right, *wrong = (
            np.corrcoef(observed, turned.ravel())[0, 1]
            for turned in (values[::-1, ::-1], values[:, ::-1], values[::-1], values)
        )
        assert right > 0.97 and max(wrong) < 0.92, (right, wrong)


class Links(HTMLParser):
    """What a page refers to, and its visible text."""

    def __init__(self, page):
        super().__init__()
        self.targets, self.words = [], []
        self.feed(page)

    def handle_starttag(self, tag, attributes):
        assert tag not in ("link", "iframe")
        assert tag != "script" or "src" not in dict(attributes)
        self.targets += [
            value
            for key, value in attributes
            if key in ("src", "href") and not value.startswith("#")
        ]

    def handle_data(self, data):
        self.words.append(data)


def test_report_is_self_contained(demo):
    page = (demo.folder / "report.html").read_text()
    links = Links(page)
    beside = [target for target in links.targets if not target.startswith("data:")]
    assert {"wind.nc", "image_t1.exr", "image_t1.png", "metrics.json"} <= set(beside)
    assert all((demo.folder / target).is_file() for target in beside)
    embedded = [target for target in links.targets if target.startswith("data:")]
    assert len(embedded) == len(FIGURES)
    for target, path in zip(embedded, sorted((demo.folder / "figures").iterdir()), strict=True):
        kind, _, code = target.partition(",")
        assert kind == "data:image/webp;base64"
        with Image.open(io.BytesIO(base64.b64decode(code))) as held, Image.open(path) as drawn:
            assert held.tobytes() == drawn.convert("RGB").tobytes()
    assert len(page) < 6e6
    assert "url(" not in page and "@import" not in page


def test_report_contains_the_numbers(demo):
    words = " ".join(Links((demo.folder / "report.html").read_text()).words)
    assert "wake_backscatter" in words and "seed: 1" in words
    for text in ("wake_slab_40s.nc at 40 s", "532 nm, 1 mJ", "mitsuba 3.", "64 samples per beam"):
        assert text in words
    assert f"{demo.metrics['backscatter.cc.rmse_v']:.3f}" in words
    assert f"backscatter.cc.rmse_v: {demo.metrics['backscatter.cc.rmse_v']:.4g} m/s" in words
    assert (
        f"wake.port_core.circulation: {demo.metrics['wake.port_core.circulation']:.4g} m²/s"
        in words
    )
    assert f"{demo.metrics['true_wind.rms_v']:.3g}" in words and "no skill" in words
    noise = (
        f"simulation {percent(demo.metrics['backscatter.mc_relative_error'])} (64 samples per beam)"
    )
    assert noise in words and "no detector" in words
    assert "cross-correlation" in words and "variational" in words
