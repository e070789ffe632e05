"""Commands to start with: list, new, explain, and completion of --set. System tier.

Detects an experiment without its question or its needs, a file of one's own that differs from what
it was made of, cannot be checked or replaces another file, a key whose explanation lacks what it
does or is not what the description checks, a mistyped key without the nearest one, and an example
that is not allowed.
"""

import math
import re
import shlex

import pytest
import yaml

from lidar_mi.cli import app as cli
from lidar_mi.cli.options import complete_change, complete_key, complete_shipped
from lidar_mi.schema import keys, reading
from lidar_mi.schema.shipped import (
    campaigns,
    experiments,
    flights,
    instrument_file,
    question_and_needs,
    shipped_file,
)
from lidar_mi.units import to_si
from tests.support.command_line import words_of

SHIPPED = experiments()
KEYS = keys.names()


# --- list ---------------------------------------------------------------------------------------


def test_list_names_all_that_is_shipped(lidar_mi):
    code, out, err = lidar_mi("list")
    assert (code, err) == (0, "")
    named = re.findall(r"^│ (\w+) +│", out, re.MULTILINE)
    assert sorted(named) == sorted([*SHIPPED, *campaigns()])
    # flights are among those that are flown
    at = {name: out.index(f"│ {name} ") for name in named}
    fly, campaign = out.index("lidar-mi fly"), out.index("lidar-mi campaign run")
    assert {name for name in SHIPPED if fly < at[name] < campaign} == set(flights())
    assert all(at[name] > campaign for name in campaigns())


@pytest.mark.parametrize("name", [*SHIPPED, *campaigns()])
def test_every_shipped_file_says_what_it_shows_and_needs(name):
    question, needs = question_and_needs(name)
    assert re.fullmatch(r"[A-Z0-9].{20,160}\?", question)
    assert re.match(r"[\d.]+ (to \d+ )?(s|minutes?|runs|flights)\b", needs)
    if name in SHIPPED:
        assert re.search(r" and [\d.]+ GB$", needs)


# --- new ----------------------------------------------------------------------------------------


def _all(path):
    """Experiments of a file by their variants, without their names."""
    found = reading.load_variants(path) or {"": reading.load(path)}
    return {key: reading.settings(one) | {"name": ""} for key, one in found.items()}


@pytest.mark.parametrize("shipped", SHIPPED)
def test_a_new_file_is_what_it_was_made_of(there, lidar_mi, shipped):
    code, out, err = lidar_mi("new", "mine", "--from", shipped)
    assert (code, err) == (0, "") and "lidar-mi check mine.yaml" in out
    text = (there / "mine.yaml").read_text()
    assert yaml.safe_load(text)["name"] == "mine" and max(map(len, text.splitlines())) <= 200
    expected = _all(shipped_file(shipped))
    for one in expected.values():
        extinction = (one.get("wake") or {}).get("extinction") or {}
        # one's own air has molecules
        if str(extinction.get("molecules")).startswith("0.0 "):
            extinction["molecules"] = "auto"
            assert "# Molecules of the site's air scatter as well" in text
    assert _all(there / "mine.yaml") == expected
    assert f"lidar-mi {'fly' if shipped in flights() else 'run'} mine.yaml" in text


def test_a_new_file_finds_the_tables_that_it_names(there, lidar_mi):
    lidar_mi("new", "mine", "--from", "eye_safe")
    code, out, _ = lidar_mi("check", "mine.yaml")
    assert code == 0 and "all checks passed" in out


def test_a_new_file_can_be_checked_and_edited(there, lidar_mi):
    assert lidar_mi("new", "mine.yaml")[0] == 0
    text = (there / "mine.yaml").read_text()
    # each key with what it does, and the names of the others
    assert "  speed: 150 m/s  # of the aircraft, along x" in text
    assert re.search(r"^  # more: .*\bgate_count\b", text, re.MULTILINE)
    assert re.search(r"^# more sections: .*\bencounter\b", text, re.MULTILINE)
    edited = text.replace("  speed: 150 m/s", "  speed: 90 m/s")
    (there / "mine.yaml").write_text(edited)
    assert reading.load("mine.yaml").platform.speed == 90
    code, out, _ = lidar_mi("check", "mine.yaml")
    assert code == 0 and "all checks passed" in out


