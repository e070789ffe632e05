"""The graph of an experiment's stages: what each needs, and what it depends on, by its signature.

A stage is a function. Each of its parameters is, by its name,

- the result of another stage (``truth``);
- a section or a value of the experiment, with ``_`` for the dots (``scan``, ``doppler_camera``);
  None for a section of another kind than the parameter's, such as a Doppler lidar's;
- by its type, a `bundle`: each of its fields is one of these;
- what a run provides: ``log``, ``search_path`` (the folder in which files that an experiment names
  are searched first) and, for a stage that gives its result in parts, ``missing`` and ``store``.

The order of the stages and the keys of the experiment that a result depends on follow from this:
two experiments that agree in these keys have the same result.
"""

import functools
import inspect
import types
from collections.abc import Callable, Iterable, Iterator, Mapping, MutableMapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import (
    Annotated,
    Any,
    NamedTuple,
    Protocol,
    TypeVar,
    Union,
    dataclass_transform,
    get_args,
    get_origin,
)

from pydantic import BaseModel

from lidar_mi.experiment.log import Log
from lidar_mi.schema.experiment import Experiment
from lidar_mi.schema.section import sections_in

PROVIDED = ("log", "search_path", "missing", "store")

T = TypeVar("T")


@dataclass(frozen=True)
class Only:
    """Of an annotated section: the result depends on these of its keys alone."""

    keys: tuple[str, ...]

    def __init__(self, *keys: str):
        object.__setattr__(self, "keys", keys)


@dataclass(frozen=True)
class But:
    """Of an annotated section: the result depends on all of its keys but these."""

    keys: tuple[str, ...]

    def __init__(self, *keys: str):
        object.__setattr__(self, "keys", keys)


class Guard:
    """Of an annotated parameter: it may stop a stage, but its result does not depend on it."""


_BUNDLES: set[Any] = set()


@dataclass_transform(frozen_default=True)
def bundle(description: type[T]) -> type[T]:
    """A frozen dataclass of what travels together, whose fields stages take as one parameter."""
    frozen = dataclass(frozen=True)(description)
    _BUNDLES.add(frozen)
    return frozen


class Parameter(NamedTuple):
    """A parameter of a stage, or a field of one that is a bundle.

    path: the dotted key of the experiment that it would be, if it is no result.
    optional: whether it may be None: the stage does without.
    default: whether it may be omitted.
    marks: `Only`, `But`, `Guard`.
    kinds (tuple of type): sections that it may be, if it is one.
    """

    name: str
    path: str | None
    optional: bool
    default: bool
    marks: tuple[Any, ...]
    kinds: tuple[type[BaseModel], ...] = ()


class Store(Protocol):
    """Storage of results during a run."""

    def stored(self, part: str) -> Any:
        """A part from an earlier run; None: there is none."""

    def unfinished(self, part: str) -> dict[str, Any] | None:
        """Unfinished part of an earlier run; None: there is none."""

    def store_unfinished(self, part: str, arrays: dict[str, Any]) -> None:
        """Save an unfinished part, until the part itself is saved."""

    def store_part(self, part: str, value: Any) -> Any:
        """Save a part; returns it as `stored` would."""

    def store_result(self, name: str, value: Any) -> None:
        """Save a result, if it is one of those that are saved."""


def _always(experiment: Experiment) -> bool:
    return True


@dataclass(frozen=True)
class Stage:
    """One step of an experiment, from sections and results to a result.

    It neither reads nor writes the files of a run, nor draws. An experiment has it if it has all
    sections and results that its function cannot do without.

    name: of its result.
    compute: returns the result, see the module.
    when: ``when(experiment)``: a further condition for the experiment to have this stage.
    preflight: computed before anything is written: cheap, and needed to foresee later failures.
    check: parameters as of ``compute``, results of `preflight` stages alone. Raises InputError for
        faults that would otherwise appear after hours.
    remarks: parameters as of ``check``; returns warnings, a line each, of what is allowed and
        likely wrong.
    parts: parameters are sections alone; names of the parts of a result that takes long. Then
        ``compute`` also takes ``missing``, the names of those to be computed, and ``store``, the
        store of unfinished ones, and yields (name, part) one by one: each is saved as soon as it is
        complete. The result is a dictionary of all parts.
    timing: step to which its duration is added.
    on_demand: computed only where another stage lacks it.
    figure_only: only the report needs it.
    """

    name: str
    compute: Callable[..., Any]
    when: Callable[[Experiment], bool] = _always
    preflight: bool = False
    check: Callable[..., None] | None = None
    remarks: Callable[..., list[str]] | None = None
    parts: Callable[..., Sequence[str]] | None = None
    timing: str | None = None
    on_demand: bool = False
    figure_only: bool = False


