"""The chapter of a flight into a wake: the answer, then measurement, prediction and motion."""

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from lidar_mi.assessment.digits import fixed, percent, three
from lidar_mi.assessment.metrics.encounter import AFTER, LEAST_REMOVED, MODES, flight_name
from lidar_mi.assessment.metrics.encounter_hazard import ACCEPTED_BANK, ACCEPTED_RATIO
from lidar_mi.assessment.metrics.requirements import Judged
from lidar_mi.assessment.report.encounter_loads import loads_answer
from lidar_mi.tables import Table

if TYPE_CHECKING:
    from lidar_mi.assessment.figures.panels import Drawn
    from lidar_mi.assessment.report.page import Chapter, Film, Tables


GOAL = 0.8
"""Goal for the lidar, as a fraction of what perfect preview removes beyond the autopilot: the
project's own, from no standard and not from the paper."""

_OF_A_FLIGHT = (
    ("largest_roll", "largest roll angle", "degrees", math.degrees(1)),
    ("largest_roll_rate", "largest roll rate", "degrees/s", math.degrees(1)),
    ("residual_moment", "rolling moment of {met} and ailerons over the {met}'s (rms)", "", 1.0),
    ("roll_control_ratio", "largest rolling moment of the {met} over the ailerons'", "", 1.0),
    ("largest_lift", "largest vertical force by the {met}'s wind", "kN", 1e-3),
    ("largest_load_increment", "largest change of the load factor", "", 1.0),
    ("largest_bending_increment", "largest change of a wing root's bending", "kN m", 1e-3),
)
_OF_THE_LIDAR = (
    ("lead_time", "first preview before the wake is felt", "s", 1.0),
    ("look_ahead", "estimate before the wing is in its slab (median)", "s", 1.0),
    ("withdrawn", "preview withdrawn, as the measured roll contradicts it", "s", 1.0),
    ("latency", "latency of the vortices, from the second scan (median)", "s", 1.0),
    ("latency_99", "the same, in 99 % of the slabs at most", "s", 1.0),
    ("wind_latency", "latency of the wind (median)", "s", 1.0),
    ("wind_latency_99", "the same, in 99 % of the slabs at most", "s", 1.0),
    ("slabs", "slabs delivered", "", 1.0),
    ("skipped_slabs", "slabs whose vortices the busy computer skipped", "", 1.0),
    ("wind_skipped_slabs", "slabs whose wind it skipped", "", 1.0),
    ("accepted_slabs", "slabs with an accepted fit of both vortices", "", 1.0),
    ("rejected_slabs", "accepted fits that the track rejected", "", 1.0),
    ("slabs_to_track", "accepted fits until the track is usable", "", 1.0),
    ("prediction_error", "error of the predicted rolling moment (rms)", "%", 100.0),
    (
        f"after_{AFTER}_slabs.circulation_error",
        f"largest error of a circulation, after {AFTER} fits",
        "%",
        100.0,
    ),
    (
        f"after_{AFTER}_slabs.core_error",
        f"largest error of a core's position, after {AFTER} fits",
        "m",
        1.0,
    ),
    (
        f"after_{AFTER}_slabs.within_2_sigma",
        f"circulations and positions within 2 standard errors, after {AFTER} fits",
        "%",
        100.0,
    ),
    (
        "tracked.circulation_error",
        f"largest error of a circulation, from {AFTER} fits on",
        "%",
        100.0,
    ),
    ("tracked.core_error", f"largest error of a core's position, from {AFTER} fits on", "m", 1.0),
    (
        "tracked.within_2_sigma",
        f"circulations and positions within 2 standard errors, from {AFTER} fits on",
        "%",
        100.0,
    ),
    ("normalised_innovation", "normalised innovation of the track (1: errors as stated)", "", 1.0),
    ("wind_ahead.w_error", "error of w expected on the wing (rms)", "m/s", 1.0),
    ("wind_ahead.w_rms", "w on the wing (rms)", "m/s", 1.0),
    ("wind_ahead.v_error", "error of v expected on the wing (rms)", "m/s", 1.0),
    ("wind_ahead.within_1_sigma", "winds on the wing within 1 standard error", "%", 100.0),
    ("wind_ahead.within_2_sigma", "winds on the wing within 2 standard errors", "%", 100.0),
)

