"""Tables of the metrics people ask for first."""

from rich.table import Table

from lidar_mi.cli.terminal import output


def print_metrics(metrics: dict[str, float]) -> None:
    """The few numbers people ask for first."""
    if any(key.startswith("doppler.bound.") for key in metrics):
        _print_doppler(metrics)
    if any(key.startswith("backscatter.") for key in metrics):
        _print_winds(metrics)
    if "sensor.vectors" in metrics:
        _print_sensor(metrics)


def _print_doppler(metrics: dict[str, float]) -> None:
    """Standard deviation and bias of every method, for every number of pictures averaged."""
    cases = [
        key.split(".")[1:4] for key in metrics if key.startswith("doppler.") and "averaged" in key
    ]
    rows = dict.fromkeys((method, centre) for method, centre, _ in cases)
    numbers = sorted({int(averaged.removeprefix("averaged_")) for *_, averaged in cases})
    table = Table(
        title="line-of-sight wind from averages of so many pictures, m/s", title_justify="left"
    )
    for head in ("method", "centre"):
        table.add_column(head)
    for number in numbers:
        for head in (f"{number}: std", "bias"):
            table.add_column(head, justify="right")
    for method, centre in rows:
        keys = [
            f"doppler.{method}.{centre}.averaged_{number}.{name}"
            for number in numbers
            for name in ("std", "bias")
        ]
        shown = ["-" if key not in metrics else f"{metrics[key]:.3f}" for key in keys]
        style = "dim" if method == "bound" else None
        name = "(bound)" if method == "bound" else method
        table.add_row(name, centre.removeprefix("centre_"), *shown, style=style)
    output.print(table)


def _print_winds(metrics: dict[str, float]) -> None:
    """Rms errors of the winds from every source, by every method."""
    table = Table(
        title="rms error of the wind in m/s, valid vectors (far: beyond two core radii)",
        title_justify="left",
    )
    components = (
        "uvw"
        if any(k.startswith("backscatter") and k.endswith(".rmse_u") for k in metrics)
        else "vw"
    )
    far = (f"far {name}" for name in components)
    for head in ("winds from", "method", *components, *far, "valid"):
        named = head in ("winds from", "method")
        table.add_column(head, justify="left" if named else "right", no_wrap=named)
    names = [
        tuple(key.split(".")[:2])
        for key in metrics
        if key.endswith(".valid_fraction") and not key.startswith("texture_sweep.")
    ]
    for source, method in names:
        values = [
            metrics.get(f"{source}.{method}.{place}rmse_{name}")
            for place in ("", "outside_cores.")
            for name in components
        ]
        shown = ["-" if value is None else f"{value:.2f}" for value in values]
        valid = f"{metrics[f'{source}.{method}.valid_fraction']:.0%}"
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


def _print_sensor(metrics: dict[str, float]) -> None:
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
