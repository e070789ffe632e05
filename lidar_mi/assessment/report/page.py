"""The report of a run: one HTML file that needs nothing else."""

import base64
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from importlib.resources import files
from pathlib import Path
from typing import NamedTuple

import jinja2
from markupsafe import Markup

from lidar_mi.assessment.figures.backscatter import METHOD_NAMES, SOURCE_NAMES, Drawn
from lidar_mi.assessment.metrics.cores import Core
from lidar_mi.assessment.metrics.velocities import CENTRES, PEAK_READERS, READERS
from lidar_mi.assessment.report.digits import fixed, in_row, percent, three, with_error
from lidar_mi.io.images import as_webp
from lidar_mi.retrieval.vortices.pair import MEANING

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
    ("valid_fraction", "share of valid vectors", "%"),
)

_DOPPLER_UNITS = {
    "doppler.line_width": "Hz",
    "doppler.free_spectral_range": "Hz",
    "doppler.velocity_range": "m/s",
    "doppler.render.largest_error": "m/s",
}

_VORTEX_UNITS = {
    name: units.replace(" s-1", "/s").replace("m2", "m²") for name, (units, _) in MEANING.items()
} | {"flow_error": "m/s"}


class Tables(NamedTuple):
    """Tables under one heading; each is (title, heads, rows), a row (name, unit, values as text)."""

    heading: str
    legend: str
    tables: Sequence[tuple[str, Sequence[str], Sequence[tuple[str, str, Sequence[str]]]]]


class Chapter(NamedTuple):
    """What one instrument of a run tells.

    Attributes
    ----------
    title : str
    lead : sequence of str
        Paragraphs before the figures.
    drawn : sequence of Drawn
    numbers : Tables
    verdict : Tables, optional
        Whether what is asked for is fulfilled; stands before all chapters' numbers.
    vectors : dict, optional
        `vector_map.map_data` with a ``title``, for a map to be looked at vector by vector.
    """

    title: str
    lead: Sequence[str]
    drawn: Sequence[Drawn]
    numbers: Tables
    verdict: Tables | None = None
    vectors: dict | None = None


def page(
    experiment,
    resolved: str,
    versions: Mapping[str, str],
    metrics: Mapping[str, float],
    chapters: Sequence[Chapter],
    warnings: Sequence[str] = (),
) -> str:
    """The report as HTML, pictures embedded, everything named by the user escaped.

    Parameters
    ----------
    experiment : lidar_mi.experiment.schema.Experiment
    resolved : str
        The experiment with all defaults, as YAML.
    versions : mapping
        Of lidar-mi and the libraries.
    metrics : mapping
        All numbers of the run.
    chapters : sequence of Chapter
    warnings : sequence of str
        What a reader of the results must know.
    """
    with ThreadPoolExecutor() as pool:
        drawn = [figure for chapter in chapters for figure in chapter.drawn]
        pictures = dict(zip(drawn, pool.map(lambda figure: embedded(figure.path), drawn)))
    return template("report.html").render(
        name=experiment.name,
        simulated=simulated(experiment, versions),
        resolved=resolved,
        metrics={key: _rounded(key, value) for key, value in metrics.items()},
        warnings=[text.rstrip(".") for text in warnings],
        script=Markup(files("lidar_mi.assessment.report").joinpath("vector_map.js").read_text()),
        chapters=[
            chapter._asdict()
            | {"pictures": [(d.title, d.caption, pictures[d]) for d in chapter.drawn]}
            for chapter in chapters
        ],
    )


def template(name: str) -> jinja2.Template:
    """One of the pages of this package; whatever is put into it is escaped."""
    return jinja2.Environment(
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        loader=jinja2.PackageLoader("lidar_mi.assessment.report", ""),
    ).get_template(name)


def embedded(path: Path) -> str:
    """A picture as the text that a page holds it by: lossless WebP, two thirds of its PNG."""
    return f"data:image/webp;base64,{base64.b64encode(as_webp(path)).decode()}"


