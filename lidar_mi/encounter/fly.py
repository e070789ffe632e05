"""Fly into a wake: the flights of an encounter, their metrics, figures and report."""

import webbrowser
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import xarray as xr

from lidar_mi import __version__
from lidar_mi.arguments import checked_arguments
from lidar_mi.assessment.metrics.encounter import CONTROLLER, MET, encounter_metrics
from lidar_mi.assessment.report.encounter import encounter_summary
from lidar_mi.encounter.ahead.preview import Lidar
from lidar_mi.encounter.check import geometry
from lidar_mi.encounter.flight import FlightData, OwnAircraft, OwnController, simulate_flights
from lidar_mi.encounter.folder import EncounterFolder
from lidar_mi.encounter.replay import recorded_flight, recorded_lidar, with_recorded
from lidar_mi.encounter.report import answer, write_report
from lidar_mi.errors import InputError, is_interrupt
from lidar_mi.experiment.device import devices_in_words, on_its_device
from lidar_mi.experiment.folder.records import REPORT
from lidar_mi.experiment.log import Log
from lidar_mi.experiment.truth.clear_air import in_air_of_its_site
from lidar_mi.experiment.truth.wake_along_path import described_wake, encounter_of
from lidar_mi.plots import plot_flights
from lidar_mi.progress import Notice, progress
from lidar_mi.schema.experiment import Experiment
from lidar_mi.schema.reading import load_experiment
from lidar_mi.tables import Table, Tabular

if TYPE_CHECKING:
    from matplotlib.axes import Axes


