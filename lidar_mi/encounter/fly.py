"""An encounter: its flights, their numbers, figures and report."""

import webbrowser
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import xarray as xr

from lidar_mi import __version__
from lidar_mi.arguments import checked_arguments
from lidar_mi.assessment.metrics.encounter import CONTROLLER, encounter_metrics
from lidar_mi.assessment.report.encounter import encounter_summary
from lidar_mi.encounter.check import geometry
from lidar_mi.encounter.flight import Flown, fly_all
from lidar_mi.encounter.folder import FlightFolder
from lidar_mi.encounter.report import answer, write_report
from lidar_mi.encounter.wake import encounter_of
from lidar_mi.errors import InputError, is_interrupt
from lidar_mi.experiment.folder.run_folder import REPORT
from lidar_mi.experiment.log import Log
from lidar_mi.experiment.schema.experiment import Experiment
from lidar_mi.experiment.schema.reading import load_experiment
from lidar_mi.progress import progress
from lidar_mi.tables import Table, Tabular


@dataclass(frozen=True, eq=False, repr=False)
class Flight(Tabular):
    """An encounter that was flown.

    Attributes
    ----------
    experiment : Experiment
    flown : Flown
        ``series`` (time series of all flights), ``track`` and ``seen`` (slab by slab).
    metrics : dict of str to float
        Flat, SI units.
    warnings : tuple of str
        What matters for the results.
    folder : Path or None
        Folder of the files.
    """

    experiment: Experiment
    flown: Flown
    metrics: dict[str, float]
    warnings: tuple[str, ...] = ()
    folder: Path | None = None

    @property
    def series(self) -> xr.Dataset:
        """States, loads and commands, dims (flight, time)."""
        return self.flown.series

    @property
    def track(self) -> xr.Dataset | None:
        """Estimates, track and truth of every slab; None without a lidar."""
        return self.flown.track

    @property
    def answer(self) -> list[str]:
        """What a reader wants to know first, in sentences."""
        return answer(self.experiment, self.flown, self.metrics)

    def tables(self) -> list[Table]:
        """The flights and the lidar, in numbers."""
        rows = [("experiment", self.experiment.name)]
        if self.folder is not None:
            rows.append(("folder", str(self.folder)))
        rows += [("warning", text) for text in self.warnings]
        return [
            Table("flight", rows),
            *encounter_summary(self.metrics, self.series.attrs.get(CONTROLLER, "")),
        ]

    def show(self) -> None:
        """Show the numbers, and the report in a browser."""
        print(self)
        if self.folder is not None:
            webbrowser.open_new_tab((self.folder / REPORT).resolve().as_uri())


@checked_arguments
def fly(
    experiment: Experiment | str | Path,
    folder: str | Path | None = None,
    *,
    lidar: Any = None,
    aircraft: Callable | None = None,
    controller: Callable | None = None,
    overwrite: bool = False,
    processes: int = 1,
    notice: Callable | None = None,
) -> Flight:
    """Fly into the wake: without control, with an autopilot, steered by the lidar, by the truth.

    All flights meet the same wake. The lidar renders its scans in the flight that it steers.

    Parameters
    ----------
    experiment : Experiment, str or path
        With a section ``encounter``. Its ``control.mode`` says which flights: off alone; off,
        autopilot and perfect; all four with feedforward.
    folder : path, optional
        Created if missing. If it holds this flight, only what is missing is computed. Figures and a
        report are only made with a folder.
    lidar : object, optional
        With ``step(t, pose, expected) -> Estimate``; default: `VirtualLidar`.
    aircraft : callable, optional
        Gives an aircraft at the start of its path, an `AircraftModel`; default: that of the
        experiment.
    controller : callable, optional
        Gives, for an aircraft, a function of the preview and the state that returns `Commands`;
        default: `lidar_mi.encounter.control.feedforward`. It steers wherever there is a preview.
    overwrite : bool
        Replace the flight of another experiment.
    processes : int
        2: the lidar's wind is estimated in a process of its own, which is faster where a second
        core is idle. The flights are the same but for rounding.
    notice : callable, optional
        Called with what is running and how far it is (0 to 1, or None).

    Returns
    -------
    Flight
        ``series``, ``track``, ``metrics``; displayed as tables. An aircraft that departs is a
        result: its flight says so.

    Raises
    ------
    InputError
        Bad input, or a folder that holds something else.

    Examples
    --------
    >>> import lidar_mi as lm
    >>> path = {"start": "80 m", "beyond": "20 m"}
    >>> flight = lm.fly(
    ...     lm.load_experiment("encounter", encounter={"path": path, "control": {"mode": "off"}})
    ... )
    >>> flight.series["roll"].dims
    ('flight', 'time')
    """
    if notice is None:
        with progress() as shown:
            return fly(
                experiment,
                folder,
                lidar=lidar,
                aircraft=aircraft,
                controller=controller,
                overwrite=overwrite,
                processes=processes,
                notice=shown,
            )
    if not isinstance(experiment, Experiment):
        experiment = load_experiment(experiment)
    encounter_of(experiment)
    log = Log(notice)
    for text in geometry(experiment, aircraft() if aircraft else None):
        log.remark(text)
    own = {"lidar": lidar, "aircraft": aircraft, "controller": controller}
    if folder is None:
        return _in_memory(experiment, own, processes, log)
    kept = FlightFolder(folder, experiment)
    with kept.claimed(overwrite):
        log.path = kept.log
        log(f"lidar-mi {__version__}, flight {experiment.name}, seed {experiment.seed}")
        try:
            return _into(kept, experiment, own, processes, log)
        except BaseException as error:
            if is_interrupt(error):
                error.add_note("start it again to fly again with the scans that are there")
            elif isinstance(error, Exception):
                log.fail(error)
                if not isinstance(error, InputError):
                    error.add_note(f"traceback in {log.path}")
            raise


def _in_memory(experiment: Experiment, own: dict, processes: int, log: Log) -> Flight:
    flown = fly_all(experiment, log.bar, **own, processes=processes)
    metrics = encounter_metrics(flown.series, flown.track)
    return Flight(experiment, flown, metrics, tuple(log.warnings))


def _into(
    kept: FlightFolder, experiment: Experiment, own: dict, processes: int, log: Log
) -> Flight:
    """Fly what the folder does not have yet; parts of one's own have no record and fly again."""
    flown = None if any(own.values()) else kept.flown()
    metrics = kept.metrics() if flown else None
    if flown is None:
        if kept.scans.number:
            log(f"{kept.scans.number} scans of the flight that was stopped are used again")
        flown = fly_all(experiment, log.bar, **own, processes=processes, scans=kept.scans)
        kept.keep(flown)
        log(f"flown: {', '.join(map(str, flown.series['flight'].values))}")
    if metrics is None:
        metrics = encounter_metrics(flown.series, flown.track)
        write_report(kept, experiment, flown, metrics, log)
    log("done")
    return Flight(experiment, flown, metrics, tuple(log.warnings), kept.path)
