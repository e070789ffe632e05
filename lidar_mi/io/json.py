"""JSON files."""

import json
from pathlib import Path
from typing import Any

from lidar_mi.errors import InputError
from lidar_mi.io.text import read_text, write_text


def read_json(path: str | Path, expected: str) -> Any:
    """Content of a JSON file.

    expected: kind of file expected, for the message: "a file of vortex pairs".

    Raises InputError: a file that cannot be read or is not JSON.
    """
    text = read_text(path, expected)
    try:
        return json.loads(text)
    except (ValueError, RecursionError):  # a number of thousands of digits, thousands of lists
        raise InputError(f"{path}: not JSON; expected {expected}") from None


def to_json(data: Any) -> str:
    """Plain data as JSON text; NaN and infinity are refused with a ValueError."""
    return json.dumps(data, indent=1, allow_nan=False) + "\n"


def write_json(path: str | Path, data: Any) -> None:
    """Write a JSON file, whole or not at all; errors as of `to_json`."""
    write_text(path, to_json(data))
