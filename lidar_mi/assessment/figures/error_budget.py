"""The figure of the cross-flow wind's error budget."""

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import PercentFormatter

from lidar_mi.assessment.digits import whole_percent
from lidar_mi.assessment.figures.panels import Captioned, Drawn, Progress, save_all
from lidar_mi.assessment.labels import METHOD_NAMES
from lidar_mi.assessment.metrics.error_budget import (
    CAUSES,
    PLACES,
    Budgets,
    causes_of,
    component_rmse,
)


def draw_all(folder: Path, budgets: Budgets, log: Progress) -> list[Drawn]:
    """Draw the fractions of all causes as a PNG into ``folder``; nothing if none is known.

    Budgets are those of `lidar_mi.assessment.metrics.error_budget.error_budget`, by method.
    """
    with_causes = {method: budget for method, budget in budgets.items() if causes_of(budget)}
    if not with_causes:
        return []
    figures = [("fig23_error_budget", "What limits the wind", _bars(with_causes))]
    return save_all(folder, figures, log)


def _bars(budgets: Budgets) -> Captioned:
    used = [c for c in CAUSES if any(c in causes_of(budget) for budget in budgets.values())]
    size = (3.4 + 3.2 * len(budgets), 1.9 + 0.5 * len(used))
    figure = Figure(figsize=size, layout="constrained")
    panels = figure.subplots(1, len(budgets), sharey=True, squeeze=False)[0]
    rows = np.arange(len(used))[::-1]
    least = min(
        budget.get(f"{place}{cause}.fraction", 0.0)
        for budget in budgets.values()
        for place in PLACES
        for cause in used
    )
    bars = {}
    for panel, (method, budget) in zip(panels, budgets.items(), strict=True):
        title = []
        for number, (place, where) in enumerate(PLACES.items()):
            if f"{place}rmse_v" not in budget:
                continue
            title.append(f"{where}: {component_rmse(budget, place):.2g} m/s")
            fractions = np.array([budget.get(f"{place}{cause}.fraction", np.nan) for cause in used])
            at = rows + 0.2 - 0.4 * number
            bars[where] = panel.barh(at, fractions, 0.36, color=f"C{number}")
            for y, fraction in zip(at, fractions, strict=True):
                if np.isfinite(fraction):
                    end = min(max(fraction, 0), 1) + 0.015
                    panel.text(end, y, whole_percent(fraction), va="center", fontsize=7)
        for y, cause in zip(rows, used, strict=True):
            if cause not in causes_of(budget):
                panel.text(0.015, y, "does not apply", va="center", color="0.5", fontsize=8)
        panel.set_title("\n".join([METHOD_NAMES[method], *title]), fontsize=10)
        panel.set_xlabel("fraction of the mean square error")
        panel.axvline(0, color="k", lw=0.8)
        panel.grid(alpha=0.3, axis="x")
        panel.set_axisbelow(True)
        panel.xaxis.set_major_formatter(PercentFormatter(1.0))
        # large negative fractions must not flatten the others: they are written as numbers
        panel.set_xlim(min(-0.35, 1.1 * max(least, -1)), 1.15)
    panels[0].set_yticks(rows, [CAUSES[cause] for cause in used])
    figure.legend(bars.values(), bars.keys(), loc="outside lower right", ncols=2, fontsize=9)
    return figure, (
        "Decrease of the mean square error of v and w without each cause of error in turn, and "
        "the rms error with all of them (per component). Fractions need not add up to 100 %; below "
        "0 the errors are larger without the cause."
    )
