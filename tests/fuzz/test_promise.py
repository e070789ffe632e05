"""Hostile input of every kind: property tests, and whatever once broke.

Detects input that ends in a traceback, a signal or a wait without end, in more than one line, in a
line that a terminal obeys, or with something left behind. ``make fuzz`` tries much more.
"""

from inspect import signature
from pathlib import Path

import pytest
from hypothesis import HealthCheck, Phase, given, settings

from tests.support.cases import Case, fault
from tests.support.hostile import KINDS, RENDERED
from tests.support.hostile_calls import annotations, candidates, functions
from tests.support.sandbox import Sandbox

CORPUS = sorted((Path(__file__).parents[1] / "corpus").glob("*.json"))
EXAMPLES = 2


@pytest.fixture(scope="module")
def sandbox():
    with Sandbox(seconds=60) as one:
        yield one


@pytest.mark.parametrize(
    "kind",
    [
        pytest.param(kind, marks=[pytest.mark.slow] if kind in RENDERED else [])
        for kind in sorted(KINDS)
    ],
)
def test_the_promise_holds(kind, sandbox):
    @settings(
        max_examples=EXAMPLES,
        derandomize=True,
        database=None,
        deadline=None,
        phases=[Phase.generate],
        suppress_health_check=list(HealthCheck),
    )
    @given(KINDS[kind]())
    def holds(case):
        assert fault(case, sandbox) is None

    holds()


@pytest.mark.parametrize("path", CORPUS, ids=[path.stem for path in CORPUS])
def test_former_failures_stay_fixed(path, sandbox):
    assert fault(Case.from_text(path.read_text()), sandbox) is None


def test_cases_come_back_from_their_files():
    case = Case("exr", ("info", "a.exr"), {"a.exr": bytes(range(256)), "b": b"text\n"}, ("c",))
    assert Case.from_text(case.to_text()) == case


@pytest.mark.parametrize("name", sorted(functions()))
def test_every_public_function_can_be_called_with_hostile_arguments(name):
    """Of types that can be evaluated: few draws reach each."""
    hints = annotations(functions()[name])
    assert set(hints) <= {*signature(functions()[name]).parameters, "return"}
    assert all(isinstance(text, str) for hint in hints.values() for text in candidates(hint))


def double(number):
    return 2 * number


def hang():
    while True:
        pass


def eat():
    return bytes(8 << 30)


def die():
    import ctypes

    ctypes.string_at(0)


def test_the_sandbox_sees_how_calls_end(sandbox):
    assert sandbox.call(double, 4).value == 8
    assert sandbox.call(hang, seconds=0.5).timed_out
    assert isinstance(sandbox.call(eat).value, MemoryError)
    assert sandbox.call(die).code < 0
