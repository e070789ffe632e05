"""Several variants of one experiment, run one after the other and compared.

Each variant is a separate run in its own folder. The folder of the study also has the comparison's
report, its figure and all metrics, named VARIANT.METRIC.
"""

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import xarray as xr

from lidar_mi.assessment.figures.comparison import draw_comparison
from lidar_mi.assessment.metrics.cores import Core
from lidar_mi.assessment.report.comparison import page
from lidar_mi.errors import InputError
from lidar_mi.experiment import run as experiment
from lidar_mi.experiment.folder.run_folder import (
    FIGURES,
    LOG,
    METRICS,
    REPORT,
    read_answer,
    read_metrics,
    read_record,
    refuse_strangers,
)
from lidar_mi.experiment.folder.run_folder import RECORD as RUN
from lidar_mi.experiment.log import Log, silent
from lidar_mi.experiment.schema.experiment import NAME, Experiment
from lidar_mi.experiment.schema.reading import settings as settings_of
from lidar_mi.io.folder import locked, make_folder
from lidar_mi.io.json import write_json
from lidar_mi.io.text import write_text
from lidar_mi.io.yaml import read_yaml, to_yaml
from lidar_mi.progress import Notice

RECORD = "study.yaml"


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
        From `lidar_mi.experiment.schema.reading.load_variants`.
    folder, beside, overwrite, notice
        As in `lidar_mi.experiment.run.run`.

    Raises
    ------
    InputError
        Bad input in any of the variants, or a folder that holds something else.
    """
    folder = Path(folder)
    refuse_strangers(folder, RECORD, "study's folder")
    # faults of the last one are reported before the first one is run
    ready = {
        key: experiment.prepare(one, beside, _of(key, notice)) for key, one in variants.items()
    }
    settings = {key: settings_of(one) for key, one in variants.items()}
    make_folder(folder)
    with locked(folder):
        refuse_strangers(folder, RECORD, "study's folder")
        write_text(folder / RECORD, to_yaml({"name": name, "variants": list(variants)}))
        metrics, rows, found = {}, {}, {}
        for key in variants:
            done = experiment.complete(ready.pop(key), folder / key, overwrite=overwrite)
            metrics[key], found[key] = done.metrics, done.answer
            # a variant without a wake has rings only, which the table compares
            if done.wind is not None:
                rows[key] = _shown(done.scans[0], done.wind, done.cores)
        log = Log(notice, folder / LOG)
        log(f"comparing {', '.join(variants)}")
        drawn = draw_comparison(folder / FIGURES, rows, log) if rows else []
        merged = {
            f"{key}.{name}": value for key, one in metrics.items() for name, value in one.items()
        }
        write_json(folder / METRICS, merged)
        write_text(folder / REPORT, page(name, settings, metrics, drawn, found))
        log("done")
    return metrics


def read_study(
    folder: str | Path,
) -> tuple[str, dict[str, dict[str, Any] | None], dict[str, dict[str, float]]]:
    """The contents of a study's folder.

    Returns
    -------
    name : str
        Of the study.
    records : dict
        By variant, as of `resumable_folder.read_record`; None: not run yet.
    metrics : dict
        By variant; of those that are done.

    Raises
    ------
    InputError
        A file in it that was not written by a study.
    """
    folder = Path(folder)
    try:
        record = read_yaml(folder / RECORD, "a study's record")
        name, variants = str(record["name"]), [str(key) for key in record["variants"]]
        if not all(re.fullmatch(NAME, key) for key in variants):
            raise KeyError("variants")
    except (InputError, TypeError, KeyError):
        raise InputError(
            f"{folder / RECORD}: not written by a study; expected its folder"
        ) from None
    started = {key: (folder / key / RUN).is_file() for key in variants}
    records = {key: read_record(folder / key) if started[key] else None for key in variants}
    metrics = {key: read_metrics(folder / key) for key in variants}
    return name, records, {key: one for key, one in metrics.items() if one is not None}


def answers(folder: str | Path) -> list[tuple[str, list[str]]]:
    """Answers of the variants in a study's folder, or of a run's own, with an empty name."""
    folder = Path(folder)
    if not (folder / RECORD).is_file():
        return [("", read_answer(folder))]
    _, records, _ = read_study(folder)
    return [(variant, read_answer(folder / variant)) for variant in records]


def _of(variant: str, notice: Notice) -> Notice:
    def named(text: str, fraction: float | None) -> None:
        # what is a warning stays one
        kind, text = ("warning: ", text[9:]) if text.startswith("warning: ") else ("", text)
        notice(f"{kind}{variant}: {text}", fraction)

    return named


def _shown(
    scan: xr.Dataset, wind: xr.Dataset, cores: Sequence[Core]
) -> tuple[xr.DataArray, xr.Dataset, list[tuple[float, float]]]:
    """First image of the instrument, wind by the first method, positions of true cores.

    Of winds in three dimensions the layer nearest to the first gate, that of the image.
    """
    wind = wind.isel(source=-1, algorithm=0)  # behind the detector, where there is one
    wind = wind.isel(x=0) if "x" in wind.dims else wind
    places = [(core.y, core.z) for core in cores]
    return scan["Y_noisy" if "Y_noisy" in scan else "Y"], wind, places
