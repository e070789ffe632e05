"""Order of stages by their signatures, and runs in memory.

Detects a stage that runs before what it needs or twice, a parameter that nothing gives, a result of
another type than is said, parts rendered again although they are there, a run in memory that writes
files or finds other numbers than one in a folder.
"""

import ast
import gc
import importlib
import inspect
from collections.abc import Iterator
from dataclasses import replace
from functools import wraps
from typing import Annotated, get_origin, get_type_hints

import numpy as np
import pytest

from lidar_mi.experiment import pipeline
from lidar_mi.experiment.graph import (
    _BUNDLES,
    But,
    Graph,
    Guard,
    Only,
    Stage,
    bundle,
    call,
    parameters,
    section_path,
)
from lidar_mi.experiment.log import Log
from lidar_mi.experiment.pipeline import STAGES, Results, stages_of
from lidar_mi.experiment.run import complete, prepare, run
from lidar_mi.instrument.lidar import BackscatterLidar
from lidar_mi.schema import reading as config
from lidar_mi.schema.shipped import experiment_file
from lidar_mi.schema.wake import Wake
from tests.support.experiments import check, small


def load(name, changes=()):
    return config.load(experiment_file(name), list(changes))


def hints(typed):
    """Annotations of a function or a class, with the types that only a type checker imports."""
    module = importlib.import_module(typed.__module__)
    known = vars(module).copy()
    for node in ast.parse(inspect.getsource(module)).body:
        if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING":
            exec(ast.unparse(node.body), known)
    return get_type_hints(typed, known, known)


def leaves(function):
    """The types of a function's parameters, of a bundle those of its fields."""
    typed = hints(function)
    found = {}
    for name, kind in typed.items():
        if name != "return":
            found |= leaves(kind) if kind in _BUNDLES else {name: kind}
    return found


def names(stages):
    return [stage.name for stage in stages]


@pytest.fixture
def experiment():
    return check(small())


def test_stages_follow_those_they_need(experiment):
    stages = [
        Stage("c", lambda b, a: a + b),
        Stage("b", lambda a: 2 * a),
        Stage("a", lambda seed: 10 * seed),
    ]
    assert names(Graph(stages, experiment)) == ["a", "b", "c"]
    # those that need nothing of each other stay as they are
    assert names(Graph([Stage("y", lambda: 1), Stage("x", lambda: 2)], experiment)) == ["y", "x"]


def test_no_pair_is_fitted_behind_a_turbine_unless_it_is_asked_for():
    turbine = load("turbine")
    assert turbine.sensor and "vortices" not in names(stages_of(turbine))
    asked = load("turbine", ["retrieval.methods=[variational,vortex_fit]"])
    assert "vortices" in names(stages_of(asked))
    assert "vortices" in names(stages_of(load("wake_sensor")))


@pytest.mark.parametrize(
    ("stages", "message"),
    [
        ([Stage("a", lambda b: 1)], "stage a: nothing gives b"),
        ([Stage("a", lambda: 1), Stage("a", lambda: 2)], "stages: a given twice"),
        ([Stage("a", lambda b: 1), Stage("b", lambda a: 1)], "stages: a, b need each other"),
        ([Stage("a", lambda b: 1, preflight=True), Stage("b", lambda: 1)], "stage a: of the prefl"),
    ],
)
def test_stages_that_do_not_go_together_are_named(stages, message, experiment):
    with pytest.raises(ValueError, match=message):
        Graph(stages, experiment)


def test_a_stage_is_there_if_all_that_it_cannot_do_without_is():
    def of_volume(volume: config.Experiment) -> int:
        return 1

    def after(first: int) -> int:
        return 2

    def without(first: int | None) -> int | None:
        return first

    stages = [Stage("first", of_volume), Stage("second", after), Stage("third", without)]
    graph = Graph(stages, check(small()))
    assert names(graph) == ["third"]
    assert graph.compute(graph["third"], {}, Log(), ".") is None