_FLIGHT = {
    "off": "This flight",
    "autopilot": "The autopilot",
    "feedforward": "The flight with the lidar",
    "perfect": "The flight with perfect preview",
}

_AUTOPILOT = "the autopilot is the controller of the flights with a preview"
_FLIGHTS_OWN = "“{0}, no preview” is {0}, the controller of the flights with a preview"
_UPSET = "banked beyond 90 degrees, or out of control; the flight ends with this state"

# Largest roll of a flight that the wake does not affect, rad.
_NO_ROLL = math.radians(0.01)


def encounter_summary(
    metrics: Mapping[str, float], controller: str = "", met: str = "wake"
) -> list[Table]:
    """The main numbers for a terminal; `controller` and `met` as in `encounter_chapter`."""
    heads, flights, lidar = _numbers(metrics, controller, met)
    rows, of_lidar = (
        [(f"{label} / {unit}" if unit else label, *values) for label, unit, values in part]
        for part in (flights, lidar)
    )
    tables = [Table(f"flights into the {met}", rows, ("", *heads), f"flight lost: {_UPSET}")]
    return tables + ([Table("the lidar in flight", of_lidar)] if lidar else [])


def encounter_chapter(
    metrics: Mapping[str, float],
    judged: Judged,
    drawn: "Sequence[Drawn]",
    film: "Film | None" = None,
    controller: str = "",
    met: str = "wake",
) -> "Chapter":
    """Answer, figures and numbers of a flight.

    metrics: from `lidar_mi.assessment.metrics.encounter.encounter_metrics`.
    judged (sequence of (RequirementTable, findings)): what was measured in flight against the
        requirements of flight control.
    controller: name of a controller of one's own.
    met {"wake", "air"}: what the flights meet.
    """
    from lidar_mi.assessment.report.page import Chapter, Tables

    heads, flights, lidar = _numbers(metrics, controller, met)
    tables = [("The flights", heads, flights)]
    if lidar:
        tables.append(("The lidar and its track", ["value"], lidar))
    numbers = Tables(
        heading="Numbers of the flight",
        legend=f"All flights meet the same {met}. Without control, a pilot levels the wings; "
        f"{_FLIGHTS_OWN.format(controller) if controller else _AUTOPILOT}, without "
        f"information on the {met}. Flight lost: {_UPSET}. The {met} is felt from a tenth of its "
        "largest rolling moment on. Errors of circulations and positions are those of the track "
        "against the truth, in the newest slab; the larger one of both vortices.",
        tables=tables,
    )
    return Chapter(
        f"Into the {met}", [], drawn, numbers, _verdict(judged) if judged else None, film=film
    )


_Row = tuple[str, str, list[str]]
"""Name, unit, values as text."""


def _numbers(
    metrics: Mapping[str, float], controller: str, met: str
) -> tuple[list[str], list[_Row], list[_Row]]:
    """Names of the flights, rows with their numbers, and rows of the lidar."""
    modes = [mode for mode in MODES if f"encounter.{mode}.largest_roll" in metrics]
    flights = [
        (label, unit, [_cell(metrics.get(f"encounter.{mode}.{key}"), factor) for mode in modes])
        for key, label, unit, factor in _of_a_flight(metrics, met)
    ]
    lost = ["yes" if _lost(metrics, mode) else "no" for mode in modes]
    flights.append(("flight lost (upset)", "", lost))
    lidar = [
        (label, unit, [_cell(metrics[f"encounter.{key}"], factor)])
        for key, label, unit, factor in _OF_THE_LIDAR
        if f"encounter.{key}" in metrics
    ]
    return [flight_name(mode, controller) for mode in modes], flights, lidar


