"""Reading experiments: from a YAML file and its variants to a checked description."""

import copy
import functools
import json
import re
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from lidar_mi.arguments import checked_arguments
from lidar_mi.errors import InputError
from lidar_mi.io.yaml import parse_yaml, read_yaml, to_yaml
from lidar_mi.schema.experiment import BACKSCATTER, NAME, Experiment
from lidar_mi.schema.faults import first_fault
from lidar_mi.schema.shipped import experiment_file
from lidar_mi.schema.site import Site
from lidar_mi.units import AS_GIVEN

RESERVED_NAMES = (
    "study.yaml",
    "experiment.yaml",
    "log.txt",
    "metrics.json",
    "report.html",
    "figures",
)
"""Names of files in the folder of a study or a run, which no variant may have."""

_LONGEST_NAME = 255
_PICTURES = (".exr", ".png", ".tif", ".tiff", ".jpg", ".jpeg", ".bmp", ".fits", ".pgm")
_OF_A_CAMPAIGN = ("sweep", "sample", "members")


@checked_arguments
def load_experiment(name: str | Path, *, variant: str | None = None, **changes: Any) -> Experiment:
    """Read an experiment, and change some of its keys.

    Parameters
    ----------
    name : path or str
        An experiment file, or the name of a shipped experiment, see `experiments`.
    variant : str, optional
        The name of the variant, if the file describes several.
    **changes
        Keys of the experiment file with their new values, as numbers in SI units or text with a
        unit: sections as dicts, which merge with what is there, or dotted keys,
        ``**{"scan.range": "200 m"}``. None removes a section.

    Returns
    -------
    Experiment
        Frozen and checked. Quantities are in SI units. It stores its file's folder, in which the
        files that it names are searched first.

    Raises
    ------
    InputError
        No such file, an unknown key, a wrong unit, a value out of range: the first fault is named.
        No variant is named where there are several, or none of this name.

    Examples
    --------
    >>> import lidar_mi as lm
    >>> experiment = lm.load_experiment("wake_backscatter", scan={"range": "200 m"}, seed=7)
    >>> experiment.scan.range, experiment.seed
    (200.0, 7)
    """
    path = experiment_file(name)
    variants = load_variants(path)
    if variant not in (variants or (None,)):
        choice = f"one of {', '.join(variants)}" if variants else f"none, as {name} has no variants"
        raise InputError(f"variant: {variant!r} is not allowed; expected {choice}")
    experiment = variants[str(variant)] if variants else load(path)
    if changes:
        # keys that the file lacks remain defaults: checks distinguish them from set ones
        data = settings(experiment) if variants else read_keys(path)
        for key, value in changes.items():
            # a.b: x is {a: {b: x}}, built from the inside
            for part in reversed(key.split(".")):
                value = {part: value}
            data = merged(data, value)
        experiment = check(data, str(name))
    return experiment.read_from(path.parent)


def load(path: str | Path, overrides: list[str] | None = None) -> Experiment:
    """Read an experiment file; ``overrides`` are texts such as ``"wake.texture.rms=0.2"``.

    Raises InputError: unreadable file, unknown key, wrong unit, value out of range: the first fault
    is named. A file of several variants: `load_variants` reads it.
    """
    data = read_keys(path)
    for override in overrides or []:
        _override(data, override)
    if "variants" in data:
        raise InputError(
            f"{path}: variants: not allowed for a single experiment; expected load_variants"
        )
    return check(data, str(path))


def load_variants(path: str | Path, overrides: list[str] | None = None) -> dict[str, Experiment]:
    """Read a file whose ``variants`` each change some keys of the experiment; empty if it has none.

    Sections merge key by key, other values replace; null removes a section. ``overrides`` count for
    all variants and over what these say, but those of ``variants.NAME.KEY`` for one. A variant's
    experiment is called NAME-OF-ALL.NAME.

    Raises InputError: as `load`, with the variant's name; no variants, or one that is no section.
    """
    data = read_keys(path)
    of_variants = [text for text in overrides or [] if text.strip().startswith("variants.")]
    if "variants" not in data and not of_variants:
        return {}
    for override in of_variants:
        _override(data, override)
    variants = data.pop("variants")
    if not isinstance(variants, dict) or not variants:
        raise InputError(f"{path}: variants: {variants!r} is not allowed; expected names with keys")
    experiments = {}
    for name, changes in variants.items():
        place = f"{path}: variants.{name}"
        if not re.fullmatch(NAME, str(name)):
            raise InputError(
                f"{place}: not allowed; expected a name of at most 100 letters, digits, _, . and -"
            )
        if str(name) in experiments:
            raise InputError(f"{place}: not allowed; another variant has this name")
        if str(name).lower() in RESERVED_NAMES:
            raise InputError(f"{place}: not allowed; a file of the study has this name")
        if not isinstance(changes, dict):
            raise InputError(f"{place}: {changes!r} is not allowed; expected keys to change")
        if "name" in changes:
            raise InputError(f"{place}.name: not allowed; the variant is its name")
        changed = merged(data, changes)
        for override in overrides or []:
            if override not in of_variants:
                _override(changed, override)
        if isinstance(changed.get("name"), str):
            changed["name"] += f".{name}"
        experiments[str(name)] = check(changed, place)
    return experiments


