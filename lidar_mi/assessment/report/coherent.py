"""The coherent lidar's chapter of a report."""

import math
from collections.abc import Mapping, Sequence

import xarray as xr

from lidar_mi.assessment.digits import whole_percent
from lidar_mi.assessment.figures.panels import Drawn
from lidar_mi.assessment.metrics.coherent import PREFIX, errors_by_age
from lidar_mi.assessment.report.page import Chapter, NumberTable, Tables

_VORTICES = f"{PREFIX}vortices."
_WINDS = f"{PREFIX}winds."


def coherent_chapter(
    metrics: Mapping[str, float], drawn: Sequence[Drawn], vortices: xr.Dataset | None = None
) -> Chapter:
    """Lines of sight, and vortices or winds from them."""
    purpose = (
        "A coherent lidar on the ground measures the Doppler shift of the air's echo in every gate "
        "of its lines of sight (lines_of_sight.nc). Every line sees the air at its own time, "
        "weighted with the pulse over the gate."
    )
    signal = metrics[f"{PREFIX}signal_fraction"]
    noise = "No gate has a signal: velocities are random."
    if signal > 0:
        noise = (
            f"The velocities have a noise of {metrics[f'{PREFIX}noise']:.2g} m/s (median of that "
            f"stated) at {metrics[f'{PREFIX}cnr']:.1f} dB; against the truth in the gates, "
            f"{metrics[f'{PREFIX}rmse_v_los']:.2g} m/s (rms)."
        )
    if 0 < signal < 1:
        noise += f" {whole_percent(1 - signal)} of the gates have no signal and are flagged."
    tables: list[NumberTable] = []
    if vortices is not None and f"{_VORTICES}place_error" in metrics:
        tables += [_by_age(vortices), _peer(metrics), _coverages(metrics)]
    elif f"{_WINDS}rmse_u" in metrics:
        tables.append(_wind_errors(metrics))
    numbers = Tables(
        heading="Accuracy of what the lines of sight tell",
        legend="Errors against the truth. Coverage: of Gaussian errors, 68 % are within one "
        "standard error and 95 % within 1.96.",
        tables=tables,
    )
    return Chapter("The coherent lidar", [purpose, noise], drawn, numbers)


def _by_age(vortices: xr.Dataset) -> NumberTable:
    rows = errors_by_age(vortices)
    heads = [f"{row['first']:.0f} to {row['last']:.0f} s" for row in rows]

    def line(name: str, unit: str, key: str, scale: float) -> tuple[str, str, list[str]]:
        values = [row[key] for row in rows]
        return (name, unit, ["-" if math.isnan(x) else f"{scale * x:.3g}" for x in values])

    return (
        "By age of the wake: medians of the sizes of the errors",
        heads,
        [
            line("slices", "", "scans", 1),
            line("of which valid", "", "valid", 1),
            line("error of the circulation", "%", "circulation", 100),
            line("error of the place, of the separation", "%", "place", 100),
        ],
    )


def _peer(metrics: Mapping[str, float]) -> NumberTable:
    columns = (_VORTICES, f"{PREFIX}track.", f"{PREFIX}rv.")
    rows = []
    for key, label in (
        ("circulation_error", "median error of the circulation"),
        ("circulation_rms", "rms error of the circulation"),
        ("place_error", "median error of the place, of the separation"),
        ("place_rms", "rms error of the place, of the separation"),
        ("valid_fraction", "slices with valid vortices"),
    ):
        values = [metrics.get(f"{start}{key}") for start in columns]
        rows.append((label, "%", ["-" if x is None else f"{100 * x:.3g}" for x in values]))
    heads = ("fit to each slice", "all slices together", "method of radial velocities")
    return "Compared with the method of radial velocities", heads, rows


def _coverages(metrics: Mapping[str, float]) -> NumberTable:
    names = ("circulation", "y", "z")
    rows = [
        (label, unit, [f"{scale * metrics[f'{_VORTICES}{key}_{name}']:.3g}" for name in names])
        for key, label, unit, scale in (
            ("coverage_68", "coverage of 68 %", "%", 100),
            ("coverage_95", "coverage of 95 %", "%", 100),
            ("normalised_error_variance", "variance of normalised errors", "", 1),
        )
    ]
    return "Whether the standard errors hold", ("circulation", "distance", "height"), rows


def _wind_errors(metrics: Mapping[str, float]) -> NumberTable:
    rows = [
        (label, unit, [f"{scale * metrics[f'{_WINDS}{key}_{name}']:.3g}" for name in "uvw"])
        for key, label, unit, scale in (
            ("rmse", "rms error", "m/s", 1),
            ("bias", "mean error", "m/s", 1),
            ("stderr", "stated", "m/s", 1),
            ("coverage_68", "coverage of 68 %", "%", 100),
            ("coverage_95", "coverage of 95 %", "%", 100),
        )
        if f"{_WINDS}{key}_u" in metrics
    ]
    return "Valid winds", ("u, to the east", "v, to the north", "w, upwards"), rows
