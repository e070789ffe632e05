"""Experiments, campaigns and scenes that come with the package, found by their names."""

import difflib
from collections.abc import Sequence
from importlib.resources import files
from pathlib import Path
from typing import NamedTuple

from lidar_mi.arguments import checked_arguments
from lidar_mi.errors import InputError
from lidar_mi.io.text import read_text
from lidar_mi.io.yaml import read_yaml


class _Kind(NamedTuple):
    """Name of a kind of file, and its folder in the package."""

    called: str
    folder: str
    suffix: str


_EXPERIMENT = _Kind("an experiment file", "", ".yaml")
_CAMPAIGN = _Kind("a campaign file", "campaigns", ".yaml")
_INSTRUMENT = _Kind("an instrument", "instruments", ".yaml")
_SCENE = _Kind("a Mitsuba scene (XML)", "", ".xml")


def experiments() -> list[str]:
    """Names of the experiments that come with the package, in alphabetical order.

    Examples
    --------
    >>> import lidar_mi as lm
    >>> "wake_backscatter" in lm.experiments()
    True
    """
    return _names(_EXPERIMENT)


def flights() -> list[str]:
    """The `experiments` that are flights: with the section ``encounter``, or based on a flight."""
    names: set[str] = set()
    data_of = {
        name: read_yaml(_folder(_EXPERIMENT) / f"{name}.yaml", "an experiment")
        for name in experiments()
    }
    while more := {
        name
        for name, data in data_of.items()
        if name not in names and ("encounter" in data or data.get("base") in names)
    }:
        names |= more
    return sorted(names)


def question_and_needs(name: str) -> tuple[str, str]:
    """The question of a shipped experiment or campaign, and what it needs.

    They are the first two lines of its file, ``# QUESTION`` and ``# Needs NEEDS.``.

    Raises InputError: there is none of this name.
    """
    path = _shipped_of(name, [_EXPERIMENT, _CAMPAIGN])
    question, needs = read_text(path, "an experiment file").splitlines()[:2]
    return question.removeprefix("# "), needs.removeprefix("# Needs ").removesuffix(".")


def instruments() -> list[str]:
    """Names of the published instruments that come with the package, in alphabetical order."""
    return _names(_INSTRUMENT)


def instrument_file(name: str) -> Path:
    """The experiment file of a published instrument, in which each number has its source.

    Raises InputError: there is none of this name; the message lists them.
    """
    return _shipped_of(name, [_INSTRUMENT])


def shipped_file(name: str) -> Path:
    """The file of a shipped experiment, whatever the working folder holds.

    Raises InputError: there is none of this name; the message lists them.
    """
    return _shipped_of(name, [_EXPERIMENT])


def scenes() -> list[str]:
    """Names of the Mitsuba scenes of the package, in alphabetical order."""
    return _names(_SCENE)


def campaigns() -> list[str]:
    """Names of the campaigns that come with the package, in alphabetical order.

    Examples
    --------
    >>> import lidar_mi as lm
    >>> "design_map" in lm.campaigns()
    True
    """
    return _names(_CAMPAIGN)


@checked_arguments
def experiment_file(name: str | Path) -> Path:
    """The experiment file of a path or of a shipped experiment's name.

    A file of that name in the working folder comes first.

    Raises InputError: neither a file nor a shipped experiment.
    """
    return _file_of(name, [_EXPERIMENT])


@checked_arguments
def campaign_file(name: str | Path) -> Path:
    """As `experiment_file`, for a campaign, or for an experiment with variants."""
    return _file_of(name, [_CAMPAIGN, _EXPERIMENT])


@checked_arguments
def scene_file(name: str | Path) -> Path:
    """The file of a Mitsuba scene of the package (``slab``), or of one's own (its path).

    A file of that name in the working folder comes first.

    Parameters
    ----------
    name : str or path

    Returns
    -------
    Path
        For ``mi.load_file``, as text: ``mi.load_file(str(path))``.

    Raises
    ------
    InputError
        Neither a file nor a scene of the package; the message lists these.

    Examples
    --------
    >>> import lidar_mi as lm
    >>> lm.scene_file("slab").name
    'slab.xml'
    """
    return _file_of(name, [_SCENE])


def _file_of(name: str | Path, kinds: Sequence[_Kind]) -> Path:
    path = Path(name)
    try:
        if path.is_file():
            return path
    except OSError as error:  # a name that is too long
        raise InputError(f"{name}: {error.strerror}; expected {kinds[0].called}") from None
    return _shipped_of(name, kinds)


def _shipped_of(name: str | Path, kinds: Sequence[_Kind]) -> Path:
    path = Path(name)
    for kind in kinds:
        file = path.name if path.suffix == kind.suffix else f"{path.name}{kind.suffix}"
        shipped = _folder(kind) / file
        if path.parent == Path() and shipped.is_file():
            return shipped
    close = difflib.get_close_matches(
        path.stem.lower(), [n for kind in kinds for n in _names(kind)], 1
    )
    hint = f"did you mean {close[0]}? Expected" if close else "expected"
    names = ", ".join(_names(kinds[0]))
    # instruments are only those of the package
    if kinds == [_INSTRUMENT]:
        raise InputError(f"{name}: no such instrument; {hint} one of {names}")
    raise InputError(f"{name}: no such file; {hint} {kinds[0].called} or one of {names}")


def _names(kind: _Kind) -> list[str]:
    return sorted(path.stem for path in _folder(kind).glob(f"*{kind.suffix}"))


def _folder(kind: _Kind) -> Path:
    return Path(str(files("lidar_mi.scenes"))) / kind.folder
