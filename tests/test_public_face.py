"""What ``import lidar_mi as lm`` offers. Unit tier.

Detects: an import that loads a renderer or a tensor library; a public name that does not exist, has
no documentation, or differs between the stub that editors read and the program.
"""

import ast
import doctest
import importlib.util
import inspect
import re
import runpy
from importlib.resources import files
from pathlib import Path

import pytest

import lidar_mi as lm
from tests.support.loaded import modules_after

HEAVY = ("mitsuba", "drjit", "torch", "numpy", "scipy", "xarray", "matplotlib", "pydantic", "rich")


def stub() -> ast.Module:
    return ast.parse((Path(lm.__file__).parent / "__init__.pyi").read_text())


def test_import_loads_nothing_heavy():
    assert modules_after("import lidar_mi").isdisjoint(HEAVY)


@pytest.mark.slow
def test_light_names_load_no_renderer():
    """Where a retrieval or an experiment file is all that is asked, Mitsuba is not loaded."""
    code = "import lidar_mi as lm; lm.experiments(); lm.read_image; lm.InputError"
    assert modules_after(code).isdisjoint(("mitsuba", "drjit", "torch"))
    code = "import lidar_mi as lm; lm.retrieve_wind; lm.fit_vortices; lm.read_vortices"
    assert modules_after(code).isdisjoint(("mitsuba", "drjit"))


def test_stub_lists_exactly_the_public_names():
    (listed,) = (
        ast.literal_eval(node.value)
        for node in stub().body
        if isinstance(node, ast.Assign) and node.targets[0].id == "__all__"
    )
    imported = {
        alias.name
        for node in stub().body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }
    assert set(listed) == imported | {"__version__"} == set(lm.__all__)
    assert listed == sorted(listed)


@pytest.mark.parametrize("name", sorted(set(lm.__all__) - {"__version__"}))
def test_public_name_is_there_and_documented(name):
    """By the same object as in the module that the stub says it comes from."""
    (home,) = (
        node.module
        for node in stub().body
        if isinstance(node, ast.ImportFrom) and name in [alias.name for alias in node.names]
    )
    public = getattr(lm, name)
    assert public is getattr(importlib.import_module(f"lidar_mi.{home}"), name)
    assert name in dir(lm)
    described = inspect.getdoc(public)
    assert described and described.splitlines()[0].endswith(".")
    if inspect.isfunction(public) and inspect.signature(public).parameters:
        assert "Parameters\n-----" in described


EXAMPLES = [
    example
    for name in lm.__all__
    if name != "__version__"
    for example in doctest.DocTestFinder(recurse=False).find(getattr(lm, name), name)
]


@pytest.mark.parametrize("example", EXAMPLES, ids=lambda example: example.name)
def test_examples_of_the_documentation_run(example, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    runner = doctest.DocTestRunner(optionflags=doctest.NORMALIZE_WHITESPACE)
    output = []
    assert runner.run(example, out=output.append).failed == 0, "".join(output)


@pytest.mark.parametrize("name", sorted(set(lm.__all__) - {"__version__"}))
def test_public_function_has_an_example(name):
    public = getattr(lm, name)
    if not inspect.isclass(public):
        examples = doctest.DocTestParser().get_examples(inspect.getdoc(public))
        assert any(f"lm.{name}(" in example.source for example in examples)


@pytest.fixture(scope="module")
def script():
    return runpy.run_path(str(Path(__file__).parents[1] / "docs" / "make_api_reference.py"))


@pytest.fixture(scope="module")
def pages(script):
    """Of the public names, as the site has them."""
    return script["pages"]()


def test_pages_are_of_modules_that_exist(script):
    """A module that has moved leaves its names to the last page."""
    starts = [start for *_, starts, _ in script["PAGES"] for start in starts if start]
    more = [name.rpartition(".")[0] for names in script["MORE"].values() for name in names]
    for name in (*starts, *more):
        assert importlib.util.find_spec(f"lidar_mi.{name}"), name


def test_every_public_name_has_its_place_in_the_documentation(pages):
    text = "\n".join(pages.values())
    named = re.findall(r"^\.\. auto\w+:: lidar_mi\.(\w+)$", text, re.MULTILINE)
    assert sorted([*named, "__version__"]) == sorted(lm.__all__)


MADE_BY_HAND = {"AircraftPose", "JSBSimInAir", "VectorValidation", "VirtualLidar", "WindowSizes"}


def test_table_of_calls_has_the_signatures(pages):
    """Every function, and what one makes by hand, with its parameters and their defaults."""
    calls = re.findall(r"^\| `lm\.(\w+)(\(.*?\))` \| ", pages["api.md"], re.MULTILINE)
    functions = {name for name in lm.__all__ if inspect.isfunction(getattr(lm, name))}
    assert {name for name, _ in calls} == functions | MADE_BY_HAND
    for name, call in calls:
        whole = inspect.signature(getattr(lm, name))
        bare = [one.replace(annotation=one.empty) for one in whole.parameters.values()]
        assert call == str(whole.replace(parameters=bare, return_annotation=whole.empty))


def test_unknown_name_is_an_attribute_error():
    with pytest.raises(AttributeError, match="nonsense"):
        lm.nonsense  # noqa: B018


def test_types_are_announced():
    package = files("lidar_mi")
    assert (package / "py.typed").is_file() and (package / "__init__.pyi").is_file()