def simulated(experiment, versions: Mapping[str, str]) -> list[tuple[str, str]]:
    """What was simulated, as (name, text): wake, instruments, seed, versions."""
    rows = []
    if experiment.wake:
        wake, scan, lidar = experiment.wake, experiment.scan, experiment.lidar
        if wake.vortex_pair:
            pair = wake.vortex_pair
            flow = (
                f"{pair.model.replace('_', ' ')} vortices, circulation {pair.circulation:g} m²/s, "
                f"separation {pair.separation:g} m, core radius {pair.core_radius:g} m"
            )
        elif wake.turbine:
            rotor = wake.turbine
            flow = (
                f"wake of a turbine of {rotor.diameter:g} m, thrust coefficient {rotor.thrust:g}, in wind "
                f"of {rotor.wind_speed:g} m/s with a turbulence of {percent(rotor.turbulence)}"
            )
        else:
            when = "" if wake.time is None else f" at {wake.time:g} s"
            flow = f"{wake.file}{when}, {wake.spacing:g} m grid"
        texture = "no texture added"
        if wake.texture.rms:
            texture = f"texture of {percent(wake.texture.rms)} rms, outer scale {wake.texture.outer_scale:g} m"
        rows.append(("wake", f"{flow}; {texture}"))
        platform = experiment.platform
        rows.append(("platform", f"{platform.speed:g} m/s, pictures {platform.dt:g} s apart"))
        beam = (
            f"{lidar.wavelength * 1e9:.5g} nm, {lidar.pulse_energy * 1e3:g} mJ, divergence "
            f"{lidar.divergence_full * 1e3:g} mrad, telescope of {2 * lidar.aperture_radius:g} m; slab "
            f"of {scan.thickness:g} m from {scan.range:g} m"
        )
        detector = "with the noise of a detector" if experiment.detector else "no detector"
        rows.append(("backscatter lidar", f"{beam}; {detector}"))
        air, render = experiment.scattering, experiment.render
        light = (
            f"scattering by {air.aerosol or air.table or air.phase.replace('_', ' ')}, orders up to "
            f"{render.max_order}, {render.samples_per_beam} photons a beam, {render.variant}"
        )
        rows.append(("light", light))
        chosen = experiment.volume or experiment.retrieval
        methods = ", ".join(METHOD_NAMES.get(name, name) for name in chosen.methods)
        rows.append(("winds by", methods))
    if experiment.doppler:
        lidar = experiment.doppler.lidar
        beam = (
            f"{lidar.wavelength * 1e9:.5g} nm, {lidar.pulse_energy * 1e3:g} mJ, {lidar.range_bin:g} m "
            f"at {lidar.range:g} m, in air of {lidar.altitude:g} m altitude"
        )
        rows.append(("Doppler lidar", beam))
    if experiment.sensor:
        scan = experiment.sensor.directions
        both = (
            f"{scan.columns} x {scan.rows} lines of sight of {experiment.sensor.pulses} pulses, v and "
            f"w by {METHOD_NAMES[experiment.sensor.method]}"
        )
        rows.append(("both together", both))
    rows.append(("seed", str(experiment.seed)))
    rows.append(("versions", ", ".join(f"{name} {version}" for name, version in versions.items())))
    return rows


