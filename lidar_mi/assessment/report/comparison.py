"""Several variants of one experiment side by side: settings that differ, and results."""

from collections.abc import Iterator, Mapping, Sequence
from itertools import product
from typing import TYPE_CHECKING

from lidar_mi import __version__
from lidar_mi.assessment.digits import fixed, three
from lidar_mi.assessment.labels import METHOD_NAMES
from lidar_mi.assessment.metrics.names import RENDERED, Source, ring_key
from lidar_mi.assessment.metrics.velocities import CENTRES, READERS
from lidar_mi.io.yaml import to_yaml
from lidar_mi.retrieval.method_names import ImageMethod, RingCentre, RingMethod, VolumeMethod
from lidar_mi.units import usual

if TYPE_CHECKING:
    from lidar_mi.assessment.figures.panels import Drawn


# rows of the comparison: key, name, unit; {}: a method's winds
_ROWS = (
    ("backscatter.mc_relative_error", "Monte Carlo noise of a pixel over its signal, median", "%"),
    ("detector.signal", "photoelectrons of a pixel, median", ""),
    ("detector.noise.all", "noise of a pixel over its signal, median", "%"),
    ("backscatter.multiple_scattering_fraction", "fraction of multiple scattering", "%"),
    ("{}.outside_cores.rmse_u", "rms error of u beyond two core radii", "m/s"),
    ("{}.outside_cores.rmse_v", "rms error of v beyond two core radii", "m/s"),
    ("{}.outside_cores.rmse_w", "rms error of w beyond two core radii", "m/s"),
    ("{}.valid_fraction", "fraction of valid vectors", "%"),
    ("true_wind.outside_cores.rms_u", "the true u itself, rms", "m/s"),
    ("true_wind.outside_cores.rms_v", "the true v itself, rms", "m/s"),
    ("true_wind.outside_cores.rms_w", "the true w itself, rms", "m/s"),
    ("doppler.photons", "Doppler lidar: photons of a pulse", ""),
    ("sensor.outside_cores.rmse_u", "both lidars: rms error of u beyond two core radii", "m/s"),
    ("sensor.outside_cores.rmse_v", "both lidars: v", "m/s"),
    ("sensor.outside_cores.rmse_w", "both lidars: w", "m/s"),
    ("sensor.triples.rmse_u", "lines of sight alone: u", "m/s"),
    ("sensor.triples.rmse_v", "lines of sight alone: v", "m/s"),
    ("sensor.triples.rmse_w", "lines of sight alone: w", "m/s"),
    ("sensor.rmse_v_los", "rms error of a line-of-sight velocity", "m/s"),
    ("sensor.doppler.photons_per_direction", "Doppler lidar: photons per direction", ""),
    ("sensor.doppler.hazard_distance", "Doppler lidar: hazard distance, unaided", "m"),
    ("coherent.noise", "coherent lidar: noise of a velocity, median", "m/s"),
    ("coherent.vortices.valid_fraction", "coherent lidar: slices with valid vortices", "%"),
    ("coherent.vortices.circulation_error", "median error of the circulation", "%"),
    ("coherent.vortices.place_error", "median error of the place, of the separation", "%"),
    ("coherent.winds.rmse_u", "coherent lidar: rms error of the wind to the east", "m/s"),
    ("coherent.winds.rmse_v", "to the north", "m/s"),
    ("coherent.winds.rmse_w", "upwards", "m/s"),
    ("safety.permissible_exposure", "permissible exposure by a pulse", "J/m²"),
    ("safety.hazard_distance", "hazard distance of a beam, unaided", "m"),
    ("safety.aided_hazard_distance", "hazard distance of a beam, with binoculars", "m"),
    ("safety.scan_hazard_distance", "hazard distance of the whole scan, unaided", "m"),
    ("safety.scan_power", "average power of the scan", "W"),
)

# of the Doppler lidar's velocities from single pulses: quantity of `velocity_metrics`, name
_RETRIEVALS = (
    ("bias", "bias"),
    ("std", "standard deviation"),
    ("retrieved_fraction", "fraction retrieved"),
)


