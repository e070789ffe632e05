"""What is warned of before a run, and the light that is forecast.

Detects: a wake of a wrong sign or a lidar that loses its light without a word, warnings of what is
right, and a forecast of light or noise that is not what the rendered images and the detector have.
"""

import re

import numpy as np
import pytest
import yaml

from lidar_mi.experiment.graph import call
from lidar_mi.experiment.log import Log
from lidar_mi.experiment.preflight.check import sections
from lidar_mi.experiment.run import finish, prepare
from lidar_mi.experiment.stages.light_budget import light_budget
from lidar_mi.schema import reading
from tests.support.command_line import in_process, words_of

WAKE = {
    "name": "warned",
    "wake": {
        "file": "wake_slab_40s.nc",
        "time": "40 s",
        "spacing": "1 m",
        "extinction": {"molecules": 0},
    },
    "render": {"samples_per_beam": 16, "max_order": 1},
    "retrieval": {"methods": ["cc"], "stride": 8, "sources": "measured"},
    "detector": {},
}


def prepared(**changes):
    return prepare(reading.check(reading.merged(WAKE, changes), "warned"))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"wake": {"names": {"v": "-v"}}}, "the divergence of v, w has 1"),
        ({"wake": {"names": {"v": "-v", "w": "-w"}}}, "the pair rises"),
        ({"wake": {"names": {"z": "-z", "w": "-w"}}}, "the pair rises"),
        ({"scan": {"range": "76 m"}}, "scan.range: a field of view (half angle) of 5 mrad sees"),
        ({"platform": {"dt": "0.5 s"}}, "platform.dt: windows of cc follow"),
        ({"retrieval": {"search": 16}, "platform": {"dt": "0.5 s"}}, "retrieval.search: windows"),
        (
            {"scan": {"timing": {"pattern": "lissajous", "cycles": [7, 5], "duration": "50 ms"}}},
            "beams of lissajous are resampled",
        ),
        ({"scan": {"timing": {"pattern": "raster", "duration": "50 ms"}}}, None),
        (
            {"lidar": {"fov_half": "0.2 deg"}, "scan": {"range": "90 m"}},
            "lidar.fov_half: 0.2 deg sees",
        ),
        (
            {
                "wake": {
                    "vortex_pair": {"circulation": "1100 m^2/s", "core_radius": "0.3 m"},
                    "file": None,
                    "time": None,
                }
            },
            "are circulation and core radius right?",
        ),
        ({"platform": {"dt": "0.5 s"}}, "windows of cc follow"),
        ({}, None),
    ],
)
def test_what_is_likely_wrong_is_said_once(changes, words):
    found = prepared(**changes).warnings
    assert len(found) == (words is not None)
    assert words is None or words in found[0]


def test_no_number_of_another_case():
    """Of a curve that was never measured no factor is stated, nor of the rows."""
    timing = {"pattern": "risley", "cycles": [9, -4], "duration": "50 ms"}
    (text,) = prepared(scan={"timing": timing}).warnings
    assert not re.search(r"\d(\.\d)? times|\d %", text)
    assert "was not measured" in text


def test_warnings_of_defaults_name_what_was_written():
    """Whatever is changed: the key that a warning begins with is one of the experiment's own."""
    for changes in (
        {"scan": {"range": "76 m"}},
        {"platform": {"dt": "0.5 s"}},
        {"wake": {"names": {"v": "-v"}}},
    ):
        one = prepared(**changes)
        for text in one.warnings:
            key = text.partition(":")[0]
            section = one.experiment
            for part in key.split("."):
                assert part in section.model_fields_set, (key, changes)
                section = getattr(section, part)


def test_a_warning_is_said_once(capsys):
    log = Log(lambda text, fraction: print(text))
    for _ in range(2):
        log.remark("dim")
    assert log.warnings == ["dim"] and capsys.readouterr().out.count("dim") == 1


@pytest.mark.slow
@pytest.mark.parametrize("command", ["check", "run"])
def test_the_terminal_shows_a_warning_once(command, tmp_path):
    """Standard output and error together; of a check in its table, of a run as it is found."""
    variants = {"a": {"seed": 1}, "b": {"seed": 2}}
    asked = reading.merged(WAKE, {"scan": {"range": "76 m"}})
    asked["wake"] = {"vortex_pair": {"width": "30 m", "height": "24 m"}, "spacing": "1 m"}
    for number, one in enumerate([asked, asked | {"variants": variants}]):
        folder = tmp_path / str(number)
        folder.mkdir()
        (folder / "a.yaml").write_text(yaml.safe_dump(one))
        done = in_process(command, "a.yaml", cwd=folder)
        assert done.returncode == 0, done.stderr
        lines = [line for line in (done.stdout + done.stderr).splitlines() if "warning: " in line]
        assert len(lines) == len(set(lines))
        whole = words_of(done.stdout + done.stderr)
        assert whole.count("of 5 mrad sees") == number + 1


def test_check_ends_with_the_warnings():
    asked = reading.check(reading.merged(WAKE, {"scan": {"range": "76 m"}}), "warned")
    *_, (title, rows) = sections(asked)
    assert title == "warned: warnings" and "overlap" in rows[0][0]


@pytest.mark.parametrize("molecules", [0, "auto"])
def test_light_and_noise_are_those_of_the_rendered_image(molecules):
    """The first order's median, to the spread of air in the median pixels (3 %)."""
    run = prepared(wake={"extinction": {"molecules": molecules}})
    results = run.results
    light = call(
        light_budget,
        run.experiment,
        truth=results["truth"],
        plan=results["plans"][0],
        air=results["air"],
        clear_air=results["clear_air"],
    )
    finish(run, with_figures=False)
    scan = run.scans[0].isel(gate=0)
    s0 = scan["S0"].values
    assert light.s0 == pytest.approx(np.median(s0), rel=0.03)
    noise = np.median(scan["S0_noise_std"].values / s0)
    assert light.noise == pytest.approx(noise, rel=0.03)
    assert light.photoelectrons == pytest.approx(run.metrics["detector.signal"], rel=0.03)
