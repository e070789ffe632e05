"""Write docs/tutorials/*.md from the notebooks in examples, with what they print and draw.

Usage: ``python docs/make_tutorials.py [NAME ...]``, by default all: three minutes on two cores.
"""

import base64
import re
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import nbformat

DOCS = Path(__file__).parent
EXAMPLES = DOCS.parent / "examples"
PICTURES = DOCS / "pictures" / "tutorials"

NOTE = "<!-- Written by docs/make_tutorials.py from examples/{name}.ipynb; edit that. -->"
# what is seen, by notebook, in the order of the pictures
SEEN = {
    "first_wind": (
        "Backscatter image of a wake, 500 m ahead",
        "Retrieved cross-flow wind as arrows on its speed: two vortices, air that sinks between",
        "Error of the vertical wind, largest in the cores",
    ),
    "own_wake": (
        "The true wind of the file: two vortices, air that sinks between them",
        "The retrieved wind, which looks the same",
    ),
    "own_lidar": (
        "Backscatter image with the noise of the detector, and the retrieved wind",
        "Error and fraction of valid vectors against the energy of a pulse, at two ranges",
    ),
    "own_controller": ("Bank angles of four flights through the wake, against time",),
    "own_scene": (
        "Backscatter image of two puffs of smoke",
        "Linear depolarisation ratio of the image: high in the puffs, 0 around them",
        "Extinction of the puffs: true, as the blurred image has it, and retrieved",
    ),
    "cloud": (
        "Extinction of a cloud against range: the inverse renderer follows the truth, Klett's "
        "inversion falls short on the near side",
    ),
}


def page(notebook: nbformat.NotebookNode, name: str, pictures: list[str]) -> str:
    """Text, code and outputs of a notebook as Markdown; its pictures as files of these names."""
    parts, left = [], list(zip(pictures, SEEN[name], strict=False))
    for cell in notebook.cells:
        if cell.cell_type == "markdown":
            parts.append(linked(cell.source))
            continue
        parts.append(code(cell))
        if said := printed(cell):
            parts.append(f"```text\n{said}\n```")
        for output in cell.outputs:
            if "image/png" in output.get("data", {}):
                file, seen = left.pop(0)
                parts.append(f"![{seen}](../pictures/tutorials/{file})")
    title, _, first = parts[0].partition("\n\n")
    about = f"*[{name}.ipynb](../../examples/{name}.ipynb) is this page as a notebook.*"
    return "\n\n".join([title, NOTE.format(name=name), first, about, *parts[1:]]) + "\n"


def code(cell: nbformat.NotebookNode) -> str:
    """The code of a cell as a block; the semicolon that hides its result is the notebook's."""
    return f"```python\n{cell.source.removesuffix(';')}\n```"


def printed(cell: nbformat.NotebookNode) -> str:
    """What a cell printed, and the tables of its last line; warnings stand in the tables."""
    lines = []
    for output in cell.outputs:
        data = output.get("data", {})
        if output.get("name") == "stdout":
            lines += [line for line in output.text.splitlines() if not line.startswith("warning:")]
        elif "text/html" in data and not data["text/plain"].startswith("<IPython"):
            lines += data["text/plain"].splitlines()
    return "\n".join(line for line in lines if line.strip())


def linked(text: str) -> str:
    """Names of other notebooks and of pages as links."""
    text = re.sub(r"`docs/((?:\w+/)*)(\w+)\.md`", r"[\2](../\1\2.md)", text)
    return re.sub(r"`(\w+)\.ipynb`", r"[\1](\1.md)", text)


def drawn(notebook: nbformat.NotebookNode) -> Iterator[bytes]:
    """Pictures of an executed notebook."""
    for cell in notebook.cells:
        for output in cell.get("outputs", []):
            if "image/png" in output.get("data", {}):
                yield base64.b64decode(output["data"]["image/png"])


def execute(name: str) -> nbformat.NotebookNode:
    """A notebook with its outputs; figures are not larger than a page."""
    from nbclient import NotebookClient

    notebook = nbformat.read(EXAMPLES / f"{name}.ipynb", as_version=4)
    small = nbformat.v4.new_code_cell("import matplotlib\nmatplotlib.rcParams['figure.dpi'] = 80")
    notebook.cells.insert(0, small)
    with tempfile.TemporaryDirectory() as folder:
        NotebookClient(notebook, resources={"metadata": {"path": folder}}).execute()
    del notebook.cells[0]
    return notebook


if __name__ == "__main__":
    PICTURES.mkdir(exist_ok=True)
    for name in sys.argv[1:] or SEEN:
        executed = execute(name)
        pictures = list(drawn(executed))
        if len(pictures) != len(SEEN[name]):
            raise SystemExit(f"{name}: {len(pictures)} pictures; SEEN describes {len(SEEN[name])}")
        files = [f"{name}_{number}.png" for number in range(1, len(pictures) + 1)]
        for file, picture in zip(files, pictures, strict=True):
            (PICTURES / file).write_bytes(picture)
        (DOCS / "tutorials" / f"{name}.md").write_text(page(executed, name, files))
        print(f"docs/tutorials/{name}.md: {len(pictures)} pictures")
