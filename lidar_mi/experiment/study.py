"""Several variants of one experiment, run one after the other and held against each other.

Each variant is a run of its own in a folder of its own; beside these folders lie the comparison's
report, its figure and all metrics, named VARIANT.METRIC.
"""

from collections.abc import Mapping
from pathlib import Path

import xarray as xr

from lidar_mi.assessment.report.comparison import draw_comparison, page
from lidar_mi.errors import InputError
from lidar_mi.experiment import reading as config
from lidar_mi.experiment import run as experiment
from lidar_mi.experiment.run_folder import IMAGES, VOLUME, Log, Notice, read_record
from lidar_mi.experiment.schema import Experiment
from lidar_mi.io import exr
from lidar_mi.io.json import read_json, write_json
from lidar_mi.io.netcdf import open_netcdf
from lidar_mi.io.text import write_text
from lidar_mi.io.yaml import parse_yaml, read_yaml, to_yaml

RECORD = "study.yaml"


def run(
    name: str,
    variants: Mapping[str, Experiment],
    folder: str | Path,
    beside: str | Path = ".",
    overwrite: bool = False,
    notice: Notice = lambda text, share: None,
) -> dict[str, dict[str, float]]:
    """Run all variants into sub-folders and compare them; metrics by variant.

    Parameters
    ----------
    name : str
        Of the study.
    variants : mapping
        From `lidar_mi.experiment.reading.load_variants`.
    folder, beside, overwrite, notice
        As in `lidar_mi.experiment.run`.

    Raises
    ------
    InputError
        Bad input in any of the variants, or a folder that holds something else.
    """
    folder = Path(folder)
    free = not folder.exists() or (folder.is_dir() and not any(folder.iterdir()))
    if not free and not (folder / RECORD).is_file():
        raise InputError(f"{folder}: is no study's folder; expected an empty or a new one (-o DIR)")
    # what is wrong with the last one is said before the first one has taken its time
    ready = {
        key: experiment.prepare(one, beside, _of(key, notice)) for key, one in variants.items()
    }
    settings = {key: parse_yaml(config.dump(one), key) for key, one in variants.items()}
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{folder}: cannot be made ({error.strerror})") from None
    record = to_yaml({"name": name, "variants": list(variants)})
    write_text(folder / RECORD, record)
    metrics = {key: one(folder / key, overwrite, _of(key, notice)) for key, one in ready.items()}
    log = Log(folder / "log.txt", notice)
    log(f"comparing {', '.join(variants)}")
    # a variant without a wake has rings only, which the table compares
    rows = {
        key: _pictures(folder / key, VOLUME if one.volume else "wind.nc", metrics[key])
        for key, one in variants.items()
        if one.wake
    }
    drawn = draw_comparison(folder / "figures", rows, log) if rows else []
    merged = {f"{key}.{name}": value for key, one in metrics.items() for name, value in one.items()}
    html = page(name, settings, metrics, drawn)
    write_json(folder / "metrics.json", merged)
    write_text(folder / "report.html", html)
    log("done")
    return metrics


def read_study(
    folder: str | Path,
) -> tuple[str, dict[str, dict | None], dict[str, dict[str, float]]]:
    """What a study's folder says it holds.

    Returns
    -------
    name : str
        Of the study.
    records : dict
        By variant, as of `run_folder.read_record`; None: not run yet.
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
    except (InputError, TypeError, KeyError):
        raise InputError(
            f"{folder / RECORD}: not written by a study; expected its folder"
        ) from None
    started = {key: (folder / key / "experiment.yaml").is_file() for key in variants}
    records = {key: read_record(folder / key) if started[key] else None for key in variants}
    metrics = {}
    for key in variants:
        path = folder / key / "metrics.json"
        if path.is_file():
            metrics[key] = read_json(path, "metrics of a run")
    return name, records, metrics


def _of(variant: str, notice: Notice) -> Notice:
    return lambda text, share: notice(f"{variant}: {text}", share)


def _pictures(folder: Path, file: str, metrics) -> tuple[xr.DataArray, xr.Dataset, list]:
    """First picture as the instrument gives it, wind by the first method, places of true cores.

    Of winds in three dimensions the layer nearest to the first gate, whose picture it is.
    """
    scan = exr.read_scan(folder / IMAGES[0])
    with open_netcdf(folder / file) as winds:
        source = winds["source"].values[-1]  # behind the detector, where there is one
        wind = winds.sel(source=source).isel(algorithm=0)
        wind = (wind.isel(x=0) if "x" in wind.dims else wind).load()
    sides = [f"wake.{side}_core" for side in ("port", "starboard")]
    cores = [(metrics[f"{one}.y"], metrics[f"{one}.z"]) for one in sides if f"{one}.y" in metrics]
    return scan["Y_noisy" if "Y_noisy" in scan else "Y"], wind, cores
