"""The pages of the tutorials.

Detects a page that is not its notebook's, and a picture that is missing.
"""

import runpy
from pathlib import Path

import pytest

nbformat = pytest.importorskip("nbformat", reason="nbformat is not installed (extra test)")

DOCS = Path(__file__).parents[2] / "docs"
SCRIPT = runpy.run_path(str(DOCS / "make_tutorials.py"))
NOTEBOOKS = sorted(path.stem for path in SCRIPT["EXAMPLES"].glob("*.ipynb"))


def test_every_notebook_has_a_page():
    assert sorted(SCRIPT["SEEN"]) == NOTEBOOKS
    listed = (DOCS / "tutorials" / "index.md").read_text()
    assert all(f"]({name}.md)" in listed for name in NOTEBOOKS)


@pytest.mark.parametrize("name", NOTEBOOKS)
def test_page_has_what_its_notebook_has(name):
    """Text and code, in this order; outputs are those of some run."""
    page = (DOCS / "tutorials" / f"{name}.md").read_text()
    notebook = nbformat.read(SCRIPT["EXAMPLES"] / f"{name}.ipynb", as_version=4)
    place = 0
    for cell in notebook.cells:
        is_code = cell.cell_type == "code"
        parts = [SCRIPT["code"](cell)] if is_code else SCRIPT["linked"](cell.source).split("\n\n")
        for part in parts:
            assert part in page[place:], f"{name}: run python docs/make_tutorials.py {name}"
            place += page[place:].index(part) + len(part)
    for number, seen in enumerate(SCRIPT["SEEN"][name], 1):
        assert f"![{seen}](../pictures/tutorials/{name}_{number}.png)" in page
