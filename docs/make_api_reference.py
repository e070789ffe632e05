"""Pages api.md and api/*.md from the public names and their docstrings.

The names are those of ``lidar_mi/__init__.pyi``; Sphinx writes their docstrings into the pages. A
name is on the page of the module that it comes from.
"""

import ast
import inspect
from collections.abc import Iterator
from pathlib import Path

import lidar_mi

NOTE = "<!-- Written by docs/make_api_reference.py from lidar_mi/__init__.pyi; edit that. -->"
HEAD = f"""\
# Python interface

{NOTE}

`import lidar_mi as lm` selects an LLVM for Dr.Jit and takes a few hundredths of a second: it loads
neither Mitsuba nor torch. Each name below is loaded on first use. Names that are not listed here
are internal and may change from version to version ([what is stable](versions.md)). Mitsuba's
plugins have [pages of their own](plugins.md).
"""
# file, title, modules whose names are there (of several that fit, the longest), use
PAGES = (
    ("experiments", "Experiments", ("experiment", "schema"), "[Python](../guide/python.md)"),
    ("encounters", "Encounters", ("encounter", "aircraft"), "[an encounter](../guide/flights.md)"),
    ("campaigns", "Campaigns", ("campaign",), "[campaigns](../campaigns.md)"),
    (
        "wind",
        "Wind from images",
        ("retrieval", "experiment.image_files"),
        "[images](../guide/images.md), [methods](../guide/methods.md)",
    ),
    (
        "lines_of_sight",
        "Wind and vortices from lines of sight",
        ("retrieval.ground_winds", "retrieval.ground_vortices"),
        "[lines of sight](../guide/doppler_lines.md)",
    ),
    ("vortices", "Vortices", ("retrieval.vortices",), "[methods](../guide/methods.md)"),
    (
        "rings",
        "Rings of an etalon",
        ("retrieval.rings", "experiment.ring_frames"),
        "[rings](../guide/rings.md)",
    ),
    (
        "files",
        "Files",
        ("io", "experiment.export", "encounter.control_block.export"),
        "[run outputs](../guide/outputs.md)",
    ),
    ("machine", "Mitsuba and the machine", ("",), "[troubleshooting](../guide/troubleshooting.md)"),
)
# of a class: what of it is described; none: all
MEMBERS = {
    "Experiment": "folder, read_from",
    "VirtualLidar": "step, wake",
    "JSBSimInAir": "run",
    "VortexPairFit": "success, port, starboard, mean_wind, quantities, after, wind",
    "Calibration": "to_dataset",
    "Rings": "splitting, curve",
    "AircraftPose": None,
    "WindowSizes": None,
    "VectorValidation": None,
    "Gap": None,
    "InputError": None,
}
# what is returned, but not made by hand
MORE = {"encounters": ("encounter.lidar.estimate.Estimate",)}
BY_HAND = ("AircraftPose", "JSBSimInAir", "VectorValidation", "VirtualLidar", "WindowSizes")


def pages() -> dict[str, str]:
    """Texts of all pages by their places under docs."""
    on = dict(_names_on_pages())
    parts = [HEAD]
    for file, title, *_ in PAGES:
        rows = [_row(name) for name in on[file] if _is_called(name)]
        parts.append(f"## [{title}](api/{file}.md)\n")
        parts.append("\n".join(["| call | does |", "| --- | --- |", *rows, ""]))
    parts.append("\n".join(["```{toctree}\n:hidden:\n", *(f"api/{p[0]}" for p in PAGES), "```\n"]))
    found = {"api.md": "\n".join(parts)}
    for file, title, _, see in PAGES:
        directives = [line for name in on[file] for line in _directive(name)]
        directives += [f".. autoclass:: lidar_mi.{name}" for name in MORE.get(file, ())]
        text = "\n".join(directives)
        head = f"# {title}\n\n{NOTE}\n\nIn use: {see}."
        found[f"api/{file}.md"] = f"{head}\n\n```{{eval-rst}}\n{text}\n```\n"
    return found


def _names_on_pages() -> Iterator[tuple[str, list[str]]]:
    stub = ast.parse(Path(lidar_mi.__file__).with_suffix(".pyi").read_text(encoding="utf-8"))
    home = {
        alias.name: node.module
        for node in stub.body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }
    for file, *_ in PAGES:
        yield file, [name for name, module in home.items() if _page_of(module) == file]


def _page_of(module: str) -> str:
    fitting = [
        (len(start), file)
        for file, _, starts, _ in PAGES
        for start in starts
        if not start or module == start or module.startswith(f"{start}.")
    ]
    return max(fitting)[1]


def _is_called(name: str) -> bool:
    return name in BY_HAND or inspect.isfunction(getattr(lidar_mi, name))


def _row(name: str) -> str:
    """A function, or a class that is made by hand, with its parameters and their defaults."""
    public = getattr(lidar_mi, name)
    whole = inspect.signature(public)
    bare = [one.replace(annotation=one.empty) for one in whole.parameters.values()]
    call = str(whole.replace(parameters=bare, return_annotation=whole.empty))
    return f"| `lm.{name}{call}` | {inspect.getdoc(public).splitlines()[0].replace('``', '`')} |"


def _directive(name: str) -> Iterator[str]:
    public = getattr(lidar_mi, name)
    if inspect.isfunction(public):
        yield f".. autofunction:: lidar_mi.{name}"
        return
    kind = "autoexception" if issubclass(public, Exception) else "autoclass"
    yield f".. {kind}:: lidar_mi.{name}"
    members = MEMBERS.get(name, "")
    if members is not None:
        yield f"   :members: {members}".rstrip()
    if name == "Flag":
        yield "   :member-order: bysource"
