"""The combined sensor's chapter of a report: its figures, its verdict, its numbers."""

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import xarray as xr
from matplotlib.figure import Figure
from scipy import stats

from lidar_mi.assessment.figures.backscatter import Drawn, save_all
from lidar_mi.assessment.metrics.cores import Core
from lidar_mi.assessment.metrics.requirements import as_rows, fulfilled, look_ahead
from lidar_mi.assessment.report.digits import in_row, percent, three
from lidar_mi.assessment.report.page import Chapter, Tables
from lidar_mi.retrieval.lines.vectors import COMPONENTS

_SPEED = "m s$^{-1}$"


def draw_all(
    folder: Path, found: xr.Dataset | None, lines: xr.Dataset, cores: Sequence[Core], log: Callable
) -> list[Drawn]:
    """Draw the combined sensor's figures as PNG into ``folder``.

    Parameters
    ----------
    found : xr.Dataset or None
        From `lidar_mi.retrieval.lines.combine.combine`, with the truth as u_true, v_true, w_true. None:
        there is no wind.
    lines : xr.Dataset
        From `lidar_mi.experiment.stages.sensor.measure_lines`.
    """
    plates = [("fig19_lines_of_sight", "The scan of the Doppler lidar", _scan(lines, cores))]
    if found is not None:
        plates += [
            ("fig20_wind3d", "The wind from both lidars", _maps(found, lines, cores)),
            ("fig21_uncertainty", "How certain it is", _uncertainty(found)),
        ]
    return save_all(folder, plates, log)


def _scan(lines, cores):
    figure = Figure(figsize=(13.6, 4.6), layout="compressed")
    panels = figure.subplots(1, 2, sharex=True, sharey=True)
    place = (lines["range"] * lines["direction"]).transpose("line", "axis").values
    speed, true = lines["v_los"].values, lines["v_los_true"].values
    reduced = (speed - true) / lines["v_los_std"].values
    read = np.isfinite(speed)
    span = np.quantile(np.where(read, speed, true), (0.0, 1.0))
    for panel, values, title, label, style in (
        (
            panels[0],
            speed,
            "velocity along the line of sight",
            _SPEED,
            {"cmap": "cividis", "vmin": span[0], "vmax": span[1]},
        ),
        (
            panels[1],
            reduced,
            "its error over its standard error",
            "reduced error",
            {"cmap": "RdBu_r", "vmin": -4, "vmax": 4},
        ),
    ):
        dots = panel.scatter(
            place[read, 1],
            place[read, 2],
            c=values[read],
            s=90,
            edgecolors="0.3",
            linewidths=0.5,
            **style,
        )
        panel.plot(place[~read, 1], place[~read, 2], "kx", ms=6)
        for core in cores:
            panel.plot(core.y, core.z, "+", color="crimson", ms=9)
        panel.set(title=title, aspect="equal", xlabel="y / m (port is left)", ylabel="z / m")
        figure.colorbar(dots, ax=panel, label=label, pad=0.02)
    # at least as wide as high, also for lines above each other
    middle, half = (
        (place[:, 1].max() + place[:, 1].min()) / 2,
        np.ptp(place[:, 1:], axis=0).max() / 2,
    )
    panels[0].set_xlim(middle + half + 4, middle - half - 4)
    return figure, (
        "Middles of the range bins; what the aircraft flies is part of the velocity. Black crosses: "
        "lines of sight whose rings could not be read. Red crosses: true cores."
    )


def _maps(found, lines, cores):
    figure = Figure(figsize=(17, 10.5), layout="compressed")
    axes = figure.subplots(3, 3, sharex=True, sharey=True)
    good = found["flag"] == 0
    y, z = found["y"], found["z"]
    place = (lines["range"] * lines["direction"]).transpose("line", "axis").values
    for row, name in zip(axes, COMPONENTS):
        true, value = found[f"{name}_true"], found[name].where(good)
        error = value - true
        both = np.concatenate([true.values.ravel(), value.values.ravel()])
        columns = (
            (true, _colours(both), f"{name}, true"),
            (value, _colours(both), f"{name}, found"),
            (error, _colours(error.values), f"{name}, error"),
        )
        for panel, (field, colours, title) in zip(row, columns):
            mesh = panel.pcolormesh(
                y,
                z,
                field.transpose("z", "y").values,
                shading="nearest",
                rasterized=True,
                **colours,
            )
            panel.set(title=title, aspect="equal")
            figure.colorbar(mesh, ax=panel, label=_SPEED, pad=0.02, extend="both")
            for core in cores:
                panel.plot(core.y, core.z, "+", color="k", ms=8)
    # lines of sight where they are used
    axes[0, 1].plot(place[:, 1], place[:, 2], "k.", ms=2)
    axes[0, 0].set_xlim(float(y.max()), float(y.min()))
    axes[0, 0].set_ylim(float(z.min()), float(z.max()))
    for panel in axes[-1]:
        panel.set_xlabel("y / m (port is left)")
    for panel in axes[:, 0]:
        panel.set_ylabel("z / m")
    return figure, (
        "Rows: u from the lines of sight (dots: their middles) with the cross-flow wind of the "
        "images taken out, v and w from the images. Good vectors alone; crosses: true cores."
    )


