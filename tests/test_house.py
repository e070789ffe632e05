"""The house: which room may import which, who may load Mitsuba, who opens files.

Detects an arrow back up, a circle, a private name taken from another module, a file read or written
outside io, a module that only forwards, a test that imports another.
"""

import ast
import importlib
from functools import cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

import lidar_mi

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "lidar_mi"

ARROWS = {
    "system": set(),
    "atmosphere": set(),
    "instrument": {"atmosphere.scattering.line"},
    "retrieval": {"atmosphere.vortices.vortex", "instrument.coherent.weighting"},
    "io": set(
        (
            "atmosphere.scattering.aerosols atmosphere.scattering.particle_scattering "
            "atmosphere.regrid atmosphere.scattering.tables retrieval.vortices.model "
            "retrieval.vortices.pair"
        ).split()
    ),
    "rendering": {"atmosphere", "instrument", "io", "system", "plugins"},
    "inversion": {"instrument", "rendering", "retrieval"},
    "schema": {"atmosphere", "instrument", "io", "rendering.settings", "retrieval.method_names"},
    "assessment": {"atmosphere", "instrument", "retrieval", "io", "schema"},
    "aircraft": {"atmosphere", "instrument", "io", "schema"},
    "experiment": set(("atmosphere instrument rendering retrieval assessment io schema").split()),
    "cli": set(
        (
            "atmosphere instrument rendering retrieval assessment io schema experiment campaign "
            "encounter system"
        ).split()
    ),
    "campaign": {"assessment", "io", "schema", "experiment", "encounter", "system"},
    "encounter": set(
        (
            "atmosphere instrument rendering retrieval assessment io schema aircraft experiment "
            "system"
        ).split()
    ),
}
"""What a room may import beside `errors` and `units`: a room, or modules of one. `atmosphere`,
`instrument` and `retrieval` share descriptions alone: a vortex, a spectral line, the weight of a
gate; `io` builds those
that its files hold; only `experiment` and what lies above it see all."""

FLOORS = {
    "atmosphere": (("scattering",), ("vortices",), ("air",)),
    "encounter": (("lidar",), ("ahead",), ("control_block",)),
    "assessment": (("metrics",), ("figures",), ("report",)),
    "experiment": (("truth",), ("stages",), ("folder",), ("preflight",)),
    "retrieval": (
        ("likelihood",),
        ("extinction", "images", "rings"),
        ("correlation", "channels", "combined", "ground_winds"),
        ("flow", "defects"),
        ("along_path", "vortices"),
        ("wind", "ground_vortices"),
    ),
}
"""Folders of a room, the lowest floor first: each imports those of lower floors alone."""

OPENS = {
    "assessment/report/campaign.py": "its own script, a resource of the package",
    "assessment/report/page.py": "its own script, a resource of the package",
    "experiment/log.py": "the log, line by line",
    "experiment/folder/records.py": "checksums of what a run depends on",
    "system/doctor.py": "a file of its own in a program that it tries",
    "system/llvm.py": "/proc",
    "system/memory.py": "/proc, /sys/fs/cgroup",
}
"""Who reads or writes a file beside `io`, and which."""

NOT_YET: set[str] = set()
"""Findings in rooms that are being rebuilt: each goes when its room is done."""


FORMATS = ("yaml", "OpenEXR", "PIL", "h5netcdf", "astropy", "tifffile", "imagecodecs", "lvpyio")
"""Libraries of file formats."""

OPENING = set(
    (
        "open read_text write_text read_bytes write_bytes loadtxt savetxt open_dataset to_netcdf "
        "savefig"
    ).split()
)


def modules() -> dict[str, tuple[Path, ast.Module]]:
    found = {}
    for path in sorted(PACKAGE.rglob("*.py")):
        name = ".".join(path.relative_to(PACKAGE).with_suffix("").parts)
        found[name] = path, ast.parse(path.read_text())
    return found


MODULES = modules()


