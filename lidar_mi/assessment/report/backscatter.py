"""The backscatter lidar's chapter of a report."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from lidar_mi.assessment.digits import in_row, percent, three
from lidar_mi.assessment.figures.panels import Drawn
from lidar_mi.assessment.labels import METHOD_NAMES, SOURCE_NAMES
from lidar_mi.assessment.metrics.names import Source, has_no_skill, wind_key
from lidar_mi.assessment.metrics.requirements import Judged
from lidar_mi.assessment.report.compliance import compliance
from lidar_mi.assessment.report.page import Chapter, NumberTable, Tables
from lidar_mi.assessment.report.simulation import samples_of
from lidar_mi.atmosphere.vortices.cores import Core
from lidar_mi.schema.experiment import Experiment

# rows of the table of results: key, name, unit
_ROWS = (
    ("rmse_v", "rms error of v", "m/s"),
    ("rmse_w", "rms error of w", "m/s"),
    ("bias_v", "bias of v", "m/s"),
    ("bias_w", "bias of w", "m/s"),
    ("rmse_speed", "rms error of speed", "m/s"),
    ("p50_direction", "median error of direction", "rad"),
    ("outside_cores.rmse_v", "rms error of v beyond two core radii", "m/s"),
    ("outside_cores.rmse_w", "rms error of w beyond two core radii", "m/s"),
    ("all.rmse_v", "rms error of v, including flagged vectors", "m/s"),
    ("all.rmse_w", "rms error of w, including flagged vectors", "m/s"),
    ("stderr_v", "rms standard error of v, as stated", "m/s"),
    ("stderr_w", "rms standard error of w, as stated", "m/s"),
    ("valid_fraction", "fraction of valid vectors", "%"),
)


def backscatter_chapter(
    experiment: Experiment,
    metrics: Mapping[str, float],
    cores: Sequence[Core],
    drawn: Sequence[Drawn],
    judged: Judged = (),
    vectors: dict[str, Any] | None = None,
) -> Chapter:
    """Images and cross-flow winds of the backscatter lidar.

    metrics: from `lidar_mi.experiment.measure.measure`.
    judged (sequence of (RequirementTable, list of Finding)): of this lidar alone; empty: no
        requirements, or it is one of two.
    vectors: from `vector_map.map_data`.
    """
    lead = ["A backscatter lidar scans a wake twice; cross-flow winds follow from the two images."]
    if experiment.wake and experiment.wake.turbine:
        lead.append("The wake is that of a turbine; most of its wind is u, along the axis.")
    elif cores:
        places = ", ".join(
            f"a vortex at y = {core.y:z.1f} m, z = {core.z:z.1f} m "
            f"(core radius {core.radius:.1f} m)"
            for core in cores
        )
        lead.append(f"The true flow has {places}.")
    else:
        lead.append("No vortex core in the true flow.")
    numbers = Tables(
        heading="Accuracy of the cross-flow winds",
        legend="Valid vectors against the truth at their position and time. Columns: data that the "
        "winds were retrieved from. Blurred is the extinction averaged over the beam's width, "
        "without noise: its difference to the extinction is the effect of the beam's width. The "
        "last column is the rms of the true wind there: an error near it means no skill, as zero "
        "wind would be no worse.",
        tables=list(_tables(experiment, metrics)),
    )
    if vectors:
        vectors = {"title": "The wind from the backscatter pair, vector by vector"} | vectors
    return Chapter(
        "The backscatter lidar",
        [*lead, _noise(experiment, metrics)],
        drawn,
        numbers,
        compliance(
            judged,
            experiment.platform.speed,
            "Errors of v and w are rms errors of valid vectors beyond two core radii, by the first "
            "method that has valid vectors.",
        ),
        vectors=vectors,
    )


def _tables(experiment: Experiment, metrics: Mapping[str, float]) -> Iterator[NumberTable]:
    sources = [
        *([Source.NOISY] if experiment.detector else []),
        Source.BACKSCATTER,
        Source.EXTINCTION,
        Source.BLURRED,
        Source.WITHOUT_TEXTURE,
    ]
    for method in experiment.retrieval.methods:
        rows = []
        for key, label, unit in _ROWS:
            values = [metrics.get(wind_key(source, method, key)) for source in sources]
            # the error of zero wind
            nothing = key.replace("rmse_", "rms_").removeprefix("all.")
            values.append(metrics.get(f"true_wind.{nothing}"))
            if any(value is not None for value in values):
                rows.append((label, unit, in_row(values, unit)))
        unskilled = [has_no_skill(metrics, source, method) for source in sources]
        if any(unskilled):
            rows.append(("verdict", "", ["no skill" if none else "-" for none in [*unskilled, 0]]))
        heads = [SOURCE_NAMES[source] for source in sources]
        yield METHOD_NAMES[method], [*heads, "true wind, rms"], rows


def _noise(experiment: Experiment, metrics: Mapping[str, float]) -> str:
    """The components of the images' noise, in one line."""
    line = (
        "Noise of the first image, relative to a pixel's signal (medians): simulation "
        f"{percent(metrics['backscatter.mc_relative_error'])} "
        f"({samples_of(experiment, metrics)})"
    )
    if not experiment.detector:
        return f"{line}; no detector."
    causes = {
        "shot": "photons",
        "speckle": "speckle",
        "background": "sky",
        "dark": "dark current",
        "readout": "read-out",
    }
    parts = ", ".join(
        f"{name} {percent(metrics[f'detector.noise.{key}'])}"
        for key, name in causes.items()
        if metrics.get(f"detector.noise.{key}", 0) >= 5e-5
    )
    return (
        f"{line}; detector {percent(metrics['detector.noise.all'])} with "
        f"{three(metrics['detector.signal'])} photoelectrons ({parts or 'each below 0.01 %'})."
    )
