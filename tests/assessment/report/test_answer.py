"""The answer of a run. Detects numbers that are not those of the metrics, a verdict without its
reason, a phase of flight that is judged at another speed, skill that is not there, and an error of
the simulation that is called the lidar's."""

import math
from types import SimpleNamespace

import pytest

from lidar_mi.assessment.metrics.names import vortex_key
from lidar_mi.assessment.metrics.requirements import (
    Requirement,
    RequirementTable,
    judge,
    read_requirements,
)
from lidar_mi.assessment.metrics.sensor import without_skill
from lidar_mi.assessment.report.answer import answer, verdict
from lidar_mi.assessment.report.simulation import simulation_remark
from lidar_mi.assessment.report.summary import summary

TABLES = read_requirements()


def an_experiment(speed=70.0, **parts):
    return SimpleNamespace(
        imaged_wake=True,
        volume=None,
        detector=None,
        fringes=None,
        coherent=None,
        platform=SimpleNamespace(speed=speed),
        scan=SimpleNamespace(range=148.75, thickness=2.5),
        retrieval=SimpleNamespace(methods=["variational", "cc"]),
        **parts,
    )


SENSOR = {
    "sensor.vectors": 190,
    "sensor.valid_fraction": 0.565,
    **{
        f"sensor.outside_cores.rmse_{n}": v for n, v in zip("uvw", (0.231, 0.48, 10.4), strict=True)
    },
    **{f"sensor.outside_cores.rms_{n}": v for n, v in zip("uvw", (0.24, 2.8, 3.71), strict=True)},
}
MEASURED = {
    "range": 150.0,
    "points_per_slab": 63,
    "slabs_per_second": 10.0,
    "slab_depth": 10.0,
    "error_v_los": 0.16,
}


def test_the_errors_of_both_lidars():
    (line,) = answer(an_experiment(), SENSOR)
    assert line == (
        "Both lidars, 148.75 to 151.25 m ahead (2.1 s at 70 m/s), images without detector noise: "
        "rms errors of u, v, w 0.23, 0.48, 10 m/s "
        "beyond two core radii (true wind 0.24, 2.8, 3.7); 56 % of the vectors are valid."
    )
    (line,) = answer(an_experiment(), SENSOR | {"sensor.spanned_fraction": 0.57})
    assert line.endswith("; 99 % of the vectors between the lines of sight are valid.")
    (line,) = answer(an_experiment(), {"sensor.vectors": 0})
    assert line.endswith("no valid wind vector.")
    (line,) = answer(an_experiment(speed=0.0), SENSOR)
    assert line.startswith("Both lidars, 148.75 to 151.25 m ahead, images without")


def test_every_method_of_the_backscatter_lidar_with_its_skill():
    metrics = {
        "backscatter.mc_relative_error": 0.01,
        "true_wind.rms_v": 2.9,
        "true_wind.rms_w": 3.7,
        "backscatter.variational.valid_fraction": 1.0,
        "backscatter.variational.rmse_v": 0.1,
        "backscatter.variational.rmse_w": 0.11,
        "backscatter.cc.valid_fraction": 0.03,
        "backscatter.cc.no_skill_fraction": 0.97,
        "backscatter.cc.rmse_v": 3.6,
        "backscatter.cc.rmse_w": 3.8,
    }
    (line,) = answer(an_experiment(), metrics)
    assert "rms errors of v, w by variational retrieval 0.10, 0.11 m/s (100 % valid)" in line
    assert "cross-correlation no skill; the true wind has 2.9, 3.7 m/s." in line


def test_a_verdict_gives_its_reasons():
    table = TABLES["disturbance", "landing"]
    assert verdict(table, judge(table, MEASURED)) == (
        "Landing, disturbance phenomenon, from line-of-sight velocities: 4 of 5 rows fulfilled; "
        "slab depth 10 m against at most 4.5 m."
    )
    better = judge(table, MEASURED | {"slab_depth": 4.0})
    assert "all 5 rows fulfilled." in verdict(table, better)
    unknown = judge(table, MEASURED | {"slab_depth": 4.0, "error_v_los": math.nan})
    assert verdict(table, unknown).endswith(
        "4 of 5 rows fulfilled; not judged: error of line-of-sight velocity (not measured)."
    )


