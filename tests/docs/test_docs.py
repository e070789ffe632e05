"""The documents say what the program does.

Detects: a reference of keys, commands, names or plugins that is not what the code says, a key that
it lacks or gives another unit, default or limit, a command, scene, experiment or piece of Python
that does not run as printed, a message that reads otherwise, a link to nowhere, a formula whose
braces do not match.
"""

import re
import runpy
import shlex
import sys
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest
import yaml

from lidar_mi.assessment.metrics.requirements import read_requirements
from lidar_mi.cli import app as cli
from lidar_mi.experiment.run import prepare
from lidar_mi.experiment.truth import extinction as truth
from lidar_mi.rendering.phase import scatterer
from lidar_mi.schema import keys, reading, shipped
from tests.support.experiments import sketched_figures, without_figures
from tests.support.hostile_experiments import KEYS as SCHEMA

ROOT = Path(__file__).parents[2]


def in_order(page):
    """Names of the table of contents of a page."""
    (table,) = re.findall(r"^```\{toctree\}\n(?::.*\n)*\n([^`]+)```$", page, re.MULTILINE)
    return table.split()


DOCS = ROOT / "docs"
# in the order in which they are read
GUIDE = tuple(
    f"docs/guide/{name}.md"
    for name in ("start", "report", "index", *in_order((DOCS / "guide" / "index.md").read_text()))
)
# guides whose commands and programs compute for seconds
COMPUTING = (
    "start python images methods rings flights control_block jsbsim air xml_scenes "
    "doppler_lines measured_wakes"
).split()
QUICK = tuple(page for page in GUIDE if Path(page).stem not in COMPUTING)
THEORY = tuple(f"docs/theory/{page.name}" for page in sorted((DOCS / "theory").glob("*.md")))
PAGES = ("README.md", *sorted(str(page.relative_to(ROOT)) for page in DOCS.rglob("*.md")))
BASE = {"name": "base", "wake": {"file": "wake_slab_40s.nc", "time": "40 s"}}
# what makes a printed run small; nothing else of it changes
SMALLER = (
    "wake.spacing=1 m",
    "render.samples_per_beam=2",
    "retrieval.stride=8",
    "retrieval.methods=[cc]",
)
SMALLER_FLIGHT = (
    "encounter.path.start=60 m",
    "encounter.path.beyond=10 m",
    "encounter.control.mode=off",
)


# --- the reference ---------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("docstring", "message"),
    [
        ("Title\n-----\n\n.. note:: beware", "into Markdown: '.. note:: beware'"),
        ("Title\n-----\n\nsee :func:`x`", "unknown role"),
        ("== ==\na  b\n== ==", "table without head or end"),
        ("==== ==\na    b\n==== ==\nlonger b\n==== ==", "across a column's edge"),
    ],
)
def test_plugin_reference_does_not_guess(docstring, message):
    script = runpy.run_path(str(DOCS / "make_plugin_reference.py"))
    with pytest.raises(ValueError, match=re.escape(message)):
        script["section"](docstring)


# --- the table of wake_changing --------------------------------------------------------------


# --- the experiment file --------------------------------------------------------------------


def documented():
    """Keys in the tables of the reference."""
    pages = "".join(page.read_text() for page in (DOCS / "reference").glob("keys*.md"))
    return re.findall(r"^\| `([a-z_.]+)` \|(?:[^|]+\|){4}$", pages, re.MULTILINE)


def test_every_key_is_documented_and_no_other():
    """What the tables say of a key is what `lidar-mi explain` says."""
    found, names = documented(), set(keys.names())
    assert len(found) == len(set(found)) and set(SCHEMA) <= names
    # a section that may be left out is a key of the one above
    leaves = {name for name in names if not keys.explain(name).keys}
    assert leaves | set(keys.OF_A_FILE) <= set(found) <= names | set(keys.OF_A_FILE)


@pytest.mark.parametrize("name", [*shipped.experiments(), *shipped.campaigns()])
def test_an_experiment_has_the_question_of_its_file(name):
    question = shipped.question_and_needs(name)[0]
    row = f"| [{name}]({name}.md) | {question[0].lower()}{question[1:]} |"
    assert row in (DOCS / "experiments" / "index.md").read_text().splitlines()


# --- what is printed runs -------------------------------------------------------------------


@dataclass(frozen=True)
class Block:
    """A code block of a page."""

    page: str
    line: int
    language: str
    text: str

    @property
    def place(self):
        return f"{self.page}:{self.line}"

    @property
    def file(self):
        """The file's name, where the first line is a comment that gives one."""
        match = re.match(r"(?:# |<!-- )([\w.]+\.(?:yaml|xml))(?: -->)?\n", self.text)
        return match and match[1]


