"""The vortices' chapter of a report: the fitted pairs and the truth."""

import math
from collections.abc import Mapping, Sequence

from lidar_mi.assessment.digits import fixed, with_error
from lidar_mi.assessment.figures.panels import Drawn
from lidar_mi.assessment.labels import METHOD_NAMES
from lidar_mi.assessment.metrics.names import vortex_key
from lidar_mi.assessment.metrics.vortices import ORIGIN_NAMES
from lidar_mi.assessment.report.page import Chapter, Tables
from lidar_mi.retrieval.vortices.pair import VortexPairFit

# rows of the table: quantity, name, unit
_ROWS = (
    *(
        (f"{side}_{key}", f"{side}: {label}", unit)
        for side in ("port", "starboard")
        for key, label, unit in (
            ("circulation_5_15", "circulation, mean over 5 to 15 m", "m²/s"),
            ("circulation", "circulation, far from the core", "m²/s"),
            ("core_radius", "core radius", "m"),
            ("y", "y", "m"),
            ("z", "z", "m"),
        )
    ),
    ("separation", "separation b0", "m"),
    ("descent_speed", "descent speed w0 = circulation / (2 pi b0)", "m/s"),
    ("drift_v", "velocity of the pair along y", "m/s"),
    ("drift_w", "velocity of the pair along z", "m/s"),
)
_ERRORS = (
    ("rmse_v", "rms error of v", "m/s"),
    ("rmse_w", "rms error of w", "m/s"),
    ("outside_cores.rmse_v", "rms error of v beyond two core radii", "m/s"),
    ("outside_cores.rmse_w", "rms error of w beyond two core radii", "m/s"),
    ("normalised_error_variance_v", "variance of normalised errors of v", ""),
    ("normalised_error_variance_w", "variance of normalised errors of w", ""),
)


def vortex_chapter(
    metrics: Mapping[str, float],
    fits: Mapping[str, VortexPairFit],
    refused: Mapping[str, str],
    drawn: Sequence[Drawn],
    method: str | None = None,
) -> Chapter:
    """Parameters of the fitted vortices, and the truth.

    Fits are the accepted ones, by `Origin`; for those ``refused`` there is a reason. The method is
    that of the wind vectors.
    """
    vectors = f" of the {METHOD_NAMES[method]}" if method else ""
    purpose = (
        "Two vortices in a mean wind are fitted to the two images as a whole, and to the wind "
        f"vectors{vectors}. The fitted pair gives the wind anywhere, with its error (vortex.json)."
    )
    lead = [purpose]
    lead += [sentence for name in fits if (sentence := _verdict(metrics, name))]
    lead += [
        f"No pair from the {ORIGIN_NAMES[name]}: {reason}." for name, reason in refused.items()
    ]
    heads = ["truth", *(f"from the {ORIGIN_NAMES[name]}" for name in fits)]
    pair = [
        (label, unit, [_cell(metrics, vortex_key(name, key)) for name in ("truth", *fits)])
        for key, label, unit in _ROWS
    ]
    errors = [
        (label, unit, [_cell(metrics, vortex_key(name, key)) for name in fits])
        for key, label, unit in _ERRORS
    ]
    tables = [("The vortex pair", heads, pair)]
    if fits:
        tables.append(("The pair's wind against the truth, over the whole slab", heads[1:], errors))
    numbers = Tables(
        heading="Vortex parameters and standard errors",
        legend="Values with standard errors, at mid-time of the images; core radius and "
        "circulation far from the core are those of the fitted profile (Lamb-Oseen), a true "
        "core radius is that of the largest swirl. True circulations and velocities are averages "
        "over rings of 5 to 15 m; a dash: undetermined.",
        tables=tables,
    )
    return Chapter("The vortices", lead, drawn, numbers)


def _verdict(metrics: Mapping[str, float], name: str) -> str | None:
    """Errors of circulations and positions of a fit, in one sentence."""
    sides = ("port", "starboard")
    circulations = [f"{side}_circulation_5_15" for side in sides]
    if any(metrics.get(vortex_key("truth", key)) is None for key in circulations):
        return None

    def estimate_and_truth(key: str) -> tuple[float, float]:
        return metrics[vortex_key(name, key)], metrics[vortex_key("truth", key)]

    deviations = [abs(fit / true - 1) for fit, true in map(estimate_and_truth, circulations)]
    places = [
        math.hypot(
            *(fit - true for fit, true in map(estimate_and_truth, (f"{side}_y", f"{side}_z")))
        )
        for side in sides
    ]
    return (
        f"From the {ORIGIN_NAMES[name]}, the errors of the circulations are "
        f"{100 * deviations[0]:.1f} % (port) and {100 * deviations[1]:.1f} % (starboard), those of "
        f"the positions {places[0]:.2f} and {places[1]:.2f} m."
    )


def _cell(metrics: Mapping[str, float], key: str) -> str:
    value, stderr = metrics.get(key), metrics.get(f"{key}_stderr")
    if value is None:
        return "-"
    return fixed(value) if stderr is None else with_error(value, stderr)
