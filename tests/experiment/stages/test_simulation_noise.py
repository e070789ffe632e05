"""Samples that are chosen, and what the simulation's noise adds to the wind.

With random numbers that are independent, and with common ones, whose errors move with the air.
Detects: a stated variance that differs from that of other random numbers by a fifth, an image that
holds samples of its pilot or depends on more than the number of its samples, an error of the wind
that is the simulation's and called the lidar's, and one that is the lidar's and called the
simulation's by half.
"""

import numpy as np
import pytest

from lidar_mi.experiment.graph import call
from lidar_mi.experiment.log import Log
from lidar_mi.experiment.pipeline import stages_of
from lidar_mi.experiment.preflight.cost import with_number
from lidar_mi.experiment.run import finish, prepare
from lidar_mi.experiment.stages import rendering
from lidar_mi.experiment.stages.rendering import (
    IMAGES,
    batches_of,
    chosen_samples,
    detect_images,
    render_images,
)
from lidar_mi.experiment.stages.simulation_noise import simulation_noise
from lidar_mi.experiment.stages.winds import cross_flow_winds
from lidar_mi.rendering.samples import noise_ratio
from lidar_mi.schema import reading
from lidar_mi.schema.reading import load_experiment

pytestmark = pytest.mark.usefixtures("variant")


def newcomer(**changes):
    """An own wake in aerosol alone, 200 m ahead, 5 mJ; samples as they come by default."""
    pair = {"circulation": 60, "separation": 16, "core_radius": 5, "width": 40, "height": 26}
    data = {
        "name": "newcomer",
        "wake": {
            "vortex_pair": pair,
            "spacing": "1 m",
            "texture": {"outer_scale": "5 m"},
            "extinction": {"molecules": 0},
        },
        "platform": {"speed": "70 m/s"},
        "lidar": {"pulse_energy": "5 mJ", "pulse_duration": "10 ns"},
        "scan": {"range": "200 m"},
        "detector": {},
        "render": {"max_order": 1, "random_numbers": "independent"},
        "retrieval": {"methods": ["variational"], "stride": 3, "sources": "measured"},
    }
    return reading.check(reading.merged(data, changes), "newcomer")


@pytest.fixture(scope="module")
def prepared():
    return prepare(newcomer())


def needed(prepared):
    return {name: prepared.results[name] for name in ("truth", "plans", "air", "flows")}


def rendered(experiment, prepared, **how):
    graph, results = stages_of(experiment), needed(prepared)
    samples = graph.compute(graph["samples"], results, Log(), experiment.folder)
    return dict(call(render_images, experiment, **needed(prepared), samples=samples, **how))


def detect(experiment, prepared, images):
    plans, truth = prepared.results["plans"], prepared.results["truth"]
    return call(detect_images, experiment, truth=truth, images=images, plans=plans)


def reseeded(experiment, seed):
    """The same air and detector with other random numbers of the light transport."""
    return experiment.model_copy(update={"seed": seed})


@pytest.fixture(scope="module")
def number(prepared):
    """The chosen number of samples."""
    return call(chosen_samples, prepared.experiment, **needed(prepared)).number


@pytest.mark.slow
def test_the_stated_fraction_is_that_of_other_random_numbers(prepared, number):
    """Variance of 12 renderings of the same air, of every beam, over the detector's."""
    asked = with_number(prepared.experiment, number)
    count, (plan, _) = 12, prepared.results["plans"]
    images = [
        rendered(reseeded(asked, seed), prepared, missing=IMAGES[:1])["image_t1"]
        for seed in range(1, count + 1)
    ]
    s0 = np.stack([image["S0"].values[0].astype(float) for image in images])
    one, truth = {"image_t1": images[0], "image_t2": images[0]}, prepared.results["truth"]
    detected = call(detect_images, asked, truth=truth, images=one, plans=[plan, plan])[0]
    ratio = s0.var(0, ddof=1) / detected["S0_noise_std"].values[0].astype(float) ** 2
    stated = detected.attrs["monte_carlo_fraction"]
    assert stated == pytest.approx(float(noise_ratio(detected).mean()))
    error = ratio.std() / np.sqrt(ratio.size)
    assert abs(ratio.mean() - stated) < 4 * error < 0.2 * stated
    asked_for = asked.render.monte_carlo_fraction
    assert 0.75 * asked_for < stated < 1.05 * asked_for


@pytest.mark.slow
def test_an_image_of_chosen_samples_is_that_of_the_number_alone(prepared, number, monkeypatch):
    """So its mean is that of independent samples whose number another, independent image chose."""
    seeds = []
    render = rendering.render_scans

    def watched(*given, **how):
        seeds.append((given[5], given[4].samples_per_beam))
        return render(*given, **how)

    monkeypatch.setattr(rendering, "render_scans", watched)
    chosen = rendered(prepared.experiment, prepared, missing=IMAGES[1:])["image_t2"]
    fixed = rendered(with_number(prepared.experiment, number), prepared, missing=IMAGES[1:])
    assert np.array_equal(chosen["S0"].values, fixed["image_t2"]["S0"].values)
    assert chosen.attrs["samples_per_beam"] == number
    (pilot, few), *others = seeds
    assert few < number and all(abs(pilot - seed) >= 1 << 29 for seed, _ in others)


