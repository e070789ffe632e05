"""The report of a run: one self-contained HTML file."""

import base64
import math
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from importlib.resources import files
from typing import Any, NamedTuple

import jinja2
from markupsafe import Markup

from lidar_mi.assessment.digits import percent, whole_percent
from lidar_mi.assessment.figures.panels import Drawn
from lidar_mi.assessment.labels import METHOD_NAMES
from lidar_mi.assessment.metrics.units import unit_of
from lidar_mi.assessment.report.coherent_lidar import coherent_lidar_rows
from lidar_mi.assessment.report.simulation import samples_of
from lidar_mi.io.images import as_webp, panel_cuts
from lidar_mi.schema.encounter import Encounter
from lidar_mi.schema.experiment import Experiment
from lidar_mi.units import shown

# Models of an aircraft that are not JSBSim's, as the report calls them.
_MODELS = {
    "roll": "an aircraft that only rolls",
    "heave": "an aircraft that rolls, pitches and moves vertically",
}

NumberTable = tuple[str, Sequence[str], Sequence[tuple[str, str, Sequence[str]]]]
"""(title, heads, rows), a row being (name, unit, values as text)."""


class Tables(NamedTuple):
    """Tables under one heading."""

    heading: str
    legend: str
    tables: Sequence[NumberTable]


class Film(NamedTuple):
    """A video, or frames with a slider.

    frames (sequence of (bytes, str)): WebP images and what each shows; of a video, the one shown
        before it plays.
    seconds: for which each is shown.
    video: MP4.
    animation: name of a file beside the report, for browsers that do not play the video.
    """

    title: str
    caption: str
    frames: Sequence[tuple[bytes, str]]
    seconds: float
    video: bytes | None = None
    animation: str = ""


class Picture(NamedTuple):
    """A figure as a data URL, its panel boundaries as fractions of the width, and its alt text."""

    title: str
    caption: str
    source: str
    cuts: str
    alt: str


class Chapter(NamedTuple):
    """The part of the report on one instrument.

    lead: paragraphs before the figures.
    verdict: compliance with the requirements; placed on the first page.
    vectors: `vector_map.map_data` with a ``title``, for an interactive map of the vectors.
    film: placed before the figures.
    """

    title: str
    lead: Sequence[str]
    drawn: Sequence[Drawn]
    numbers: Tables
    verdict: Tables | None = None
    vectors: dict[str, Any] | None = None
    film: Film | None = None


def page(
    experiment: Experiment,
    resolved: str,
    versions: Mapping[str, str],
    metrics: Mapping[str, float],
    chapters: Sequence[Chapter],
    warnings: Sequence[str] = (),
    answer: Sequence[str] = (),
    data: Sequence[str] = (),
) -> str:
    """The report as HTML, with embedded images; all text of the user is escaped.

    resolved: the experiment with all defaults, as YAML.
    versions: of lidar-mi and the libraries.
    metrics: all numbers of the run.
    warnings: those that matter for the results.
    answer: from `lidar_mi.assessment.report.answer.answer`.
    data: names of files beside the report, which links to them.
    """
    with ThreadPoolExecutor() as pool:
        drawn = [figure for chapter in chapters for figure in chapter.drawn]
        images = dict(zip(drawn, pool.map(picture, drawn), strict=True))
    pictures = [[images[figure] for figure in chapter.drawn] for chapter in chapters]
    first = next((figures for figures in pictures if figures), [])
    overview, first[:1] = first[:1], []
    return template("report.html").render(
        name=experiment.name,
        simulated=simulated(experiment, versions, metrics),
        resolved=resolved,
        metrics={key: f"{value:.4g} {unit_of(key)}".strip() for key, value in metrics.items()},
        answer=answer,
        overview=overview,
        data=data,
        warnings=[text.rstrip(".") for text in warnings],
        script=script("vector_map.js"),
        film_script=script("film.js"),
        stacking=script("panels.js"),
        chapters=[
            chapter._asdict()
            | {"images": figures, "film": _packed(chapter.film) if chapter.film else None}
            for chapter, figures in zip(chapters, pictures, strict=True)
        ],
    )


def template(name: str) -> jinja2.Template:
    """One of the templates of this package; inserted text is escaped."""
    return jinja2.Environment(
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        loader=jinja2.PackageLoader("lidar_mi.assessment.report", ""),
    ).get_template(name)


def _packed(film: Film) -> dict[str, Any]:
    """A film as the template takes it; shown first is the frame in the middle."""
    frames = [
        {"data": base64.b64encode(data).decode(), "caption": text} for data, text in film.frames
    ]
    middle = len(frames) // 2
    return {
        "title": film.title,
        "caption": film.caption,
        "frames": frames,
        "middle": middle,
        "first": f"data:image/webp;base64,{frames[middle]['data']}",
        "now": frames[middle]["caption"],
        "milliseconds": round(1000 * film.seconds),
        "video": base64.b64encode(film.video).decode() if film.video else "",
        "animation": film.animation,
    }


