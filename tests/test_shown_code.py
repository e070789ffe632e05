"""Code that users read, and programs that are run by hand.

Detects: a call of a function of the package that does not exist or does not take these arguments,
in examples, notebooks, pages, validation and benchmarks.
"""

import ast
import importlib
import inspect
import json
import re
from pathlib import Path

import pytest

import lidar_mi

ROOT = Path(__file__).parents[1]
PYTHON_BLOCK = re.compile(r"^```python\n(.*?)^```", re.DOTALL | re.MULTILINE)
LINES_OF_SHELLS = re.compile(r"^[%!].*$", re.MULTILINE)


def scripts():
    for folder in ("examples", "validation", "benchmarks", "docs"):
        yield from sorted((ROOT / folder).rglob("*.py"))
    yield from sorted((ROOT / "examples").glob("*.ipynb"))
    yield from [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]


def code(path):
    """All Python of a file."""
    text = path.read_text(encoding="utf-8")
    if path.suffix == ".ipynb":
        cells = (c for c in json.loads(text)["cells"] if c["cell_type"] == "code")
        return LINES_OF_SHELLS.sub("", "\n".join("".join(cell["source"]) for cell in cells))
    if path.suffix == ".md":
        return "\n".join(LINES_OF_SHELLS.sub("", part) for part in PYTHON_BLOCK.findall(text))
    return text


def imported(tree):
    """Objects of the package by the names that a file gives them."""
    found = {}
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            for name in node.names:
                if name.name.partition(".")[0] == "lidar_mi":
                    module = importlib.import_module(name.name)
                    found[name.asname or "lidar_mi"] = module if name.asname else lidar_mi
        elif isinstance(node, ast.ImportFrom) and not node.level:
            if (node.module or "").partition(".")[0] == "lidar_mi":
                module = importlib.import_module(node.module)
                for name in node.names:
                    if not hasattr(module, name.name):
                        importlib.import_module(f"{node.module}.{name.name}")
                    found[name.asname or name.name] = getattr(module, name.name)
    return found


def called(function, names):
    """The object of a call's function, if it is one of the package."""
    if isinstance(function, ast.Name):
        return names.get(function.id)
    if isinstance(function, ast.Attribute):
        owner = called(function.value, names)
        # methods have a self, which is not counted
        if inspect.ismodule(owner):
            return getattr(owner, function.attr)
    return None


def faults(source, where):
    tree = ast.parse(source, where)
    names = imported(tree)
    own = {n.name for n in ast.walk(tree) if isinstance(n, (ast.FunctionDef, ast.ClassDef))}
    names = {name: value for name, value in names.items() if name not in own}
    for node in ast.walk(tree):
        if not isinstance(node, ast.Call):
            continue
        function = called(node.func, names)
        unpacked = any(isinstance(a, ast.Starred) for a in node.args) or any(
            k.arg is None for k in node.keywords
        )
        if not callable(function) or unpacked:
            continue
        try:
            signature = inspect.signature(function)
        except ValueError:  # written in C
            continue
        try:
            signature.bind(*node.args, **{k.arg: k.value for k in node.keywords})
        except TypeError as error:
            yield f"{where}, line {node.lineno}: {ast.unparse(node.func)}: {error}"


@pytest.mark.parametrize("path", scripts(), ids=lambda path: str(path.relative_to(ROOT)))
def test_calls_fit_the_signatures(path):
    assert list(faults(code(path), path.name)) == []


@pytest.mark.parametrize(
    "line",
    [
        "import lidar_mi as lm; lm.retrieve_wind(a, b, 0.1, 'cc', 1, 2, 3, 4, 5, 6, 7, 8, 9, 10)",
        "from lidar_mi.rendering.backscatter import ScanRenderer as R; R(1, 2, 3)",
        "from lidar_mi.instrument import scan; scan.plan_scans(colour='red')",
    ],
)
def test_what_does_not_fit_is_found(line):
    assert len(list(faults(line, "a line"))) == 1


def test_a_name_that_does_not_exist_is_found():
    with pytest.raises(ModuleNotFoundError):
        list(faults("from lidar_mi.instrument.scan import no_such_plan", "a line"))
