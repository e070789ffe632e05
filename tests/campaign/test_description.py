"""Descriptions of campaigns: what is read, and what is refused by name.

Detects: a fault that is only met after hours, one that is reported under another key, values of a
range that miss its ends, a coarse version with points that the whole one has not.
"""

import re
from pathlib import Path

import numpy as np
import pytest
import yaml

from lidar_mi.campaign.description import Campaign, read_campaign
from lidar_mi.campaign.engine import prepare_campaign
from lidar_mi.errors import InputError
from lidar_mi.schema.shipped import campaign_file

SWEEP = {"scan.range": ["300 m", "500 m"]}


def written(path, **keys):
    data = {"name": "test", "base": "wake_backscatter", "sweep": SWEEP} | keys
    path.write_text(yaml.safe_dump({k: v for k, v in data.items() if v is not None}))
    return path


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"sweep": {"scan.range": ["300 m", "300 m"]}}, "sweep.scan.range: '300 m' twice"),
        ({"sweep": {"scan.range": []}}, r"sweep.scan.range: \[\] is not allowed"),
        ({"sweep": {"scan.range": ["300 m", "1000 ft"]}}, "values in m and in ft"),
        ({"sweep": {"scan.range": ["300 m", 500]}}, "values in m and in no unit"),
        ({"sweep": {"scan.range": {"log": ["0 m", "3 m"], "n": 3}}}, "expected ends above 0"),
        ({"sweep": {"scan.range": {"log": ["1 m", "3 km"], "n": 3}}}, "expected one unit, not m"),
        ({"sweep": {"scan.range": {"linear": ["1 m", "1 m"], "n": 3}}}, "two different ends"),
        ({"sweep": {"scan.range": {"linear": ["1 m", "2 m"]}}}, "sweep.scan.range: n: missing"),
        ({"sweep": {"scan.range": {"linear": ["1 m", "2 m"], "n": 1}}}, "expected 2 to"),
        ({"sweep": {"case": {"day": 3}}}, "sweep.case.day: 3 is not allowed"),
        ({"sweep": {"seed": [1, 2]}}, "sweep.seed: not allowed; expected members"),
        ({"sweep": None}, "sweep: missing"),
        ({"sample": {"n": 4, "over": {"scan.range": {"linear": [1, 2]}}}}, "expected one of the"),
        (
            {"sweep": None, "sample": {"n": 100, "over": {"scan.range": {"linear": [1, 2]}}}},
            "expected a power of 2 such as 64 or 128",
        ),
        ({"members": 0}, "members: 0 is not allowed; expected 1 to"),
        ({"keep": "all"}, "keep: 'all' is not allowed; expected 'metrics'"),
        ({"swep": {}}, "swep: unknown key; did you mean sweep"),
    ],
)
def test_a_fault_is_named(tmp_path, keys, message):
    with pytest.raises(InputError, match=message):
        read_campaign(written(tmp_path / "c.yaml", **keys))


def test_ranges_include_their_ends():
    linear, log = (
        Campaign(name="a", base="b", sweep={"x": {kind: ["0.1 mJ", "100 mJ"], "n": 4}}).sweep["x"]
        for kind in ("linear", "log")
    )
    assert linear.values()[0] == log.values()[0] == "0.1 mJ"
    assert linear.values()[-1] == log.values()[-1] == "100.0 mJ"
    numbers = [float(v.split()[0]) for v in log.values()]
    np.testing.assert_allclose(np.diff(np.log10(numbers)), 1, rtol=1e-12)
    numbers = [float(v.split()[0]) for v in linear.values()]
    np.testing.assert_allclose(np.diff(numbers), 33.3, rtol=1e-12)


def test_the_coarse_version_picks_named_sets_and_replaces_ranges(tmp_path):
    sweep = {
        "case": {"a": {"seed": 1}, "b": {"seed": 2}, "c": {"seed": 3}},
        "scan.range": {"linear": ["100 m", "500 m"], "n": 9},
    }
    quick = {"sweep": {"case": ["a", "c"], "scan.range": {"n": 2}}, "members": 1}
    path = written(tmp_path / "c.yaml", sweep=sweep, quick=quick, members=8)
    whole, coarse = read_campaign(path), read_campaign(path, quick=True)
    assert (whole.members, coarse.members) == (8, 1)
    assert list(coarse.sweep["case"]) == ["a", "c"]
    assert coarse.sweep["scan.range"].values() == ["100.0 m", "500.0 m"]
    assert coarse.name == "test.quick"
    with pytest.raises(InputError, match="quick: missing"):
        read_campaign(written(tmp_path / "d.yaml"), quick=True)


def test_variants_are_a_campaign_of_one_dimension(tmp_path):
    path = tmp_path / "e.yaml"
    variants = {"near": {"scan": {"range": "100 m"}}, "far": {}}
    path.write_text(yaml.safe_dump({"name": "e", "wake": {}, "variants": variants}))
    found = read_campaign(path)
    assert found.sweep == {"variant": variants} and found.base == str(path)


def test_an_experiment_is_no_campaign():
    with pytest.raises(InputError, match="one experiment, not a campaign; expected lidar-mi run"):
        read_campaign(campaign_file("wake_sensor"))


def test_the_command_line_changes_keys(tmp_path):
    found = read_campaign(
        written(tmp_path / "c.yaml"), ["members=4", "set.scan.thickness=5 m", "sweep.seed_=[1]"]
    )
    assert found.members == 4 and found.set == {"scan.thickness": "5 m"}
    assert found.sweep["seed_"] == [1]
    with pytest.raises(InputError, match="--set members: expected KEY=VALUE"):
        read_campaign(written(tmp_path / "c.yaml"), ["members"])


def test_the_campaign_of_the_guide_is_one(tmp_path):
    guide = Path(__file__).parents[2] / "docs" / "campaigns.md"
    (text,) = re.findall(r"^```yaml\n(.*?)^```", guide.read_text(), re.DOTALL | re.MULTILINE)
    (tmp_path / "my_map.yaml").write_text(text)
    found = prepare_campaign(tmp_path / "my_map.yaml", tmp_path / "out")
    assert found.points.shape == (7, 2, 8)
