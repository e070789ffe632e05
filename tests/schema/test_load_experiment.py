"""Experiments by name, with changes. Unit tier.

Detects: a change that is lost, lands in another key or replaces its section's other keys; a file
that is no longer found beside the experiment; a message that does not name the fault.
"""

import pytest

import lidar_mi as lm
from lidar_mi.schema.new_file import new_file
from lidar_mi.schema.reading import dump, load, load_variants
from lidar_mi.schema.shipped import experiment_file, shipped_file

HERE = "name: here\nwake: {file: air.nc, time: 40 s}\nscan: {range: 300 m}\n"


def test_without_changes_it_is_the_file():
    for name in lm.experiments():
        if load_variants(experiment_file(name)):
            continue
        assert dump(lm.load_experiment(name)) == dump(load(experiment_file(name)))


@pytest.mark.parametrize(
    "changes",
    [
        {"scan": {"range": "200 m", "thickness": 5}, "seed": 7},
        {"scan.range": "200 m", "scan.thickness": 5.0, "seed": 7},
        {"scan": {"range": 200}, "scan.thickness": "500 cm", "seed": 7},
    ],
)
def test_changes_reach_their_keys_and_no_other(changes):
    plain = lm.load_experiment("wake_backscatter")
    changed = lm.load_experiment("wake_backscatter", **changes)
    assert (changed.scan.range, changed.scan.thickness, changed.seed) == (200, 5, 7)
    before, after = (e.model_dump(mode="json") for e in (plain, changed))
    for data in (before, after):
        del data["seed"], data["scan"]["range"], data["scan"]["thickness"]
    assert before == after


def test_sections_come_and_go():
    noisy = lm.load_experiment("wake_backscatter", detector={})
    assert noisy.detector is not None
    sensor = lm.load_experiment("wake_sensor")
    assert sensor.sensor and sensor.doppler
    alone = lm.load_experiment("wake_sensor", sensor=None, doppler=None)
    assert alone.sensor is None and alone.doppler is None


def test_a_variant_has_to_be_named():
    with pytest.raises(lm.InputError, match="variant: None is not allowed; expected one") as stop:
        lm.load_experiment("near_range")
    with pytest.raises(lm.InputError, match="expected none, as turbine has no variants"):
        lm.load_experiment("turbine", variant="day")
    for name in str(stop.value).split("one of ")[1].split(", "):
        assert lm.load_experiment("near_range", variant=name, seed=9).seed == 9


def test_a_file_remembers_its_folder(tmp_path):
    (tmp_path / "here.yaml").write_text(HERE)
    experiment = lm.load_experiment(tmp_path / "here.yaml", seed=2)
    assert experiment.folder == tmp_path
    assert experiment.read_from("elsewhere").folder.name == "elsewhere"
    assert experiment.folder == tmp_path


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"scan": {"ranje": 3}}, "scan.ranje: unknown key; did you mean range?"),
        ({"scan.range": "3 kg"}, "scan.range: '3 kg'"),
        ({"scan.range": -1}, "scan.range: -1 m is not allowed; expected 0.1 to 100000 m"),
        ({"scan": 5}, "scan: 5 is not allowed; expected a section"),
    ],
)
def test_a_wrong_change_is_named(changes, says):
    with pytest.raises(lm.InputError, match="turbine: ") as stop:
        lm.load_experiment("turbine", **changes)
    assert says in str(stop.value) and len(str(stop.value).splitlines()) == 1


def test_a_misspelt_name_is_answered_with_the_nearest():
    with pytest.raises(lm.InputError, match="did you mean wake_sensor"):
        lm.load_experiment("wake_senor")


def write(path, text):
    path.write_text(text)
    return path


def test_a_base_is_changed_key_by_key(tmp_path):
    write(
        tmp_path / "mine.yaml", "name: mine\nbase: wake_sensor\nscan: {range: 90 m}\nsensor: null"
    )
    own = lm.load_experiment(tmp_path / "mine.yaml")
    base = lm.load_experiment("wake_sensor")
    assert (own.name, own.scan.range, own.scan.thickness) == ("mine", 90, base.scan.thickness)
    assert own.sensor is None and own.doppler == base.doppler and own.wake == base.wake
    # a base of a base, beside it
    nearer = write(
        tmp_path / "nearer.yaml", "base: mine.yaml\nname: nearer\nscan: {thickness: 1 m}"
    )
    found = lm.load_experiment(nearer, seed=3)
    assert (found.scan.range, found.scan.thickness, found.seed) == (90, 1, 3)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("base: no_such_experiment", "no_such_experiment: no such file"),
        ("base: 3", "base: 3 is not allowed; expected an experiment's name"),
        (f"base: {'x' * 300}", "is not allowed; expected an experiment's name"),
        ("base: a.yaml", "base: a.yaml is based on this file"),
        ("base: b.yaml", "base: a.yaml is based on this file"),
        ("base: wake_sensor\nsweep: {seed: [1, 2]}", "a campaign, not an experiment"),
    ],
)
def test_bases_that_are_none(tmp_path, text, message):
    write(tmp_path / "b.yaml", "base: a.yaml")
    with pytest.raises(lm.InputError) as error:
        lm.load_experiment(write(tmp_path / "a.yaml", text))
    assert message in str(error.value) and "\n" not in str(error.value)


def test_a_new_file_names_the_keys_of_its_kind():
    """Of a coherent lidar none of those of an etalon, and the other way round."""
    texts = {
        name: new_file("mine", name, shipped_file(name), "run") for name in ("airport", "fringes")
    }
    assert "# more: bias, interval" in texts["airport"] and "speckle" not in texts["airport"]
    assert "speckle_modes" in texts["fringes"] and "passage" not in texts["fringes"]


def test_keys_that_nobody_gave_stay_defaults():
    """Checks warn of chosen keys without effect, not of defaults."""
    changed = lm.load_experiment("encounter", scan={"rows": 99}, platform={"dt": "0.2 s"})
    assert changed.scan.model_fields_set == {"thickness", "rows"}
    assert changed.platform.model_fields_set == {"dt"}
