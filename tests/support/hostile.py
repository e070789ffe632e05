"""All kinds of hostile input by name: strategies of cases."""

from collections.abc import Callable

from hypothesis.strategies import SearchStrategy

from tests.support import accepted
from tests.support import hostile_calls as calls
from tests.support import hostile_experiments as experiments
from tests.support import hostile_files as files
from tests.support import hostile_lines as lines

KINDS: dict[str, Callable[[], SearchStrategy]] = {
    "experiment": experiments.experiments,
    "override": experiments.overrides,
    "yaml": experiments.structures,
    "exr": files.exr_cases,
    "image": files.image_cases,
    "netcdf": files.wake_cases,
    "lines": lines.line_cases,
    "xml": files.scene_cases,
    "text": files.text_cases,
    "folder": files.folder_cases,
    "call": calls.calls,
    "run": accepted.run_cases,
}
RENDERED = ("call", "run")
"""Kinds that take seconds a case."""
