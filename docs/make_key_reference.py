"""Pages reference/keys*.md from the descriptions of the experiment file.

They say what ``lidar-mi explain`` says, a page for each section of a file, or for each kind of
it.
"""

import re
from dataclasses import replace

from pydantic import BaseModel

from lidar_mi.schema import keys

NOTE = (
    "<!-- Written by docs/make_key_reference.py from the descriptions of the keys; edit those. -->"
)
HEAD = f"""\
# Keys

{NOTE}

Every key of an experiment file, section by section: unit, default, what is allowed, what it does.
[Experiment files](../guide/keys.md) describes their syntax. A plain number is in the unit of the
table, except that angles and energies always need a unit. Limits have their reason in parentheses.
`lidar-mi explain KEY` says the same on the command line.
"""
# where a section is described in use
GUIDES = {
    "wake": "[your own wake](../guide/wake.md), [wakes from flow solvers](../cfd.md)",
    "platform": "[times and poses of beams](../guide/beams.md)",
    "lidar": "[your own sensor](../guide/sensor.md), [lidar equation](../theory/lidar_equation.md)",
    "detector": "[detectors](../guide/keys.md#detectors), [theory](../theory/detector.md)",
    "scan": "[times and poses of beams](../guide/beams.md), [theory](../theory/scan.md)",
    "scattering": "[mixtures](../guide/keys.md#mixtures), [theory](../theory/scatterers.md)",
    "render": "[runs](../guide/running.md), "
    "[simulation or lidar](../guide/methods.md#simulation-or-lidar)",
    "retrieval": "[methods](../guide/methods.md), [limits](../guide/keys_retrieval.md#retrieval)",
    "doppler": "[Doppler lidar](../guide/keys_retrieval.md#doppler), [rings](../guide/rings.md)",
    "doppler_coherent": "[coherent lidar](../guide/keys_coherent.md)",
    "sensor": "[both lidars](../guide/keys_sensor.md#sensor), [theory](../theory/combination.md)",
    "volume": "[volumes](../guide/keys_sensor.md#volume), [theory](../theory/volumes.md)",
    "encounter": "[flights](../guide/flights.md), [air](../guide/air.md), "
    "[theory](../theory/encounter.md)",
}
TABLE = "| key | meaning | unit | default | allowed |\n| --- | --- | --- | --- | --- |"


def pages() -> dict[str, str]:
    """Texts of all pages by their places below ``docs``."""
    found = [keys.explain(name) for name in keys.sections()]
    top = [keys.explain(name) for name in keys.OF_A_FILE]
    sections = [key for key in found if key.keys]
    of_a_file = [_line(key) for key in (*found, *top) if not key.keys]
    below = {name: page for key in sections for name, page in _of_section(key).items()}
    listed = [
        f"| [`{title}`]({name}.md) | {meaning} |" for name, (title, meaning, _) in below.items()
    ]
    contents = "\n".join(
        [
            HEAD,
            "\n".join([TABLE, *of_a_file]),
            "",
            "\n".join(["| section | |", "| --- | --- |", *listed]),
            "",
            "```{toctree}\n:hidden:\n",
            *below,
            "```\n",
        ]
    )
    texts = {"keys": contents} | {name: text for name, (*_, text) in below.items()}
    return {f"reference/{name}.md": text for name, text in texts.items()}


def _of_section(key: keys.Key) -> dict[str, tuple[str, str, str]]:
    """Titles, meanings and texts of the pages of a section, one for each kind of it."""
    found = {}
    listed: tuple[str, ...] = ()
    for number, kind in enumerate(keys.kinds(key.name)):
        name = f"{key.name}_{kind.word}" if number else key.name
        title = f"{key.name}, kind: {kind.word}"
        own = tuple(one for one in kind.keys if one not in listed)
        listed += own
        text = section(replace(key, keys=own, more=kind.more), title, name)
        found[f"keys_{name}"] = title, _text(kind.more[0].removesuffix(".")), text
    alone = key.name, _text(key.meaning), section(key, key.name, key.name)
    return found or {f"keys_{key.name}": alone}


def section(key: keys.Key, title: str, name: str) -> str:
    """The page of a section at the top of a file, or of a kind of it."""
    # a section of another package may have no page of its own in the guide
    see = f"In use: {GUIDES[name]}." if name in GUIDES else ""
    parts = [f"# {title}", NOTE, *(part for part in _about(key) if part), see]
    parts += [_table(key), *_below(key)]
    return "\n\n".join(part for part in parts if part) + "\n"


def _below(key: keys.Key) -> list[str]:
    """The sections in a section, each with what it is and its keys."""
    found = []
    for inner in map(keys.explain, key.keys):
        if inner.keys:
            each = "A list of sections, each with these keys." if _is_list(inner) else ""
            found += [f"## {inner.name}", *_about(inner), each, _table(inner), *_below(inner)]
    return found


def _table(key: keys.Key) -> str:
    rows = [_line(inner) for inner in map(keys.explain, key.keys) if not _always(inner)]
    return "\n".join([TABLE, *rows]) if rows else ""


def _always(key: keys.Key) -> bool:
    """Whether it is a section that every experiment has, of which the keys say all."""
    return bool(key.keys) and isinstance(key.value, BaseModel)


def _is_list(key: keys.Key) -> bool:
    return key.allowed.startswith("a list")


def _about(key: keys.Key) -> list[str]:
    return [_text(part) for part in key.more]


def _line(key: keys.Key) -> str:
    cells = [f"`{key.name}`", _text(key.meaning), _raised(key.unit), _code(key.default)]
    return f"| {' | '.join([*cells, _allowed(key)])} |"


def _allowed(key: keys.Key) -> str:
    """What is allowed, words as code, units as in their own column."""
    text = key.allowed
    for word in (*key.words, "null"):
        text = re.sub(rf"(^|, |of ){re.escape(word)}(?=, |$)", rf"\1`{word}`", text)
    return _raised(text)


def _code(text: str) -> str:
    return f"`{text}`" if text and text != "required" else text


def _raised(text: str) -> str:
    """Squares and cubes of units."""
    return re.sub(r"(?<=[a-z])\^([23])", lambda found: "²³"[int(found[1]) - 2], text)


def _text(text: str) -> str:
    """Prose as Markdown: names of keys as code, but for those that are code already."""
    parts = re.split(r"(`[^`]*`)", text)
    named = r"(?<![\w.`/-])([a-z]\w*(?:[._][a-z]\w*)+)(?![\w`-])"
    parts[::2] = [re.sub(named, r"`\1`", part.replace("<", r"\<")) for part in parts[::2]]
    return "".join(parts)
