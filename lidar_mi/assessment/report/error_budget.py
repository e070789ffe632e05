"""The chapter of a report on the error budget of the cross-flow wind."""

from collections.abc import Mapping, Sequence

from lidar_mi.assessment.digits import fixed, whole_percent
from lidar_mi.assessment.figures.panels import Drawn
from lidar_mi.assessment.labels import METHOD_NAMES
from lidar_mi.assessment.metrics.error_budget import (
    CAUSES,
    PLACES,
    Budgets,
    causes_of,
    component_rmse,
)
from lidar_mi.assessment.report.page import Chapter, NumberTable, Tables

# A cause with a smaller fraction of the mean square error is not named.
_LEAST = 0.1
_LARGER = "larger without"


def limit_sentence(budget: Mapping[str, float], method: str) -> str:
    """Error budget of a method's wind, in one sentence; beyond two core radii of any cores."""
    name = METHOD_NAMES[method]
    causes = causes_of(budget)
    if not causes:
        return f"The error budget of the wind by {name} is undetermined: no vector is valid."
    place, where = "", ""
    if f"outside_cores.{causes[0]}.fraction" in budget:
        place, where = "outside_cores.", " beyond two core radii"
    fractions = {cause: budget[f"{place}{cause}.fraction"] for cause in causes}
    ranked = sorted(causes, key=lambda cause: fractions[cause], reverse=True)
    parts = [
        f"{CAUSES[c]} ({whole_percent(fractions[c])}" for c in ranked if fractions[c] >= _LEAST
    ][:3]
    error = f"{component_rmse(budget, place):.2f} m/s"
    if not parts:
        return (
            f"The wind by {name} has an rms error of {error}{where}; no single cause has "
            f"{whole_percent(_LEAST)} of the mean square error."
        )
    text = (
        f"The wind by {name} has an rms error of {error}{where}, limited by "
        + "), then ".join([f"{parts[0]} of the mean square error", *parts[1:]])
        + ")."
    )
    if ranked[0] == "monte_carlo":
        text += (
            " That noise is not the lidar's: more Monte Carlo samples per beam "
            "(render.samples_per_beam) lower it."
        )
    return text


def budget_chapter(budgets: Budgets, drawn: Sequence[Drawn]) -> Chapter:
    """The error budget of the cross-flow wind."""
    numbers = Tables(
        heading="Errors without each cause in turn",
        legend="Rms errors in m/s of v and w, and the fraction of the mean square error of both "
        "due to the cause: over the same valid vectors, and over those beyond two core radii. "
        f"{_LARGER}: the mean square error more than doubles without the cause: no fraction is due "
        "to it, and the row does not apply. Noise is removed as realised, not drawn again. The "
        "method: its error without blur and noise.",
        tables=[_table(budget, method) for method, budget in budgets.items()],
    )
    lead = [limit_sentence(budget, method) for method, budget in budgets.items()]
    return Chapter("Error budget of the cross-flow wind", lead, drawn, numbers)


def _fraction(value: float) -> str:
    """A fraction of the mean square error; in words where the error doubles without the cause."""
    return _LARGER if value < -1 else whole_percent(value)


def _table(budget: Mapping[str, float], method: str) -> NumberTable:
    def values(cause: str) -> list[str]:
        cells = []
        for place in PLACES:
            for key, style in (("rmse_v", fixed), ("rmse_w", fixed), ("fraction", _fraction)):
                value = budget.get(f"{place}{cause}{key}")
                cells.append("-" if value is None else style(value))
        return cells

    rows = [("with all causes", "", values(""))]
    rows += [(f"without: {CAUSES[c]}", "", values(f"{c}.")) for c in causes_of(budget)]
    heads = [
        f"{quantity}{where}"
        for where in ("", ", beyond cores")
        for quantity in ("v", "w", "fraction")
    ]
    return METHOD_NAMES[method], heads, rows