def _uncertainty(found):
    figure = Figure(figsize=(17, 4.3), layout="compressed")
    axes = figure.subplots(1, 3, width_ratios=(1.25, 1.25, 1))
    good = (found["flag"] == 0).transpose("z", "y").values
    y, z = found["y"], found["z"]
    for panel, name in zip(axes, ("u", "w")):
        stderr = found[f"{name}_stderr"].transpose("z", "y").values
        top = float(np.quantile(stderr[good], 0.99)) if good.any() else 1.0
        mesh = panel.pcolormesh(
            y,
            z,
            np.where(good, stderr, np.nan),
            shading="nearest",
            rasterized=True,
            cmap="viridis",
            vmin=0,
            vmax=top,
        )
        panel.set(
            title=f"standard error of {name}",
            aspect="equal",
            xlabel="y / m (port is left)",
            ylabel="z / m",
        )
        panel.set_xlim(float(y.max()), float(y.min()))
        figure.colorbar(mesh, ax=panel, label=_SPEED, pad=0.02, extend="max")
    axes = axes[-1]
    edges = np.linspace(-5, 5, 51)
    for name in COMPONENTS:
        error = (found[name] - found[f"{name}_true"]) / found[f"{name}_stderr"]
        values = error.transpose("z", "y").values[good]
        axes.hist(
            np.clip(values[np.isfinite(values)], -5, 5),
            edges,
            density=True,
            histtype="step",
            label=name,
        )
    middle = (edges[1:] + edges[:-1]) / 2
    axes.plot(middle, stats.norm.pdf(middle), "k:", label="as stated")
    axes.set(title="errors over standard errors", xlabel="reduced error", ylabel="density")
    axes.legend()
    return figure, (
        "Left, middle: standard errors of good vectors. Right: how errors against the truth, in "
        "units of their standard errors, are distributed; the last bins hold all beyond."
    )


def _colours(values: np.ndarray) -> dict:
    """Two-sided about 0, or of the values' own range where all of them point the same way."""
    known = values[np.isfinite(values)]
    low, high = np.quantile(known, (0.005, 0.995)) if known.size else (0.0, 0.0)
    if low > 0 or high < 0:
        return {"cmap": "viridis", "vmin": low, "vmax": high}
    limit = (float(np.quantile(np.abs(known), 0.995)) if known.size else 0.0) or 1.0
    return {"cmap": "RdBu_r", "vmin": -limit, "vmax": limit}


def sensor_chapter(
    experiment,
    metrics: dict[str, float],
    judged: Sequence[tuple],
    drawn: Sequence[Drawn],
    vectors: dict | None = None,
) -> Chapter:
    """What both lidars together tell, and whether that satisfies flight control.

    Parameters
    ----------
    experiment : lidar_mi.experiment.schema.Experiment
    metrics : dict
        From `lidar_mi.experiment.stages.sensor`.
    judged : sequence of (RequirementTable, list of Finding)
        Empty: nothing is asked for.
    drawn : sequence of Drawn
    vectors : dict, optional
        From `vector_map.map_data`.
    """
    speed = experiment.platform.speed
    purpose = (
        "Both lidars look at the same slab of air: the Doppler lidar's lines of sight and the "
        "cross-flow wind of the backscatter lidar's images give the wind in three dimensions."
    )
    if speed:
        ahead = look_ahead(experiment.scan.range + experiment.scan.thickness / 2, speed)
        warning = f"At {speed:g} m/s the aircraft is there {ahead:.2g} s later."
    else:
        warning = "The platform stands still: there is no look-ahead time"
        warning += "." if judged else ", and requirements for flight control do not apply."
    verdicts = {True: "fulfilled", False: "not fulfilled", None: "cannot be told"}
    tables = [
        (
            f"{table.title}, {table.phase}: {verdicts[fulfilled(findings)]}",
            ["verdict", "measured", "required", "margin"],
            [
                (name, "", (verdict, measured, required, margin))
                for name, required, measured, margin, verdict in as_rows(findings)
            ],
        )
        for table, findings in judged
    ]
    if vectors:
        vectors = {"title": "The wind from both lidars, vector by vector"} | vectors
    return Chapter(
        title="Both lidars as one sensor",
        lead=[
            purpose,
            warning,
            *_limit_of_u(metrics),
            *_not_stated(experiment.sensor.errors),
            *_costs(metrics),
        ],
        drawn=drawn,
        verdict=Tables(
            "Whether it does what flight control asks for"
            if speed
            else "Whether it does what is asked for",
            "Errors of u, v, w are rms errors of good vectors beyond two core radii, those of v_LOS "
            "rms errors of lines of sight, in this run for all phases of flight. A margin is the "
            "distance from the limit, as a share of it.",
            tables,
        )
        if judged
        else None,
        numbers=Tables(
            "How good the wind from both lidars is",
            f"{metrics['sensor.lines_read']} of {metrics['sensor.lines']} lines of sight were read; "
            f"{metrics['sensor.vectors']} vectors, {percent(metrics['sensor.good_fraction'])}, are good. "
            "Errors over standard errors have a variance of 1 where they are as stated; then 68 % "
            "lie within one standard error and 95 % within 1.96.",
            [_numbers(metrics)],
        ),
        vectors=vectors,
    )