def encounter_answer(
    metrics: Mapping[str, float], controller: str = "", met: str = "wake"
) -> list[str]:
    """The answer in sentences; `controller` and `met` as in `encounter_chapter`.

    What the lidar added, the roll of the aircraft in every flight, the time of the first detection,
    the limits.
    """
    modes = [mode for mode in MODES if f"encounter.{mode}.largest_roll" in metrics]
    if "off" not in modes:
        return []
    lead = what_the_lidar_added(metrics, controller)
    rolls = {mode: metrics[f"encounter.{mode}.largest_roll"] for mode in modes}
    if max(rolls.values()) < _NO_ROLL:
        return [
            *lead,
            f"No flight rolls by more than {three(math.degrees(_NO_ROLL))} degrees: the {met} is "
            "missed, or both wings meet the same wind, as in a wake across the path.",
            *loads_answer(metrics),
        ]
    parts = []
    for mode, roll in rolls.items():
        size = "upset" if _lost(metrics, mode) else f"{three(math.degrees(roll))} degrees"
        parts.append(f"{size} ({flight_name(mode, controller)})")
    best = "feedforward" if "feedforward" in rolls else "perfect" if "perfect" in rolls else "off"
    verdict = "stays below" if rolls[best] <= ACCEPTED_BANK else "exceeds"
    ratio = metrics[f"encounter.{best}.roll_control_ratio"]
    answer = (
        f"Largest roll angles in this {met}: {', '.join(parts)}. {_FLIGHT[best]} {verdict} the "
        f"{math.degrees(ACCEPTED_BANK):.0f} degrees of bank at which an approach is called "
        f"unstable. The {met}'s rolling moment reaches {three(ratio)} times the largest of the "
        "controls"
    )
    # the rating is of wakes
    rated = f"; pilots rated wakes of up to {ACCEPTED_RATIO:g} times as uncritical"
    lead += [answer + (f"{rated}." if met == "wake" else "."), *loads_answer(metrics)]
    if {"encounter.slabs_to_track", "encounter.prediction_error"} <= metrics.keys():
        lead.append(
            f"The track is usable after {metrics['encounter.slabs_to_track']:.0f} accepted fits"
            + _lead_time(metrics)
            + ". The error of the predicted rolling moment is "
            f"{percent(metrics['encounter.prediction_error'])} (rms)."
        )
        lead += _limits(metrics)
    if metrics.get("encounter.withdrawn", 0) > 0:
        lead.append(
            f"The measured roll contradicted the preview, which was withdrawn for "
            f"{three(metrics['encounter.withdrawn'])} s: the autopilot flew."
        )
    return lead + _latency(metrics)


def what_the_lidar_added(metrics: Mapping[str, float], controller: str = "") -> list[str]:
    """The verdict: what the lidar removes beyond the autopilot, of what perfect preview does.

    Nothing without a flight with the lidar. It begins with a preview that came too late, or never.
    Roll is always judged, the load factor where the aircraft rises.
    """
    if "encounter.feedforward.largest_roll" not in metrics:
        return []
    steers = f"{controller} without a preview" if controller else "the autopilot"
    if "encounter.preview_from" not in metrics:
        fits = metrics.get("encounter.accepted_slabs", 0)
        return [
            f"The lidar never had a preview: {fits:.0f} fits of vortices accepted, in "
            f"{metrics.get('encounter.slabs', 0):.0f} slabs. It added nothing to {steers}."
        ]
    sentences = []
    lead = metrics.get("encounter.lead_time", 0.0)
    if lead < 0:
        sentences.append(f"The lidar's first preview came too late by {three(-lead)} s.")
    for quantity, (name, unit, factor) in _JUDGED.items():
        values = [metrics.get(f"encounter.{m}.{quantity}") for m in MODES[1:]]
        scaled = [factor * value for value in values if value is not None]
        if len(scaled) == len(values):
            least = factor * LEAST_REMOVED[quantity]
            fraction = metrics.get(f"encounter.removed_beyond_autopilot.{quantity}")
            sentences.append(_added(name, unit, steers, scaled, least, fraction))
    return [" ".join(sentences)]


_JUDGED = {
    "largest_roll": ("the largest roll angle", " degrees", math.degrees(1)),
    "largest_load_increment": ("the largest change of the load factor", "", 1.0),
}
"""Quantities of the verdict: name, unit, factor to the unit."""