def test_a_new_file_replaces_no_other(there, lidar_mi):
    (there / "mine.yaml").write_text("name: mine\n")
    code, _, err = lidar_mi("new", "mine")
    assert code == 2 and "mine.yaml: is there already" in err
    assert (there / "mine.yaml").read_text() == "name: mine\n"


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (("a b",), "expected at most 100 letters"),
        (("wake_sensor",), "a shipped experiment has this name"),
        (("mine", "--from", "wake_senser"), "did you mean wake_sensor?"),
        (("mine", "--from", "tiny.yaml"), "expected an experiment file or one of"),
        (("mine", "--like", "halo"), "halo: no such instrument; "),
        (("mine", "--like", "radar"), "expected one of aeroli, awiator, halo_streamline, live,"),
        (("nowhere/mine",), "is no folder"),
    ],
)
def test_what_cannot_be_new_is_said_in_a_line(there, lidar_mi, arguments, says):
    before = sorted(there.iterdir())
    code, _, err = lidar_mi("new", *arguments)
    assert code == 2 and says in err and len(err.splitlines()) == 1
    assert sorted(there.iterdir()) == before


# --- explain ------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", KEYS)
def test_every_key_is_explained(name):
    key = keys.explain(name)
    assert len(key.meaning) > 3 and key.allowed
    assert key.meaning.strip() == key.meaning and "\n" not in key.meaning


def _value_at(experiment, name):
    for part in name.split("."):
        experiment = getattr(experiment, part)
    return experiment


# of sections that every experiment with a wake has
PLAIN = [
    name
    for name in keys.settable()
    if re.match(r"(lidar|render|retrieval|scan|site)\.(?!timing)", name)
    and keys.explain(name).example
]
# what their examples need besides
TOGETHER = {"retrieval.pointing.offset": ["retrieval.pointing.stderr=1 mrad"]}


@pytest.mark.parametrize("name", PLAIN)
def test_defaults_are_those_of_an_experiment(name):
    """As an experiment that leaves the key out has it."""
    base = reading.load(shipped_file("wake_backscatter"))
    bare = reading.check({"name": "a", "wake": reading.settings(base)["wake"]}, "a")
    key = keys.explain(name)
    default, found = yaml.safe_load(key.default), _value_at(bare, name)
    if isinstance(found, tuple):
        read = [to_si(one, key.unit, "1") if key.unit else one for one in default]
        assert read == pytest.approx(list(found)) if key.unit else read == list(found)
    elif isinstance(found, float):
        assert to_si(default, key.unit, "1") == pytest.approx(found)
    else:
        assert default == found


@pytest.mark.parametrize(
    "name", [name for name in keys.settable() if re.match(r"[-\d]", keys.explain(name).default)]
)
def test_numbers_have_defaults_that_can_be_typed(name):
    key = keys.explain(name)
    assert math.isfinite(to_si(key.default, key.unit, "1"))


@pytest.mark.parametrize("name", PLAIN)
def test_examples_are_allowed(name):
    option, change = shlex.split(keys.explain(name).example)
    assert option == "--set" and change.startswith(f"{name}=")
    reading.load(shipped_file("wake_backscatter"), [*TOGETHER.get(name, ()), change])


def test_explain_says_what_a_key_does(lidar_mi):
    code, out, _ = lidar_mi("explain", "scan.gates")
    assert code == 0
    said = words_of(out)
    assert "default planar" in said and "allowed planar, spherical" in said
    assert "shape of the gates" in said and "--set scan.gates=spherical" in said
    _, out, _ = lidar_mi("explain", "lidar.wavelength")
    assert "unit m " in words_of(out) and "default 532 nm" in words_of(out)
    assert "1e-07 to 2e-05 m (from the vacuum ultraviolet" in words_of(out)
    _, out, _ = lidar_mi("explain", "platform.motion.sinusoids.axis")
    assert "of each in platform.motion.sinusoids" in words_of(out) and "--set" not in out


