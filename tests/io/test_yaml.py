"""YAML and JSON files: unit tests.

Detect a key taken twice, a value changed by writing and reading, and any broken file that does not
give one clear line.
"""

import math
import os

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lidar_mi.errors import InputError
from lidar_mi.io.json import read_json, write_json
from lidar_mi.io.yaml import parse_yaml, read_yaml, to_yaml

# 9^9 and 2^25 values in a few hundred bytes
ALIASES = "a0: &a0 [x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"a{k}: &a{k} [{', '.join([f'*a{k - 1}'] * 9)}]\n" for k in range(1, 9)
)
MERGES = "a0: &a0 {k: 1}\n" + "".join(
    f"a{k}: &a{k} {{<<: [*a{k - 1}, *a{k - 1}]}}\n" for k in range(1, 25)
)

PLAIN = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text(),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(), inner, max_size=4),
    max_leaves=12,
)


@settings(max_examples=30)
@given(PLAIN)
def test_plain_data_round_trip(data):
    assert parse_yaml(to_yaml(data), "text") == data


def test_keys_keep_their_order():
    assert to_yaml({"z": 1, "a": [1, 2]}).startswith("z: 1\na:")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a: 1\nb: 2\na: 3", "x.yaml: line 3 not valid YAML (key 'a' is there twice)"),
        ("s: {a: 1, a: 2}", "x.yaml: line 1 not valid YAML (key 'a' is there twice)"),
        ("a: [", "not valid YAML"),
        ("a: !!python/object:os.system 3", "not valid YAML"),
        ("yes: 1\ntrue: 2", "line 2 not valid YAML (key True is there twice)"),
        ("a: 2020-13-45", "line 1 not valid YAML ('2020-13-45' is not of the type timestamp)"),
        ("a: !!int abc", "line 1 not valid YAML ('abc' is not of the type int)"),
        ("a: !!bool maybe", "line 1 not valid YAML ('maybe' is not of the type bool)"),
        ("a: !!timestamp now", "line 1 not valid YAML ('now' is not of the type timestamp)"),
        ("a: " + "9" * 5000, "99' is not of the type int)"),
        ("a: 0x" + "f" * 5000, "ff' is not of the type int)"),
        ("- " * 2000, "more than 40 sections in each other"),
        ("[" * 2000 + "]" * 2000, "more than 40 sections in each other"),
        ("a: &a [*a]", "line 1 not valid YAML (an alias within what it stands for)"),
        (ALIASES, "more than 10000 values, aliases included"),
        (MERGES, "more than 10000 values, aliases included"),
        ("#" * 200_000, "x.yaml: 200000 characters; expected at most 131072"),
    ],
)
def test_bad_yaml_gives_one_line(text, message):
    with pytest.raises(InputError) as error:
        parse_yaml(text, "x.yaml")
    assert message in str(error.value) and "\n" not in str(error.value)


def test_aliases_and_merged_sections_are_allowed():
    text = "a: &a {k: 1, l: 2}\nb: {<<: *a, k: 3}\nc: *a"
    assert parse_yaml(text, "text") == {
        "a": {"k": 1, "l": 2},
        "b": {"k": 3, "l": 2},
        "c": {"k": 1, "l": 2},
    }


@pytest.mark.parametrize("read", [read_yaml, read_json])
def test_files_without_an_end_are_not_read(tmp_path, read):
    with pytest.raises(InputError, match="/dev/zero: a device or a pipe; expected a table"):
        read("/dev/zero", "a table")
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(InputError, match="pipe: a device or a pipe; expected a table"):
        read(tmp_path / "pipe", "a table")
    with open(tmp_path / "long", "wb") as file:
        file.truncate(1 << 40)
    with pytest.raises(InputError, match="long: 1099511627776 bytes are not allowed"):
        read(tmp_path / "long", "a table")


@pytest.mark.parametrize("text", ["[" * 100_000, "9" * 5000, '{"a": 1', "\x1b"])
def test_broken_json_gives_one_line(tmp_path, text):
    path = tmp_path / "a.json"
    path.write_text(text)
    with pytest.raises(InputError, match=r"a.json: not JSON; expected metrics"):
        read_json(path, "metrics")


@pytest.mark.parametrize("read", [read_yaml, read_json])
def test_unreadable_files_are_named(tmp_path, read):
    path = tmp_path / "a"
    with pytest.raises(InputError, match=r"a: No such file or directory; expected a table$"):
        read(path, "a table")
    path.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(InputError, match=r"a: not a text file; expected a table$"):
        read(path, "a table")


def test_json(tmp_path):
    path = tmp_path / "a.json"
    write_json(path, {"b": 0.1, "a": None})
    assert read_json(path, "metrics") == {"b": 0.1, "a": None}
    with pytest.raises(ValueError, match="not JSON compliant"):
        write_json(path, {"b": math.nan})
    assert read_json(path, "metrics") == {"b": 0.1, "a": None}
    path.write_text("{")
    with pytest.raises(InputError, match=r"a.json: not JSON; expected metrics"):
        read_json(path, "metrics")
