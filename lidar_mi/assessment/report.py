"""The report of a run: one HTML file that needs nothing else."""

import base64
import math
from collections.abc import Sequence
from importlib.resources import files
from typing import NamedTuple

import jinja2

from .. import __version__
from .cores import Core
from .figures import METHOD_NAMES, Drawn
from .velocities import CENTRES, READERS

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

_DOPPLER_UNITS = {
    "doppler.line_width": "Hz", "doppler.free_spectral_range": "Hz",
    "doppler.velocity_range": "m/s", "doppler.render.largest_error": "m/s",
}  # fmt: skip


class Chapter(NamedTuple):
    """What one instrument of a run tells.

    Attributes
    ----------
    lead : sequence of str
        Paragraphs before the figures.
    drawn : sequence of Drawn
    heading, legend : str
        Of the tables.
    tables : sequence of (title, heads, rows)
        Rows are (name, unit, values as text).
    """

    lead: Sequence[str]
    drawn: Sequence[Drawn]
    heading: str
    legend: str
    tables: Sequence[tuple[str, Sequence[str], Sequence[tuple[str, str, Sequence[str]]]]]


def page(
    name: str, resolved: str, metrics: dict[str, float], chapters: Sequence[Chapter],
    warnings: Sequence[str] = (),
) -> str:  # fmt: skip
    """The report as HTML, pictures embedded, everything named by the user escaped.

    Parameters
    ----------
    name : str
        Of the experiment.
    resolved : str
        The experiment with all defaults, as YAML.
    metrics : dict
        All numbers of the run.
    chapters : sequence of Chapter
    warnings : sequence of str
        What a reader of the results must know.
    """
    environment = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined)
    template = environment.from_string(
        files("lidar_mi.assessment").joinpath("report.html").read_text()
    )
    return template.render(
        name=name,
        version=__version__,
        resolved=resolved,
        metrics={key: _rounded(key, value) for key, value in metrics.items()},
        warnings=warnings,
        chapters=[
            chapter._asdict() | {"pictures": [
                (d.title, d.caption, base64.b64encode(d.path.read_bytes()).decode())
                for d in chapter.drawn
            ]}
            for chapter in chapters
        ],
    )  # fmt: skip


def backscatter_chapter(
    experiment, metrics: dict[str, float], cores: Sequence[Core], drawn: Sequence[Drawn]
) -> Chapter:
    """What the backscatter lidar tells.

    Parameters
    ----------
    experiment : lidar_mi.config.Experiment
    metrics : dict
        From `lidar_mi.backscatter_chain.verdict`.
    """
    lead = [
        "A backscatter lidar looks at a wake twice; cross-flow winds follow from the two images."
    ]
    if cores:
        places = ", ".join(
            f"a vortex at y = {core.y:.1f} m, z = {core.z:.1f} m (core radius {core.radius:.1f} m)"
            for core in cores
        )
        lead.append(f"The true flow holds {places}.")
    return Chapter(
        lead=[*lead, _noise(experiment, metrics)],
        drawn=drawn,
        heading="How good the winds are",
        legend="Valid vectors against the truth at their place and time. Columns: what the winds "
        "were retrieved from. Blurred is the extinction as wide beams see it, without noise: its "
        "difference to the extinction is what the beam's width costs. The last column says how "
        "strong the true wind is there: an error near it means no skill, as no wind at all would "
        "be no worse.",
        tables=list(_tables(experiment, metrics)),
    )


def doppler_chapter(doppler, metrics: dict[str, float], drawn: Sequence[Drawn]) -> Chapter:
    """What the Doppler lidar tells.

    Parameters
    ----------
    doppler : lidar_mi.config.Doppler
    metrics : dict
        From `lidar_mi.fringe_chain`.
    """
    purpose = (
        "A Doppler lidar sends its backscatter through an etalon onto a CCD; the wind along the "
        "line of sight follows from the radii of the rings."
    )
    light = (
        f"A pulse gives {metrics['doppler.photons']:.3g} photons from {doppler.lidar.range:g} m and "
        f"{metrics['doppler.background_photons']:.3g} of sunlight; speckle has "
        f"{metrics.get('doppler.speckle_modes', math.inf):.3g} modes a pixel, read-out "
        f"{doppler.ccd.read_noise:g} photoelectrons of noise."
    )
    rings = (
        f"The line is {metrics['doppler.line_width'] / 1e9:.2f} GHz wide, the etalon's free "
        f"spectral range {metrics['doppler.free_spectral_range'] / 1e9:.2f} GHz, its finesse "
        f"{metrics['doppler.finesse']:.1f}: winds are told apart over "
        f"{metrics['doppler.velocity_range']:.0f} m/s. Without noise, the rendered pictures give "
        f"the true winds to {metrics['doppler.render.largest_error']:.2g} m/s."
    )
    return Chapter(
        lead=[purpose, light, rings],
        drawn=drawn,
        heading="How good the line-of-sight winds are",
        legend="Winds that each method reads from noisy pictures, or from averages of several "
        "(columns), over all speeds. CA: circular averaging; ML: midpoint lines; both, like the "
        "Savitzky-Golay filter, give the innermost ring's radius in emitted and received light. "
        "The bound (Cramer-Rao) is the least standard deviation without bias; its row says nothing "
        "of any method.",
        tables=[
            _doppler_table(doppler.retrieval, centre, metrics)
            for centre in doppler.retrieval.centre
        ],
    )


def _doppler_table(settings, centre, metrics):
    rows = []
    for method in settings.methods:
        for quantity, label in (("std", "standard deviation"), ("bias", "bias")):
            shown = []
            for n in settings.averaged:
                key = f"doppler.{method}.centre_{centre}.averaged_{n}.{quantity}"
                value, error = metrics.get(key), metrics.get(f"{key}_stderr")
                text = "-" if value is None else f"{value:.3g}"
                shown.append(text if error is None else f"{text} \u00b1 {error:.1g}")
            rows.append((f"{READERS[method].replace('$^2$', '^2')}: {label}", "m/s", shown))
    key = f"doppler.bound.centre_{centre}.averaged_{{}}.std"
    rows.append(("bound", "m/s", [f"{metrics[key.format(n)]:.3g}" for n in settings.averaged]))
    heads = [f"{n} picture{'s' * (n > 1)}" for n in settings.averaged]
    return CENTRES[centre], heads, rows


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
    if name.startswith(("rms_", "rmse_", "bias", "p50_", "p90_", "std", "expected_std")):
        unit = "rad" if quantity == "direction" else "m/s"
    elif key in _DOPPLER_UNITS:
        unit = _DOPPLER_UNITS[key]
    elif parent.endswith("_core"):
        unit = "m^2/s" if name == "circulation" else "m"
    else:
        unit = {"timing": "s"}.get(parent, "")
    return f"{value:.4g} {unit}".strip()
