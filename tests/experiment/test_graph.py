"""Order of stages, and runs in memory.

Detects a stage that runs before what it needs or twice, a need that nothing gives, parts rendered
again although they are there, a run in memory that writes files or finds other numbers than one in
a folder.
"""

import gc
from dataclasses import replace

import numpy as np
import pytest

from lidar_mi.experiment import pipeline
from lidar_mi.experiment.graph import Stage, in_order, result_of
from lidar_mi.experiment.log import Log
from lidar_mi.experiment.pipeline import STAGES, stages_of
from lidar_mi.experiment.run import complete, prepare, run
from lidar_mi.experiment.schema import reading as config
from lidar_mi.experiment.shipped import experiment_file
from tests.support.experiments import check, small


def add(*numbers, log):
    """A stage's computation: the first of what it gets is the experiment."""
    return 1 + sum(numbers[1:])


def load(name, changes=()):
    return config.load(experiment_file(name), list(changes))


def names(stages):
    return [stage.name for stage in stages]


def test_stages_follow_those_they_need():
    stages = [Stage("c", add, ("b", "a")), Stage("b", add, ("a",)), Stage("a", add, ("given",))]
    assert names(in_order(stages, ("given",))) == ["a", "b", "c"]
    # those that need nothing of each other stay as they are
    assert names(in_order([Stage("y", add), Stage("x", add)])) == ["y", "x"]


def test_no_pair_is_fitted_behind_a_turbine_unless_it_is_asked_for():
    turbine = load("turbine")
    assert turbine.sensor and "vortices" not in names(stages_of(turbine))
    asked = load("turbine", ["retrieval.methods=[variational,vortex_fit]"])
    assert "vortices" in names(stages_of(asked))
    assert "vortices" in names(stages_of(load("wake_sensor")))


@pytest.mark.parametrize(
    ("stages", "message"),
    [
        ([Stage("a", add, ("b",))], "stage a: nothing gives b"),
        ([Stage("a", add), Stage("a", add)], "stages: a given twice"),
        ([Stage("a", add, ("b",)), Stage("b", add, ("a",))], "stages: a, b need each other"),
        ([Stage("a", add, ("b",), ahead=True), Stage("b", add)], "stage a: is ahead of what it"),
    ],
)
def test_stages_that_do_not_go_together_are_named(stages, message):
    with pytest.raises(ValueError, match=message):
        in_order(stages)


def test_a_result_is_computed_from_its_needs_in_order():
    observed = []
    stage = Stage("c", lambda experiment, *given, log: observed.append(given), ("b", "a"))
    result_of(stage, None, {"a": 1, "b": 2, "other": 3}, Log())
    assert observed == [(2, 1)]


class Drawer:
    """Keeps things as a run folder does, with what an earlier run left."""

    def __init__(self, **left):
        self.parts, self.results = left, {}

    def kept(self, part):
        return self.parts.get(part)

    def keep_part(self, part, value):
        self.parts[part] = f"{value}, read"
        return self.parts[part]

    def keep(self, name, value):
        self.results[name] = value


def test_parts_that_are_there_are_not_made_again():
    asked = []

    def compute(experiment, *, log, missing, keeper):
        asked.append(list(missing))
        yield from ((name, f"new {name}") for name in missing)

    stage = Stage("images", compute, parts=lambda experiment: ("one", "two"))
    drawer = Drawer(two="old two")
    expected = {"one": "new one, read", "two": "old two"}
    assert result_of(stage, None, {}, Log(), drawer) == expected
    # all there: nothing is computed; no one to keep them: all are made
    assert result_of(stage, None, {}, Log(), drawer) == expected
    assert result_of(stage, None, {}, Log()) == {"one": "new one", "two": "new two"}
    assert asked == [["one"], ["one", "two"]]


@pytest.mark.parametrize(
    "sections",
    [
        {"wake": {"vortex_pair": {}}},
        {"doppler": {}},
        {"wake": {"vortex_pair": {}}, "retrieval": {"methods": ["vortex_fit"]}},
        {"wake": {"turbine": {}}, "volume": {}, "scan": {"gate_count": 10, "thickness": "10 m"}},
        {
            "wake": {"vortex_pair": {}},
            "retrieval": {"methods": ["variational"], "error_budget": True},
            "detector": {},
            "doppler": {},
            "sensor": {},
        },
    ],
)
def test_every_kind_of_experiment_has_stages_that_go_together(sections):
    experiment = check({"name": "x"} | sections)
    stages = names(stages_of(experiment))
    assert len(stages) == len(set(stages))
    assert ("v_los" in stages) == ("doppler" in sections)
    assert ("wind3d" in stages) == ("sensor" in sections)
    assert ("wind_volume" in stages) == ("volume" in sections)
    assert ("vortices" in stages) == ("sensor" in sections or "vortex_fit" in str(sections))


@pytest.fixture
def counted(monkeypatch):
    """How often each stage was computed."""
    counts = {}

    def counting(stage):
        def compute(*needed, **options):
            counts[stage.name] = counts.get(stage.name, 0) + 1
            return stage.compute(*needed, **options)

        return replace(stage, compute=compute)

    monkeypatch.setattr(pipeline, "STAGES", tuple(map(counting, STAGES)))
    yield counts
    gc.collect()
    gc.collect()


@pytest.mark.usefixtures("variant")
def test_a_run_in_memory_writes_nothing_and_computes_each_stage_once(
    tmp_path, monkeypatch, counted
):
    """Its numbers are those of a run in a folder, whose images are rounded to float32; a detector's
    noise is drawn for images in both."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("lidar_mi.assessment.figures.backscatter.draw_all", lambda *_: [])
    monkeypatch.setattr("lidar_mi.experiment.stages.texture.LEVELS", (0.1,))
    experiment = check(small() | {"detector": {}})
    prepared = prepare(experiment)
    truth = prepared.truth
    assert prepared.wind is None and prepared.metrics == {}
    done = complete(prepared)
    assert list(tmp_path.iterdir()) == [] and done.folder is None
    assert set(counted.values()) == {1}
    assert set(counted) == {stage.name for stage in stages_of(experiment)}
    assert done.truth is truth
    assert done.wind.sizes["source"] == 5 and len(done.scans) == 2 and done.vortices is None
    # the light comes without noise, the detector adds it
    assert all("Y_noisy" not in image for image in done.results["images"].values())
    assert all("Y_noisy" in scan for scan in done.scans)
    kept = run(experiment, tmp_path / "run")
    assert set(kept.metrics) == {*done.metrics, "timing.figures_s"}
    for key, value in done.metrics.items():
        if not key.startswith("timing."):
            # medians step from one float32 to the next, and biases nearly cancel
            assert kept.metrics[key] == pytest.approx(value, rel=1e-4, abs=1e-6), key
    again = run(experiment, tmp_path / "run")
    assert counted["images"] == 2 and counted["wind"] == 3
    for scan, same in zip(kept.scans, again.scans, strict=True):
        np.testing.assert_array_equal(scan["Y_noisy"], same["Y_noisy"])
    numbers = {key: x for key, x in kept.metrics.items() if not key.startswith("timing.")}
    assert numbers == {key: again.metrics[key] for key in numbers}
