"""YAML, strictly: a key that stands twice in one section is an error."""

from pathlib import Path
from typing import Any

import yaml

from lidar_mi.errors import InputError
from lidar_mi.io.text import read_text


class _Loader(yaml.SafeLoader):  # type: ignore[misc]  # PyYAML has no types
    """PyYAML would take the last of two equal keys without a word."""

    def construct_mapping(self, node, deep=False):
        seen = set()
        for key in (key for key, _ in node.value if isinstance(key, yaml.ScalarNode)):
            if key.value in seen:
                raise yaml.constructor.ConstructorError(
                    None, None, f"key {key.value!r} is there twice", key.start_mark
                )
            seen.add(key.value)
        return super().construct_mapping(node, deep)


def parse_yaml(text: str, origin: str) -> Any:
    """Content of YAML text: dict, list, str, number, bool or None.

    Parameters
    ----------
    text : str
    origin : str
        Where it comes from, for the message: a path.

    Raises
    ------
    InputError
        Not YAML, or a key that is there twice; with the line.
    """
    try:
        return yaml.load(text, _Loader)
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        line = f" line {mark.line + 1}" if mark else ""
        reason = " ".join(str(getattr(error, "problem", None) or error).split())
        raise InputError(f"{origin}:{line} not valid YAML ({reason})") from None


def read_yaml(path: str | Path, expected: str) -> Any:
    """Content of a YAML file; ``expected`` and errors as in `read_text` and `parse_yaml`."""
    return parse_yaml(read_text(path, expected), str(path))


def to_yaml(data: Any) -> str:
    """Plain data as YAML text, keys in the order in which they are."""
    return yaml.safe_dump(data, sort_keys=False)