def imports(name: str, tree: ast.Module) -> list[str]:
    """Modules and names that a module imports, wherever in it; ours without ``lidar_mi.``."""
    found = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{name}: relative import"
            found += [f"{node.module}.{alias.name}" for alias in node.names]
    return [one.removeprefix("lidar_mi.") for one in found]


def ours(imported: str) -> str | None:
    """The module of ours that an import leads to."""
    parts = imported.split(".")
    for count in (len(parts), len(parts) - 1):
        name = ".".join(parts[:count])
        if name in MODULES:
            return name
    return None


def circle(graph: dict[str, set[str]]) -> list[str]:
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        return error.args[1]
    return []


def room(name: str) -> str:
    return name.split(".")[0]


def wrong_arrows() -> list[str]:
    found = []
    for name, (_, tree) in MODULES.items():
        if "." not in name:
            continue
        for imported in imports(name, tree):
            other = imported.split(".")[0]
            if other == room(name) or other not in {*ARROWS, "plugins"}:
                continue
            if not {other, ours(imported)} & ARROWS[room(name)]:
                found.append(f"{name} imports {imported}")
    return found


def arrows_up_in_a_room() -> list[str]:
    found = []
    for name, (_, tree) in MODULES.items():
        floors = FLOORS.get(room(name), ())
        floor = {folder: level for level, folders in enumerate(floors) for folder in folders}
        inside = name.split(".")[1] if name.count(".") > 1 else None
        for imported in imports(name, tree):
            parts = (ours(imported) or "").split(".")
            if parts[0] != room(name) or len(parts) < 3 or parts[1] == inside:
                continue
            if {parts[1], inside} <= {*floor} and floor[parts[1]] >= floor[inside]:
                found.append(f"{name} imports {imported}")
    return found


def circles() -> list[str]:
    """Of modules, and of folders at every level: what is deeper counts as its folder."""
    modules = {
        name: {other for one in imports(name, tree) if (other := ours(one)) and other != name}
        for name, (_, tree) in MODULES.items()
    }
    found = [circle(modules)]
    for depth in range(1, max(name.count(".") for name in modules) + 1):
        folders: dict[str, set[str]] = {}
        for name, others in modules.items():
            own = ".".join(name.split(".")[:depth])
            others = {".".join(other.split(".")[:depth]) for other in others}
            folders.setdefault(own, set()).update(others - {own})
        found.append(circle(folders))
    return [" -> ".join(one) for one in found if one]


def mitsuba_elsewhere() -> list[str]:
    return [
        f"{name} imports {one}"
        for name, (_, tree) in MODULES.items()
        for one in imports(name, tree)
        if one.split(".")[0] in ("mitsuba", "drjit") and room(name) not in ("rendering", "system")
    ]


