"""The figures of a run: an overview, the paper's figures 5 to 11, errors and products.

All of them show the slab from the pilot's view: port (+y) on the left, up (+z) at the top.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.colors import Normalize, TwoSlopeNorm
from matplotlib.figure import Figure

from lidar_mi.assessment.figures.accuracy import error_and_bound, error_by_texture, truth_vectors
from lidar_mi.assessment.figures.panels import (
    Captioned,
    Drawn,
    Progress,
    arrow_scale,
    frame,
    image_panel,
    mark_cores,
    panels_of,
    save_all,
    sheet,
    speed_of,
)
from lidar_mi.assessment.labels import BACKSCATTER, METHOD_NAMES, SOURCE_NAMES
from lidar_mi.assessment.metrics.errors import deviations
from lidar_mi.assessment.metrics.names import Source
from lidar_mi.atmosphere.vortices.cores import Core
from lidar_mi.plots import ARROWS, arrow_length, arrow_stretch


class ObservedAir(Protocol):
    """The true wind, on (z, y), and extinction of the observed air."""

    @property
    def wind(self) -> xr.Dataset:
        """Components v and w, m/s."""

    def image(self, which: int, smooth: bool = False) -> xr.DataArray:
        """Extinction at one of both times, 1/m; ``smooth``: without texture."""


@dataclass(frozen=True)
class Scale:
    """Common settings of all wind maps of a run.

    limit: speed at the end of the colours, m/s.
    length: of its arrow, in distances between arrows.
    y, z: axes of the plane, m.
    """

    limit: float
    length: float
    y: np.ndarray
    z: np.ndarray


def _scale(truth: ObservedAir) -> Scale:
    speed = speed_of(truth.wind["v"], truth.wind["w"])
    # the few nodes of a core must not determine the scale of all others
    limit = float(speed.quantile(0.999)) or 1.0
    length = arrow_length(speed.values, limit)
    return Scale(limit, length, truth.wind["y"].values, truth.wind["z"].values)


_PRODUCTS = {
    "depolarization": (
        "fig14_depolarization",
        "Linear depolarisation ratio",
        "linear depolarisation ratio",
        "Linear depolarisation ratio of the first image, cross- over co-polarised light.",
    ),
    "multiple_scattering_fraction": (
        "fig15_multiple_scattering",
        "Multiple scattering",
        "fraction of multiple scattering",
        "Fraction of the light of the first image that was scattered more than once.",
    ),
}
"""File, title, label and caption of the figure of a product."""


def draw_all(
    folder: Path,
    truth: ObservedAir,
    scans: Sequence[xr.Dataset],
    winds: xr.Dataset,
    cores: Sequence[Core],
    sweep: xr.Dataset,
    log: Progress,
) -> list[Drawn]:
    """Draw every figure of a backscatter run as PNG into ``folder``.

    Winds are those of `lidar_mi.experiment.stages.winds.cross_flow_winds`, errors by texture those
    of `lidar_mi.experiment.stages.texture.texture_sweep`.
    """
    scale, sources = _scale(truth), [str(name) for name in winds["source"].values]
    # with measured images alone there are no winds from extinction to compare with
    compared = Source.EXTINCTION in sources
    ideal, lidar = (Source.EXTINCTION, Source.BACKSCATTER) if compared else (sources[-1],) * 2
    figures: list[tuple[str, str, Captioned | None]] = [
        ("fig00_overview", "Image and retrieved wind", overview(truth, scans, winds, cores)),
        ("fig05_extinction", "Extinction", _extinction(truth)),
        (
            "fig06_wind_from_extinction" if compared else "fig06_wind",
            f"Wind: truth and from the {SOURCE_NAMES[ideal]} pair",
            _wind_and_truth(truth, winds, ideal, cores, scale),
        ),
        (
            "fig07_deviation_from_truth",
            f"Winds from {SOURCE_NAMES[ideal]} against the truth",
            _deviation_maps(winds, ideal, None),
        ),
        ("fig08_backscatter", "Backscatter images", _backscatter(scans)),
        (
            "fig09_backscatter_against_extinction",
            "Backscatter against extinction",
            _image_differences(truth, scans),
        ),
        (
            "fig10_wind_from_backscatter",
            "Wind from the backscatter pair",
            _retrieved(winds, lidar, cores, scale),
        ),
    ]
    if compared:
        changes = _deviation_maps(winds, lidar, ideal)
        title = "Change of the winds by the instrument"
        figures.append(("fig11_deviation_from_extinction_winds", title, changes))
    figures += [
        ("fig12_error_by_texture", "Error and texture", error_by_texture(winds, sweep)),
        ("fig12b_error_and_bound", "Errors and Cramer-Rao bound", error_and_bound(winds)),
        *(
            (file, title, _product(scans[0], name, label, caption))
            for name, (file, title, label, caption) in _PRODUCTS.items()
            if name in scans[0]
        ),
    ]
    drawn = [(name, title, fig) for name, title, fig in figures if fig is not None]
    return save_all(folder, drawn, log)


def _with_valid(winds: xr.Dataset, *sources: str) -> tuple[list[str], str]:
    """Methods with a valid vector from each source, and a sentence on the others.

    Vectors of a method without a valid one are random numbers.
    """
    valid = (winds["flag"].sel(source=list(sources)) == 0).any(("z", "y")).all("source")
    methods = [str(name) for name in winds["algorithm"].values]
    with_valid = [name for name in methods if bool(valid.sel(algorithm=name))]
    without = [METHOD_NAMES[name] for name in methods if name not in with_valid]
    return with_valid, f" No valid vector by {' and '.join(without)}." if without else ""


def _arrows(axes: Axes, wind: xr.Dataset, cores: Sequence[Core], title: str, scale: Scale) -> None:
    """Vectors at their positions, a few dozen across; flagged ones grey, valid ones by speed."""
    every = max(1, round(wind.sizes["y"] / ARROWS))
    step = every * float(wind["y"][1] - wind["y"][0]) if wind.sizes["y"] > 1 else 1.0
    thin = wind.isel(z=slice(every // 2, None, every), y=slice(every // 2, None, every))
    y, z = (np.broadcast_to(thin[f"{a}_vector"], thin["v"].shape).ravel() for a in "yz")
    v, w, flag = (thin[name].values.ravel() for name in ("v", "w", "flag"))
    retrieved = np.isfinite(v) & np.isfinite(w)
    style: dict[str, Any] = {
        "angles": "xy",
        "scale_units": "xy",
        "scale": scale.limit / (scale.length * step),
        "width": 0.0022,
    }
    flagged, valid = retrieved & (flag != 0), retrieved & (flag == 0)
    if flagged.any():
        # no longer than the spacing of the arrows, as most of it is noise
        most = scale.limit / scale.length
        shorter = most / np.maximum(np.hypot(v, w)[flagged], most)
        clipped = v[flagged] * shorter, w[flagged] * shorter
        axes.quiver(y[flagged], z[flagged], *clipped, color="0.75", **style)
    speed = np.hypot(v, w)[valid]
    stretch = arrow_stretch(speed, None, scale.limit / scale.length)
    arrows = axes.quiver(
        y[valid],
        z[valid],
        v[valid] * stretch,
        w[valid] * stretch,
        speed,
        cmap="viridis",
        norm=Normalize(0, scale.limit),
        **style,
    )
    arrow_scale(axes, arrows, scale.limit)
    mark_cores(axes, cores, "crimson")
    frame(axes, scale.y, scale.z, title)
    axes.figure.colorbar(arrows, ax=axes, label="speed / m s$^{-1}$", pad=0.02, extend="max")


def overview(
    truth: ObservedAir, scans: Sequence[xr.Dataset], winds: xr.Dataset, cores: Sequence[Core]
) -> tuple[Figure, str]:
    """First image of the lidar beside the wind retrieved from two, and a caption; as `draw_all`."""
    scale = _scale(truth)
    detected = "Y_noisy" in scans[0]
    source = Source.NOISY if detected else Source.BACKSCATTER
    methods, none = _with_valid(winds, source)
    figure, panels = panels_of(1 + bool(methods))
    first = scans[0]["Y_noisy" if detected else "Y"] * 1e6
    norm = _span(first) if detected else _bright([first])
    image_panel(
        panels[0],
        first,
        "backscatter, $t_1$",
        BACKSCATTER,
        "both" if detected else "max",
        norm=norm,
        cmap="cividis",
    )
    noise = " with photon, sky, dark and speckle noise of one pulse per beam" if detected else ""
    if not methods:
        return figure, f"The first backscatter image{noise}.{none}"
    wind = winds.sel(source=source, algorithm=methods[0])
    _arrows(panels[1], wind, cores, "wind retrieved from two such images", scale)
    return figure, (
        f"The first backscatter image{noise}, and the cross-flow wind retrieved from it and the "
        f"second one by {METHOD_NAMES[methods[0]]}; grey vectors are flagged{_crosses(cores)}."
    )


def _crosses(cores: Sequence[Core]) -> str:
    """The part of the caption about the vortices; empty without any."""
    return ", red crosses mark the true cores" if cores else ""


def _at_both_times(
    fields: Sequence[xr.DataArray], label: str, extend: str, norm: Normalize, colours: str
) -> Figure:
    figure, axes = sheet(1, 2)
    for k, field in enumerate(fields):
        image_panel(axes[0, k], field, f"$t_{k + 1}$", label, extend, norm=norm, cmap=colours)
    return figure


def _extinction(truth: ObservedAir) -> Captioned:
    fields = [truth.image(k) * 1e3 for k in (0, 1)]
    label = "extinction / km$^{-1}$"
    return _at_both_times(fields, label, "max", _bright(fields), "cividis"), (
        "Extinction coefficient of the slab at t1 and t2, averaged over the gate's depth. "
        "The change in dt is hardly visible, but is detected by the retrieval."
    )


def _wind_and_truth(
    truth: ObservedAir, winds: xr.Dataset, source: str, cores: Sequence[Core], scale: Scale
) -> Captioned:
    methods, none = _with_valid(winds, source)
    figure, (vectors, colours, *panels) = panels_of(2 + len(methods))
    first = winds.sel(source=source).isel(algorithm=0)
    _arrows(vectors, truth_vectors(first), cores, "true wind", scale)
    image_panel(
        colours,
        speed_of(truth.wind["v"], truth.wind["w"]),
        "speed of the true wind",
        "speed / m s$^{-1}$",
        extend="max",
        norm=Normalize(0, scale.limit),
        cmap="viridis",
    )
    _retrieved_into(panels, winds, source, methods, cores, scale)
    return figure, (
        "The true cross-flow wind and its speed, and the winds retrieved from the "
        f"{SOURCE_NAMES[source]} pair. Grey vectors are flagged{_crosses(cores)}.{none}"
    )


def _retrieved_into(
    panels: Sequence[Axes],
    winds: xr.Dataset,
    source: str,
    methods: Sequence[str],
    cores: Sequence[Core],
    scale: Scale,
) -> None:
    for axis, method in zip(panels, methods, strict=True):
        wind = winds.sel(source=source, algorithm=method)
        _arrows(axis, wind, cores, f"{METHOD_NAMES[method]}, {source}", scale)


def _retrieved(
    winds: xr.Dataset, source: str, cores: Sequence[Core], scale: Scale
) -> Captioned | None:
    methods, none = _with_valid(winds, source)
    if not methods:
        return None
    figure, panels = panels_of(len(methods))
    _retrieved_into(panels, winds, source, methods, cores, scale)
    return figure, (
        f"Winds retrieved from the rendered {source} pair, unfiltered: grey vectors are flagged"
        f"{_crosses(cores)}.{none}"
    )


def _deviation_maps(winds: xr.Dataset, source: str, reference: str | None) -> Captioned | None:
    methods, none = _with_valid(winds, source, *([reference] if reference else []))
    if not methods:
        return None
    figure, axes = sheet(len(methods), 2)
    for row, method in zip(axes, methods, strict=True):
        wind = winds.sel(source=source, algorithm=method)
        compared = (
            truth_vectors(wind)
            if reference is None
            else winds.sel(source=reference, algorithm=method)
        )
        # flagged vectors do not characterise the method
        error = deviations(wind, compared).where((wind["flag"] == 0) & (compared["flag"] == 0))
        limit = _upper(abs(error["speed"]), 0.99) or 1.0
        # directions differ by half a turn at most
        largest = min(_upper(abs(error["direction"]), 0.99) or 1.0, np.pi)
        for axis, name, unit, end, colours in (
            (row[0], "speed", "m s$^{-1}$", limit, "RdBu_r"),
            (row[1], "direction", "rad", largest, "PuOr_r"),
        ):
            # visible where there is no vector
            axis.set_facecolor("0.7")
            title, norm = f"{METHOD_NAMES[method]}: {name}", TwoSlopeNorm(0, -end, end)
            label = f"{name} / {unit}"
            image_panel(axis, error[name], title, label, "both", norm=norm, cmap=colours)
    against = "the true wind" if reference is None else f"winds from {reference}"
    return figure, (
        f"Deviations of winds from {source} against {against}: speed (left) and direction "
        f"(right). Grey: flagged, or no displacement.{none}"
    )


def _bright(fields: Sequence[xr.DataArray]) -> Normalize:
    """From 0, or from the darkest pixels where none is near 0, to the brightest.

    Single bright pixels must not determine the scale.
    """
    low = min(float(field.quantile(0.001)) for field in fields)
    high = max(_upper(field, 0.999) for field in fields)
    return Normalize(low if low > 0.3 * high else 0, high)


def _upper(field: xr.DataArray, fraction: float) -> float:
    """The value that this fraction of the finite values does not exceed; 0 if there is none."""
    values = field.values[np.isfinite(field.values)]
    return float(np.quantile(values, fraction)) if values.size else 0.0


def _backscatter(scans: Sequence[xr.Dataset]) -> Captioned:
    fields = [scan["Y"] * 1e6 for scan in scans]
    return _at_both_times(fields, BACKSCATTER, "max", _bright(fields), "cividis"), (
        "Rendered backscatter, normalised for range, gate length and the environment's "
        "transmittance; without the noise of a detector."
    )


def _product(scan: xr.Dataset, name: str, label: str, caption: str) -> Captioned:
    """A product of a scan's first gate, and its standard error."""
    figure, axes = sheet(1, 2)
    first = scan.isel(gate=0)
    image_panel(
        axes[0, 0], first[name], "$t_1$", label, "both", norm=_span(first[name]), cmap="cividis"
    )
    stderr = first[f"{name}_stderr"]
    bound = scan.attrs[f"{name}_stderr_is_bound"]
    kind = "upper bound of the standard error" if bound else "standard error"
    image_panel(axes[0, 1], stderr, kind, label, "both", norm=_span(stderr), cmap="cividis")
    return figure, (
        f"{caption} Right: {kind} of each pixel, from the Monte Carlo samples. Colours span the "
        "middle 99 % of the pixels."
    )


def _span(field: xr.DataArray) -> Normalize:
    """The middle 99 % of the values: single bright pixels must not determine the colours."""
    low, high = (float(field.quantile(q)) for q in (0.005, 0.995))
    # equal values get one colour, independent of rounding
    half = max((high - low) / 2, 1e-5 * abs(high + low), 1e-9)
    return Normalize((low + high) / 2 - half, (low + high) / 2 + half)


def _image_differences(truth: ObservedAir, scans: Sequence[xr.Dataset]) -> Captioned:
    differences = []
    for k, scan in enumerate(scans):
        field = truth.image(k).interp(y=scan["y"], z=scan["z"])
        # over their means, as units and gain differ
        differences.append(scan["Y"] / scan["Y"].mean() - field / field.mean())
    limit = max(float(abs(d).quantile(0.999)) for d in differences)
    norm, label = TwoSlopeNorm(0, -limit, limit), "difference of relative values"
    return _at_both_times(differences, label, "both", norm, "RdBu_r"), (
        "Backscatter over its mean minus extinction over its mean: the beam's width smooths "
        "sharp structure, Monte Carlo noise adds grain, and a pulse longer than the slab's depth "
        "adds light from the air before and behind it."
    )
