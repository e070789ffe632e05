"""The chapter of a report on wind in three dimensions."""

from collections.abc import Iterator, Mapping, Sequence

from lidar_mi.assessment.digits import fixed, in_row, percent
from lidar_mi.assessment.figures.panels import Drawn
from lidar_mi.assessment.labels import METHOD_NAMES, SOURCE_NAMES
from lidar_mi.assessment.metrics.names import Source, wind_key
from lidar_mi.assessment.metrics.volume import COMPONENTS
from lidar_mi.assessment.report.page import Chapter, NumberTable, Tables
from lidar_mi.assessment.report.simulation import samples_of
from lidar_mi.schema.experiment import Experiment


def volume_chapter(
    experiment: Experiment, metrics: Mapping[str, float], drawn: Sequence[Drawn]
) -> Chapter:
    """Volumes of the backscatter lidar and the winds retrieved from them."""
    scan = experiment.scan
    purpose = (
        f"A backscatter lidar scans {scan.gate_count} slabs of "
        f"{scan.thickness / scan.gate_count:g} m twice; the wind in three dimensions follows from "
        "the two volumes."
    )
    noise = (
        "Noise of the simulation in a voxel, relative to its signal (median): "
        f"{percent(metrics['backscatter.mc_relative_error'])} "
        f"({samples_of(experiment, metrics)}); "
        f"{'with the noise of a detector' if experiment.detector else 'no detector'}."
    )
    numbers = Tables(
        heading="Accuracy of the winds in three dimensions",
        legend="Valid vectors against the truth at their position. The true wind's own rms is "
        "given with the errors: an error near it means no skill.",
        tables=list(_tables(experiment, metrics)),
    )
    return Chapter("Wind in three dimensions", [purpose, noise], drawn, numbers)


def _tables(experiment: Experiment, metrics: Mapping[str, float]) -> Iterator[NumberTable]:
    sources = [Source.BACKSCATTER, *([Source.NOISY] if experiment.detector else [])]
    for source in sources:
        for method in experiment.volume.methods if experiment.volume else ():
            rows = []
            for key, label, unit in (
                ("rmse_{}", "rms error", "m/s"),
                ("outside_cores.rmse_{}", "rms error beyond two core radii", "m/s"),
                ("all.rmse_{}", "rms error, including flagged vectors", "m/s"),
                ("bias_{}", "bias", "m/s"),
                ("stderr_{}", "rms standard error, as stated", "m/s"),
                ("normalised_error_variance_{}", "variance of normalised errors", ""),
                ("coverage_68_{}", "within one standard error", "%"),
            ):
                values = [metrics.get(wind_key(source, method, key.format(n))) for n in COMPONENTS]
                rows.append((label, unit, in_row(values, unit)))
            strength = [fixed(metrics[f"true_wind.rms_{name}"]) for name in COMPONENTS]
            rows.append(("the true wind itself, rms", "m/s", strength))
            valid = metrics[wind_key(source, method, "valid_fraction")]
            name = METHOD_NAMES[method]
            title = f"{SOURCE_NAMES[source]}, {name}: {percent(valid)} of the vectors are valid"
            yield title, list(COMPONENTS), rows
