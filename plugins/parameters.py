"""Reading plugin parameters; messages name plugin, field, value and what is allowed."""

import math
from pathlib import Path
from typing import NoReturn

import mitsuba as mi
import numpy as np

from .variant_types import Properties, Table, Transform


def fail(plugin: str, field: str, value: object, allowed: str) -> NoReturn:
    """Raise ValueError: ``plugin.field: value is not allowed; expected ...``."""
    raise ValueError(f"{plugin}.{field}: {value!r} is not allowed; expected {allowed}")


# single precision holds numbers of this size, and their squares
TINY, HUGE = 1e-18, 1e18
# tables of the package
SHIPPED = Path(__file__).resolve().parents[1] / "scenes"


def number(props: Properties, plugin: str, field: str, default: float) -> float:
    """The float parameter ``field``; infinite only where the default is."""
    value = props.get(field, default)
    try:
        value = float(value)
    except (TypeError, ValueError):
        fail(plugin, field, value, "a number")
    if not abs(value) <= HUGE and not value == default:
        fail(plugin, field, value, f"a finite number, {HUGE:g} at most")
    return value


def positive(props: Properties, plugin: str, field: str, default: float) -> float:
    """The float parameter ``field``, greater than zero; infinite only where the default is."""
    value = number(props, plugin, field, default)
    if not value >= TINY:
        fail(plugin, field, value, f"a finite number above 0 ({TINY:g} at least)")
    return value


def at_least(props: Properties, plugin: str, field: str, default: float, least: float) -> float:
    """The finite float parameter ``field``, no smaller than ``least``."""
    value = number(props, plugin, field, default)
    if not (value >= least and math.isfinite(value)):
        fail(plugin, field, value, f"a finite number of at least {least:g}")
    return value


def whole(props: Properties, plugin: str, field: str, default: int, least: int) -> int:
    """The integer parameter ``field``, no smaller than ``least``."""
    value = int(props.get(field, default))
    if not least <= value < 2**31:
        fail(plugin, field, value, f"a whole number of at least {least}, below 2^31")
    return value


def choice(
    props: Properties, plugin: str, field: str, default: str, allowed: tuple[str, ...]
) -> str:
    """The string parameter ``field``, one of ``allowed``."""
    value = props.get(field, default)
    if value not in allowed:
        fail(plugin, field, value, "one of " + ", ".join(allowed))
    return value


def pose(props: Properties, plugin: str, field: str = "to_world") -> Transform:
    """The transform parameter ``field`` in the variant's precision; Mitsuba reads doubles."""
    if field not in props:
        return mi.Transform4f()
    placed = mi.Transform4f(np.array(props[field].matrix, dtype=np.float32))
    check_pose(placed, plugin, field)
    return placed


def check_pose(placed: Transform, plugin: str, field: str = "to_world") -> None:
    """Refuse a pose that is not a rotation and translation: it must not scale an instrument."""
    matrix = np.array(placed.matrix, float).reshape(4, 4)
    rotation = matrix[:3, :3]
    rigid = np.abs(rotation @ rotation.T - np.eye(3)).max() < 1e-3 and np.linalg.det(rotation) > 0
    # NaN compares as false
    if not (rigid and np.isfinite(matrix).all() and (matrix[3] == [0, 0, 0, 1]).all()):
        fail(plugin, field, matrix.round(4).tolist(), "a rotation and a translation")


def table(plugin: str, field: str, source: Table, columns: int) -> np.ndarray:
    """Numbers given as a tensor, or by the name of a ``.npy`` or text file.

    A file is searched where Mitsuba searches, beside the scene, then among those of the package.
    Text has a line per row, blanks or commas between its numbers, and ``#`` before comments.
    """
    if not isinstance(source, str):
        return np.array(source)
    path = Path(str(mi.file_resolver().resolve(source)))
    if not path.is_file():
        path = SHIPPED / source
    if not path.is_file():
        fail(plugin, field, source, "a readable file")
    try:
        if path.suffix == ".npy":
            return np.asarray(np.load(path), float)
        rows = (
            line.split("#")[0].replace(",", " ").split()
            for line in path.read_text("utf-8-sig").splitlines()
        )
        return np.array([row for row in rows if row], float)
    except (ValueError, EOFError) as error:
        fail(plugin, field, source, f"N lines of {columns} numbers ({error})")


def numbers(props: Properties, plugin: str, field: str, default: str) -> list[float]:
    """The parameter ``field`` of finite numbers, separated by commas or blanks."""
    text = str(props.get(field, default))
    try:
        values = [float(v) for v in text.replace(",", " ").split()]
    except ValueError:
        values = []
    if not values or not all(math.isfinite(v) for v in values):
        fail(plugin, field, text, "finite numbers such as '1, 0.5'")
    return values
