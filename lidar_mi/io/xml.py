"""Scene files, checked before Mitsuba parses them."""

from pathlib import Path
from xml.parsers import expat

from lidar_mi.errors import InputError

DEEPEST = 64
"""Most levels of tags; a scene needs six. Mitsuba's parser recurses into each, and its stack is
limited."""


def check_scene_file(path: str | Path) -> None:
    """Refuse a scene that would crash the process, before it is parsed as a whole.

    Included files are checked, too.

    Raises InputError: no XML, or tags nested deeper than `DEEPEST`.
    """
    pending, checked = [Path(path)], set()
    while pending:
        file = pending.pop().resolve()
        if file not in checked and file.is_file():
            checked.add(file)
            pending += [file.parent / name for name in _included(file)]


def _included(path: Path) -> list[str]:
    """Names of the files that a scene file includes; its depth is checked on the way."""
    depth = 0
    names: list[str] = []

    def enter(tag: str, attributes: dict[str, str]) -> None:
        nonlocal depth
        depth += 1
        if depth > DEEPEST:
            raise InputError(
                f"{path}: line {parser.CurrentLineNumber}: <{tag}> inside {depth - 1} others is "
                f"not allowed; expected at most {DEEPEST} levels"
            )
        if tag == "include" and "filename" in attributes:
            names.append(attributes["filename"])

    def leave(tag: str) -> None:
        nonlocal depth
        depth -= 1

    parser = expat.ParserCreate()
    parser.StartElementHandler, parser.EndElementHandler = enter, leave
    try:
        with path.open("rb") as file:
            parser.ParseFile(file)
    except expat.ExpatError as error:
        raise InputError(f"{path}: not XML ({error}); expected a Mitsuba scene") from None
    return names
