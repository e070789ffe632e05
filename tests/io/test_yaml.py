"""YAML and JSON files: unit tests.

Detect a key taken twice, a value changed by writing and reading, and any broken file that does not
give one clear line.
"""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lidar_mi.errors import InputError
from lidar_mi.io.json import read_json, write_json
from lidar_mi.io.yaml import parse_yaml, read_yaml, to_yaml

PLAIN = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text(),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(), inner, max_size=4),
    max_leaves=12,
)


@given(PLAIN)
def test_plain_data_comes_back(data):
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
    ],
)
def test_bad_yaml_gives_one_line(text, message):
    with pytest.raises(InputError) as error:
        parse_yaml(text, "x.yaml")
    assert message in str(error.value) and "\n" not in str(error.value)


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