def merged(data: Any, changes: dict[str, Any]) -> dict[str, Any]:
    """``data`` with ``changes``, section by section; null removes. Both remain unchanged."""
    result = copy.deepcopy(data)
    for key, value in changes.items():
        inner = result.get(key)
        if value is None and isinstance(inner, dict):
            del result[key]
            continue
        nested = isinstance(inner, dict) and isinstance(value, dict)
        result[key] = merged(inner, value) if nested else copy.deepcopy(value)
    return result


def read_keys(path: str | Path) -> dict[str, Any]:
    """The keys of an experiment file, merged into those of its ``base`` if it has one."""
    return _read_keys(Path(path), ())


def _read_keys(path: Path, above: tuple[Path, ...]) -> dict[str, Any]:
    """`read_keys` of a file that those ``above`` are based on."""
    if path.suffix == ".xml":
        raise InputError(
            f"{path}: a Mitsuba scene, not an experiment; expected lidar-mi render {path}"
        )
    if path.suffix in (".nc", ".nc4", ".cdf"):
        raise InputError(
            f"{path}: a wake, not an experiment; expected a YAML file that says wake: "
            f"{{file: {path}}}"
        )
    if path.suffix.lower() in _PICTURES:
        raise InputError(
            f"{path}: a picture, not an experiment; expected lidar-mi info {path}, or lidar-mi "
            "retrieve with two images of the same air"
        )
    data = read_yaml(path, "an experiment file")
    if not isinstance(data, dict):
        raise InputError(f"{path}: holds no keys; expected name, wake, ...")
    if isinstance(data.get("experiment"), dict) and "versions" in data:
        data = data["experiment"]  # the record in a run folder can be run again
    if "base" not in data:
        return data
    if set(_OF_A_CAMPAIGN) & set(data):
        raise InputError(
            f"{path}: a campaign, not an experiment; expected lidar-mi campaign run {path}"
        )
    base = data.pop("base")
    if not isinstance(base, str) or len(base) > _LONGEST_NAME or "\0" in base:
        text = repr(base)[:60]
        raise InputError(f"{path}: base: {text} is not allowed; expected an experiment's name")
    sibling = path.parent / base
    file = sibling if sibling.is_file() else experiment_file(base)
    # links and relative paths may lead to the same file
    chain = (*above, path.resolve())
    if file.resolve() in chain:
        raise InputError(f"{path}: base: {base} is based on this file; expected another experiment")
    return merged(_read_keys(file, chain), data)


def check(data: dict[str, Any], origin: str) -> Experiment:
    """An experiment from a nested dictionary; see `load` for the errors."""
    try:
        return Experiment.model_validate(data)
    except ValidationError as error:
        raise InputError(f"{origin}: {first_fault(error, Experiment)}") from None


def dump(experiment: Experiment) -> str:
    """The resolved experiment as YAML; see `settings`. `load` reads it again."""
    return to_yaml(settings(experiment))


def settings(experiment: Experiment, *, si: bool = False) -> dict[str, Any]:
    """The resolved experiment as nested sections, without those of a lidar that it does not have.

    Quantities are text as they were given, or with their SI units.
    """
    unused = {*BACKSCATTER} if experiment.imaged_wake is None else set()
    if experiment.imaged_wake is None and experiment.site == Site():
        unused.add("site")
    unused |= {
        name
        for name in ("wake", "doppler", "sensor", "volume", "encounter")
        if getattr(experiment, name) is None
    }
    context = None if si else AS_GIVEN
    return experiment.model_dump(mode="json", exclude=unused, context=context)


def in_si(data: dict[str, Any]) -> dict[str, Any]:
    """The `settings` of an experiment in SI units: equal for equal experiments."""
    # the cache must not be changed by a caller
    return copy.deepcopy(_in_si(json.dumps(data)))


@functools.lru_cache(64)
def _in_si(text: str) -> dict[str, Any]:
    """`in_si` of the JSON, cached: every stage of a run needs it."""
    # as text, since a cache has no dictionaries as keys
    data = json.loads(text)
    try:
        return settings(check(data, ""), si=True)
    except InputError:  # of a version with other keys
        return data


def _override(data: dict[str, Any], text: str) -> None:
    key, equals, value = text.partition("=")
    if not equals or not key.strip():
        raise InputError(f"--set {text}: expected KEY=VALUE, such as wake.texture.rms=0.2")
    *parents, last = key.strip().split(".")
    for parent in parents:
        data = data.setdefault(parent, {})
        if not isinstance(data, dict):
            raise InputError(f"--set {text}: {parent} is a value, not a section")
    try:
        data[last] = parse_yaml(value, key)
    except InputError:
        raise InputError(f"--set {text}: {value!r} is not a YAML value") from None
