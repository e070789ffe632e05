"""Samples of an unfinished image: kept, taken up again, bit by bit the undisturbed image.

Detects a pass that is made twice or left out, moments that are rounded on the way through the file,
a merge in another order, and batches that are kept too often or too rarely.
"""

from importlib.resources import files

import mitsuba as mi
import numpy as np
import pytest

from lidar_mi.io.arrays import read_arrays, write_arrays
from lidar_mi.rendering import batches
from lidar_mi.rendering.batches import Batches

SCENES = files("lidar_mi.scenes")

LIDAR = """<integer name="max_order" value="2"/> <boolean name="orders" value="true"/>
    <boolean name="covariance" value="true"/> <integer name="samples_per_pass" value="20"/>"""


def lidar_scene(estimator, size=20):
    """3 x 2 beams of 50 samples, a beam at a time in passes of 20, 20 and 10."""
    text = (SCENES / "slab.xml").read_text()
    for old, new in (
        ('"219"', '"3"'),
        ('"139"', '"2"'),
        ('<integer name="sample_count" value="64"/>', '<integer name="sample_count" value="50"/>'),
        ('<integer name="max_order" value="1"/>', LIDAR.replace("20", str(size))),
    ):
        assert old in text
        text = text.replace(old, new)
    return mi.load_string(text, estimator=estimator)


def ring_scene(estimator, size=1000):
    """40 x 30 pixels; 8 paths each in passes of 1000."""
    text = (SCENES / "fringes.xml").read_text()
    for old, new in (
        ('"960"', '"40"'),
        ('"780"', '"30"'),
        (
            'value="$estimator"/> <',
            'value="$estimator"/> <integer name="samples_per_pass" value="SIZE"/> <'.replace(
                "SIZE", str(size)
            ),
        ),
    ):
        assert old in text
        text = text.replace(old, new)
    return mi.load_string(text, estimator=estimator, samples="8")


class Killed(Exception):
    """Ends a rendering."""


def rendered(scene, path=None, passes=None):
    """The image; what is kept in a file; ends after so many passes, if requested."""
    made = []

    def progress(done, total):
        made.append(done)
        if len(made) == passes:
            raise Killed

    def load():
        return read_arrays(path) if path.exists() else None

    integrator = scene.integrator()
    integrator.progress = progress
    integrator.batches = path and Batches(load, lambda arrays: write_arrays(path, arrays))
    return np.array(mi.render(scene, seed=5)), made


@pytest.mark.slow
@pytest.mark.parametrize(
    ("make", "estimator"),
    [
        (lidar_scene, "gated"),
        (lidar_scene, "analog"),
        (ring_scene, "camera"),
        (ring_scene, "forward"),
    ],
)
def test_a_killed_image_resumes_where_it_was(variant, tmp_path, monkeypatch, make, estimator):
    """Killed after every single pass, one pass in each life."""
    monkeypatch.setattr(batches, "INTERVAL", 0)
    scene, path = make(estimator), tmp_path / "batches.npz"
    whole, passes = rendered(scene)
    assert len(passes) > 9 and np.isfinite(whole).all() and whole.any()
    for _ in passes[:-1]:
        with pytest.raises(Exception) as caught:  # Dr.Jit may wrap it
            rendered(scene, path, passes=1)
        assert "Killed" in repr((caught.value, caught.value.__cause__))
    image, made = rendered(scene, path)
    assert made == passes[-1:]
    np.testing.assert_array_equal(image.view(np.uint32), whole.view(np.uint32))


@pytest.mark.parametrize(
    ("make", "estimator", "other"),
    [(ring_scene, "camera", 700), pytest.param(lidar_scene, "gated", 15, marks=pytest.mark.slow)],
)
def test_passes_of_another_size_are_not_taken(
    variant, tmp_path, monkeypatch, make, estimator, other
):
    """As a machine with less memory makes them: their number says nothing of these."""
    monkeypatch.setattr(batches, "INTERVAL", 0)
    path, resumed = tmp_path / "batches.npz", make(estimator, other)
    whole, passes = rendered(resumed)
    with pytest.raises(Exception) as caught:
        rendered(make(estimator), path, passes=3)
    assert "Killed" in repr((caught.value, caught.value.__cause__)) and path.is_file()
    image, made = rendered(resumed, path)
    assert made == passes
    np.testing.assert_array_equal(image.view(np.uint32), whole.view(np.uint32))


def test_batches_are_kept_every_half_minute(monkeypatch):
    """And less often where that takes long: 10 % of the time is spent on it at most."""
    clock, kept, slow = [0.0], [], [0.0]
    monkeypatch.setattr(batches.time, "monotonic", lambda: clock[0])

    def save(arrays):
        kept.append((int(arrays["passes"]), float(arrays["seconds"])))
        clock[0] += slow[0]

    one = Batches(lambda: None, save)
    assert one.stored() == (0, {})
    for passes in range(1, 20):
        clock[0] += 7
        one.store(passes, dict)
    assert kept == [(5, 35.0), (10, 70.0), (15, 105.0)]
    slow[0] = 6.0
    for passes in range(20, 50):
        clock[0] += 7
        one.store(passes, dict)
    assert np.diff([seconds for _, seconds in kept[3:]]).min() >= 60


def test_seconds_of_earlier_runs_count(monkeypatch):
    monkeypatch.setattr(batches, "INTERVAL", 0)
    kept = []
    one = Batches(lambda: {"passes": np.array(3), "seconds": np.array(100.0)}, kept.append)
    assert one.stored() == (3, {}) and one.seconds == 100
    one.store(4, dict)
    assert float(kept[0]["seconds"]) >= 100
