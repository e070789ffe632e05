"""Tables of the metrics people ask for first."""

from collections.abc import Mapping, Sequence
from itertools import product

from rich.table import Table

from lidar_mi.assessment.metrics.names import Source, bound_key, ring_key, wind_key
from lidar_mi.cli.terminal import output
from lidar_mi.retrieval.methods import ImageMethod, RingCentre, RingMethod, VolumeMethod

_METHODS = dict.fromkeys((*ImageMethod, *VolumeMethod))


def print_metrics(metrics: Mapping[str, float], averaged: Sequence[int] = ()) -> None:
    """The few numbers people ask for first.

    Parameters
    ----------
    metrics : mapping
    averaged : sequence of int
        How many images of rings the experiment averages, ``doppler.retrieval.averaged``.
    """
    if averaged:
        _print_doppler(metrics, averaged)
    if f"{Source.BACKSCATTER}.mc_relative_error" in metrics:
        _print_winds(metrics)
    if "sensor.vectors" in metrics:
        _print_sensor(metrics)


def _print_doppler(metrics: Mapping[str, float], averaged: Sequence[int]) -> None:
    """Standard deviation and bias of every method, for every number of images averaged."""
    numbers = sorted(averaged)
    table = Table(
        title="line-of-sight wind from averages of so many images, m/s", title_justify="left"
    )
    for head in ("method", "centre"):
        table.add_column(head)
    for number in numbers:
        for head in (f"{number}: std", "bias"):
            table.add_column(head, justify="right")

    def add(name, centre, keys, style=None):
        if any(key in metrics for key in keys):
            shown = ["-" if key not in metrics else f"{metrics[key]:.3f}" for key in keys]
            table.add_row(name, str(centre), *shown, style=style)

    for centre in RingCentre:
        bounds = [key for n in numbers for key in (bound_key(centre, n), "")]
        add("(bound)", centre, bounds, "dim")
    for method, centre in product(RingMethod, RingCentre):
        keys = [ring_key(method, centre, n, name) for n in numbers for name in ("std", "bias")]
        add(str(method), centre, keys)
    output.print(table)


def _print_winds(metrics: Mapping[str, float]) -> None:
    """Rms errors of the winds from every source, by every method."""
    table = Table(
        title="rms error of the wind in m/s, valid vectors (far: beyond two core radii)",
        title_justify="left",
    )
    winds = [
        one for one in product(Source, _METHODS) if wind_key(*one, "valid_fraction") in metrics
    ]
    components = "uvw" if "true_wind.rms_u" in metrics else "vw"
    far = (f"far {name}" for name in components)
    for head in ("winds from", "method", *components, *far, "valid"):
        named = head in ("winds from", "method")
        table.add_column(head, justify="left" if named else "right", no_wrap=named)
    for source, method in winds:
        values = [
            metrics.get(wind_key(source, method, f"{place}rmse_{name}"))
            for place in ("", "outside_cores.")
            for name in components
        ]
        shown = ["-" if value is None else f"{value:.2f}" for value in values]
        valid = f"{metrics[wind_key(source, method, 'valid_fraction')]:.0%}"
        table.add_row(source.replace("_", " ").replace("extinction ", ""), method, *shown, valid)
    strength = [
        metrics.get(f"true_wind.{place}rms_{name}")
        for place in ("", "outside_cores.")
        for name in components
    ]
    shown = ["-" if value is None else f"{value:.2f}" for value in strength]
    table.add_row("true wind", "", *shown, "", style="dim")
    output.print(table)
    output.print(
        "An error near the rms of the true wind (last row) means no skill: zero would be as good."
    )


def _print_sensor(metrics: Mapping[str, float]) -> None:
    """Rms errors of the wind from both lidars, beyond two core radii where there are any."""
    far = any(key.startswith("sensor.outside_cores.") for key in metrics)
    place = "outside_cores." if far else ""
    table = Table(
        title=f"rms error of the wind from both lidars{', beyond cores' if far else ''}, m/s",
        title_justify="left",
    )
    for head in ("", "u", "v", "w"):
        table.add_column(head, justify="right" if head else "left")
    for label, key, style in (
        ("both lidars", f"sensor.{place}rmse_", None),
        ("lines of sight alone, all over", "sensor.triples.rmse_", None),
        ("true wind (rms)", f"sensor.{place}rms_", "dim"),
    ):
        values = [metrics.get(f"{key}{name}") for name in "uvw"]
        if any(value is not None for value in values):
            shown = ["-" if value is None else f"{value:.2f}" for value in values]
            table.add_row(label, *shown, style=style)
    if table.rows:
        output.print(table)
