"""Several variants of one experiment side by side: what differs, and what comes of it."""

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
import xarray as xr
from matplotlib.figure import Figure

from lidar_mi import __version__
from lidar_mi.assessment.figures.backscatter import BACKSCATTER, METHOD_NAMES, Drawn, save_all
from lidar_mi.assessment.metrics.velocities import CENTRES, READERS
from lidar_mi.assessment.report.digits import fixed, three
from lidar_mi.assessment.report.page import embedded, template
from lidar_mi.io.yaml import to_yaml

_SPEED = "m s$^{-1}$"

# rows of the comparison: key, name, unit; {} stands for a method's winds
_ROWS = (
    ("backscatter.mc_relative_error", "Monte Carlo noise of a pixel over its signal, median", "%"),
    ("detector.signal", "photoelectrons of a pixel, median", ""),
    ("detector.noise.all", "noise of a pixel over its signal, median", "%"),
    ("backscatter.multiple_scattering_fraction", "share of multiple scattering", "%"),
    ("{}.outside_cores.rmse_u", "rms error of u beyond two core radii", "m/s"),
    ("{}.outside_cores.rmse_v", "rms error of v beyond two core radii", "m/s"),
    ("{}.outside_cores.rmse_w", "rms error of w beyond two core radii", "m/s"),
    ("{}.valid_fraction", "share of valid vectors", "%"),
    ("true_wind.outside_cores.rms_u", "the true u itself, rms", "m/s"),
    ("true_wind.outside_cores.rms_v", "the true v itself, rms", "m/s"),
    ("true_wind.outside_cores.rms_w", "the true w itself, rms", "m/s"),
    ("doppler.photons", "Doppler lidar: photons of a pulse", ""),
    ("sensor.outside_cores.rmse_u", "both lidars: rms error of u beyond two core radii", "m/s"),
    ("sensor.outside_cores.rmse_v", "both lidars: v", "m/s"),
    ("sensor.outside_cores.rmse_w", "both lidars: w", "m/s"),
    ("sensor.triples.rmse_u", "lines of sight alone: u", "m/s"),
    ("sensor.triples.rmse_v", "lines of sight alone: v", "m/s"),
    ("sensor.triples.rmse_w", "lines of sight alone: w", "m/s"),
    ("sensor.rmse_v_los", "rms error of a line-of-sight velocity", "m/s"),
    ("sensor.doppler.photons_per_direction", "Doppler lidar: photons of a direction", ""),
    ("sensor.doppler.hazard_distance", "Doppler lidar: hazard distance, naked eye", "m"),
    ("safety.permissible_exposure", "permissible exposure by a pulse", "J/m²"),
    ("safety.hazard_distance", "hazard distance of a beam, naked eye", "m"),
    ("safety.aided_hazard_distance", "hazard distance of a beam, binoculars", "m"),
    ("safety.scan_hazard_distance", "hazard distance of the whole scan, naked eye", "m"),
    ("safety.scan_power", "average power of the scan", "W"),
)

# of the Doppler lidar's readings of single pulses: measure of `velocity_metrics`, name
_READINGS = (("bias", "bias"), ("std", "standard deviation"), ("found_fraction", "share read"))
_SINGLE = re.compile(r"(doppler\.(\w+)\.centre_(\w+)\.averaged_1)\.found_fraction")


def flat(settings: Mapping, prefix: str = "") -> dict[str, object]:
    """Nested sections as dotted keys; lists are values."""
    found = {}
    for key, value in settings.items():
        name = f"{prefix}{key}"
        found |= flat(value, f"{name}.") if isinstance(value, Mapping) else {name: value}
    return found


def differences(settings: Mapping[str, Mapping[str, object]]) -> dict[str, list]:
    """Keys that not all variants have alike, with each one's value (None: has no such key)."""
    keys = dict.fromkeys(key for one in settings.values() for key in one if key != "name")
    values = {key: [one.get(key) for one in settings.values()] for key in keys}
    return {key: row for key, row in values.items() if any(value != row[0] for value in row)}


def page(
    name: str,
    settings: Mapping[str, Mapping],
    metrics: Mapping[str, Mapping[str, float]],
    drawn: Sequence[Drawn],
) -> str:
    """What differs between the variants of a study and what comes of it, as HTML that needs nothing else.

    Parameters
    ----------
    name : str
        Of the study.
    settings : mapping of variant to experiment
        As nested sections, with all defaults.
    metrics : mapping of variant to metrics
    drawn : sequence of Drawn
    """
    changed = [
        (key, "", [setting(value) for value in values])
        for key, values in differences({key: flat(one) for key, one in settings.items()}).items()
    ]
    legend = (
        "Errors are those of valid vectors against the truth; an error near the true wind's own rms "
        "means no skill. A variant without a number has a dash."
    )
    return template("comparison.html").render(
        name=name,
        version=__version__,
        variants=list(settings),
        pictures=[(one.title, one.caption, embedded(one.path)) for one in drawn],
        tables=[
            ("What comes of it", legend, list(results(metrics))),
            ("What differs", "In SI units; a dash: the variant has no such key.", changed),
        ],
        resolved=to_yaml(dict(settings)),
    )


