"""Several variants of one experiment, run one after the other and compared.

Each variant is a separate run in its own folder. The folder of the study also has the comparison's
report, its figure and all metrics, named VARIANT.METRIC.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path

import xarray as xr

from lidar_mi.atmosphere.vortices.cores import Core
from lidar_mi.experiment.folder.records import LOG, METRICS, REPORT, STUDY
from lidar_mi.experiment.folder.run_folder import FIGURES, refuse_strangers
from lidar_mi.experiment.log import Log, silent
from lidar_mi.io.folder import locked, make_folder
from lidar_mi.io.json import write_json
from lidar_mi.io.text import write_text
from lidar_mi.io.yaml import to_yaml
from lidar_mi.progress import Notice
from lidar_mi.schema.experiment import Experiment
from lidar_mi.schema.reading import settings as settings_of


def run(
    name: str,
    variants: Mapping[str, Experiment],
    folder: str | Path,
    beside: str | Path = ".",
    overwrite: bool = False,
    notice: Notice = silent,
) -> dict[str, dict[str, float]]:
    """Run all variants into sub-folders and compare them; metrics by variant.

    Parameters
    ----------
    name : str
        Of the study.
    variants : mapping
        From `lidar_mi.schema.reading.load_variants`.
    folder, beside, overwrite, notice
        As in `lidar_mi.experiment.run.run`.

    Raises
    ------
    InputError
        Bad input in any of the variants, or a folder that holds something else.
    """
    from lidar_mi.assessment.figures.comparison import draw_comparison
    from lidar_mi.assessment.report.comparison import page
    from lidar_mi.experiment import run as experiment

    folder = Path(folder)
    refuse_strangers(folder, STUDY, "study's folder")
    # faults of the last one are reported before the first one is run
    ready = {
        key: experiment.prepare(each, beside, _of(key, notice)) for key, each in variants.items()
    }
    settings = {key: settings_of(each) for key, each in variants.items()}
    make_folder(folder)
    with locked(folder):
        refuse_strangers(folder, STUDY, "study's folder")
        write_text(folder / STUDY, to_yaml({"name": name, "variants": list(variants)}))
        metrics, rows, answers = {}, {}, {}
        for key in variants:
            done = experiment.complete(ready.pop(key), folder / key, overwrite=overwrite)
            metrics[key], answers[key] = done.metrics, done.answer
            # a variant without a wake has rings only, which the table compares
            if done.wind is not None:
                rows[key] = _images_and_wind(done.scans[0], done.wind, done.cores)
        log = Log(notice, folder / LOG)
        log(f"comparing {', '.join(variants)}")
        drawn = draw_comparison(folder / FIGURES, rows, log) if rows else []
        merged = {
            f"{key}.{name}": value for key, each in metrics.items() for name, value in each.items()
        }
        write_json(folder / METRICS, merged)
        write_text(folder / REPORT, page(name, settings, metrics, drawn, answers))
        log("done")
    return metrics


def _of(variant: str, notice: Notice) -> Notice:
    def named(text: str, fraction: float | None) -> None:
        # warnings remain warnings
        kind, text = ("warning: ", text[9:]) if text.startswith("warning: ") else ("", text)
        notice(f"{kind}{variant}: {text}", fraction)

    return named


def _images_and_wind(
    scan: xr.Dataset, wind: xr.Dataset, cores: Sequence[Core]
) -> tuple[xr.DataArray, xr.Dataset, list[tuple[float, float]]]:
    """First image of the instrument, wind by the first method, positions of true cores.

    Of winds in three dimensions the layer nearest to the first gate, that of the image.
    """
    wind = wind.isel(source=-1, algorithm=0)  # behind the detector, where there is one
    wind = wind.isel(x=0) if "x" in wind.dims else wind
    places = [(core.y, core.z) for core in cores]
    return scan["Y_noisy" if "Y_noisy" in scan else "Y"], wind, places