def _added(
    name: str, unit: str, steers: str, values: Sequence[float], least: float, fraction: float | None
) -> str:
    """A sentence on one quantity: autopilot, lidar and perfect preview, in its unit."""
    blind, ours, perfect = values
    change = f"{three(blind)}{unit} with {steers}, {three(ours)} with the lidar"
    if ours > blind + least:
        return f"The lidar makes it worse: {name} is {change}."
    if fraction is None:
        return (
            f"There was nothing for the lidar to add: beyond {steers}, perfect preview removes "
            f"{three(max(0.0, blind - perfect))}{unit} of {name}, less than {three(least)}."
        )
    if fraction <= 0:
        return f"The lidar adds nothing: {name} is {change}."
    verdict = "meets" if fraction >= GOAL else "misses"
    return (
        f"Beyond {steers}, the lidar removes {three(blind - ours)}{unit} of {name}, "
        f"{percent(fraction)} of what perfect preview removes ({three(blind - perfect)}): it "
        f"{verdict} lidar-mi's own goal of {percent(GOAL)}."
    )


def _latency(metrics: Mapping[str, float]) -> list[str]:
    """When the computer delivered its estimates, and what it skipped."""
    if "encounter.latency" not in metrics:
        return []
    sentences = []
    for estimates, name, skipped in (
        ("The vortices", "latency", "skipped_slabs"),
        ("The wind", "wind_latency", "wind_skipped_slabs"),
    ):
        if f"encounter.{name}" in metrics:
            median, most = (three(metrics[f"encounter.{name}{end}"]) for end in ("", "_99"))
            sentences.append(
                f"{estimates} of a slab {'are' if estimates.endswith('s') else 'is'} delivered "
                f"{median} s after its second scan (median; {most} s in 99 %); the computer was "
                f"too busy for {metrics[f'encounter.{skipped}']:.0f} of "
                f"{metrics['encounter.slabs']:.0f} slabs."
            )
    return [" ".join(sentences)]


def _lead_time(metrics: Mapping[str, float]) -> str:
    """When the first preview came, as part of a sentence; nothing where no wake is met."""
    if "encounter.lead_time" not in metrics:
        return ""
    lead = metrics["encounter.lead_time"]
    return (
        f", {three(abs(lead))} s {'after' if lead < 0 else 'before'} the wake is first felt (a "
        "tenth of its largest rolling moment)"
    )


def _of_a_flight(metrics: Mapping[str, float], met: str) -> list[tuple[str, str, str, float]]:
    """Rows of the table of flights that these metrics have."""
    return [
        (key, label.format(met=met), unit, factor)
        for key, label, unit, factor in _OF_A_FLIGHT
        if any(name.endswith(f".{key}") for name in metrics)
    ]


def _limits(metrics: Mapping[str, float]) -> list[str]:
    """Causes of the remaining rolling moment, in a sentence."""
    perfect = metrics.get("encounter.perfect.residual_moment")
    ours = metrics.get("encounter.feedforward.residual_moment")
    if perfect is None or ours is None:
        return []
    return [
        f"Wake and ailerons together have {three(ours)} times the rolling moment of the wake "
        f"with the lidar, and {three(perfect)} times with perfect preview (rms). With perfect "
        "preview the cause is the limits of the ailerons and the controller, which may minimise "
        "the roll angle and not the moment. Only what exceeds this is due to errors of the lidar."
    ]


def _verdict(judged: Judged) -> "Tables":
    from lidar_mi.assessment.report.compliance import compared

    return compared(
        "Requirements, as measured in flight",
        "Range: distance of the aircraft to the slab when its estimate is delivered. "
        "Errors of v and w are those of valid vectors against the truth; a lidar "
        "without Doppler measurements has no u.",
        judged,
    )


def _lost(metrics: Mapping[str, float], mode: str) -> bool:
    return metrics.get(f"encounter.{mode}.departed", 0) > 0


def _cell(value: float | None, factor: float) -> str:
    if value is None:
        return "-"
    scaled = factor * value
    return f"{scaled:.0f}" if scaled == round(scaled) else fixed(scaled)