def blocks(page):
    lines = (ROOT / page).read_text().splitlines()
    start = None
    for number, line in enumerate(lines):
        if line.startswith("```"):
            if start is None:
                start = number
            else:
                text = "\n".join(lines[start + 1 : number]) + "\n"
                yield Block(page, start + 2, lines[start][3:].strip(), text)
                start = None
    assert start is None, f"{page}: block of line {start} is not closed"


@pytest.fixture
def workplace(tmp_path, monkeypatch):
    """A folder to work in that looks like the project's from the outside."""
    for name in ("scenes", "Makefile"):
        (tmp_path / name).symlink_to(ROOT / name)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def command(line, capsys, extra=()):
    """Run a ``lidar-mi`` command line here; exit code and what it said on stderr."""
    arguments = shlex.split(line, comments=True)
    assert Path(arguments[0]).name == "lidar-mi"
    before, sys.argv = sys.argv, ["lidar-mi", *arguments[1:], *extra]
    capsys.readouterr()
    try:
        cli.main()
        code = 0
    except SystemExit as stop:
        code = stop.code or 0
    finally:
        sys.argv = before
    return code, capsys.readouterr().err


def run_shell(block, capsys):
    for line in block.text.splitlines():
        words = shlex.split(line, comments=True)
        if not words:
            continue
        if words[0] == "make":
            targets = re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE)
            assert set(words[1:]) <= set(targets), f"{block.place}: {line}"
        elif words[0] == ".":
            assert words[1] == ".venv/bin/activate"
        elif words[1] == "doctor":
            assert words[2:] == []  # it starts a process for every variant; it has its own tests
        elif words[1:4:2] == ["export", "--format"] and words[4] == "control":
            assert Path(words[2]).is_dir()  # it needs 50 slabs in succession; it has its own tests
        else:
            keys = {"run": SMALLER, "fly": SMALLER_FLIGHT}.get(words[1], ())
            small = [word for key in keys for word in ("--set", key)]
            with without_figures(), sketched_figures():
                code, output = command(line, capsys, small)
            assert code == 0, f"{block.place}: {line}\n{output}"


def run_console(block, workplace, capsys):
    """Commands after ``$`` are refused with exactly the line below them."""
    for question, answer in re.findall(r"^\$ (.+)\n(?!\$)(.+)\n", block.text, re.MULTILINE):
        code, output = command(question, capsys)
        assert code == 2, f"{block.place}: {question}\n{output}"
        output = output.splitlines()[-1]
        output = output.replace(str(files("lidar_mi.scenes")), "<shipped>")
        output = output.replace(str(ROOT / "scenes"), "<shipped>")
        output = output.replace(str(workplace.resolve()), "<folder>")
        assert output == answer, f"{block.place}: {question}"
    assert block.text.count("$ ") * 2 == len(block.text.splitlines()), block.place


def check_yaml(block):
    data = yaml.safe_load(block.text)
    if block.file and "requirements" in block.file:
        Path(block.file).write_text(block.text)
        assert read_requirements(block.file)
    elif block.file:
        Path(block.file).write_text(block.text)
        for experiment in reading.load_variants(block.file).values() or [reading.load(block.file)]:
            if experiment.imaged_wake:
                truth.make_truth(experiment)
            elif experiment.coherent:
                prepare(experiment)
    else:
        loaded = reading.check({**BASE, **data}, block.place)
        scatterer(loaded.scattering, wavelength=loaded.lidar.wavelength)  # finds the tables


def check_xml(block):
    import mitsuba as mi

    if block.file:
        Path(block.file).write_text(block.text)
        mi.load_string(block.text)
        return
    # a piece of a scene: what it refers to stands before it
    air = '<medium type="homogeneous" id="environment"/>'
    mi.load_string(
        f'<scene version="3.0.0">{air if "environment" in block.text else ""}{block.text}</scene>'
    )


def test_a_file_name_stands_for_one_text():
    """A reader who follows one page must not write over the files of another recipe."""
    texts = {}
    for page in (*GUIDE, *THEORY, "README.md"):
        for block in blocks(page):
            if block.file:
                first = texts.setdefault(block.file, block)
                assert first.text == block.text, f"{block.place}: {block.file}, as {first.place}"