def picture(figure: Drawn) -> Picture:
    """A figure for a page: lossless WebP, two thirds of its PNG."""
    source = f"data:image/webp;base64,{base64.b64encode(as_webp(figure.path)).decode()}"
    cuts = " ".join(f"{cut:.4f}" for cut in panel_cuts(figure.path))
    alt = f"{figure.title}. {figure.alt_text}".strip()
    return Picture(figure.title, figure.caption, source, cuts, alt)


def script(name: str) -> Markup:
    """A program of this package, for a page."""
    return Markup(files("lidar_mi.assessment.report").joinpath(name).read_text())


def simulated(
    experiment: Experiment, versions: Mapping[str, str], metrics: Mapping[str, float]
) -> list[tuple[str, str]]:
    """What was simulated, as (name, text): wake, instruments, seed, versions."""
    rows = []
    if experiment.imaged_wake:
        wake, scan, lidar = experiment.imaged_wake, experiment.scan, experiment.lidar
        if wake.vortex_pair:
            pair = wake.vortex_pair
            model = pair.model.replace("_", "-").title()
            flow = (
                f"{model} vortices, circulation {pair.circulation:g} m²/s, "
                f"separation {pair.separation:g} m, core radius {pair.core_radius:g} m"
            )
        elif wake.turbine:
            rotor = wake.turbine
            flow = (
                f"wake of a turbine of {rotor.diameter:g} m, thrust coefficient {rotor.thrust:g}, "
                f"in wind of {rotor.wind_speed:g} m/s with a turbulence of "
                f"{percent(rotor.turbulence)}"
            )
        else:
            time = "" if wake.time is None else f" at {wake.time:.15g} s"
            flow = f"{wake.file}{time}, {wake.spacing:g} m grid"
        texture = "no texture added"
        if wake.texture.rms:
            scale = f"outer scale {wake.texture.outer_scale:g} m"
            texture = f"texture of {percent(wake.texture.rms)} rms, {scale}"
        rows.append(("wake", f"{flow}; {texture}"))
        flight = experiment.encounter
        steps = f"{shown(experiment.platform.dt, 's')} apart"
        platform = "platform", f"{shown(experiment.platform.speed, 'm/s')}, images {steps}"
        rows.append(_flight(flight) if flight else platform)
        distance = flight.look_ahead if flight else scan.range
        beam = (
            f"{shown(lidar.wavelength, 'nm')}, {shown(lidar.pulse_energy, 'mJ')}, "
            f"divergence {shown(lidar.divergence_full, 'mrad')}, "
            f"telescope of {2 * lidar.aperture_radius:g} m; "
            f"slab of {scan.thickness:g} m from {distance:g} m"
        )
        detector = "with the noise of a detector" if experiment.detector else "no detector"
        rows.append(("backscatter lidar", f"{beam}; {detector}"))
        air, render = experiment.scattering, experiment.render
        light = (
            f"scattering by {air.aerosol or air.table or air.phase.replace('_', ' ')}, orders up "
            f"to {render.max_order}, {samples_of(experiment, metrics)}, {render.variant}"
        )
        molecules = metrics.get("backscatter.fraction.molecules", 0.0)
        if molecules:
            light += f"; {whole_percent(molecules)} of the backscatter by molecules of the air"
        rows.append(("light", light))
        chosen = experiment.volume or experiment.retrieval
        methods = ", ".join(METHOD_NAMES[name] for name in chosen.methods)
        rows.append(("winds by", methods))
    if experiment.coherent:
        rows += coherent_lidar_rows(experiment.coherent, experiment.wake)
    if experiment.fringes:
        doppler = experiment.fringes.lidar
        beam = (
            f"{shown(doppler.wavelength, 'nm')}, {shown(doppler.pulse_energy, 'mJ')}, "
            f"{doppler.range_bin:g} m at {doppler.range:g} m, in air of {doppler.altitude:g} m "
            "altitude"
        )
        if doppler.pressure is not None and doppler.temperature is not None:
            beam += f" ({doppler.pressure / 100:.4g} hPa, {doppler.temperature:.4g} K)"
        rows.append(("Doppler lidar", beam))
    if experiment.sensor:
        lines = experiment.sensor.directions
        combined = (
            f"{lines.columns} x {lines.rows} lines of sight of {experiment.sensor.pulses} pulses, "
            f"v and w by {METHOD_NAMES[experiment.sensor.method]}"
        )
        rows.append(("both together", combined))
    rows.append(("seed", str(experiment.seed)))
    rows.append(("versions", ", ".join(f"{name} {version}" for name, version in versions.items())))
    return rows


def _flight(encounter: Encounter) -> tuple[str, str]:
    path, model = encounter.path, encounter.aircraft.model
    kind = _MODELS.get(model, f"JSBSim's {model}")
    wake = encounter.air is None or encounter.air.wake
    crossing = f"crossing the wake at {math.degrees(path.crossing_angle):.3g} degrees "
    return "flight", (
        f"{kind}, at {shown(path.speed, 'm/s')}, {crossing if wake else ''}on a path of "
        f"{math.degrees(path.climb_angle):+.3g} degrees; {encounter.rate:g} slabs a second"
    )