def results(metrics: Mapping[str, Mapping[str, float]]) -> Iterator[tuple[str, str, list[str]]]:
    """What comes of variants: (name, unit, one text a variant), where any of them has a number."""
    winds = dict.fromkeys(
        key.removesuffix(".valid_fraction")
        for one in metrics.values()
        for key in one
        if key.startswith("backscatter") and key.endswith(".valid_fraction")
    )
    for pattern, label, unit in _ROWS:
        for wind in winds if "{}" in pattern else (None,):
            key = pattern.format(wind)
            values = [one.get(key) for one in metrics.values()]
            if any(value is not None for value in values):
                yield (f"{_named(wind)}: {label}" if wind else label), unit, _shown(values, unit)
    readings = dict.fromkeys(
        found.groups()
        for one in metrics.values()
        for key in one
        if (found := _SINGLE.fullmatch(key))
    )
    for key, reader, centre in readings:
        for measure, label in _READINGS:
            values = [one.get(f"{key}.{measure}") for one in metrics.values()]
            if any(value is not None for value in values):
                title = f"{READERS.get(reader, reader)}, {CENTRES.get(centre, centre)}"
                unit = "%" if measure == "found_fraction" else "m/s"
                yield f"one pulse by {title}: {label}", unit, _shown(values, unit)


def _shown(values: Sequence[float | None], unit: str) -> list[str]:
    style = {"m/s": fixed, "%": lambda share: three(100 * share)}.get(unit, three)
    return ["-" if value is None else style(value) for value in values]


def _named(wind: str) -> str:
    source, method = wind.split(".")
    title = METHOD_NAMES.get(method, method.replace("_", " "))
    return f"{title}, with the detector's noise" if source.endswith("noisy") else title


def setting(value) -> str:
    """An experiment's value as text, numbers to six digits; a dash: there is none."""
    if value is None:
        return "-"
    if isinstance(value, list):
        return ", ".join(map(setting, value))
    number, blank, unit = str(value).partition(" ")
    try:
        return f"{float(number):.6g}{blank}{unit}"
    except ValueError:
        return str(value)


def draw_comparison(
    folder: Path, rows: Mapping[str, tuple[xr.DataArray, xr.Dataset, Sequence]], log: Callable
) -> list[Drawn]:
    """One row a variant: its first picture, the w found in the pair, and its error.

    Parameters
    ----------
    rows : mapping of variant to (picture, winds, cores)
        Apparent backscatter (m^-1 sr^-1) and winds on (z, y), these with w_true and flag; places
        (y, z) of the true cores, m.
    """
    figure = Figure(figsize=(19, 4.0 * len(rows)), layout="compressed")
    axes = figure.subplots(len(rows), 3, squeeze=False)
    limit = max(float(abs(wind["w_true"]).quantile(0.995)) for _, wind, _ in rows.values()) or 1.0
    speeds = {"cmap": "RdBu_r", "vmin": -limit, "vmax": limit}
    errors = {
        name: (wind["w"] - wind["w_true"]).where(wind["flag"] == 0)
        for name, (_, wind, _) in rows.items()
    }
    largest = [
        float(abs(error).quantile(0.99)) for error in errors.values() if error.notnull().any()
    ]
    # one variant without skill must not hide the errors of those that have some
    top = min(float(np.median(largest)) if largest else 0.0, limit) or limit
    for row, (name, (picture, wind, cores)) in zip(axes, rows.items()):
        low, high = (float(1e6 * picture.quantile(share)) for share in (0.002, 0.998))
        good, place = (
            wind["flag"] == 0,
            {axis: slice(wind[axis][0], wind[axis][-1]) for axis in "yz"},
        )
        columns = (
            (
                1e6 * picture.sel(place),
                {"cmap": "cividis", "vmin": low, "vmax": high},
                f"{name}: picture",
                BACKSCATTER,
            ),
            (wind["w"].where(good), speeds, f"{name}: w found", _SPEED),
            (errors[name], speeds | {"vmin": -top, "vmax": top}, f"{name}: error of w", _SPEED),
        )
        for panel, (field, style, title, label) in zip(row, columns):
            y, z = field["y"].values, field["z"].values
            mesh = panel.pcolormesh(
                y, z, field.transpose("z", "y").values, shading="nearest", rasterized=True, **style
            )
            panel.set(title=title, aspect="equal", xlim=(y.max(), y.min()), ylim=(z.min(), z.max()))
            for core in cores:
                panel.plot(*core, "k+", ms=8)
            figure.colorbar(mesh, ax=panel, label=label, pad=0.02, extend="both")
        row[0].set_ylabel("z / m")
    for panel in axes[-1]:
        panel.set_xlabel("y / m (port is left)")
    caption = (
        "Each variant's first picture, the vertical wind found by its first method (white: flagged "
        "vectors), and its error; winds are on one scale, errors on another, that of the middle variant. Crosses: true cores. Of "
        "several gates the first, of winds in three dimensions the layer nearest to it."
    )
    plate = ("fig00_comparison", "The variants side by side", (figure, caption))
    return save_all(folder, [plate], log)