@dataclass(frozen=True, eq=False, repr=False)
class Flights(Tabular):
    """The flights of an encounter, one for each controller.

    Attributes
    ----------
    experiment : Experiment
    data : FlightData
        ``series`` (time series of all flights), ``track`` and ``slabs`` (slab by slab).
    metrics : dict of str to float
        Flat, SI units.
    warnings : tuple of str
        Limitations of the results.
    folder : Path or None
        Folder of the files.
    """

    experiment: Experiment
    data: FlightData
    metrics: dict[str, float]
    warnings: tuple[str, ...] = ()
    folder: Path | None = None

    @property
    def series(self) -> xr.Dataset:
        """States, loads and commands, dims (flight, time)."""
        return self.data.series

    @property
    def track(self) -> xr.Dataset | None:
        """Estimates, track and truth of every slab; None without a lidar."""
        return self.data.track

    @property
    def answer(self) -> list[str]:
        """The main results, in sentences."""
        return answer(self.experiment, self.data, self.metrics)

    def tables(self) -> list[Table]:
        """The flights and the lidar, in numbers."""
        rows = [("experiment", self.experiment.name)]
        if self.folder is not None:
            rows.append(("folder", str(self.folder)))
        rows += [("answer", text) for text in self.answer]
        rows += [("warning", text) for text in self.warnings]
        return [
            Table("flight", rows),
            *encounter_summary(
                self.metrics,
                self.series.attrs.get(CONTROLLER, ""),
                self.series.attrs.get(MET, "wake"),
            ),
        ]

    def plot(self, name: str = "roll", ax: "Axes | None" = None) -> "Axes":
        """Draw a time series of every flight, angles in degrees.

        Parameters
        ----------
        name : str
            Variable of ``series``.
        ax : matplotlib Axes, optional
            Default: of a new figure.

        Raises
        ------
        InputError
            No such time series.
        """
        if name not in self.series:
            names = ", ".join(map(str, self.series.data_vars))
            raise InputError(f"plot: no time series {name}; expected one of {names}")
        return plot_flights(self.series, ax, name)

    def thumbnail(self) -> bytes:
        """The bank angles as PNG."""
        from matplotlib.figure import Figure

        from lidar_mi.io.png import png_bytes

        figure = Figure(figsize=(7.5, 4.2), layout="compressed")
        plot_flights(self.series, figure.subplots())
        return png_bytes(figure)

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
    lidar: Lidar | None = None,
    aircraft: OwnAircraft | None = None,
    controller: OwnController | None = None,
    replay: str | Path | None = None,
    overwrite: bool = False,
    processes: int = 1,
    notice: Notice | None = None,
) -> Flights:
    """Fly into the wake, with and without a preview of its wind.

    All flights meet the same wake. Only the flight that the lidar steers renders its scans.

    Parameters
    ----------
    experiment : Experiment, str or path
        With a section ``encounter``. Its ``control.mode`` says which flights: "off" with the wings
        levelled only; "perfect" also with an autopilot without preview and with the true wind as
        preview; "feedforward" also with the preview of the lidar.
    folder : path, optional
        Created if missing. If it holds flights of this experiment, only missing results are
        computed. Figures and a report are only made with a folder.
    lidar : object, optional
        With ``step(t, pose, expected) -> Estimate``; default: `VirtualLidar`.
    aircraft : callable, optional
        Gives an aircraft at the start of its path, an `AircraftModel`; default: that of the
        experiment.
    controller : callable, optional
        Gives, for an aircraft, a function of the preview and the state that returns `Commands`;
        default: `lidar_mi.aircraft.control.feedforward`. It steers all flights with a preview.
    replay : path, optional
        Folder of a flight with the lidar, whose estimates are delivered again: nothing is rendered.
        The experiment may differ in `encounter.aircraft` and `encounter.control`.
    overwrite : bool
        Replace the flights of another experiment.
    processes : int
        2: the lidar's wind is estimated in a process of its own, which is faster where a second
        core is idle. The flights are the same but for rounding.
    notice : callable, optional
        Called with the running step and its progress (0 to 1, or None).

    Returns
    -------
    Flights
        ``series``, ``track``, ``metrics``; displayed as tables. A flight that is lost (upset) is a
        result, no error: ``departed`` in its series.

    Raises
    ------
    InputError
        Bad input, a folder of anything else, a replay of another experiment.

    Examples
    --------
    >>> import lidar_mi as lm
    >>> path = {"start": "80 m", "beyond": "20 m"}
    >>> flights = lm.fly(
    ...     lm.load_experiment("encounter", encounter={"path": path, "control": {"mode": "off"}})
    ... )
    >>> flights.series["roll"].dims
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
                replay=replay,
                overwrite=overwrite,
                processes=processes,
                notice=shown,
            )
    if not isinstance(experiment, Experiment):
        experiment = load_experiment(experiment)
    encounter_of(experiment)
    experiment = in_air_of_its_site(on_its_device(experiment), experiment.folder)
    recorded = None
    if replay is not None:
        if lidar is not None:
            raise InputError("lidar: not allowed with replay, which has a lidar; expected one")
        if folder is not None and Path(folder).resolve() == Path(replay).resolve():
            raise InputError(f"{folder}: is the flight to be replayed; expected another folder")
        recorded = recorded_flight(replay, experiment)
        lidar = recorded_lidar(recorded, experiment)
    log = Log(notice)
    for warning in geometry(experiment, aircraft() if aircraft else None):
        log.remark(warning)
    simulate = partial(
        _simulated,
        recorded,
        experiment,
        notice=log.bar,
        lidar=lidar,
        aircraft=aircraft,
        controller=controller,
        processes=processes,
    )
    if folder is None:
        data = simulate()
        metrics = encounter_metrics(data.series, data.track)
        return Flights(experiment, data, metrics, tuple(log.warnings))
    results = EncounterFolder(folder, experiment)
    with results.claimed(overwrite):
        log.path = results.log
        log(f"lidar-mi {__version__}, flight {experiment.name}, seed {experiment.seed}")
        log(devices_in_words(experiment))
        for name, text in described_wake(experiment):
            log(f"{name}: {text}")
        # the record names no lidar, aircraft or controller of one's own: their flights are not
        # recognised in a folder
        reusable = not (lidar or aircraft or controller)
        try:
            return _completed(results, experiment, simulate, reusable, log)
        except BaseException as error:
            if is_interrupt(error):
                error.add_note("start it again to fly again with the scans that are there")
            elif isinstance(error, Exception):
                log.fail(error)
                if not isinstance(error, InputError):
                    error.add_note(f"traceback in {log.path}")
            raise


def _simulated(recorded: FlightData | None, experiment: Experiment, **how: Any) -> FlightData:
    """The flights; of a replay with images and errors of the recorded one."""
    data = simulate_flights(experiment, **how)
    return data if recorded is None else with_recorded(data, recorded)


def _completed(
    folder: EncounterFolder,
    experiment: Experiment,
    simulate: Callable[..., FlightData],
    reusable: bool,
    log: Log,
) -> Flights:
    """The results that the folder holds; those that it lacks are computed and written."""
    data = folder.read() if reusable else None
    metrics = folder.metrics() if data else None
    if data is None:
        if folder.scans.number:
            log(f"{folder.scans.number} scans of the flight that was stopped are used again")
        data = simulate(scans=folder.scans)
        folder.write(data)
        log(f"flights simulated: {', '.join(map(str, data.series['flight'].values))}")
    if metrics is None:
        # they are written last: without them the report is missing too
        metrics = encounter_metrics(data.series, data.track)
        write_report(folder, experiment, data, metrics, log)
    log("done")
    return Flights(experiment, data, metrics, tuple(log.warnings), folder.path)