_METHODS = dict.fromkeys((*ImageMethod, *VolumeMethod))


def flat(settings: Mapping[str, object], prefix: str = "") -> dict[str, object]:
    """Nested sections as dotted keys; lists are values."""
    dotted: dict[str, object] = {}
    for key, value in settings.items():
        name = f"{prefix}{key}"
        dotted |= flat(value, f"{name}.") if isinstance(value, Mapping) else {name: value}
    return dotted


def differences(settings: Mapping[str, Mapping[str, object]]) -> dict[str, list[object]]:
    """Keys in which the variants differ, with each one's value (None: has no such key)."""
    keys = dict.fromkeys(key for variant in settings.values() for key in variant if key != "name")
    values = {key: [variant.get(key) for variant in settings.values()] for key in keys}
    return {key: row for key, row in values.items() if any(value != row[0] for value in row)}


def page(
    name: str,
    settings: Mapping[str, Mapping[str, object]],
    metrics: Mapping[str, Mapping[str, float]],
    drawn: "Sequence[Drawn]",
    answers: Mapping[str, Sequence[str]],
) -> str:
    """Settings, metrics and figures of the variants of a study, as self-contained HTML.

    Settings are nested sections with all defaults, by variant; answers are those of
    `lidar_mi.assessment.report.answer.answer`.
    """
    from lidar_mi.assessment.report.page import picture, script, template

    changed = [
        (key, "", [setting(value) for value in values])
        for key, values in differences({key: flat(each) for key, each in settings.items()}).items()
    ]
    legend = (
        "Errors are those of valid vectors against the truth; an error near the true wind's own "
        "rms means no skill. A variant without a number has a dash."
    )
    return template("comparison.html").render(
        name=name,
        version=__version__,
        variants=list(settings),
        answers=answers,
        images=[picture(each) for each in drawn],
        stacking=script("panels.js"),
        tables=[
            ("Results", legend, list(results(metrics))),
            ("Settings that differ", "In SI units; a dash: the variant has no such key.", changed),
        ],
        resolved=to_yaml(dict(settings)),
    )


def results(metrics: Mapping[str, Mapping[str, float]]) -> Iterator[tuple[str, str, list[str]]]:
    """Results of variants: (name, unit, one text per variant), where any of them has a number."""
    for pattern, label, unit in _ROWS:
        if "{}" not in pattern:
            yield from _row(metrics, pattern, label, unit)
            continue
        for source, method in product(RENDERED, _METHODS):
            key = pattern.format(f"{source}.{method}")
            yield from _row(metrics, key, f"{_method_and_source(source, method)}: {label}", unit)
    for method, centre in product(RingMethod, RingCentre):
        for measure, label in _RETRIEVALS:
            unit = "%" if measure == "retrieved_fraction" else "m/s"
            title = f"one pulse by {READERS[method]}, {CENTRES[centre]}: {label}"
            yield from _row(metrics, ring_key(method, centre, 1, measure), title, unit)


def _row(
    metrics: Mapping[str, Mapping[str, float]], key: str, label: str, unit: str
) -> Iterator[tuple[str, str, list[str]]]:
    """A metric of all variants, if any of them has it."""
    values = [variant.get(key) for variant in metrics.values()]
    if any(value is not None for value in values):
        yield label, unit, _cells(values, unit)


def _cells(values: Sequence[float | None], unit: str) -> list[str]:
    def cell(value: float) -> str:
        if unit == "m/s":
            return fixed(value)
        return three(100 * value if unit == "%" else value)

    return ["-" if value is None else cell(value) for value in values]


def _method_and_source(source: str, method: str) -> str:
    title = METHOD_NAMES[method]
    return f"{title}, with the detector's noise" if source == Source.NOISY else title


def setting(value: object) -> str:
    """An experiment's value as text, in the units that people use; a dash: there is none."""
    if value is None:
        return "-"
    if isinstance(value, list):
        return ", ".join(map(setting, value))
    number, _, unit = str(value).partition(" ")
    try:
        return usual(float(number), unit)
    except ValueError:
        return str(value)
