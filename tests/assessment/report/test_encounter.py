"""The chapter of a flight: its answer in words.

Detects a goal that is met by the wrong comparison, an upset that is told as an angle, a verdict of
another flight, a script of frames that the page lacks.
"""

import math

import pytest

from lidar_mi.assessment.metrics.encounter import judged_in_flight
from lidar_mi.assessment.metrics.requirements import read_requirements
from lidar_mi.assessment.report.encounter import (
    encounter_answer,
    encounter_chapter,
    encounter_summary,
)
from lidar_mi.assessment.report.page import Film, page
from lidar_mi.schema.reading import check
from tests.support.synthetic_lidar import encounter_keys


def numbers(**rolls):
    found = {}
    for mode, degrees in rolls.items():
        found[f"encounter.{mode}.largest_roll"] = math.radians(degrees)
        found[f"encounter.{mode}.departed"] = float(degrees >= 90)
        found[f"encounter.{mode}.roll_control_ratio"] = 1.5
    return found


def lidar_numbers(autopilot=7.0, lidar=3.0, perfect=2.0, fraction=0.8, lead=1.2, **more):
    found = numbers(off=25, autopilot=autopilot, feedforward=lidar, perfect=perfect) | {
        "encounter.slabs": 40,
        "encounter.accepted_slabs": 12,
        "encounter.slabs_to_track": 3,
        "encounter.prediction_error": 0.04,
    }
    if lead is not None:
        found |= {"encounter.preview_from": 1.0, "encounter.lead_time": lead}
    if fraction is not None:
        found["encounter.removed_beyond_autopilot.largest_roll"] = fraction
    return found


@pytest.mark.parametrize(
    ("values", "first"),
    [
        (
            {},
            "Beyond the autopilot, the lidar removes 4 degrees of the largest roll angle, 80 % of "
            "what perfect preview removes (5): it meets lidar-mi's own goal of 80 %.",
        ),
        ({"lidar": 5.0, "fraction": 0.4}, "40 % of what perfect preview removes (5): it misses"),
        (
            {"lidar": 7.2, "fraction": -0.04},
            "The lidar adds nothing: the largest roll angle is 7 degrees with the autopilot, 7.2",
        ),
        ({"lidar": 9.0, "fraction": -0.4}, "The lidar makes it worse: the largest roll angle is 7"),
        (
            {"autopilot": 2.3, "lidar": 2.2, "fraction": None},
            "There was nothing for the lidar to add: beyond the autopilot, perfect preview removes "
            "0.3 degrees of the largest roll angle, less than 0.5.",
        ),
        (
            {"lead": None},
            "The lidar never had a preview: 12 fits of vortices accepted, in 40 slabs. It added "
            "nothing to the autopilot.",
        ),
        ({"lead": -0.42}, "The lidar's first preview came too late by 0.42 s. Beyond"),
    ],
)
def test_the_verdict_is_what_the_lidar_added(values, first):
    answer, rolls, *_ = encounter_answer(lidar_numbers(**values))
    assert first in answer
    assert rolls.startswith("Largest roll angles in this wake: 25 degrees (without control), ")


def test_the_first_preview_is_told():
    text = " ".join(encounter_answer(lidar_numbers()))
    assert "usable after 3 accepted fits, 1.2 s before the wake is first felt" in text
    assert "The flight with the lidar stays below the 7 degrees of bank" in text


def test_flights_through_air_are_called_so():
    metrics = numbers(off=25, perfect=2)
    answer, *_ = encounter_answer(metrics, met="air")
    assert answer.startswith("Largest roll angles in this air: 25 degrees") and "wake" not in answer
    assert "The air's rolling moment reaches 1.5 times" in answer
    chapter = encounter_chapter(metrics, [], [], met="air")
    assert chapter.title == "Into the air"
    table, *_ = encounter_summary(metrics, met="air")
    assert ("largest rolling moment of the air over the ailerons'", "1.50", "1.50") in table.rows