def test_explain_a_section_has_its_keys(lidar_mi):
    _, out, _ = lidar_mi("explain", "encounter")
    for key in ("aircraft", "path", "control", "look_ahead"):
        assert re.search(rf"^│ {key} +│", out, re.MULTILINE)
    _, out, _ = lidar_mi("explain")
    for section in ("base", "variants", "wake", "encounter"):
        assert re.search(rf"^│ {section} +│", out, re.MULTILINE)


@pytest.mark.parametrize(
    ("mistyped", "meant"),
    [
        ("scan.gate", "scan.gates or scan.gate_count"),
        ("scan.gatse", "scan.gates"),
        ("encouter", "encounter"),
        ("gates", "doppler.laser.gates or scan.gates or sensor.directions.gates"),
        ("wake.vortex_pair.circ", "wake.vortex_pair.circulation"),
        ("lidar.wavelenght", "lidar.wavelength"),
        ("varient", "variants"),
    ],
)
def test_a_mistyped_key_has_the_nearest(lidar_mi, mistyped, meant):
    code, out, err = lidar_mi("explain", mistyped)
    assert (code, out) == (2, "") and f"unknown key; did you mean {meant}?" in err


def test_a_key_unlike_any_has_the_sections(lidar_mi):
    code, _, err = lidar_mi("explain", "zzz")
    assert code == 2 and "expected name, seed, device, wake" in err


# --- completion and help -------------------------------------------------------------------------


def test_shells_complete_keys():
    assert "scan.gates=" in complete_change("scan.ga")
    assert complete_change("scan.gates=") == ["scan.gates=planar", "scan.gates=spherical"]
    assert complete_change("scan.gates=s") == ["scan.gates=spherical"]
    assert complete_change("zzz=") == [] and "scan=" not in complete_change("")
    assert complete_key("encounter.pa")[:2] == ["encounter.path", "encounter.path.speed"]
    assert complete_shipped("wake_s") == ["wake_sensor"]


def test_a_set_option_is_completed(monkeypatch, capsys):
    monkeypatch.setenv("_LIDAR_MI_COMPLETE", "complete_zsh")
    monkeypatch.setenv("_TYPER_COMPLETE_ARGS", "lidar-mi run wake_sensor --set scan.gates=s")
    with pytest.raises(SystemExit):
        cli.app(prog_name="lidar-mi")
    assert "scan.gates=spherical" in capsys.readouterr().out


def test_new_file_like_an_instrument(lidar_mi, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    code, _, _ = lidar_mi("new", "mine", "--like", "windcube_200s")
    assert code == 0
    shipped, mine = (
        instrument_file("windcube_200s").read_text(),
        (tmp_path / "mine.yaml").read_text(),
    )
    # sources stand beside the numbers as before
    assert mine == shipped.replace("name: windcube_200s", "name: mine")
    assert reading.load(tmp_path / "mine.yaml").name == "mine"
    code, _, err = lidar_mi("new", "other", "--like", "windcube_200")
    assert code == 2 and "did you mean windcube_200s?" in err and "halo_streamline" in err
    assert not (tmp_path / "other.yaml").exists()


def test_the_wind_of_a_lidar_on_the_ground_is_to_the_east_and_north(tmp_path, lidar_mi):
    """5 m/s along a flight to the south and 2 m/s to its left, which is east; and without light."""
    (tmp_path / "a.yaml").write_text(
        instrument_file("halo_streamline").read_text() + "  passage: {heading: 180 deg}\n"
    )
    change = ("--set", "doppler.signal.cnr=-60")
    _, out, _ = lidar_mi("check", str(tmp_path / "a.yaml"), *change)
    said = words_of(out)
    assert "mean wind 2 m/s to the east, -5 m/s to the north" in said
    assert "noise of a velocity no signal at 1000 m" in said
    change = ("--set", "site.altitude=1 km")
    _, _, err = lidar_mi("check", str(tmp_path / "a.yaml"), *change)
    assert "whose echo is that of aerosol and as strong as doppler.signal says" in err