@pytest.mark.slow
@pytest.mark.parametrize("numbers", ["independent", "common"])
def test_what_it_adds_to_the_wind_is_the_spread_of_other_random_numbers(prepared, numbers):
    """Winds of eight renderings of the same air without a detector, about their mean."""
    asked = newcomer(
        detector=None,
        render={"samples_per_beam": 32, "random_numbers": numbers},
        retrieval={"methods": ["cc"]},
    )
    plans, truth = prepared.results["plans"], prepared.results["truth"]
    winds, stated = [], []
    for seed in range(1, 9):
        one = reseeded(asked, seed)
        scans = detect(one, prepared, rendered(one, prepared))
        wind = call(cross_flow_winds, one, truth=truth, plans=plans, scans=scans, log=Log())
        winds.append(wind.isel(source=0, algorithm=0))
        more = {"detected": scans, "scans": scans, "plans": plans, "wind": wind, "log": Log()}
        stated.append(call(simulation_noise, one, **more))
    valid = np.all([(wind["flag"] == 0).values for wind in winds], 0)
    assert valid.sum() > 20
    for name in ("v", "w"):
        spread = np.var([wind[name].values[valid] for wind in winds], 0, ddof=1).mean()
        changes = np.concatenate([one[name].values[0][valid] for one in stated])
        changes = changes[np.isfinite(changes)]
        # chi-square of 7 x vectors beside 8 x vectors, half of which overlap
        sigma = np.sqrt(2 / (7 * valid.sum() / 2) + 2 / (len(changes) / 2))
        assert np.log((changes**2).mean() / spread) == pytest.approx(0, abs=max(4 * sigma, 0.3))


@pytest.mark.slow
def test_the_first_sentence_names_it_where_samples_are_too_few_and_only_there(prepared):
    for samples, expected in ((4, True), ("auto", False)):
        asked = newcomer(render={"samples_per_beam": samples})
        run = prepare(asked, known=prepared.results)
        finish(run, with_figures=False)
        said = run.answer[0].startswith("Noise of the simulation")
        warned = [text for text in run.warnings if "noise of the simulation" in text]
        assert said == expected and len(warned) == expected
        fraction = run.metrics["backscatter_noisy.monte_carlo_fraction"]
        key = "backscatter_noisy.variational.monte_carlo_w"
        assert (key in run.metrics) == (fraction > 0.1) == expected
        if expected:
            assert warned[0].startswith("render.samples_per_beam: ") and "or auto" in warned[0]
            assert run.metrics["backscatter.samples_per_beam"] == 4
    limited = newcomer(render={"max_samples": 4e4})
    run = prepare(limited, known=prepared.results)
    finish(run, with_figures=False)
    assert run.metrics["backscatter.samples_per_beam"] == 4e4 // (41 * 27)
    said = [text for text in run.warnings if text.startswith("render.max_samples: ")]
    assert bool(said) == run.answer[0].startswith("Noise of the simulation")


@pytest.mark.slow
def test_where_as_much_noise_again_leaves_no_valid_vector_it_is_said_of_the_images():
    """Of half the contrast, by molecules, and four samples."""
    molecules = {"extinction": {"molecules": "auto"}}
    run = prepare(newcomer(wake=molecules, render={"samples_per_beam": 4}))
    finish(run, with_figures=False)
    assert not np.isfinite(run.results["simulation_noise"]["w"]).any()
    assert run.metrics["backscatter_noisy.monte_carlo_fraction"] > 10
    assert run.answer[0].startswith("Noise of the images is in part that of the simulation")
    assert any(text.startswith("render.samples_per_beam: noise of") for text in run.warnings)


@pytest.mark.slow
def test_a_run_along_a_curve_has_it():
    """Which pixels scattered beams reach at the reference time depends on the noise."""
    timing = {"pattern": "lissajous", "cycles": [139, 110], "duration": "95 ms"}
    asked = load_experiment(
        "wake_backscatter",
        wake={"spacing": "1 m"},
        platform={"speed": "70 m/s"},
        lidar={"pulse_energy": "1 mJ", "pulse_duration": "10 ns"},
        scan={"range": "148.75 m", "air": "moving", "timing": timing},
        detector={},
        render={"samples_per_beam": 16, "max_order": 1},
        retrieval={"methods": ["variational"], "sources": "measured", "stride": 4},
    )
    run = prepare(asked)
    finish(run, with_figures=False)
    assert run.results["simulation_noise"].sizes["algorithm"] == 1


def test_samples_of_another_number_are_not_resumed():
    """A number that was chosen on another machine may be another one."""

    class Store:
        stored = None

        def unfinished(self, part):
            return self.stored and dict(self.stored)

        def store_unfinished(self, part, arrays):
            self.stored = arrays

    store = Store()
    batches = batches_of(IMAGES, store, Log(), 100)(0)
    batches._next = 0.0
    batches.store(3, lambda: {"image": np.ones(2)})
    assert batches_of(IMAGES, store, Log(), 100)(0).stored()[0] == 3
    assert batches_of(IMAGES, store, Log(), 110)(0).stored() == (0, {})
