"""Stages: the steps of an experiment, ordered by their dependencies, each computed once."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

from lidar_mi.experiment.log import Log
from lidar_mi.experiment.schema.experiment import Experiment


def _always(experiment: Experiment) -> bool:
    return True


@dataclass(frozen=True)
class Stage:
    """One step of an experiment, from results to a result.

    It neither reads nor writes the files of a run, nor draws.

    Attributes
    ----------
    name : str
        Of its result.
    compute : callable
        ``compute(experiment, *results that it needs, log=log)``, returns the result.
    needs : tuple of str
        Names of the results it needs, in the order of its arguments.
    wanted : callable
        ``wanted(experiment)``: whether the experiment has this stage.
    ahead : bool
        Computed before anything is written: cheap, and needed to foresee later failures.
    check : callable, optional
        ``check(experiment, *those of needs that are computed ahead)`` raises InputError for faults
        that would otherwise appear after hours.
    remarks : callable, optional
        The same arguments; returns warnings, a line each, of what is allowed and likely wrong.
    parts : callable, optional
        ``parts(experiment)``, names of the parts of a result that takes long. Then ``compute`` also
        takes ``missing=``, the names of those to be computed, and ``keeper=``, the store of
        unfinished ones, and yields (name, part) one by one: each is saved as soon as it is
        complete. The result is a dictionary of all parts.
    timing : str, optional
        Step to which its duration is added.
    indifferent_to : tuple of str, optional
        Dotted keys of the experiment, sections or values, that have no influence on the result.
        Runs that differ in these alone share it. None: it is not shared.
    needed_by : callable, optional
        ``needed_by(experiment)``, those of ``indifferent_to`` that have an influence after all,
        with the experiment's other settings; see `indifferent`.
    illustrates : bool
        Only the report needs it.
    """

    name: str
    compute: Callable[..., Any]
    needs: tuple[str, ...] = ()
    wanted: Callable[[Experiment], bool] = _always
    ahead: bool = False
    check: Callable[..., None] | None = None
    remarks: Callable[..., list[str]] | None = None
    parts: Callable[[Experiment], Sequence[str]] | None = None
    timing: str | None = None
    indifferent_to: tuple[str, ...] | None = None
    needed_by: Callable[[Experiment], Sequence[str]] | None = None
    illustrates: bool = False

    def indifferent(self, experiment: Experiment) -> tuple[str, ...] | None:
        """Keys of an experiment that have no influence on the result; None: it is not shared."""
        if self.indifferent_to is None or self.needed_by is None:
            return self.indifferent_to
        needed = self.needed_by(experiment)
        return tuple(key for key in self.indifferent_to if key not in needed)


class Keeper(Protocol):
    """Storage of results during a run."""

    def kept(self, part: str) -> Any:
        """A part from an earlier run; None: there is none."""

    def unfinished(self, part: str) -> dict[str, Any] | None:
        """Unfinished part of an earlier run; None: there is none."""

    def keep_unfinished(self, part: str, arrays: dict[str, Any]) -> None:
        """Save an unfinished part, until the part itself is saved."""

    def keep_part(self, part: str, value: Any) -> Any:
        """Save a part; returns it as `kept` would."""

    def keep(self, name: str, value: Any) -> None:
        """Save a result, if it is one of those that are saved."""


def in_order(stages: Sequence[Stage], given: Sequence[str] = ()) -> list[Stage]:
    """Stages so that each follows those it needs, otherwise in the given order.

    Parameters
    ----------
    stages : sequence of Stage
    given : sequence of str
        Names of results given from the start.

    Raises
    ------
    ValueError
        Two stages of one name, a result that no stage gives, circular dependencies, a stage
        computed ahead that needs one that is not.
    """
    names = [*given, *(stage.name for stage in stages)]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise ValueError(f"stages: {', '.join(twice)} given twice")
    late = {stage.name for stage in stages if not stage.ahead}
    for stage in stages:
        unknown = [need for need in stage.needs if need not in names]
        if unknown:
            raise ValueError(f"stage {stage.name}: nothing gives {', '.join(unknown)}")
        if stage.ahead and late.intersection(stage.needs):
            raise ValueError(f"stage {stage.name}: is ahead of what it needs")
    ordered: list[Stage] = []
    there, waiting = set(given), list(stages)
    while waiting:
        ready = next((stage for stage in waiting if there.issuperset(stage.needs)), None)
        if ready is None:
            raise ValueError(f"stages: {', '.join(s.name for s in waiting)} need each other")
        waiting.remove(ready)
        ordered.append(ready)
        there.add(ready.name)
    return ordered


def result_of(
    stage: Stage,
    experiment: Experiment,
    results: dict[str, Any],
    log: Log,
    keeper: Keeper | None = None,
) -> Any:
    """The result of one stage from those it needs, saved if there is a keeper."""
    needed = [results[need] for need in stage.needs]
    if stage.parts is None:
        result = stage.compute(experiment, *needed, log=log)
        if keeper:
            keeper.keep(stage.name, result)
        return result
    names = stage.parts(experiment)
    there = {name: keeper.kept(name) if keeper else None for name in names}
    missing = [name for name in names if there[name] is None]
    if len(missing) < len(names):
        log(
            f"using {len(names) - len(missing)} of {len(names)} {stage.name.replace('_', ' ')} "
            "from an earlier run"
        )
    if missing:
        made = stage.compute(experiment, *needed, log=log, missing=missing, keeper=keeper)
        for name, part in made:
            there[name] = keeper.keep_part(name, part) if keeper else part
    return there
