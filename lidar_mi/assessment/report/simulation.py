"""What is said of the simulation's own noise: in the answer, in warnings, beside the number."""

from collections.abc import Mapping

from lidar_mi.assessment.labels import METHOD_NAMES
from lidar_mi.assessment.metrics.names import Source
from lidar_mi.assessment.metrics.simulation import simulation_parts
from lidar_mi.assessment.report.digits import whole_percent

_FRACTION = f"{Source.NOISY}.monte_carlo_fraction"
_SAMPLES = f"{Source.BACKSCATTER}.samples_per_beam"
# Of an error: what the rest of it is, and so the number of samples, follows from a small difference
_NEARLY_ALL = 0.9


def simulation_sentence(experiment, metrics: Mapping[str, float]) -> str:
    """Which part of the wind's error is the simulation's; empty where it is as small as asked for.

    Of volumes, whose winds are not retrieved once more, which part of the noise it is.

    Parameters
    ----------
    experiment : lidar_mi.experiment.schema.Experiment
    metrics : mapping of str to float
        Of a run.
    """
    if _SAMPLES not in metrics:
        return ""
    allowed = experiment.render.monte_carlo_fraction
    number = f"{metrics[_SAMPLES]:.0f} Monte Carlo samples per beam"
    if experiment.volume:
        fraction = metrics.get(_FRACTION, 0.0)
        if fraction <= allowed:
            return ""
        return (
            f"The noise of the volumes is in part the simulation's, not the lidar's: with {number} "
            f"it has {fraction:.2g} of the variance of the detector's."
        )
    parts = simulation_parts(metrics, experiment.retrieval.methods)
    large = [part for part in parts if part.exceeds(allowed)]
    if not large:
        return ""
    named = " and ".join(
        f"{whole_percent(part.fraction)} by {METHOD_NAMES[part.method]}" for part in large
    )
    beyond = " beyond two core radii" if large[0].place else ""
    beside = ""
    if _FRACTION in metrics:
        beside = f", whose noise has {metrics[_FRACTION]:.2g} of the variance of the detector's"
    return (
        f"Of the mean square error of v and w{beyond}, noise of the simulation, not of the lidar, "
        f"makes {named} ({number}{beside})."
    )


def simulation_remark(experiment, metrics: Mapping[str, float]) -> str:
    """The same as a warning, with what to set; empty where the answer has no such sentence."""
    sentence = simulation_sentence(experiment, metrics)
    if not sentence:
        return ""
    text = sentence[0].lower() + sentence[1:].removesuffix(".")
    samples, needed = metrics[_SAMPLES], _needed(experiment, metrics)
    if experiment.render.samples_per_beam == "auto" and experiment.detector:
        times = f"; expected {needed / samples:.2g} times as much" if needed else ""
        return f"render.max_samples: {text}{times}"
    expected = f"{needed:.2g} or more" if needed else "more"
    automatic = ", or auto" if experiment.detector else ""
    return f"render.samples_per_beam: {text}; expected {expected}{automatic}"


def samples_of(experiment, metrics: Mapping[str, float]) -> str:
    """The number of samples of a run's images, and whether it was chosen."""
    asked = experiment.render.samples_per_beam
    number = f"{metrics.get(_SAMPLES, asked):.4g}" if _SAMPLES in metrics else str(asked)
    chosen = " chosen by the detector's noise" if asked == "auto" and _SAMPLES in metrics else ""
    return f"{number} samples per beam{chosen if experiment.detector else ''}"


def _needed(experiment, metrics: Mapping[str, float]) -> float:
    """Samples per beam that are enough; 0: not known, as hardly any error is of something else."""
    samples, allowed = metrics[_SAMPLES], experiment.render.monte_carlo_fraction
    if _FRACTION in metrics:
        return samples * metrics[_FRACTION] / allowed
    parts = simulation_parts(metrics, experiment.retrieval.methods)
    largest = max((part.fraction for part in parts), default=1.0)
    return samples * largest / (1 - largest) / allowed if largest < _NEARLY_ALL else 0.0
