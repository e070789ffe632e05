"""A run: an experiment, its results, its metrics."""

import webbrowser
from collections import defaultdict
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

import xarray as xr
from rich.console import Console

from lidar_mi.atmosphere.vortices.cores import Core
from lidar_mi.errors import InputError
from lidar_mi.experiment.folder.records import REPORT
from lidar_mi.experiment.log import Log
from lidar_mi.experiment.pipeline import Results
from lidar_mi.experiment.truth.extinction import Truth
from lidar_mi.schema.experiment import Experiment
from lidar_mi.tables import Table, Tabular

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from lidar_mi.experiment.stages.vortices import VortexFits


@dataclass(repr=False)
class Run(Tabular):
    """An experiment with its results.

    Displayed as its main errors; `show` adds an image.

    Attributes
    ----------
    experiment : Experiment
    results : Results
        Of the completed stages, by name.
    metrics : dict of str to float
        Flat; empty until everything is done.
    folder : Path or None
        Folder of the files.
    log : Log
        Lines of the log; ``log.warnings`` are those that matter for the results.
    seconds : dict of str to float
        Duration of the steps.
    search_path : Path
        Folder in which files that the experiment names are searched first.
    """

    experiment: Experiment
    results: Results
    log: Log
    metrics: dict[str, float] = field(default_factory=dict)
    folder: Path | None = None
    seconds: dict[str, float] = field(default_factory=lambda: defaultdict(float))
    search_path: Path = Path()

    @property
    def warnings(self) -> list[str]:
        """Warnings that matter for the results."""
        return self.log.warnings

    @property
    def truth(self) -> Truth | None:
        """Extinction at both times and the true wind."""
        return self.results.get("truth")

    @property
    def cores(self) -> list[Core]:
        """True vortex cores."""
        return self.results.get("cores", [])

    @property
    def scans(self) -> list[xr.Dataset]:
        """Both scans of the backscatter lidar."""
        return self.results.get("scans", [])

    @property
    def wind(self) -> xr.Dataset | None:
        """Wind from the images or volumes of the backscatter lidar, by source and algorithm."""
        return self.results.get("wind", self.results.get("wind_volume"))

    @property
    def v_los(self) -> xr.Dataset | None:
        """Line-of-sight velocities retrieved from images of rings of the Doppler lidar."""
        return self.results.get("v_los")

    @property
    def lines(self) -> xr.Dataset | None:
        """Lines of sight: through the slab, in a sensor of both lidars, or of a coherent lidar."""
        return self.results.get("lines", self.results.get("coherent_lines"))

    @property
    def wind3d(self) -> xr.Dataset | None:
        """Wind in three dimensions from both lidars."""
        return self.results.get("wind3d")

    @property
    def vortices(self) -> "VortexFits | None":
        """Vortex pairs fitted to images and to wind vectors."""
        return self.results.get("vortices")

    @property
    def answer(self) -> list[str]:
        """Errors and verdicts with their reasons, in sentences; empty until everything is done."""
        from lidar_mi.assessment.report.answer import answer
        from lidar_mi.experiment.measure import judged

        if not self.metrics:
            return []
        verdicts = judged(self.experiment, self.results, self.metrics)
        return answer(self.experiment, self.metrics, verdicts)

    def tables(self) -> list[Table]:
        """The answer, the experiment and its main errors."""
        from lidar_mi.assessment.report.summary import summary

        doppler = self.experiment.fringes
        seconds = sum(self.seconds.values())
        rows = [("experiment", self.experiment.name), ("computed in", f"{seconds:.1f} s")]
        if self.folder is not None:
            rows.append(("folder", str(self.folder)))
        rows += [("warning", text) for text in self.warnings]
        averaged = doppler.retrieval.averaged if doppler else ()
        fits = self.vortices.pairs if self.vortices else {}
        vortices = [
            replace(pair.tables()[0], title=f"vortex pair fitted to {origin}")
            for origin, pair in fits.items()
        ]
        first = [Table("answer", [(line,) for line in self.answer])] if self.metrics else []
        return [*first, Table("run", rows), *summary(self.metrics, averaged), *vortices]

    def plot(self) -> "Figure":
        """Image of the backscatter lidar and cross-flow wind, side by side.

        Returns
        -------
        matplotlib Figure

        Raises
        ------
        InputError
            A run without images of the backscatter lidar, or without wind from them.
        """
        from lidar_mi.assessment.figures.backscatter import overview
        from lidar_mi.io.png import png_bytes

        if self.truth is None or "wind" not in self.results or not self.scans:
            raise InputError(
                f"plot: {self.experiment.name} has no wind from images of the backscatter lidar; "
                "expected one that has, or its folder's figures"
            )
        figure, _ = overview(self.truth, self.scans, self.results["wind"], self.cores)
        # a notebook shows figures that pyplot made; of others it asks this
        vars(figure)["_repr_png_"] = lambda: png_bytes(figure)
        return figure

    def thumbnail(self) -> bytes | None:
        """The `plot` as PNG; None: there is nothing to draw."""
        from lidar_mi.io.png import png_bytes

        if self.truth is None or "wind" not in self.results or not self.scans:
            return None
        return png_bytes(self.plot())

    def show(self) -> None:
        """Show the results: in a notebook with an image, else as text, and the report in a browser.

        A run in memory alone has no report.
        """
        if Console().is_jupyter:
            from IPython.display import display

            display(self)
            return
        print(self)
        if self.folder is not None:
            webbrowser.open_new_tab((self.folder / REPORT).resolve().as_uri())