def backscatter_chapter(
    experiment,
    metrics: dict[str, float],
    cores: Sequence[Core],
    drawn: Sequence[Drawn],
    vectors: dict | None = None,
) -> Chapter:
    """What the backscatter lidar tells.

    Parameters
    ----------
    experiment : lidar_mi.experiment.schema.Experiment
    metrics : dict
        From `lidar_mi.experiment.stages.backscatter.verdict`.
    vectors : dict, optional
        From `vector_map.map_data`.
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
    else:
        lead.append("No vortex is found in the true flow.")
    numbers = Tables(
        heading="How good the cross-flow winds are",
        legend="Valid vectors against the truth at their place and time. Columns: what the winds "
        "were retrieved from. Blurred is the extinction as wide beams see it, without noise: its "
        "difference to the extinction is what the beam's width costs. The last column says how "
        "strong the true wind is there: an error near it means no skill, as no wind at all would "
        "be no worse.",
        tables=list(_tables(experiment, metrics)),
    )
    if vectors:
        vectors = {"title": "The wind from the backscatter pair, vector by vector"} | vectors
    return Chapter(
        "The backscatter lidar",
        [*lead, _noise(experiment, metrics)],
        drawn,
        numbers,
        vectors=vectors,
    )


def doppler_chapter(doppler, metrics: dict[str, float], drawn: Sequence[Drawn]) -> Chapter:
    """What the Doppler lidar tells.

    Parameters
    ----------
    doppler : lidar_mi.experiment.schema.Doppler
    metrics : dict
        From `lidar_mi.experiment.stages.fringes`.
    """
    purpose = (
        "A Doppler lidar sends its backscatter through an etalon onto a CCD; the wind along the "
        "line of sight follows from the radii of the rings."
    )
    modes = metrics.get("doppler.speckle_modes")
    speckle = f"speckle has {three(modes)} modes a pixel" if modes else "there is no speckle"
    light = (
        f"A pulse gives {three(metrics['doppler.photons'])} photons from {doppler.lidar.range:g} m and "
        f"{three(metrics['doppler.background_photons'])} of sunlight; {speckle}, read-out "
        f"{doppler.ccd.read_noise:g} photoelectrons of noise."
    )
    rings = (
        f"The line is {metrics['doppler.line_width'] / 1e9:.2f} GHz wide, the etalon's free "
        f"spectral range {metrics['doppler.free_spectral_range'] / 1e9:.2f} GHz, its finesse "
        f"{metrics['doppler.finesse']:.1f}: winds are told apart over "
        f"{metrics['doppler.velocity_range']:.0f} m/s. Without noise, the rendered pictures give "
        f"the true winds to {metrics['doppler.render.largest_error']:.2g} m/s."
    )
    numbers = Tables(
        heading="How good the line-of-sight winds are",
        legend="Winds that each method reads from noisy pictures, or from averages of several "
        f"(columns), over all speeds, with standard errors. {_abbreviations(doppler.retrieval.methods)}"
        "The bound (Cramér-Rao) is the least standard deviation without bias; its row says nothing "
        "of any method.",
        tables=[
            _doppler_table(doppler.retrieval, centre, metrics)
            for centre in doppler.retrieval.centre
        ],
    )
    return Chapter("The Doppler lidar", [purpose, light, rings], drawn, numbers)


def _abbreviations(methods: Sequence[str]) -> str:
    """What the names of those methods mean that read the peaks of the innermost ring."""
    names = {"ca": "CA: circular averaging", "ml": "ML: midpoint lines"}
    used = [text for key, text in names.items() if any(m.partition("_")[0] == key for m in methods)]
    if not set(methods) & set(PEAK_READERS):
        return ""
    return "; ".join([*used, "peaks are those of the innermost ring, emitted and received"]) + ". "


def _doppler_table(settings, centre, metrics):
    rows = []
    for method in settings.methods:
        for quantity, label in (("std", "standard deviation"), ("bias", "bias")):
            shown = []
            for n in settings.averaged:
                key = f"doppler.{method}.centre_{centre}.averaged_{n}.{quantity}"
                value, error = metrics.get(key), metrics.get(f"{key}_stderr")
                known = "-" if value is None else fixed(value)
                shown.append(known if error is None else with_error(value, error))
            rows.append((f"{READERS[method]}: {label}", "m/s", shown))
    key = f"doppler.bound.centre_{centre}.averaged_{{}}.std"
    rows.append(("bound", "m/s", [fixed(metrics[key.format(n)]) for n in settings.averaged]))
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
            rows.append((label, unit, in_row(values, unit)))
        heads = [SOURCE_NAMES[source] for source in sources]
        yield METHOD_NAMES[method], [*heads, "true wind, rms"], rows


def _noise(experiment, metrics) -> str:
    """What the pictures' noise is made of, in one line."""
    line = (
        "Noise of the first picture, relative to a pixel's light (medians): simulation "
        f"{percent(metrics['backscatter.mc_relative_error'])} "
        f"({experiment.render.samples_per_beam} photons a beam)"
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


def _rounded(key: str, value: float) -> str:
    """A metric with four digits and its unit."""
    *_, parent, name = ("", *key.split("."))
    quantity = name.rpartition("_")[2]
    described = _VORTEX_UNITS.get(name.removesuffix("_stderr"))
    if name.startswith(("rms_", "rmse_", "bias", "p50_", "p90_", "std", "expected_std")):
        unit = "rad" if quantity == "direction" else "m/s"
    elif key in _DOPPLER_UNITS:
        unit = _DOPPLER_UNITS[key]
    elif key.startswith("vortex.") and described:
        unit = described
    elif parent.endswith("_core"):
        unit = "m²/s" if name == "circulation" else "m"
    else:
        unit = {"timing": "s"}.get(parent, "")
    return f"{value:.4g} {unit}".strip()