@pytest.mark.parametrize(("error", "skill"), [(0.24, False), (0.231, False), (0.15, True)])
def test_a_component_as_uncertain_as_it_varies_fulfils_nothing(error, skill):
    """190 vectors: an rms is known to 5 %. u varies by 0.24 m/s, v and w by more than errors."""
    table = RequirementTable(
        "wake", "a table", "landing", tuple(Requirement(f"error_{n}", maximum=1.0) for n in "uvw")
    )
    metrics = SENSOR | {
        "sensor.outside_cores.rmse_u": error,
        "sensor.outside_cores.rmse_w": 0.5,
        **{
            f"sensor.outside_cores.std_{n}": v for n, v in zip("uvw", (0.24, 2.8, 3.7), strict=True)
        },
    }
    errors = {f"error_{n}": metrics[f"sensor.outside_cores.rmse_{n}"] for n in "uvw"}
    found = judge(table, errors, {f"error_{n}": "no skill" for n in without_skill(metrics)})
    *_, line = answer(an_experiment(), metrics, [(table, found)])
    assert ("all 3 rows fulfilled." in line) == skill
    words = "2 of 3 rows fulfilled; not judged: error of u (no skill)."
    assert (words in line) != skill


@pytest.mark.parametrize(
    ("speed", "assessed", "other"),
    [(70.0, "Landing", "Cruise (from 129 m/s)"), (240.0, "Cruise", "Landing (up to 129 m/s)")],
)
def test_a_phase_is_judged_at_its_own_speed(speed, assessed, other):
    judged = [(table, judge(table, MEASURED)) for table in TABLES.values()]
    _, *lines, last = answer(an_experiment(speed), SENSOR, judged)
    assert len(lines) == 2 and all(line.startswith(f"{assessed}, ") for line in lines)
    assert last == f"{other}: not assessed at {speed:g} m/s."


def test_the_vortices_with_their_errors():
    metrics = SENSOR | {
        "vortex.truth.port_circulation_5_15": 440.1,
        "vortex.truth.starboard_circulation_5_15": -439.2,
        "vortex.vectors.port_circulation_5_15": 412.27,
        "vortex.vectors.port_circulation_5_15_stderr": 8.495,
        "vortex.vectors.starboard_circulation_5_15": -416.34,
        "vortex.vectors.starboard_circulation_5_15_stderr": 8.306,
    }
    line = answer(an_experiment(), metrics)[1]
    assert line == (
        "Vortex pair: circulations 412.3 ± 8.5 and -416.3 ± 8.3 m²/s, true 440 and -439 m²/s, "
        "off by up to 3.3 standard errors."
    )


def test_a_statistic_has_its_error_bar():
    """Of few images a standard deviation may be below its bound: 0.119 +- 0.021 against 0.136."""
    experiment = an_experiment()
    experiment.imaged_wake = None
    experiment.fringes = SimpleNamespace(
        lidar=SimpleNamespace(range=56.0),
        retrieval=SimpleNamespace(methods=["annular"], centre=["free"], averaged=[20]),
    )
    metrics = {
        f"doppler.{key}": value
        for key, value in {
            "annular.centre_free.averaged_20.std": 0.119,
            "annular.centre_free.averaged_20.std_stderr": 0.0212,
            "annular.centre_free.averaged_20.bias": 0.0244,
            "annular.centre_free.averaged_20.bias_stderr": 0.0301,
            "bound.centre_free.averaged_20.std": 0.136,
        }.items()
    }
    (line,) = answer(experiment, metrics)
    assert line == (
        "Doppler lidar, 56 m ahead, all rings, full model: standard deviation of the line-of-sight "
        "velocity of 20 images 0.119 ± 0.021 m/s (Cramér-Rao bound 0.14), bias 0.024 ± 0.030 m/s."
    )
    (table,) = summary(metrics, [20])
    assert ("annular", "free", "0.119 ± 0.021", "0.024 ± 0.030") in table.rows
    assert ("(bound)", "free", "0.136", "-") in table.rows


