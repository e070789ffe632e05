"""The folder of an encounter: its experiment, the data sets of its flights, its report."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path

import xarray as xr

from lidar_mi.encounter.flight import FlightData
from lidar_mi.encounter.lidar.scan_store import ScanStore
from lidar_mi.errors import InputError
from lidar_mi.experiment.export_flight import FLIGHT_FILES as FILES
from lidar_mi.experiment.folder.image_store import MADE_BY
from lidar_mi.experiment.folder.records import (
    LOG,
    METRICS,
    RECORD,
    REPORT,
    SUMMARY,
    read_metrics,
    read_record,
)
from lidar_mi.experiment.folder.run_folder import FIGURES, held, made_by, new_record, write_verdict
from lidar_mi.experiment.truth.wake_along_path import encounter_of
from lidar_mi.io.atomic import write_atomically
from lidar_mi.io.netcdf import read_netcdf, write_netcdf
from lidar_mi.io.text import encoded
from lidar_mi.io.yaml import to_yaml
from lidar_mi.schema.experiment import Experiment

ANIMATION, VIDEO, SCANS = "approach.gif", "approach.mp4", "scans"


class EncounterFolder:
    """The files of an encounter, each written under a temporary name."""

    def __init__(self, path: str | Path, experiment: Experiment) -> None:
        self.path = Path(path)
        self.figures, self.log = self.path / FIGURES, self.path / LOG
        self.record = new_record(experiment, experiment.folder)
        # trajectories depend on the version of JSBSim, where it is used
        if encounter_of(experiment).aircraft.model not in ("roll", "heave"):
            self.record["versions"]["jsbsim"] = version("jsbsim")
        self.made_by = made_by(self.record)
        self.scans = ScanStore(self.path / SCANS, self.made_by)
        self._input_folder = experiment.folder.resolve()

    @contextmanager
    def claimed(self, overwrite: bool) -> Iterator[None]:
        """Lock the folder for this experiment.

        Raises InputError: another process uses the folder; it is no folder of flights, or holds
        those of another experiment or version and ``overwrite`` is not set.
        """
        with held(self.path, "flight's folder"):
            self._start(overwrite)
            yield

    def _start(self, overwrite: bool) -> None:
        marker = self.path / RECORD
        if marker.is_file():
            if made_by(read_record(self.path)) == self.made_by:
                return
            if not overwrite:
                raise InputError(
                    f"{self.path}: holds another experiment or was made by another version; "
                    "expected an empty folder (-o DIR), or --overwrite to replace it"
                )
            # its inputs would be removed with the old results
            if self._input_folder == self.path.resolve():
                raise InputError(
                    f"{self.path}: holds the experiment that this one was made from; expected "
                    "another folder (-o DIR)"
                )
        names = (METRICS, REPORT, SUMMARY, LOG, ANIMATION, VIDEO, *FILES.values())
        old = [self.path / name for name in names]

        def remove_old() -> None:
            for path in (*old, *self.figures.glob("*.png")):
                path.unlink(missing_ok=True)
            self.scans.remove()

        # if the disk is full, the earlier results remain unchanged
        write_atomically(marker, encoded(to_yaml(self.record)), first=remove_old)

    def read(self) -> FlightData | None:
        """The data sets of this experiment's flights; None: not simulated yet."""
        series, track, slabs = (self._read(FILES[name]) for name in ("series", "track", "slabs"))
        return None if series is None else FlightData(series, track, slabs)

    def metrics(self) -> dict[str, float] | None:
        """Of complete results; None: there are none."""
        return read_metrics(self.path)

    def write(self, data: FlightData) -> None:
        """Write the data sets, and remove the stored scans, which only an unfinished flight needs.

        The time series comes last: its file says that all are there.
        """
        (self.path / FILES["series"]).unlink(missing_ok=True)
        for name in ("slabs", "track", "series"):
            value = getattr(data, name)
            if value is None:
                (self.path / FILES[name]).unlink(missing_ok=True)
            else:
                write_netcdf(value.assign_attrs({MADE_BY: self.made_by}), self.path / FILES[name])
        self.scans.remove()

    def data_files(self) -> list[str]:
        """Names of the files that the report links to."""
        names = (*FILES.values(), VIDEO, ANIMATION)
        there = [name for name in names if (self.path / name).is_file()]
        return [*there, METRICS, SUMMARY, RECORD, LOG]

    def write_verdict(self, metrics: Mapping[str, float], page: str, answer: Sequence[str]) -> None:
        """Write report, answer and metrics: the results are complete."""
        write_verdict(self.path, self.record, metrics, page, answer)

    def _read(self, file: str) -> xr.Dataset | None:
        path = self.path / file
        if not path.is_file():
            return None
        dataset = read_netcdf(path)
        return dataset if dataset.attrs.get(MADE_BY) == self.made_by else None