@functools.cache
def parameters(function: Callable[..., Any]) -> tuple[Parameter, ...]:
    """The parameters of a stage's function that the graph provides; of a bundle its fields.

    A type in quotes is that of a result, from a module that only the stage itself loads: it is read
    as text.
    """
    leaves: list[Parameter] = []
    for name, given in inspect.signature(function).parameters.items():
        # their names stand for nothing that the graph could look up
        if given.kind in (given.VAR_POSITIONAL, given.VAR_KEYWORD):
            continue
        kind, marks = given.annotation, ()
        if kind in _BUNDLES:
            leaves += parameters(kind)
            continue
        if isinstance(kind, str) and "Annotated" in kind:
            raise ValueError(f"{function.__name__}: {name}: marks in quotes are not read")
        if get_origin(kind) is Annotated:
            kind, *rest = get_args(kind)
            marks = tuple(rest)
        # Optional[X] and X | None have different origins
        optional = (
            kind.endswith("| None")
            if isinstance(kind, str)
            else get_origin(kind) in (Union, types.UnionType) and type(None) in get_args(kind)
        )
        default = given.default is not given.empty
        kinds = () if isinstance(kind, str) else tuple(sections_in(kind))
        leaves.append(Parameter(name, section_path(name), optional, default, marks, kinds))
    return tuple(leaves)


@functools.cache
def section_path(name: str, model: type[BaseModel] = Experiment) -> str | None:
    """The dotted key that a parameter's name stands for; None: none."""
    for key, field in model.model_fields.items():
        if name == key:
            return key
        # keys contain _ themselves: every key that the name begins with is tried
        for inner in sections_in(field.annotation) if name.startswith(f"{key}_") else ():
            rest = section_path(name[len(key) + 1 :], inner)
            if rest is not None:
                return f"{key}.{rest}"
    return None


def section(experiment: Experiment, path: str) -> Any:
    """A section or a value of an experiment, by its dotted key.

    None below a missing section, or one of a kind that has no such key.
    """
    value: Any = experiment
    for key in path.split("."):
        value = getattr(value, key, None)
    return value


def _given(experiment: Experiment, parameter: Parameter) -> Any:
    """The section or value of a parameter; None where it is a section of another kind."""
    assert parameter.path is not None
    value = section(experiment, parameter.path)
    wrong = isinstance(value, BaseModel) and parameter.kinds
    return None if wrong and not isinstance(value, parameter.kinds) else value


def call(function: Callable[..., T], experiment: Experiment, **given: Any) -> T:
    """A stage's function with its sections from an experiment.

    **given: its other parameters: results, and what a run provides; by default a silent log, and
        the experiment's folder.
    """
    provided = {"log": Log(), "search_path": experiment.folder} | given
    for parameter in parameters(function):
        if parameter.name not in provided and parameter.path is not None:
            provided[parameter.name] = _given(experiment, parameter)
    return function(**_bundled(function, provided))


def _bundled(function: Callable[..., Any], values: Mapping[str, Any]) -> dict[str, Any]:
    """Arguments of a function from the values of its `parameters`."""
    arguments = {}
    for name, given in inspect.signature(function).parameters.items():
        if name in values:
            arguments[name] = values[name]
        elif given.annotation in _BUNDLES:
            arguments[name] = given.annotation(**_bundled(given.annotation, values))
    return arguments


