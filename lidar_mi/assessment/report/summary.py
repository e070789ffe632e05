"""The main numbers of a run, as tables for terminals and notebooks."""

from collections.abc import Mapping, Sequence
from itertools import product

from lidar_mi.assessment.metrics.names import (
    OUTSIDE_CORES,
    Source,
    bound_key,
    far_from_cores,
    has_no_skill,
    ring_key,
    wind_key,
)
from lidar_mi.retrieval.method_names import ImageMethod, RingCentre, RingMethod, VolumeMethod
from lidar_mi.tables import Table, with_error

_METHODS = tuple(dict.fromkeys((*ImageMethod, *VolumeMethod)))


def summary(metrics: Mapping[str, float], averaged: Sequence[int] = ()) -> list[Table]:
    """Errors of the line-of-sight velocities, of the winds, and of the wind from both lidars.

    The experiment averages ``averaged`` images of rings, its ``doppler.retrieval.averaged``.
    """
    tables = []
    if averaged:
        tables.append(_line_of_sight(metrics, sorted(averaged)))
    if f"{Source.BACKSCATTER}.mc_relative_error" in metrics:
        tables.append(_winds(metrics))
    if "sensor.vectors" in metrics:
        tables.append(_sensor(metrics))
    return [table for table in tables if table.rows]


def _line_of_sight(metrics: Mapping[str, float], numbers: Sequence[int]) -> Table:
    """Standard deviation and bias of every method, for every number of images averaged."""
    heads = ("method", "centre", *(f"{n}: {name}" for n in numbers for name in ("std", "bias")))
    rows = []
    for centre in RingCentre:
        bounds = [key for n in numbers for key in (bound_key(centre, n), "")]
        rows.append(("(bound)", centre, bounds))
    for method, centre in product(RingMethod, RingCentre):
        keys = [ring_key(method, centre, n, name) for n in numbers for name in ("std", "bias")]
        rows.append((method, centre, keys))
    return Table(
        "line-of-sight wind from averages of images, m/s",
        [
            (str(name), str(centre), *(_with_error(metrics, key) for key in keys))
            for name, centre, keys in rows
            if any(key in metrics for key in keys)
        ],
        heads,
        "± one standard error: a standard deviation of few images may come out below its bound.",
    )


def _winds(metrics: Mapping[str, float]) -> Table:
    """Rms errors of the winds from every source, by every method."""
    components = "uvw" if "true_wind.rms_u" in metrics else "vw"
    places = [""] + [OUTSIDE_CORES] * bool(far_from_cores(metrics, "true_wind.", "rms_"))
    columns = [(place, name) for place in places for name in components]
    rows = []
    for source, method in product(Source, _METHODS):
        valid = metrics.get(wind_key(source, method, "valid_fraction"))
        if valid is not None:
            keys = [wind_key(source, method, f"{place}rmse_{name}") for place, name in columns]
            label = source.replace("_", " ").replace("extinction ", "")
            errors = (_decimals(metrics.get(key)) for key in keys)
            validity = "no skill" if has_no_skill(metrics, source, method) else f"{valid:.0%}"
            rows.append((label, str(method), *errors, validity))
    strength = [_decimals(metrics.get(f"true_wind.{place}rms_{name}")) for place, name in columns]
    heads = [f"far {name}" if place else name for place, name in columns]
    far = " (far: beyond two core radii)" if len(places) > 1 else ""
    return Table(
        f"rms error of the wind in m/s, valid vectors{far}",
        [*rows, ("true wind", "", *strength, "")],
        ("winds from", "method", *heads, "valid"),
        "An error near the rms of the true wind (last row) means no skill: zero would be as good.",
    )


def _sensor(metrics: Mapping[str, float]) -> Table:
    """Rms errors of the wind from both lidars, beyond two core radii where there are any."""
    place = far_from_cores(metrics, "sensor.", "rmse_")
    rows = []
    for label, key in (
        ("both lidars", f"sensor.{place}rmse_"),
        ("lines of sight alone, everywhere", "sensor.triples.rmse_"),
        ("true wind (rms)", f"sensor.{place}rms_"),
    ):
        values = [metrics.get(f"{key}{name}") for name in "uvw"]
        if any(value is not None for value in values):
            rows.append((label, *map(_decimals, values)))
    title = f"rms error of the wind from both lidars{', beyond cores' if place else ''}, m/s"
    return Table(title, rows, ("", "u", "v", "w"))


def _with_error(metrics: Mapping[str, float], key: str) -> str:
    """A statistic with its standard error, where it has one."""
    value, stderr = metrics.get(key), metrics.get(f"{key}_stderr")
    if value is None or stderr is None:
        return _decimals(value, 3)
    return with_error(value, stderr)


def _decimals(value: float | None, decimals: int = 2) -> str:
    return "-" if value is None else f"{value:.{decimals}f}"