def test_a_result_depends_on_the_keys_of_its_signature_and_of_all_that_it_needs():
    def light(
        lidar: Annotated[BackscatterLidar, But("pulse_energy")], wake_texture_rms: float
    ) -> int:
        return 1

    def image(light: int, scan: Annotated[object, Only("range")], limit: Annotated[int, Guard]):
        return 2

    def limit(retrieval: object) -> int:
        return 3

    graph = Graph(
        [Stage("light", light), Stage("limit", limit), Stage("image", image)], check(small())
    )
    keys = graph.keys(graph["image"])
    held = ("lidar.fov_half", "wake.texture.rms", "scan.range")
    others = ("lidar.pulse_energy", "wake.texture", "scan.thickness", "retrieval.template", "seed")
    assert all(key in keys for key in held) and not any(key in keys for key in others)
    settings = {"lidar": {"fov_half": 1, "pulse_energy": 2}, "scan": {"range": 3}, "seed": 4}
    assert keys.of(settings) == {"lidar.fov_half": 1, "scan.range": 3}
    # a section that is left out is one value
    assert keys.of({"lidar": None}) == {"lidar": None}


def test_a_bundle_stands_for_its_fields():
    """What it takes, what a result depends on, and what a stage gets; also one in another."""

    @bundle
    class Light:
        lidar: Annotated[BackscatterLidar, But("pulse_energy")]
        seed: int

    @bundle
    class Image:
        light: Light
        first: int

    def first() -> int:
        return 7

    def image(image: Image, scan: Annotated[object, Only("range")]) -> Image:
        return image

    experiment = check(small())
    graph = Graph([Stage("second", image), Stage("first", first)], experiment)
    assert names(graph) == ["first", "second"] and graph.needs(graph["second"]) == ["first"]
    made = graph.compute(graph["second"], {"first": 7}, Log(), ".")
    assert made == Image(Light(experiment.lidar, experiment.seed), 7)
    assert call(image, experiment, first=8) == replace(made, first=8)
    keys = graph.keys(graph["second"])
    assert all(key in keys for key in ("lidar.fov_half", "seed", "scan.range"))
    assert "lidar.pulse_energy" not in keys and "scan.thickness" not in keys


class Drawer:
    """Stores things as a run folder does, with what an earlier run left."""

    def __init__(self, **left):
        self.parts, self.results = left, {}

    def stored(self, part):
        return self.parts.get(part)

    def store_part(self, part, value):
        self.parts[part] = f"{value}, read"
        return self.parts[part]

    def store_result(self, name, value):
        self.results[name] = value


def test_parts_that_are_there_are_not_made_again(experiment):
    asked, needed = [], []

    def compute(number, missing):
        asked.append(list(missing))
        yield from ((name, f"new {name}") for name in missing)

    stages = [
        Stage("number", lambda: needed.append(1), on_demand=True),
        Stage("images", compute, parts=lambda: ("one", "two")),
    ]
    graph = Graph(stages, experiment)

    def images(store=None):
        return graph.compute(graph["images"], {}, Log(), ".", store)

    drawer = Drawer(two="old two")
    expected = {"one": "new one, read", "two": "old two"}
    assert images(drawer) == expected and needed == [1]
    # all there: nothing is computed, nor what only they need; no store: all are made
    assert images(drawer) == expected and needed == [1]
    assert images() == {"one": "new one", "two": "new two"}
    assert asked == [["one"], ["one", "two"]]


def test_names_are_unambiguous_and_types_those_of_the_results():
    """No stage has the name of a section; every parameter is typed; results are what is said."""
    said = hints(Results)
    assert {stage.name for stage in STAGES} == set(said)
    for stage in STAGES:
        assert section_path(stage.name) is None
        functions = (stage.compute, stage.check, stage.remarks, stage.parts)
        for function in (f for f in functions if f is not None):
            typed = leaves(function)
            assert {p.name for p in parameters(function)} <= set(typed), function
        if not inspect.isclass(stage.compute):
            kind = hints(stage.compute)["return"]
            assert get_origin(kind) is Iterator or kind == said[stage.name], stage.name


def test_a_parameter_names_a_key():
    assert section_path("doppler_camera") == "doppler.camera"
    assert section_path("wake_texture_rms") == "wake.texture.rms"
    assert section_path("wake") == "wake" and section_path("nothing") is None
    assert get_type_hints(pipeline.true_cores)["wake"] is Wake


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
        @wraps(stage.compute)
        def compute(*needed, **options):
            counts[stage.name] = counts.get(stage.name, 0) + 1
            return stage.compute(*needed, **options)

        return replace(stage, compute=compute)

    monkeypatch.setattr(pipeline, "STAGES", tuple(map(counting, STAGES)))
    yield counts
    gc.collect()
    gc.collect()


@pytest.mark.slow
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
