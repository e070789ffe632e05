"""The folder of a flight: its experiment, its data sets, its report."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path

import xarray as xr

from lidar_mi.encounter.flight import Flown
from lidar_mi.encounter.scan_store import ScanStore
from lidar_mi.encounter.wake import encounter_of
from lidar_mi.errors import InputError
from lidar_mi.experiment.export_flight import FLIGHT_FILES as FILES
from lidar_mi.experiment.folder.image_store import MADE_BY
from lidar_mi.experiment.folder.run_folder import (
    FIGURES,
    LOG,
    METRICS,
    RECORD,
    REPORT,
    SUMMARY,
    held,
    made_by,
    new_record,
    read_metrics,
    read_record,
    write_verdict,
)
from lidar_mi.experiment.schema.experiment import Experiment
from lidar_mi.io.atomic import write_atomically
from lidar_mi.io.netcdf import read_netcdf, write_netcdf
from lidar_mi.io.text import encoded
from lidar_mi.io.yaml import to_yaml

ANIMATION, SCANS = "approach.gif", "scans"


class FlightFolder:
    """The files of a flight, each written under a temporary name.

    Parameters
    ----------
    path : path
    experiment : Experiment
    """

    def __init__(self, path: str | Path, experiment: Experiment):
        self.path = Path(path)
        self.figures, self.log = self.path / FIGURES, self.path / LOG
        self.record = new_record(experiment, experiment.folder)
        if encounter_of(experiment).aircraft.model != "roll":
            self.record["versions"]["jsbsim"] = version("jsbsim")
        self.made_by = made_by(self.record)
        self.scans = ScanStore(self.path / SCANS, self.made_by)
        self._beside = experiment.folder.resolve()

    @contextmanager
    def claimed(self, overwrite: bool) -> Iterator[None]:
        """Lock the folder for this flight.

        Raises
        ------
        InputError
            Another process uses the folder; it is no folder of a flight, or holds that of another
            experiment or version and ``overwrite`` is not set.
        """
        with held(self.path, "flight's folder"):
            self._begin(overwrite)
            yield

    def _begin(self, overwrite: bool) -> None:
        marker = self.path / RECORD
        if marker.is_file():
            before = read_record(self.path)
            if made_by(before) == self.made_by:
                return
            if not overwrite:
                raise InputError(
                    f"{self.path}: holds another experiment or was made by another version; "
                    "expected an empty folder (-o DIR), or --overwrite to replace it"
                )
            if self._beside == self.path.resolve():
                raise InputError(
                    f"{self.path}: holds the experiment that this one was made from; expected "
                    "another folder (-o DIR)"
                )
        names = (METRICS, REPORT, SUMMARY, LOG, ANIMATION, *FILES.values())
        old = [self.path / name for name in names]

        def remove_old() -> None:
            for path in (*old, *self.figures.glob("*.png")):
                path.unlink(missing_ok=True)
            self.scans.remove()

        # if the disk is full, the earlier flight remains unchanged
        write_atomically(marker, encoded(to_yaml(self.record)), first=remove_old)

    def flown(self) -> Flown | None:
        """The data sets of this experiment's flights; None: not flown yet."""
        found = {name: self._read(self.path / file) for name, file in FILES.items()}
        return Flown(**found) if found["series"] is not None else None

    def metrics(self) -> dict[str, float] | None:
        """Of a flight that is complete."""
        return read_metrics(self.path)

    def keep(self, flown: Flown) -> None:
        """Write the data sets, the time series last: with it, the flight is there.

        What is kept of its scans is in them.
        """
        (self.path / FILES["series"]).unlink(missing_ok=True)
        for name in ("seen", "track", "series"):
            value = getattr(flown, name)
            if value is None:
                (self.path / FILES[name]).unlink(missing_ok=True)
            else:
                write_netcdf(value.assign_attrs({MADE_BY: self.made_by}), self.path / FILES[name])
        self.scans.remove()

    def data_files(self) -> list[str]:
        """Names of the files beside the report, for links to them."""
        names = (*FILES.values(), ANIMATION)
        there = [name for name in names if (self.path / name).is_file()]
        return [*there, METRICS, SUMMARY, RECORD, LOG]

    def keep_verdict(self, metrics: Mapping[str, float], page: str, answer: Sequence[str]) -> None:
        """Write report, answer and metrics: the flight is complete."""
        write_verdict(self.path, self.record, metrics, page, answer)

    def _read(self, path: Path) -> xr.Dataset | None:
        if not path.is_file():
            return None
        found = read_netcdf(path)
        return found if found.attrs.get(MADE_BY) == self.made_by else None
