"""Reading experiments: from a YAML file and its variants to a checked description."""

import copy
import difflib
import re
from pathlib import Path
from typing import Any, get_args

from pydantic import BaseModel, ValidationError

from lidar_mi.arguments import checked_arguments
from lidar_mi.errors import InputError
from lidar_mi.experiment.schema import BACKSCATTER, NAME, Experiment
from lidar_mi.experiment.shipped import experiment_file
from lidar_mi.io.yaml import parse_yaml, read_yaml, to_yaml
from lidar_mi.units import Unit, Within, to_si

BESIDE_VARIANTS = (
    "study.yaml",
    "experiment.yaml",
    "log.txt",
    "metrics.json",
    "report.html",
    "figures",
)
"""Names of files in the folder of a study or a run, which no variant may have."""


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
        wanted = f"one of {', '.join(variants)}" if variants else f"none, as {name} has no variants"
        raise InputError(f"variant: {variant!r} is not allowed; expected {wanted}")
    found = variants[str(variant)] if variants else load(path)
    if changes:
        data = settings(found)
        for key, value in changes.items():
            for part in reversed(key.split(".")):
                value = {part: value}
            data = merged(data, value)
        found = check(data, str(name))
    return found.read_from(path.parent)


def load(path: str | Path, overrides: list[str] | None = None) -> Experiment:
    """Read an experiment file; ``overrides`` are texts such as ``"wake.texture.rms=0.2"``.

    Raises
    ------
    InputError
        Unreadable file, unknown key, wrong unit, value out of range: the first fault is named. A
        file of several variants: `load_variants` reads it.
    """
    data = _read(path)
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

    Raises
    ------
    InputError
        As `load`, with the variant's name; no variants, or one that is no section.
    """
    data = _read(path)
    own = [text for text in overrides or [] if text.strip().startswith("variants.")]
    if "variants" not in data and not own:
        return {}
    for override in own:
        _override(data, override)
    variants = data.pop("variants")
    if not isinstance(variants, dict) or not variants:
        raise InputError(f"{path}: variants: {variants!r} is not allowed; expected names with keys")
    found = {}
    for name, changes in variants.items():
        place = f"{path}: variants.{name}"
        if not re.fullmatch(NAME, str(name)):
            raise InputError(
                f"{place}: not allowed; expected a name of at most 100 letters, digits, _, . and -"
            )
        if str(name) in found:
            raise InputError(f"{place}: not allowed; another variant has this name")
        if str(name).lower() in BESIDE_VARIANTS:
            raise InputError(f"{place}: not allowed; a file beside the variants has this name")
        if not isinstance(changes, dict):
            raise InputError(f"{place}: {changes!r} is not allowed; expected keys to change")
        if "name" in changes:
            raise InputError(f"{place}.name: not allowed; the variant is its name")
        changed = merged(data, changes)
        for override in overrides or []:
            if override not in own:
                _override(changed, override)
        if isinstance(changed.get("name"), str):
            changed["name"] += f".{name}"
        found[str(name)] = check(changed, place)
    return found


def merged(data: Any, changes: dict) -> dict:
    """``data`` with ``changes``, section by section; null removes. Both remain unchanged."""
    found = copy.deepcopy(data)
    for key, value in changes.items():
        inner = found.get(key)
        if value is None and isinstance(inner, dict):
            del found[key]
            continue
        both = isinstance(inner, dict) and isinstance(value, dict)
        found[key] = merged(inner, value) if both else copy.deepcopy(value)
    return found


def _read(path: str | Path) -> dict:
    """The keys of an experiment file, as they stand."""
    path = Path(path)
    if path.suffix == ".xml":
        raise InputError(
            f"{path}: a Mitsuba scene, not an experiment; expected lidar-mi render {path}"
        )
    if path.suffix in (".nc", ".nc4", ".cdf"):
        raise InputError(
            f"{path}: a wake, not an experiment; expected a YAML file that says wake: "
            f"{{file: {path}}}"
        )
    data = read_yaml(path, "an experiment file")
    if not isinstance(data, dict):
        raise InputError(f"{path}: holds no keys; expected name, wake, ...")
    if isinstance(data.get("experiment"), dict) and "versions" in data:
        data = data["experiment"]  # the record in a run folder can be run again
    return data


def check(data: dict, origin: str) -> Experiment:
    """An experiment from a nested dictionary; see `load` for the errors."""
    try:
        return Experiment.model_validate(data)
    except ValidationError as error:
        raise InputError(f"{origin}: {_first_fault(error)}") from None


def dump(experiment: Experiment) -> str:
    """The resolved experiment as YAML; see `settings`. `load` reads it again."""
    return to_yaml(settings(experiment))


def settings(experiment: Experiment) -> dict[str, Any]:
    """The resolved experiment as nested sections, quantities as text with their SI units.

    Without the sections of a lidar that it does not have.
    """
    unused = {"wake", *BACKSCATTER} if experiment.wake is None else set()
    unused |= {
        name for name in ("doppler", "sensor", "volume") if getattr(experiment, name) is None
    }
    return experiment.model_dump(mode="json", exclude=unused)


def _override(data: dict, text: str) -> None:
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


def _first_fault(error: ValidationError) -> str:
    faults = error.errors()
    # a misspelt key also leaves one missing: report the misspelt one
    fault = next((f for f in faults if f["type"] == "extra_forbidden"), faults[0])
    where, word = _key(fault["loc"]), ""
    if len(where) < len(fault["loc"]) and fault["type"] == "literal_error":
        # a word or a number: report the number's fault
        word = fault["ctx"]["expected"] + " or "
        fault = next(f for f in faults if f is not fault and _key(f["loc"]) == where)
    field = ".".join(where)
    message = fault["msg"].removeprefix("Value error, ")
    if fault["type"] == "extra_forbidden":
        allowed = _keys_at(fault["loc"][:-1])
        close = difflib.get_close_matches(where[-1], allowed, 1)
        hint = f"; did you mean {close[0]}?" if close else ""
        return f"{field}: unknown key{hint} (allowed: {', '.join(allowed)})"
    if fault["type"] == "missing":
        return f"{field}: missing"
    if fault["type"] == "value_error":
        return f"{field}: {message}" if field else message
    value = fault["input"]
    unit, within = _metadata_at(fault["loc"], Unit), _metadata_at(fault["loc"], Within)
    symbol = unit.symbol if unit else ""
    shown = f"{value:g} {symbol}".strip() if isinstance(value, float) else repr(value)
    if fault["type"] in ("out_of_range", "finite_number", "int_parsing_size") and within:
        if unit and not isinstance(value, float):
            # as it was understood, with its unit
            shown = f"{to_si(value, symbol, unit.example):g} {symbol}".strip()
        expected = word + within.words(symbol)
    elif fault["type"].startswith("model_"):
        expected = f"a section with keys out of {', '.join(_keys_at(fault['loc']))}"
    elif fault["type"] == "string_pattern_mismatch":
        expected = "at most 100 letters, digits, _, . and -, a letter or digit first"
    elif fault["type"] in ("tuple_type", "list_type"):
        expected = "a list in brackets"
    elif fault["type"] == "too_short":
        expected = f"{fault['ctx']['min_length']} or more"
    else:
        expected = message.removeprefix("Input should be ")
    return f"{field}: {shown} is not allowed; expected {expected}"


def _key(location: tuple) -> list[str]:
    """A fault's location without the kinds of value that pydantic tried there."""
    kinds = ("literal[", "function-")
    return [str(p) for p in location if p != "float" and not str(p).startswith(kinds)]


def _metadata_at(location: tuple, kind: type) -> Any:
    """The part of a kind in the annotation of the key at a location; None if there is none."""
    model: Any = Experiment
    field: Any = None
    for part in location:
        if model and part in model.model_fields:
            field = model.model_fields[part]
            model = _section(field.annotation)
    pending = [field.annotation, *field.metadata] if field else []
    while pending:
        part = pending.pop()
        if isinstance(part, kind):
            return part
        pending += (*get_args(part), *getattr(part, "__metadata__", ()))
    return None


def _keys_at(location: tuple) -> list[str]:
    model: Any = Experiment
    for part in location:
        if isinstance(part, str):
            model = _section(model.model_fields[part].annotation)
    return list(model.model_fields)


def _section(annotation) -> type[BaseModel] | None:
    """The model in an annotation such as ``tuple[Model, ...] | None``."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    return next(filter(None, map(_section, get_args(annotation))), None)
