"""The chapter of a report that says what limits the cross-flow wind."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import PercentFormatter

from lidar_mi.assessment.figures.backscatter import METHOD_NAMES, Drawn, save_all
from lidar_mi.assessment.metrics.error_budget import CAUSES
from lidar_mi.assessment.report.digits import fixed
from lidar_mi.assessment.report.page import Chapter, Tables

# A cause with less of the mean square error is no limit.
_LEAST = 0.1
_PLACES = {"": "all", "outside_cores.": "beyond two core radii"}


def draw_all(
    folder: Path, metrics: Mapping[str, float], methods: Sequence[str], log: Callable
) -> list[Drawn]:
    """Draw the shares of all causes as a PNG into ``folder``; nothing where none is known.

    Parameters
    ----------
    metrics : mapping
        ``error_budget.METHOD.KEY`` with the keys of `error_budget.error_budget`.
    methods : sequence of str
    """
    known = [method for method in methods if _causes(metrics, method)]
    if not known:
        return []
    plates = [("fig23_error_budget", "What limits the wind", _bars(metrics, known))]
    return save_all(folder, plates, log)


def _causes(metrics, method) -> list[str]:
    return [c for c in CAUSES if f"error_budget.{method}.{c}.share" in metrics]


def _bars(metrics, methods):
    used = [c for c in CAUSES if any(c in _causes(metrics, m) for m in methods)]
    figure = Figure(figsize=(3.4 + 3.2 * len(methods), 1.9 + 0.5 * len(used)), layout="constrained")
    panels = figure.subplots(1, len(methods), sharey=True, squeeze=False)[0]
    rows = np.arange(len(used))[::-1]
    least = min(
        metrics.get(f"error_budget.{method}.{place}{cause}.share", 0.0)
        for method in methods
        for place in _PLACES
        for cause in used
    )
    bars = {}
    for panel, method in zip(panels, methods):
        title = []
        for number, (place, where) in enumerate(_PLACES.items()):
            prefix = f"error_budget.{method}.{place}"
            if f"{prefix}rmse_v" not in metrics:
                continue
            title.append(f"{where}: {_both(metrics, prefix):.2g} m/s")
            shares = np.array([metrics.get(f"{prefix}{cause}.share", np.nan) for cause in used])
            at = rows + 0.2 - 0.4 * number
            bars[where] = panel.barh(at, shares, 0.36, color=f"C{number}")
            for y, share in zip(at, shares):
                if np.isfinite(share):
                    end = min(max(share, 0), 1) + 0.015
                    panel.text(end, y, _percent(share), va="center", fontsize=7)
        for y, cause in zip(rows, used):
            if cause not in _causes(metrics, method):
                panel.text(0.015, y, "does not apply", va="center", color="0.5", fontsize=8)
        panel.set_title("\n".join([METHOD_NAMES[method], *title]), fontsize=10)
        panel.set_xlabel("share of the mean square error")
        panel.axvline(0, color="k", lw=0.8)
        panel.grid(alpha=0.3, axis="x")
        panel.set_axisbelow(True)
        panel.xaxis.set_major_formatter(PercentFormatter(1.0))
        # what makes things many times worse must not flatten the others: its number stands there
        panel.set_xlim(min(-0.35, 1.1 * max(least, -1)), 1.15)
    panels[0].set_yticks(rows, [CAUSES[cause] for cause in used])
    figure.legend(bars.values(), bars.keys(), loc="outside lower right", ncols=2, fontsize=9)
    return figure, (
        "By how much the mean square error of v and w falls without each cause of error in turn, and "
        "the rms error with all of them (of a component). Shares need not add up to 100 %; below 0 "
        "the wind is worse without the cause."
    )


def _percent(share: float) -> str:
    """Without a sign before 0."""
    return f"{round(100 * share) + 0} %"


def _both(metrics, prefix: str) -> float:
    """Rms error of v and w together, a component."""
    return float(np.hypot(metrics[f"{prefix}rmse_v"], metrics[f"{prefix}rmse_w"]) / np.sqrt(2))


def limit_sentence(metrics: Mapping[str, float], method: str) -> str:
    """What limits a method's wind, in one sentence; beyond two core radii where there are cores."""
    name = METHOD_NAMES[method]
    causes = _causes(metrics, method)
    if not causes:
        return f"What limits the wind by {name} cannot be told: no vector is valid."
    prefix = f"error_budget.{method}."
    where = ""
    if f"{prefix}outside_cores.{causes[0]}.share" in metrics:
        prefix, where = f"{prefix}outside_cores.", " beyond two core radii"
    shares = {cause: metrics[f"{prefix}{cause}.share"] for cause in causes}
    ranked = sorted(causes, key=shares.get, reverse=True)
    parts = [f"{CAUSES[c]} ({_percent(shares[c])}" for c in ranked if shares[c] >= _LEAST][:3]
    error = f"{_both(metrics, prefix):.2f} m/s"
    if not parts:
        return (
            f"The wind by {name} is off by {error} rms{where}; no single cause has {_percent(_LEAST)} "
            "of the mean square error."
        )
    text = (
        f"The wind by {name} is off by {error} rms{where}, limited by "
        + "), then ".join([f"{parts[0]} of the mean square error", *parts[1:]])
        + ")."
    )
    if ranked[0] == "monte_carlo":
        text += " That noise is not the lidar's: more photons a beam (render.samples_per_beam) lower it."
    return text


def budget_chapter(
    metrics: Mapping[str, float], methods: Sequence[str], drawn: Sequence[Drawn]
) -> Chapter:
    """What limits the cross-flow wind.

    Parameters
    ----------
    metrics : mapping
        As `draw_all` takes it.
    methods : sequence of str
    drawn : sequence of Drawn
    """
    numbers = Tables(
        heading="Errors without each cause in turn",
        legend="Rms errors in m/s of v and w, and the share of the mean square error of both that goes "
        "with the cause: over valid vectors, always the same, and over those beyond two core radii. "
        "Noise is taken out as it fell, not drawn anew. The method itself: what it is off by "
        "on pictures of the air as it is, without blur and noise.",
        tables=[_table(metrics, method) for method in methods],
    )
    lead = [limit_sentence(metrics, method) for method in methods]
    known = {method: _causes(metrics, method) for method in methods}
    whole = [METHOD_NAMES[m] for m, causes in known.items() if causes and "window" not in causes]
    if whole:
        lead.append(
            "There is no window, no shear within one and no straight path to take away for "
            f"{' and '.join(whole)}, fitted to whole pictures along curved paths: how smooth the flow is "
            "belongs to the method itself."
        )
    return Chapter("What limits the cross-flow wind", lead, drawn, numbers)


def _table(metrics, method):
    def values(cause: str) -> list[str]:
        shown = []
        for place in _PLACES:
            for key, style in (("rmse_v", fixed), ("rmse_w", fixed), ("share", _percent)):
                value = metrics.get(f"error_budget.{method}.{place}{cause}{key}")
                shown.append("-" if value is None else style(value))
        return shown

    rows = [("with all causes", "", values(""))]
    rows += [(f"without: {CAUSES[c]}", "", values(f"{c}.")) for c in _causes(metrics, method)]
    heads = [
        f"{quantity}{where}" for where in ("", ", beyond cores") for quantity in ("v", "w", "share")
    ]
    return METHOD_NAMES[method], heads, rows
