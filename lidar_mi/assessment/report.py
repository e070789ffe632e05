"""The report of a run: one HTML file that needs nothing else."""

import base64
from collections.abc import Sequence
from importlib.resources import files

import jinja2

from .. import __version__
from .cores import Core
from .figures import METHOD_NAMES, Drawn

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
    ("all.rmse_v", "rms error of v, flagged vectors too", "m/s"),
    ("all.rmse_w", "rms error of w, flagged vectors too", "m/s"),
    ("valid_fraction", "share of valid vectors", ""),
)


def page(
    experiment, resolved: str, metrics: dict[str, float], cores: Sequence[Core],
    drawn: Sequence[Drawn], warnings: Sequence[str] = (),
) -> str:  # fmt: skip
    """The report as HTML, pictures embedded, everything named by the user escaped.

    Parameters
    ----------
    experiment : lidar_mi.config.Experiment
    resolved : str
        The experiment with all defaults, as YAML.
    metrics : dict
        From `lidar_mi.experiment.verdict`.
    warnings : sequence of str
        What a reader of the results must know.
    """
    environment = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined)
    template = environment.from_string(
        files("lidar_mi.assessment").joinpath("report.html").read_text()
    )
    return template.render(
        name=experiment.name,
        version=__version__,
        resolved=resolved,
        metrics={key: _rounded(key, value) for key, value in metrics.items()},
        noise=_noise(experiment, metrics),
        warnings=warnings,
        cores=cores,
        tables=list(_tables(experiment, metrics)),
        pictures=[
            (d.title, d.caption, base64.b64encode(d.path.read_bytes()).decode()) for d in drawn
        ],
    )


def _tables(experiment, metrics):
    sources = ["backscatter", "extinction", "extinction_blurred", "extinction_without_texture"]
    if experiment.detector:
        sources.insert(0, "backscatter_noisy")
    for method in experiment.retrieval.methods:
        rows = []
        for key, label, unit in _ROWS:
            values = [metrics.get(f"{source}.{method}.{key}") for source in sources]
            # what zero wind instead of the found one would be off by
            nothing = key.replace("rmse_", "rms_").removeprefix("all.")
            values.append(metrics.get(f"true_wind.{nothing}"))
            shown = ["-" if value is None else f"{value:.3g}" for value in values]
            rows.append((label, unit, shown))
        heads = [source.replace("_", " ") for source in sources]
        yield METHOD_NAMES[method], [*heads, "the true wind itself, rms"], rows


def _noise(experiment, metrics) -> str:
    """What the pictures' noise is made of, in one line."""
    line = (
        "Noise of the first picture, relative to a pixel's light (medians): simulation "
        f"{metrics['backscatter.mc_relative_error']:.2%} "
        f"({experiment.render.samples_per_beam} photons a beam)"
    )
    if not experiment.detector:
        return f"{line}; no detector."
    causes = {"shot": "photons", "speckle": "speckle", "background": "sky", "dark": "dark current",
              "readout": "read-out"}  # fmt: skip
    parts = ", ".join(
        f"{name} {metrics[f'detector.noise.{key}']:.2%}"
        for key, name in causes.items() if metrics.get(f"detector.noise.{key}", 0) > 0
    )  # fmt: skip
    return (
        f"{line}; detector {metrics['detector.noise.all']:.2%} with "
        f"{metrics['detector.signal']:.3g} photoelectrons ({parts})."
    )


def _rounded(key: str, value: float) -> str:
    """A metric with four digits and its unit."""
    *_, parent, name = ("", *key.split("."))
    quantity = name.rpartition("_")[2]
    if name.startswith(("rms_", "rmse_", "bias_", "p50_", "p90_")):
        unit = "rad" if quantity == "direction" else "m/s"
    elif parent.endswith("_core"):
        unit = "m^2/s" if name == "circulation" else "m"
    else:
        unit = {"timing": "s"}.get(parent, "")
    return f"{value:.4g} {unit}".strip()
