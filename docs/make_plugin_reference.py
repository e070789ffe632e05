"""Pages plugins.md and plugins/*.md, one for each plugin, from the plugins' docstrings.

The docstrings are reStructuredText as Mitsuba's own plugins have them. Of that language this knows
what they use: a label, a title, paragraphs, simple tables and code blocks, with literals and
references in the text. Anything else is an error, not a guess.
"""

import inspect
import re

from lidar_mi.plugins import PLUGINS

HEAD = """\
# Plugins

Mitsuba plugins of lidar-mi: types and parameters as in XML scenes and Python dictionaries.
`import lidar_mi` registers them in every variant except the scalar ones. Formulas are in the
[theory](theory/index.md), whole scenes in the [user guide](guide/xml_scenes.md).

<!-- Written by docs/make_plugin_reference.py from the docstrings in plugins/; edit those. -->

| plugin | kind | |
| --- | --- | --- |
"""

_NOTE = "<!-- Written by docs/make_plugin_reference.py from the plugin's docstring; edit that. -->"
_RULE = re.compile(r"=+(?: +=+)+")
_KINDS = {"phase": "phase function"}


def pages() -> dict[str, str]:
    """Texts of all pages as GitHub-flavoured Markdown, by their places below ``docs``."""
    rows = [
        f"| [`{plugin.NAME}`](plugins/{plugin.NAME}.md) | {_KINDS.get(plugin.KIND, plugin.KIND)} | "
        f"{_title(plugin).partition(' (`')[0]} |"
        for plugin in PLUGINS
    ]
    contents = ["```{toctree}", ":hidden:", "", *(f"plugins/{p.NAME}" for p in PLUGINS), "```", ""]
    index = HEAD + "\n".join([*rows, "", *contents])
    return {"plugins.md": index} | {f"plugins/{plugin.NAME}.md": page(plugin) for plugin in PLUGINS}


def page(plugin) -> str:
    """One plugin's page."""
    title, _, text = section(inspect.getdoc(plugin)).partition("\n")
    return f"{title}\n\n{_NOTE}\n{text}"


def _title(plugin) -> str:
    """The title of a plugin's docstring: the line above the dashes."""
    lines = inspect.getdoc(plugin).splitlines()
    underlines = [i for i, line in enumerate(lines) if re.fullmatch(r"-{3,}", line)]
    if len(underlines) != 1 or underlines[0] == 0:
        raise ValueError(f"{plugin.NAME}: expected one title underlined with dashes")
    return _inline(lines[underlines[0] - 1])


def section(text: str) -> str:
    """One plugin's docstring as a section."""
    lines = text.splitlines()
    out, i = [], 0
    while i < len(lines):
        line = lines[i]
        if re.fullmatch(r"\.\. _[\w-]+:", line):
            i += 1  # a label: Markdown makes its own from the title
        elif i + 1 < len(lines) and re.fullmatch(r"-{3,}", lines[i + 1]):
            out.append(f"# {_inline(line)}")
            i += 2
        elif _RULE.fullmatch(line):
            stop = _closing_rule(lines, i)
            out += _table(lines[i : stop + 1])
            i = stop + 1
        elif match := re.fullmatch(r"\.\. code-block:: (\w+)", line):
            stop = i + 1
            while stop < len(lines) and (not lines[stop] or lines[stop].startswith("    ")):
                stop += 1
            block = "\n".join(code[4:] for code in lines[i + 1 : stop]).strip("\n")
            out += [f"```{match[1]}", block, "```", ""]
            i = stop
        elif line.startswith((".. ", " ")):
            raise ValueError(f"cannot turn this line into Markdown: {line!r}")
        else:
            # a paragraph at a time: a reference may run over the end of a line
            stop = i
            while stop < len(lines) and lines[stop]:
                stop += 1
            out += [_inline("\n".join(lines[i:stop])), ""] if stop > i else [""]
            i = stop + 1
    return re.sub(r"\n{3,}", "\n\n", "\n".join(out)).strip() + "\n"


def _closing_rule(lines: list[str], first: int) -> int:
    rules = [i for i in range(first, len(lines)) if _RULE.fullmatch(lines[i])]
    if len(rules) < 3:
        raise ValueError(f"table without head or end: {lines[first + 1]!r}")
    return rules[2]


def _table(lines: list[str]) -> list[str]:
    """A simple table as a Markdown table; a row whose first cell is empty goes on the one above."""
    edges = [match.start() for match in re.finditer(r"=+", lines[0])]
    spans = list(zip(edges, [*edges[1:], None], strict=True))
    rows: list[list[str]] = []
    for line in lines[1:-1]:
        if _RULE.fullmatch(line):
            continue
        cells = [line[a:b].strip() for a, b in spans]
        if any(re.fullmatch(r"\S\S", line[edge - 1 : edge + 1]) for edge in edges[1:]):
            raise ValueError(f"text across a column's edge: {line!r}")
        if cells[0]:
            rows.append(cells)
        else:
            rows[-1] = [
                f"{above} {cell}".strip() for above, cell in zip(rows[-1], cells, strict=True)
            ]
    body = [f"| {' | '.join(_inline(cell) for cell in row)} |" for row in rows]
    return [body[0], "|" + " --- |" * len(spans), *body[1:], ""]


def _inline(text: str) -> str:
    """Literals and references of a piece of text."""
    names = {f"{plugin.KIND}-{plugin.NAME}": plugin for plugin in PLUGINS}

    def link(match: re.Match) -> str:
        return f"[{match[1]}]({names[match[2]].NAME}.md)"

    text = re.sub(r":ref:`([^<`]+?)\s+<([\w-]+)>`", link, text)
    if re.search(r":\w+:`", text):
        raise ValueError(f"unknown role in: {text!r}")
    return re.sub(r"``([^`]+)``", r"`\1`", text)