@pytest.mark.parametrize(
    ("inner", "outer", "valid", "words"),
    [
        (0.45, 0.71, 0.9, "too small here: 71 % of the errors are within 1.96 of them (95 %)"),
        (0.95, 1.0, 0.9, "too large here: 95 % of the errors are within 1 of them (68 %)"),
        (0.66, 0.94, 0.9, None),
        (0.45, 0.71, 0.1, None),
    ],
)
def test_standard_errors_that_do_not_hold_are_said(inner, outer, valid, words):
    head = "backscatter.variational."
    metrics = {f"{head}coverage_68_{n}": inner for n in "vw"}
    metrics |= {f"{head}coverage_95_{n}": outer for n in "vw"} | {f"{head}valid_fraction": valid}
    said = [line for line in answer(an_experiment(sensor=None), metrics) if "stated" in line]
    assert len(said) == bool(words)
    assert words is None or words in said[0]


@pytest.mark.parametrize(("found", "words"), [(424.7, "3.3 standard errors"), (431.0, None)])
def test_a_circulation_off_by_many_standard_errors_is_said(found, words):
    metrics = {}
    for side in ("port", "starboard"):
        metrics[vortex_key("truth", f"{side}_circulation_5_15")] = 440.0
        key = vortex_key("vectors", f"{side}_circulation_5_15")
        metrics |= {key: found if side == "port" else 440.0, f"{key}_stderr": 4.6}
    (line,) = answer(an_experiment(sensor=None), metrics)
    assert (words in line) if words else ("standard errors" not in line)


NOISY = {
    "backscatter.mc_relative_error": 0.01,
    "backscatter.samples_per_beam": 64,
    "backscatter_noisy.monte_carlo_fraction": 1.5,
    "true_wind.rms_v": 2.9,
    "true_wind.rms_w": 3.7,
    **{
        f"backscatter_noisy.{method}.{key}": value
        for method in ("variational", "cc")
        for key, value in (("valid_fraction", 1.0), ("rmse_v", 0.3), ("rmse_w", 0.4))
    },
}


def rendered(samples="auto", detector=True, **parts):
    experiment = an_experiment(**parts)
    experiment.detector = detector or None
    experiment.render = SimpleNamespace(samples_per_beam=samples, monte_carlo_fraction=0.1)
    return experiment


def noise(method, v, w):
    key = f"backscatter_noisy.{method}.monte_carlo_"
    return {f"{key}v": v, f"{key}w": w}


def test_the_first_sentence_says_which_part_is_the_simulations():
    """0.15 and 0.2 of 0.3 and 0.4 m/s are a quarter of the mean square error."""
    metrics = NOISY | noise("variational", 0.15, 0.2) | noise("cc", 0.03, 0.04)
    first, second = answer(rendered(64), metrics)
    assert first == (
        "Noise of the simulation, which a lidar does not have, causes 25 % (variational "
        "retrieval) of the mean square error of v and w (64 Monte Carlo samples per beam, with "
        "1.5 times the variance of the detector noise)."
    )
    assert second.startswith("Backscatter lidar, ")
    text = simulation_remark(rendered(64), metrics)
    assert text.startswith("render.samples_per_beam: noise of the simulation")
    assert text.endswith("; expected 960 or more, or auto")
    text = simulation_remark(rendered("auto"), metrics)
    assert text.startswith("render.max_samples: ") and text.endswith("expected 15 times as many")


@pytest.mark.parametrize(
    "part",
    [
        {"backscatter_noisy.monte_carlo_fraction": 0.09},
        noise("variational", 0.08, 0.12),
        noise("cc", 0.05, 0.09),
    ],
)
def test_a_small_part_has_no_sentence(part):
    """0.09 of the error, a tenth of all else: as asked for. Without numbers of it, of the noise."""
    experiment = rendered(64)
    (only,) = answer(experiment, NOISY | part)
    assert only.startswith("Backscatter lidar, ") and not simulation_remark(
        experiment, NOISY | part
    )