def test_an_upset_is_told():
    (answer,) = encounter_answer(numbers(off=120))
    assert answer.startswith("Largest roll angles in this wake: upset (without control). This")


def test_summary_names_every_flight():
    table, *_ = encounter_summary(numbers(off=25.3, perfect=2.04))
    assert table.heads == ("", "without control", "perfect preview")
    assert table.rows[0] == ("largest roll angle / degrees", "25.3", "2.04")


def test_page_has_frames_and_their_script():
    frames = [(b"one", "0.1 s"), (b"two", "0.2 s"), (b"three", "0.3 s")]
    judged = judged_in_flight(read_requirements(), {"slabs_per_second": 10.0}, 75.0)
    shown = Film("The flight", "Frames.", frames, 0.2)
    chapter = encounter_chapter(numbers(off=25), judged, [], shown)
    html = page(check(encounter_keys(), "test"), "name: x", {"lidar-mi": "0"}, {}, [chapter])
    assert html.count('class="film"') == 1 and "for (const film of" in html
    # the one in the middle is there without a script
    assert "base64,dHdv" in html and '<p class="now">0.2 s</p>' in html
    assert "crossing the wake at 20 degrees" in html
    row = 'data-head="measured">10 Hz</td><td data-head="required">at least 10 Hz</td>'
    assert row in html and 'table class="many"' in html


def test_page_has_the_video_and_the_animation_for_browsers_without():
    shown = Film("The flight", "Frames.", [(b"one", "0.1 s")], 0.2, b"film", "approach.gif")
    chapter = encounter_chapter(numbers(off=25), [], [], shown)
    html = page(check(encounter_keys(), "test"), "name: x", {"lidar-mi": "0"}, {}, [chapter])
    assert '<video class="paper" controls' in html
    assert 'src="data:video/mp4;base64,ZmlsbQ=="' in html
    assert 'src="approach.gif"' in html and "for (const film of" not in html


@pytest.mark.parametrize(
    ("model", "air", "words"),
    [
        ("roll", None, "only rolls, at 75 m/s, crossing the wake"),
        ("heave", {"wake": False}, "moves vertically, at 75 m/s, on a path of"),
        ("737", None, "JSBSim&#39;s 737, at 75 m/s, crossing the wake"),
    ],
)
def test_page_names_the_aircraft_and_what_it_meets(model, air, words):
    keys = encounter_keys()
    keys["encounter"] = keys["encounter"] | {"aircraft": {"model": model}, "air": air}
    html = page(check(keys, "test"), "name: x", {"lidar-mi": "0"}, {}, [])
    assert words in html


@pytest.mark.parametrize("mode", ["off", "perfect"])
def test_flights_without_a_lidar_have_no_verdict(mode):
    assert encounter_chapter(numbers(**{mode: 3}), [], []).verdict is None


def test_a_flight_that_is_not_rolled_has_no_ratio_of_rounding():
    (answer,) = encounter_answer(numbers(off=1e-15, autopilot=1e-12, perfect=1e-12))
    assert answer.startswith("No flight rolls by more than 0.01 degrees")


def test_loads_in_words():
    metrics = numbers(off=2, perfect=1)
    for mode, load in (("off", 0.75), ("autopilot", 0.78), ("perfect", 0.3)):
        metrics[f"encounter.{mode}.largest_load_increment"] = load
        metrics[f"encounter.{mode}.largest_bending_increment"] = 1e6 * load
    assert encounter_answer(metrics)[1] == (
        "The load factor changes by up to 0.75 without control, 0.78 with the autopilot, 0.3 with "
        "perfect preview."
    )
    # a gust on both wings alike
    level = metrics | {f"encounter.{mode}.largest_roll": 0.0 for mode in ("off", "perfect")}
    assert encounter_answer(level, met="air")[1] == encounter_answer(metrics)[1]
    (table, *_) = encounter_summary(metrics, met="air")
    rows = {row[0]: row[1:] for row in table.rows}
    assert rows["largest change of a wing root's bending / kN m"][0] == "750"