def plugins_that_know_the_package() -> list[str]:
    found = []
    for path in sorted((ROOT / "plugins").glob("*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            names = [a.name for a in node.names] if isinstance(node, ast.Import) else []
            names += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            found += [f"{path.name}: {n}" for n in names if n.split(".")[0] == "lidar_mi"]
    return found


def private_names_of_others() -> list[str]:
    found = []
    for name, (_, tree) in MODULES.items():
        aliases = set()
        for node in ast.walk(tree):
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("lidar_mi"):
                aliases |= {alias.asname or alias.name for alias in node.names}
                found += [f"{name}: {a.name}" for a in node.names if is_private(a.name)]
        found += [
            f"{name}: {node.value.id}.{node.attr}"
            for node in ast.walk(tree)
            if isinstance(node, ast.Attribute)
            and is_private(node.attr)
            and isinstance(node.value, ast.Name)
            and node.value.id in aliases
        ]
    return found


def is_private(name: str) -> bool:
    return name.startswith("_") and not name.startswith("__")


def files_opened_elsewhere() -> list[str]:
    found = []
    for name, (path, tree) in MODULES.items():
        if room(name) == "io" or str(path.relative_to(PACKAGE)) in OPENS:
            continue
        for node in ast.walk(tree):
            if isinstance(node, ast.Call):
                # by a bare name, the functions of io are called
                method = getattr(node.func, "attr", "")
                builtin = getattr(node.func, "id", "") == "open"
                found += [f"{name}: {method or 'open'}"] if builtin or method in OPENING else []
        found += [f"{name}: {one}" for one in imports(name, tree) if one.split(".")[0] in FORMATS]
    return found


def modules_of_imports_only() -> list[str]:
    found = []
    for name, (path, tree) in MODULES.items():
        own = [
            node
            for node in tree.body
            if not isinstance(node, ast.Import | ast.ImportFrom)
            and not (isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant))
        ]
        forwards = any(isinstance(node, ast.Import | ast.ImportFrom) for node in tree.body)
        if not own and (forwards or path.name != "__init__.py"):
            found.append(f"{name}: only imports")
    return found


def imports_between_tests() -> list[str]:
    """What several tests use is in tests/support."""
    found = []
    for path in sorted((ROOT / "tests").rglob("*.py")):
        place = str(path.relative_to(ROOT))
        for one in imports(place, ast.parse(path.read_text())):
            parts = one.split(".")
            shared = parts[:2] == ["tests", "support"] and not parts[-1].startswith("test_")
            if parts[0] in ("tests", "conftest") and not shared:
                found.append(f"{place} imports {one}")
    return found


def bound(node: ast.AST) -> set[str]:
    """Names that imports anywhere in a part of a module bind."""
    found = (n for n in ast.walk(node) if isinstance(n, ast.Import | ast.ImportFrom))
    return {alias.asname or alias.name.split(".")[0] for one in found for alias in one.names}


def used(node: ast.AST) -> set[str]:
    """Names that a part of a module looks up when it runs: annotations of locals are not."""
    if isinstance(node, ast.Name):
        return {node.id}
    if isinstance(node, ast.AnnAssign):
        return used(node.value) if node.value else set()
    if isinstance(node, ast.FunctionDef):
        # as nested ones are defined where their annotations are evaluated
        return set().union(*map(used, ast.iter_child_nodes(node))) - bound(node)
    return set().union(*map(used, ast.iter_child_nodes(node)))


def types_used_at_run_time() -> list[str]:
    """Names that only a type checker imports, used in the program: no checker says so."""
    found = []
    for name, (_, tree) in MODULES.items():
        for block in tree.body:
            if isinstance(block, ast.If) and ast.unparse(block.test) == "TYPE_CHECKING":
                rest = ast.Module([node for node in tree.body if node is not block], [])
                wrong = bound(ast.Module(block.body, [])) & used(rest)
                found += [f"{name}: {one}" for one in sorted(wrong)]
    return found


RULES = (
    wrong_arrows,
    arrows_up_in_a_room,
    circles,
    mitsuba_elsewhere,
    plugins_that_know_the_package,
    private_names_of_others,
    files_opened_elsewhere,
    modules_of_imports_only,
    imports_between_tests,
    types_used_at_run_time,
)


@cache
def found_by(rule):
    return list(rule())


@pytest.mark.parametrize("rule", RULES)
def test_rule_is_kept(rule):
    assert [one for one in found_by(rule) if one not in NOT_YET] == []


def test_every_room_has_its_rule():
    found = {room(name) for name in MODULES if "." in name}
    assert found == set(ARROWS)
    assert len(found) <= 14


def test_every_folder_of_a_room_with_floors_has_one():
    for name, floors in FLOORS.items():
        folders = {m.split(".")[1] for m in MODULES if room(m) == name and m.count(".") > 1}
        assert sorted(folder for floor in floors for folder in floor) == sorted(folders)


def test_fixed_exceptions_leave_the_list():
    assert NOT_YET <= {one for rule in RULES for one in found_by(rule)}


def test_every_module_imports():
    """Types alone may name what is missing at run time."""
    for name in MODULES:
        if not name.endswith("__main__"):  # which runs the command
            importlib.import_module(f"lidar_mi.{name}".removesuffix(".__init__"))


def test_this_package_was_read():
    assert Path(lidar_mi.__file__).parent == PACKAGE and len(MODULES) > 100