def test_without_a_detector_all_noise_is_the_simulations():
    metrics = {
        key.replace("_noisy", ""): value for key, value in NOISY.items() if "fraction" not in key
    }
    metrics |= {"backscatter.variational.valid_fraction": 1.0}
    part = {
        "backscatter.variational.monte_carlo_v": 0.1,
        "backscatter.variational.monte_carlo_w": 0.3,
    }
    experiment = rendered(64, detector=False)
    first, _ = answer(experiment, metrics | part)
    assert "causes 40 % (variational retrieval) of the mean square error of v and w (64" in first
    # 64 x 0.4 / 0.6 / 0.1
    assert simulation_remark(experiment, metrics | part).endswith("; expected 430 or more")
    lost = {"backscatter.variational.valid_fraction": 0.0}
    first, _ = answer(experiment, metrics | lost)
    assert first.startswith(
        "No vector is valid with as much noise again, and noise of the images, 1 %"
    )
    # 1 % of the light against a texture of 2 %: 64 (1/2)^2 / 0.1
    experiment.wake = SimpleNamespace(texture=SimpleNamespace(rms=0.02))
    remark = simulation_remark(experiment, metrics | lost)
    assert remark.endswith(
        "; expected more: with 1.6e+02 its variance is 10 % of that of the texture"
    )


def test_of_volumes_the_noise_is_compared():
    experiment = rendered(64)
    experiment.volume = SimpleNamespace(methods=["correlation"])
    (first, *_) = answer(experiment, NOISY)
    assert "it has 1.5 times the variance of the detector noise" in first
    enough = NOISY | {"backscatter_noisy.monte_carlo_fraction": 0.09}
    assert answer(experiment, enough)[0].startswith("Backscatter lidar, ")


LINES = {"coherent.lines": 800.0, "coherent.noise": 0.019}
SLICES = LINES | {
    "coherent.vortices.scans": 16.0,
    "coherent.vortices.valid_fraction": 0.75,
    "coherent.vortices.circulation_error": 0.021,
    "coherent.vortices.place_error": 0.0041,
    "coherent.vortices.coverage_95_circulation": 0.9,
    "coherent.vortices.coverage_95_y": 1.0,
    "coherent.vortices.coverage_95_z": 0.5,
}


@pytest.mark.parametrize(
    ("metrics", "lines"),
    [
        (
            SLICES,
            [
                "Coherent lidar, 16 vertical slices: median errors of the vortices' circulation "
                "2.1 %, of their place 0.41 % of the separation (published: 4 % and 6 %); 75 % of "
                "the slices are valid.",
                "95 % intervals of circulation, distance and height hold 90 %, 100 %, 50 % of the "
                "errors.",
            ],
        ),
        (
            LINES | {"coherent.vortices.scans": 3.0, "coherent.vortices.valid_fraction": 0.0},
            ["Coherent lidar, 3 vertical slices: no valid vortex."],
        ),
        (
            LINES
            | {f"coherent.winds.rmse_{name}": 0.25 for name in "uvw"}
            | {"coherent.winds.valid_fraction": 1.0},
            [
                "Coherent lidar: rms errors of the wind to the east, to the north and up 0.250, "
                "0.250, 0.250 m/s; 100 % of the winds are valid."
            ],
        ),
        (
            LINES,
            [
                "Coherent lidar: 800 lines of sight, whose velocities have a noise of 0.019 m/s "
                "(median)."
            ],
        ),
    ],
)
def test_what_the_lines_of_a_coherent_lidar_tell(metrics, lines):
    experiment = an_experiment()
    experiment.imaged_wake, experiment.coherent = None, True
    assert answer(experiment, metrics) == lines


def test_the_answer_names_its_gates_its_noise_and_what_scatters():
    metrics = NOISY | {
        "backscatter.fraction.molecules": 0.235,
        "backscatter.fraction.background": 0.2,
        "backscatter.fraction.exhaust": 0.565,
    }
    first, second = answer(rendered("auto"), metrics | noise("cc", 0.01, 0.01))
    assert first.startswith("Backscatter lidar, 148.75 to 151.25 m ahead (2.1 s at 70 m/s): rms")
    assert second == (
        "Backscatter in the gate, mean over the image: molecules 24 %, clear background 20 %, "
        "exhaust 56 %."
    )
    without = {key.replace("_noisy", ""): value for key, value in NOISY.items()}
    del without["backscatter.samples_per_beam"]
    *_, line = answer(an_experiment(), without)
    assert ", images without detector noise: rms errors" in line


def test_a_coherent_lidar_without_a_signal_says_so():
    experiment = an_experiment()
    experiment.imaged_wake, experiment.coherent = None, True
    (line,) = answer(experiment, {"coherent.lines": 9.0, "coherent.signal_fraction": 0.0})
    assert line == "Coherent lidar: no signal in any gate, velocities are random."
