"""Arguments of public functions. Unit tier.

Detects an argument of another type that goes through, or one of the right type that does not, and a
message that does not name the argument.
"""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Literal

import numpy as np
import pytest
import xarray as xr

import lidar_mi as lm
from lidar_mi.arguments import checked_arguments


@checked_arguments
def called(
    number: float = 0,
    whole: int = 0,
    text: str | None = None,
    path: str | Path = "",
    pair: tuple[float, float] = (0, 0),
    several: Sequence[int] = (),
    by_name: Mapping[str, int] | None = None,
    kind: Literal["a", "b"] = "a",
    answer: Callable[[int], int] | None = None,
    flag: bool = False,
    free=None,
    **more,
):
    return True


@pytest.mark.parametrize(
    "given",
    [
        {"number": 1},
        {"number": np.float32(1)},
        {"number": np.array(1.0)},
        {"whole": np.int64(3)},
        {"text": "a"},
        {"path": Path()},
        {"pair": np.array([1, 2])},
        {"pair": [1, 2.0]},
        {"several": [1, 2]},
        {"by_name": {"a": 1}},
        {"kind": "c"},  # which the function itself refuses
        {"answer": abs},
        {"flag": True},
        {"free": object(), "another": object()},
    ],
)
def test_of_the_right_type(given):
    assert called(**given)


@pytest.mark.parametrize(
    ("given", "says"),
    [
        ({"number": "1"}, "number: '1' is not allowed; expected a number"),
        ({"number": True}, "number: True is not allowed; expected a number"),
        ({"number": None}, "number: None is not allowed; expected a number"),
        ({"number": 10**400}, "number: int is not allowed; expected a number"),
        ({"whole": 1.0}, "whole: 1.0 is not allowed; expected a whole number"),
        ({"text": 3}, "text: 3 is not allowed; expected text or None"),
        ({"path": b"a" * 99}, "expected text or a path"),
        ({"path": "a\0"}, r"path: 'a\x00' is not allowed; expected text or a path"),
        ({"pair": (1,)}, "pair: tuple is not allowed; expected (a number, a number)"),
        ({"pair": "ab"}, "expected (a number, a number)"),
        ({"several": [1, "a"]}, "several: list is not allowed; expected a list of a whole number"),
        ({"by_name": {"a": "b"}}, "expected a mapping to a whole number or None"),
        ({"kind": 1}, "kind: 1 is not allowed; expected one of a, b"),
        ({"answer": 3}, "answer: 3 is not allowed; expected a function or None"),
        ({"flag": 1}, "flag: 1 is not allowed; expected True or False"),
    ],
)
def test_of_another_type(given, says):
    with pytest.raises(lm.InputError) as error:
        called(**given)
    assert says in str(error.value) and len(str(error.value)) < 120


@pytest.mark.parametrize(
    ("call", "says"),
    [
        (lambda: lm.make_truth(3), "experiment: 3 is not allowed; expected Experiment"),
        (lambda: lm.run("a"), "experiment: 'a' is not allowed; expected Experiment"),
        (lambda: lm.fit_vortices_to_wind(-1), "vectors: -1 is not allowed; expected Dataset"),
        (lambda: lm.analyse_rings(None), "images: object is not allowed; expected real numbers"),
        (lambda: lm.analyse_rings(np.eye(20), centre=3), "centre: 3 is not allowed"),
        (lambda: lm.write_vortices("a", {}, source=3), "source: 3 is not allowed; expected text"),
        (lambda: lm.on_one_grid(1, 2), "image1: 1 is not allowed; expected DataArray"),
        (lambda: lm.on_one_grid(*[xr.DataArray(np.eye(4))] * 2), "image1: dims ('dim_0', 'dim_1')"),
    ],
)
def test_public_functions_name_the_argument(call, says):
    with pytest.raises(lm.InputError) as error:
        call()
    assert str(error.value).startswith(says)