@pytest.mark.usefixtures("variant")
@pytest.mark.parametrize(
    "pages",
    [
        pytest.param(THEORY, id="theory"),
        pytest.param(QUICK, id="quick"),
        pytest.param((*GUIDE, "README.md"), id="guide", marks=pytest.mark.slow),
    ],
)
def test_printed_code_runs(pages, workplace, capsys):
    """Block by block, as a reader would: files written by one are there for the next.

    Of the README, which names files of the reader's own, command lines are run by no test: see
    `test_command_lines_are_understood`.
    """
    import mitsuba as mi

    for block in (block for page in pages for block in blocks(page)):
        if block.language == "sh":
            if block.page != "README.md":
                run_shell(block, capsys)
        elif block.language == "console":
            run_console(block, workplace, capsys)
        elif block.language == "yaml":
            check_yaml(block)
        elif block.language == "xml":
            mi.set_variant("llvm_ad_mono_polarized")
            mi.set_log_level(mi.LogLevel.Error)
            check_xml(block)
        elif block.language == "python":
            file = str(ROOT / block.page)
            code = compile("\n" * (block.line - 1) + block.text, file, "exec")
            with without_figures():
                exec(code, {"__name__": "__docs__"})  # that is the test
        else:
            assert block.language in ("math", "{toctree}"), f"{block.place}: {block.language!r}"


@pytest.mark.usefixtures("variant")
def test_plugin_examples_load(workplace):
    """XML and Python of the plugin reference, with tables for those it names."""
    import mitsuba as mi

    table = np.loadtxt(ROOT / "scenes" / "aerosol_spheroids_532nm.txt")
    Path("spheroids_532nm.txt").write_text(
        (ROOT / "scenes" / "aerosol_spheroids_532nm.txt").read_text()
    )
    raster = [[7.5 * t, 0, 0, 1, y, z, t] for t, (z, y) in enumerate(np.ndindex(2, 3))]
    np.savetxt("raster.csv", raster, delimiter=",")
    np.save("puff.npy", np.ones((5, 4, 3, 2)))
    pages = sorted(page.relative_to(ROOT) for page in (DOCS / "plugins").glob("*.md"))
    found = [block for page in pages for block in blocks(str(page))]
    assert len(found) >= 11
    for block in found:
        if block.language == "xml":
            text = re.sub(r"^<(\w+) ", r'<\1 version="3.0.0" ', block.text)
            assert mi.load_string(text) is not None
        else:
            assert block.language == "python"
            assert mi.load_dict(eval(block.text, {"mi": mi, "table": table})) is not None


@pytest.mark.parametrize("page", PAGES)
def test_command_lines_are_understood(page):
    """Options and commands that a page prints exist, also where no test runs them."""
    import typer

    group = typer.main.get_command(cli.app)
    for block in blocks(page):
        if block.language != "sh":
            continue
        for line in block.text.splitlines():
            words = shlex.split(line, comments=True)
            if words and Path(words[0]).name == "lidar-mi":
                known = group.commands[words[1]]
                known.make_context(words[1], list(words[2:]))


# --- links and formulas ---------------------------------------------------------------------


def prose(page):
    """A page without its code blocks."""
    return re.sub(r"^```.*?^```$", "", (ROOT / page).read_text(), flags=re.MULTILINE | re.DOTALL)


def anchors(page):
    headings = re.findall(r"^#+ (.+)$", prose(page), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", h.lower()).replace(" ", "-") for h in headings}


@pytest.mark.parametrize("page", PAGES)
def test_relative_links_lead_somewhere(page):
    links = re.findall(r"\[([^\]]+)\]\(([^)\s]+)\)", prose(page))
    for text, target in links:
        if re.match(r"https?:", target):
            continue
        path, _, anchor = target.partition("#")
        file = ((ROOT / page).parent / path).resolve() if path else ROOT / page
        assert file.exists(), f"{page}: {target}"
        if anchor:
            assert anchor in anchors(str(file.relative_to(ROOT))), f"{page}: {target}"
        if file.suffix == ".py" and re.fullmatch(r"`?[\w.]+`?", text):
            name = text.strip("`").rpartition(".")[2]
            assert re.search(rf"^\s*(?:def|class) {name}\b", file.read_text(), re.MULTILINE), (
                f"{page}: {text} is not in {path}"
            )


@pytest.mark.parametrize("page", PAGES)
def test_formulas_are_whole(page):
    text = (ROOT / page).read_text()
    display = re.findall(r"^```math\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)
    inline = []
    for paragraph in re.split(r"\n\s*\n", re.sub(r"`[^`\n]*`", "", prose(page))):
        assert paragraph.count("$") % 2 == 0, f"{page}: {paragraph[:80]}"
        inline += re.findall(r"\$([^$]+)\$", paragraph)
    for formula in (*display, *inline):
        bare = formula.replace(r"\{", "").replace(r"\}", "")
        assert bare.count("{") == bare.count("}"), f"{page}: {formula}"
        assert len(re.findall(r"\\left\b", bare)) == len(re.findall(r"\\right\b", bare)), formula
        begun, ended = (re.findall(rf"\\{w}{{(\w+)}}", bare) for w in ("begin", "end"))
        assert sorted(begun) == sorted(ended), formula
    # Markdown takes the backslash off these, unless they stand in a block
    assert not [f for f in inline if re.search(r"\\[,;!\\{}]", f)]