# A cause with less of u's mean square error is no limit.
_LEAST = 0.05
_CAUSES = {
    "between_lines": "the air between the lines of sight",
    "line_noise": "the noise of the rings",
    "range_bin": "averaging along the range bin",
    "crossflow": "errors of v and w",
    "pointing": "errors of attitude and pointing",
}


def _limit_of_u(metrics) -> list[str]:
    """What limits u, in a sentence; nothing where it is not known."""
    keys = {c: f"sensor.error_budget.{c}.share_u" for c in _CAUSES}
    shares = {c: metrics[key] for c, key in keys.items() if key in metrics}
    if not shares:
        return []
    ranked = sorted(shares, key=shares.get, reverse=True)
    parts = [f"{_CAUSES[c]} ({percent(min(shares[c], 1))}" for c in ranked if shares[c] >= _LEAST]
    little = [_CAUSES[c] for c in ranked if shares[c] < _LEAST]
    rmse = metrics.get("sensor.outside_cores.rmse_u", metrics["sensor.rmse_u"])
    text = f"u is off by {rmse:.2g} m/s rms, limited by " + "), then ".join(
        [f"{parts[0]} of the mean square error", *parts[1:]]
    )
    return [f"{text})" + (f"; next to nothing by {' or '.join(little)}." if little else ".")]


def _not_stated(errors) -> list[str]:
    """That errors of the platform are there, and not in what is stated."""
    if errors == type(errors)():
        return []
    text = (
        "The platform's attitude, pointing or speed is not what it is taken for (sensor.errors). Standard "
        "errors do not know of this: what turns all lines alike is on top of them."
    )
    return [text]


def _costs(metrics) -> list[str]:
    needed = metrics.get("sensor.doppler.pulses_needed")
    text = (
        f"The Doppler lidar's directions take {_rate(metrics, 'doppler')}, and give "
        f"{three(metrics['sensor.doppler.photons_per_direction'])} photons each"
        + (
            f"; the error of v_LOS that is asked for takes {needed} of them a direction."
            if needed
            else "."
        )
        + f" The pictures take {_rate(metrics, 'backscatter')}."
    )
    safety = []
    for name, title in (("doppler", "Doppler"), ("backscatter", "backscatter")):
        distance = metrics.get(f"sensor.{name}.hazard_distance")
        if distance is None:
            continue
        aided = metrics[f"sensor.{name}.aided_hazard_distance"]
        where = "where it leaves"
        if aided > 0:
            where = f"from {three(distance)} m on, with binoculars from {three(aided)} m"
        limit = three(metrics[f"sensor.{name}.permissible_exposure"])
        safety.append(
            f"The {title} lidar's beam is safe for eyes {where}: {limit} J/m² of each pulse are "
            "permissible (IEC 60825-1:2014)."
        )
    return [text, *safety]


def _rate(metrics, name: str) -> str:
    """Pulses a second of all directions of a lidar, what they carry, how many must be there at once."""
    rate, power, beams = (
        metrics[f"sensor.{name}.{key}"] for key in ("pulses_per_second", "average_power", "beams")
    )
    at_once = f", {beams} directions at a time" if beams > 1 else ""
    return f"{three(rate)} pulses a second{at_once}, {three(power)} W of light"


def _numbers(metrics):
    rows = []
    for key, label, unit in (
        ("rmse_{}", "rms error", "m/s"),
        ("outside_cores.rmse_{}", "rms error beyond cores", "m/s"),
        ("outside_cores.rms_{}", "the true wind itself there, rms", "m/s"),
        ("bias_{}", "bias", "m/s"),
        ("reduced_variance_{}", "variance of reduced errors", ""),
        ("coverage_68_{}", "within one standard error", "%"),
        ("coverage_95_{}", "within 1.96 standard errors", "%"),
        ("triples.rmse_{}", "rms error, lines of sight alone, in threes", "m/s"),
        ("neighbours.rmse_{}", "rms error, the same, up to nine by least squares", "m/s"),
    ):
        values = [metrics.get(f"sensor.{key.format(name)}") for name in (*COMPONENTS, "v_los")]
        rows.append((label, unit, in_row(values, unit)))
    return "Errors against the truth", ["u", "v", "w", "v_LOS"], rows
