"""YAML, strictly: plain data, of bounded size, and a key that stands twice is an error."""

from collections.abc import Hashable
from pathlib import Path
from typing import Any

import yaml

from lidar_mi.errors import InputError, one_line
from lidar_mi.io.text import read_text

LONGEST = 128 << 10
"""Most bytes of a YAML file."""
LARGEST = 10_000
"""Most values in a file, including those that aliases repeat."""
DEEPEST = 40
"""Most levels of sections."""

_LARGEST_NUMBER = 10**300
# ten times as fast where PyYAML was built with libyaml
_DUMPER = getattr(yaml, "CSafeDumper", yaml.SafeDumper)
# exceptions of Python for invalid numbers and dates
_NO_VALUE = (ValueError, TypeError, LookupError, AttributeError, ArithmeticError)


class _Loader(yaml.SafeLoader):  # type: ignore[misc]  # PyYAML has no types
    """PyYAML as it is would expand aliases without end and take the last of two equal keys."""

    def __init__(self, stream: str) -> None:
        super().__init__(stream)
        self._depth = self._count = 0
        # number of values in a node, by its id; absent until the node is complete
        self._sizes: dict[int, int] = {}

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node | None:
        event = self.peek_event()
        self._count += 1
        self._depth += 1
        if self._depth > DEEPEST:
            raise _fault(f"more than {DEEPEST} sections in each other", event.start_mark)
        node = super().compose_node(parent, index)
        self._depth -= 1
        if not isinstance(event, yaml.AliasEvent):
            self._sizes[id(node)] = 1 + sum(self._sizes[id(child)] for child in _children(node))
        elif id(node) not in self._sizes:
            raise _fault("an alias within what it stands for", event.start_mark)
        if max(self._count, self._sizes[id(node)]) > LARGEST:
            raise _fault(f"more than {LARGEST} values, aliases included", event.start_mark)
        return node

    def construct_object(self, node: yaml.Node, deep: bool = False) -> Any:
        try:
            value = super().construct_object(node, deep)
            # larger integers are no floats and cannot be printed
            if not isinstance(value, int) or abs(value) < _LARGEST_NUMBER:
                return value
        except _NO_VALUE:
            pass
        kind = node.tag.rsplit(":", 1)[-1]
        text = repr(node.value) if isinstance(node, yaml.ScalarNode) else "a section"
        raise _fault(f"{one_line(text, 60)} is not of the type {kind}", node.start_mark)

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Hashable, Any]:
        keys = [key for key, _ in node.value if key.tag != "tag:yaml.org,2002:merge"]
        data = super().construct_mapping(node, deep)
        names = set()
        for key in keys:
            name = self.construct_object(key, deep=True)
            if name in names:
                raise _fault(f"key {one_line(repr(name), 60)} is there twice", key.start_mark)
            names.add(name)
        return data


def _children(node: yaml.Node) -> list[yaml.Node]:
    if isinstance(node, yaml.MappingNode):
        return [part for pair in node.value for part in pair]
    return node.value if isinstance(node, yaml.SequenceNode) else []


def _fault(problem: str, mark: yaml.Mark) -> yaml.constructor.ConstructorError:
    return yaml.constructor.ConstructorError(None, None, problem, mark)


def parse_yaml(text: str, origin: str) -> Any:
    """Content of YAML text: dict, list, str, number, bool, date or None.

    origin: where it comes from, for the message: a path.

    Raises InputError: not YAML, larger or deeper than allowed, a value that is not of its type, or
    a key that is there twice; with the line.
    """
    if len(text) > LONGEST:
        raise InputError(f"{origin}: {len(text)} characters; expected at most {LONGEST}")
    try:
        return yaml.load(text, _Loader)
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        line = f" line {mark.line + 1}" if mark else ""
        reason = str(getattr(error, "problem", None) or error)
        raise InputError(f"{origin}:{line} not valid YAML ({reason})") from None


def read_yaml(path: str | Path, expected: str) -> Any:
    """Content of a YAML file; ``expected`` and errors as in `read_text` and `parse_yaml`."""
    return parse_yaml(read_text(path, expected, LONGEST), str(path))


def to_yaml_line(value: Any) -> str:
    """A plain value as YAML text in one line: ``[cc, ws]``, ``500 m``, ``{}``."""
    text = yaml.dump(value, Dumper=_DUMPER, sort_keys=False, default_flow_style=True, width=10**6)
    return text.removesuffix("\n").removesuffix("\n...")


def to_yaml(data: Any) -> str:
    """Plain data as YAML text, keys in the order in which they are."""
    try:
        return yaml.dump(data, Dumper=_DUMPER, sort_keys=False)
    except UnicodeEncodeError:
        # names of files that are not UTF-8, which libyaml does not escape
        return yaml.dump(data, Dumper=yaml.SafeDumper, sort_keys=False)
