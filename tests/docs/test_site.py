"""The documentation as a site.

Detects a page that the site lists but does not have, or has but does not list, a page too long to
be read at once, an image or link that leads nowhere, a formula that is left as its source, and
styled letters that browsers would draw plain.
"""

import importlib.util
import json
import re
import runpy
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

DOCS = Path(__file__).parents[2] / "docs"
NEEDED = ("sphinx", "myst_parser", "furo", "latex2mathml")
MOST_LINES = 300
GENERATED = {"performance.md", "reference/commands.md"}
missing = [name for name in NEEDED if importlib.util.find_spec(name) is None]
with_sphinx = pytest.mark.skipif(bool(missing), reason=f"no {', '.join(missing)}: extra docs")


def listed(page):
    """Pages in the tables of contents of a page and those it lists."""
    tables = re.findall(r"^```\{toctree\}\n(?::.*\n)*\n([^`]+)```$", page.read_text(), re.MULTILINE)
    for name in " ".join(tables).split():
        below = page.parent / f"{name}.md"
        yield below
        yield from listed(below)


def test_pages_that_are_made_are_written_where_they_change(tmp_path, monkeypatch):
    script = runpy.run_path(str(DOCS / "make_pages.py"))
    monkeypatch.setitem(script["write"].__globals__, "DOCS", tmp_path)
    made = {"api.md": "a\n", "plugins/ccd.md": "b\n", "reference/keys.md": "c\n"}
    monkeypatch.setitem(script["write"].__globals__, "pages", lambda: made)
    (tmp_path / "reference").mkdir()
    (tmp_path / "reference" / "keys.md").write_text("c\n")
    (tmp_path / "reference" / "keys_gone.md").write_text("of a key that was renamed\n")
    before = (tmp_path / "reference" / "keys.md").stat().st_mtime_ns
    script["write"]()
    found = {str(page.relative_to(tmp_path)): page.read_text() for page in tmp_path.rglob("*.md")}
    assert found == made
    assert (tmp_path / "reference" / "keys.md").stat().st_mtime_ns == before


def test_every_page_is_listed_and_there():
    found = sorted(listed(DOCS / "index.md"))
    assert found == sorted(set(DOCS.rglob("*.md")) - {DOCS / "index.md"})


def test_pages_are_short():
    """Pages of tables that a program writes aside."""
    lines = {
        str(page.relative_to(DOCS)): len(page.read_text().splitlines())
        for page in DOCS.rglob("*.md")
    }
    long = {name for name, number in lines.items() if number > MOST_LINES}
    assert not {name for name in long - GENERATED if not name.startswith("validation/")}


def test_the_readme_is_one_screen():
    """What, for whom, a picture, the commands, and where to go on."""
    readme = (DOCS.parent / "README.md").read_text()
    assert len(readme.splitlines()) <= 60
    assert readme.count("![") == 1 and "make demo" in readme and "make test" in readme


def test_no_line_begins_with_a_per_cent_sign():
    """MyST takes it for a comment and drops the line."""
    for page in DOCS.rglob("*.md"):
        assert not re.findall(r"^\s*%.*", page.read_text(), re.MULTILINE), page.name


def test_images_exist():
    for page in DOCS.rglob("*.md"):
        for image in re.findall(r"!\[[^\]]+\]\(([^)]+)\)", page.read_text()):
            assert (page.parent / image).is_file(), f"{page.name}: {image}"


@with_sphinx
def test_formulas_become_mathml():
    mathml = runpy.run_path(str(DOCS / "conf.py"))["_mathml"]
    drawn = mathml(r"\mathbf x = \mathcal T \boldsymbol\epsilon^2", "inline")
    assert "<mi>\U0001d431</mi>" in drawn and "<mi>\U0001d4af</mi>" in drawn
    assert "\U0001d750" in drawn and "<msup>" in drawn and "mathvariant" not in drawn


SEARCH = """
const { wordsOf, rank, excerpt } = require(process.argv[1]);
const texts = {
  "guide/pulses": "The pulse energy, " + "of a laser ".repeat(30),
  "guide/much": "pulse energy and pulse energy ".repeat(5) + "of a laser ".repeat(20),
  "changelog": "pulse energy and pulse energy ".repeat(5) + "of a laser ".repeat(20),
};
const words = wordsOf("Pulse  energy?");
const score = (page) => rank(5, page, words, texts);
const order = Object.keys(texts).sort((a, b) => score(b) - score(a));
const far = "pulse ".repeat(3) + "x ".repeat(300) + "the energy of a pulse " + "y ".repeat(300);
console.log(JSON.stringify([words, order, excerpt(far, words), excerpt("a < b", [])]));
"""


@with_sphinx
def test_keys_end_a_line_between_their_words():
    breakable = runpy.run_path(str(DOCS / "conf.py"))["breakable"]
    key = '<code><span class="pre">doppler.lidar.pulse_energy</span></code> a.b'
    assert breakable(key) == key.replace("lidar.", "lidar.<wbr>").replace(
        "doppler.", "doppler.<wbr>"
    ).replace("pulse_", "pulse_<wbr>")
    number = '<span class="pre">0.5</span> <span class="pre">a.yaml</span>'
    assert breakable(number) == number.replace("a.", "a.<wbr>")


@pytest.mark.skipif(shutil.which("node") is None, reason="no node")
def test_search_ranks_and_shows_where_words_are_found():
    """Pages with more of the words first, the changelog last; excerpts where most words are."""
    done = subprocess.run(
        ["node", "-e", SEARCH, str(DOCS / "search.js")], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    words, order, far, none = json.loads(done.stdout)
    assert words == ["pulse", "energy"]
    assert order == ["guide/much", "guide/pulses", "changelog"]
    assert [piece for piece, marked in far if marked] == ["energy", "pulse"]
    text = "".join(piece for piece, _ in far)
    assert text.startswith("… x") and text.endswith("y …") and len(text) < 260
    assert none == [["a < b", False]]


@pytest.mark.slow
@with_sphinx
def test_site_is_built_without_a_warning(tmp_path):
    command = [
        sys.executable,
        "-m",
        "sphinx",
        "-q",
        "-W",
        "--keep-going",
        "-d",
        str(tmp_path / "doctrees"),
        str(DOCS),
        str(tmp_path / "site"),
    ]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    static = tmp_path / "site" / "_static"
    theory = [page.read_text() for page in (tmp_path / "site" / "theory").glob("*.html")]
    assert sum(page.count("<math ") for page in theory) > 500
    assert not any("merror" in page for page in theory)
    search = (tmp_path / "site" / "search.html").read_text()
    assert "pages.js" in search and "rank(score" in (static / "language_data.js").read_text()
    texts = json.loads((static / "pages.js").read_text().partition("= ")[2].rstrip(";\n"))
    assert "pulse energy" in texts["campaigns"].lower() and len(texts) > 100
    # no script or style from elsewhere: it opens offline
    for page in (tmp_path / "site").rglob("*.html"):
        assert not re.search(r'(?:src|href)="https?://[^"]+\.(?:js|css)', page.read_text())