class Graph:
    """The stages, out of those of all experiments, that an experiment has, in their order.

    Raises ValueError: two stages of one name, a parameter that is nothing, stages that need each
    other, a stage of the preflight that needs one that is not.
    """

    def __init__(self, stages: Sequence[Stage], experiment: Experiment):
        self.experiment = experiment
        self._names = {stage.name for stage in stages}
        for stage in stages:
            for parameter in parameters(stage.compute):
                known = parameter.name in {*self._names, *PROVIDED} or parameter.path is not None
                if not (known or parameter.default):
                    raise ValueError(f"stage {stage.name}: nothing gives {parameter.name}")
        there = self._existing(stages)
        # stages of one name are allowed whose conditions exclude each other
        names = [stage.name for stage in there]
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice:
            raise ValueError(f"stages: {', '.join(twice)} given twice")
        self.stages = self._in_order(there)
        self._by_name = {stage.name: stage for stage in self.stages}

    def __getitem__(self, name: str) -> Stage:
        return self._by_name[name]

    def __iter__(self) -> Iterator[Stage]:
        return iter(self.stages)

    def needs(self, stage: Stage) -> list[str]:
        """Names of the results that a stage takes."""
        return [p.name for p in parameters(stage.compute) if p.name in self._by_name]

    def _existing(self, stages: Sequence[Stage]) -> list[Stage]:
        """Those that have all they cannot do without."""
        remaining = [stage for stage in stages if stage.when(self.experiment)]
        # a stage without its inputs goes, and with it those that need its result
        while True:
            names = {stage.name for stage in remaining}
            possible = [stage for stage in remaining if self._is_possible(stage, names)]
            if len(possible) == len(remaining):
                return possible
            remaining = possible

    def _is_possible(self, stage: Stage, names: set[str]) -> bool:
        for parameter in parameters(stage.compute):
            if parameter.optional or parameter.name in PROVIDED:
                continue
            if parameter.name in self._names:
                if parameter.name not in names:
                    return False
            elif parameter.path and _given(self.experiment, parameter) is None:
                return False
        return True

    def _in_order(self, stages: Sequence[Stage]) -> list[Stage]:
        """Each behind those that it needs, otherwise as given."""
        all_names = {stage.name for stage in stages}
        # a preflight stage cannot wait for these
        late = {stage.name for stage in stages if not (stage.preflight or stage.on_demand)}
        ordered: list[Stage] = []
        there: set[str] = set()
        waiting = list(stages)
        while waiting:
            # stages that the experiment has not are not waited for: their parameters are None
            ready = next((s for s in waiting if there >= self._taken(s) & all_names), None)
            if ready is None:
                raise ValueError(f"stages: {', '.join(s.name for s in waiting)} need each other")
            if ready.preflight and late & self._taken(ready):
                raise ValueError(f"stage {ready.name}: of the preflight, but what it needs is not")
            waiting.remove(ready)
            ordered.append(ready)
            there.add(ready.name)
        return ordered

    def _taken(self, stage: Stage) -> set[str]:
        return {p.name for p in parameters(stage.compute)} & self._names

    def arguments(
        self,
        function: Callable[..., Any],
        results: Mapping[str, Any],
        provided: Mapping[str, Any] = types.MappingProxyType({}),
    ) -> dict[str, Any] | None:
        """Arguments of a function from sections and results; None: a result is not there."""
        arguments = {}
        for parameter in parameters(function):
            if parameter.name in provided:
                arguments[parameter.name] = provided[parameter.name]
            elif parameter.name in self._names:
                if parameter.name in results:
                    arguments[parameter.name] = results[parameter.name]
                elif parameter.name in self._by_name:
                    # the experiment has this stage: its result is still to come
                    return None
                else:
                    arguments[parameter.name] = None
            elif parameter.path is not None:
                arguments[parameter.name] = _given(self.experiment, parameter)
        return _bundled(function, arguments)

    def call(self, function: Callable[..., T], results: Mapping[str, Any]) -> T:
        """A function that takes sections and results of the preflight."""
        arguments = self.arguments(function, results)
        if arguments is None:
            raise ValueError(f"{function.__name__}: takes what the preflight does not compute")
        return function(**arguments)

    def compute(
        self,
        stage: Stage,
        results: MutableMapping[str, Any],
        log: Log,
        search_path: str | Path,
        store: Store | None = None,
    ) -> Any:
        """The result of a stage, saved if there is a store. Results that it needs come first.

        Parts that the store has are not computed, nor what only they need.
        """
        provided: dict[str, Any] = {"log": log, "search_path": Path(search_path)}
        if stage.parts is None:
            result = stage.compute(**self._inputs(stage, results, provided, store))
            if store:
                store.store_result(stage.name, result)
            return result
        names = self.parts(stage)
        there = {name: store.stored(name) if store else None for name in names}
        missing = [name for name in names if there[name] is None]
        if len(missing) < len(names):
            log(
                f"using {len(names) - len(missing)} of {len(names)} "
                f"{stage.name.replace('_', ' ')} from an earlier run"
            )
        # inputs of parts that are all stored are not computed
        if missing:
            provided |= {"missing": missing, "store": store}
            for name, part in stage.compute(**self._inputs(stage, results, provided, store)):
                # one by one: a stopped run goes on behind the last of them
                there[name] = store.store_part(name, part) if store else part
        return there

    def _inputs(
        self,
        stage: Stage,
        results: MutableMapping[str, Any],
        provided: dict[str, Any],
        store: Store | None,
    ) -> dict[str, Any]:
        """The arguments of a stage; results that are missing are computed."""
        for name in self.needs(stage):
            # others were computed before
            if name not in results:
                log, folder = provided["log"], provided["search_path"]
                results[name] = self.compute(self[name], results, log, folder, store)
        arguments = self.arguments(stage.compute, results, provided)
        assert arguments is not None  # all that it needs was computed just now
        return arguments

    def parts(self, stage: Stage) -> list[str]:
        """Names of the parts of a stage's result."""
        if stage.parts is None:
            return []
        return list(stage.parts(**(self.arguments(stage.parts, {}) or {})))

    def keys(self, stage: Stage) -> "Keys":
        """The keys of the experiment that a result depends on, through all that it needs."""
        keys: set[tuple[str, Only | But | None]] = set()
        visited: set[str] = set()
        waiting = [stage]
        while waiting:
            one = waiting.pop()
            visited.add(one.name)
            # sections that select the parts select the result, too
            functions = [one.compute] + ([one.parts] if one.parts else [])
            for parameter in (p for f in functions for p in parameters(f)):
                # it refuses or lets pass: the result is the same for all values that pass
                if Guard in parameter.marks:
                    continue
                if parameter.name in self._names:
                    if parameter.name in self._by_name and parameter.name not in visited:
                        waiting.append(self[parameter.name])
                elif parameter.path is not None:
                    marks = [m for m in parameter.marks if isinstance(m, Only | But)]
                    keys.add((parameter.path, marks[0] if marks else None))
        return Keys(frozenset(keys))


@dataclass(frozen=True)
class Keys:
    """Keys of an experiment: whole sections, or some of their keys."""

    sections: frozenset[tuple[str, Only | But | None]]

    def __contains__(self, key: str) -> bool:
        return any(_holds(path, mark, key) for path, mark in self.sections)

    def of(self, settings: Mapping[str, Any]) -> dict[str, Any]:
        """Those of nested settings, by their dotted keys."""
        return {key: value for key, value in _leaves(settings) if key in self}


def _holds(path: str, mark: Only | But | None, key: str) -> bool:
    if not _is_below(key, path):
        return False
    if mark is None:
        return True
    listed = any(_is_below(key, f"{path}.{one}") for one in mark.keys)
    # a section that is omitted as a whole is one value, None
    return listed == isinstance(mark, Only) or key == path


def _is_below(key: str, path: str) -> bool:
    return key == path or key.startswith(f"{path}.")


def _leaves(settings: Mapping[str, Any], above: str = "") -> Iterable[tuple[str, Any]]:
    for key, value in settings.items():
        # an empty section is a value, other than a missing one
        if isinstance(value, dict) and value:
            yield from _leaves(value, f"{above}{key}.")
        else:
            yield f"{above}{key}", value
