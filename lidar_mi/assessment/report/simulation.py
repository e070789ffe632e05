"""Sentences on the simulation's own noise: in the answer, in warnings, with the number."""

from collections.abc import Callable, Mapping

import numpy as np
import xarray as xr

from lidar_mi.assessment.digits import whole_percent
from lidar_mi.assessment.labels import METHOD_NAMES
from lidar_mi.assessment.metrics.campaign import metrics_of
from lidar_mi.assessment.metrics.names import Source
from lidar_mi.assessment.metrics.simulation import largest_parts, simulation_parts
from lidar_mi.schema.experiment import Experiment

_FRACTION = f"{Source.NOISY}.monte_carlo_fraction"
_SAMPLES = f"{Source.BACKSCATTER}.samples_per_beam"
# Above this fraction of the error the remainder, and so the number of samples, is ill-determined.
_LARGEST_PART = 0.9
# Least fraction of the mean square error that is mentioned: 5 % of the rms error.
_LEAST_PART = 0.1


def simulation_sentence(experiment: Experiment, metrics: Mapping[str, float]) -> str:
    """The part of the wind's error by the simulation; empty where it is as small as requested.

    The part of the images' noise for volumes, whose winds are not retrieved again, and where no
    vector is valid with twice this noise.
    """
    if _SAMPLES not in metrics:
        return ""
    allowed = experiment.render.monte_carlo_fraction
    number = f"{metrics[_SAMPLES]:.0f} Monte Carlo samples per beam"
    parts = simulation_parts(metrics, experiment.retrieval.methods)
    if experiment.volume or not parts:
        fraction = metrics.get(_FRACTION, 0.0)
        if experiment.detector and fraction > allowed:
            return (
                "Noise of the images is in part that of the simulation, not of the lidar: with "
                f"{number} it has {fraction:.2g} times the variance of the detector noise."
            )
        if experiment.detector or experiment.volume:
            return ""
        relative = whole_percent(metrics[f"{Source.BACKSCATTER}.mc_relative_error"])
        return (
            "No vector is valid with as much noise again, and noise of the images, "
            f"{relative} of the signal of a pixel, is that of the simulation, not of the lidar "
            f"({number})."
        )
    large = [part for part in parts if part.exceeds(allowed)]
    if not large:
        return ""
    methods = " and ".join(
        f"{whole_percent(part.fraction)} ({METHOD_NAMES[part.method]})" for part in large
    )
    beyond = " beyond two core radii" if large[0].place else ""
    ratio = ""
    if _FRACTION in metrics:
        ratio = f", with {metrics[_FRACTION]:.2g} times the variance of the detector noise"
    return (
        f"Noise of the simulation, which a lidar does not have, causes {methods} of the mean "
        f"square error of v and w{beyond} ({number}{ratio})."
    )


def simulation_remark(experiment: Experiment, metrics: Mapping[str, float]) -> str:
    """The same as a warning, with what to set; empty where the answer has no such sentence."""
    sentence = simulation_sentence(experiment, metrics)
    if not sentence:
        return ""
    text = sentence[0].lower() + sentence[1:].removesuffix(".")
    samples, enough = metrics[_SAMPLES], _sufficient_samples(experiment, metrics)
    allowed = experiment.render.monte_carlo_fraction
    if experiment.render.samples_per_beam == "auto" and experiment.detector:
        times = f"; expected {float(f'{enough / samples:.2g}'):g} times as many" if enough else ""
        return f"render.max_samples: {text}{times}"
    # it is known to two digits
    expected = f"{float(f'{enough:.2g}'):.0f} or more" if enough else "more"
    visible = 0.0 if enough else _texture_visible(experiment, metrics)
    if visible > samples:
        expected += (
            f": with {visible:.2g} its variance is {whole_percent(allowed)} of that of the texture"
        )
    automatic = ", or auto" if experiment.detector else ""
    return f"render.samples_per_beam: {text}; expected {expected}{automatic}"


def samples_of(experiment: Experiment, metrics: Mapping[str, float]) -> str:
    """The number of samples of a run's images, and whether it was chosen."""
    samples = experiment.render.samples_per_beam
    number = f"{metrics.get(_SAMPLES, samples):.4g}" if _SAMPLES in metrics else str(samples)
    chosen = " chosen by the detector noise" if samples == "auto" and _SAMPLES in metrics else ""
    return f"{number} samples per beam{chosen if experiment.detector else ''}"


def points_sentence(dataset: xr.Dataset, place: Callable[[dict[str, int]], str]) -> str:
    """At which points of a campaign the error is in part the simulation's; empty: nowhere.

    dataset: the campaign's. Points without numbers of the simulation have as small a part as asked
        for.
    place: a point's coordinates as text, from its indices.

    Returns
    -------
    str
        With a space at its end.
    """
    parts = largest_parts(metrics_of(dataset))
    if parts is None or not (parts > _LEAST_PART).any():
        return ""
    index = np.unravel_index(np.nanargmax(parts.values), parts.shape)
    where = place({str(dim): int(k) for dim, k in zip(parts.dims, index, strict=True)})
    return (
        f"At {int((parts > _LEAST_PART).sum())} of {parts.size} points, noise of the simulation, "
        f"which a lidar does not have, causes more than {whole_percent(_LEAST_PART)} of the mean "
        f"square error of v and w: up to {whole_percent(float(parts.max()))}"
        f"{f' ({where})' if where else ''}; "
        "render.samples_per_beam: auto or more, or a larger render.max_samples, reduces it. "
    )


def _texture_visible(experiment: Experiment, metrics: Mapping[str, float]) -> float:
    """Samples per beam for the same fraction of the texture's variance; 0: no texture."""
    texture = experiment.wake.texture.rms if experiment.wake else 0.0
    if not texture:
        return 0.0
    ratio = metrics[f"{Source.BACKSCATTER}.mc_relative_error"] / texture
    return metrics[_SAMPLES] * ratio**2 / experiment.render.monte_carlo_fraction


def _sufficient_samples(experiment: Experiment, metrics: Mapping[str, float]) -> float:
    """Samples per beam that suffice; 0: unknown, as nearly all of the error is the simulation's."""
    samples, allowed = metrics[_SAMPLES], experiment.render.monte_carlo_fraction
    if _FRACTION in metrics:
        return samples * metrics[_FRACTION] / allowed
    parts = () if experiment.volume else simulation_parts(metrics, experiment.retrieval.methods)
    largest = max((part.fraction for part in parts), default=1.0)
    return samples * largest / (1 - largest) / allowed if largest < _LARGEST_PART else 0.0
