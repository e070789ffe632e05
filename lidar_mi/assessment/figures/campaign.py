"""Figures of a campaign: maps, lines with bands over members, knobs of a sample, compromises."""

from collections.abc import Callable, Mapping, Sequence
from itertools import cycle
from typing import Any, NamedTuple

import numpy as np
import xarray as xr
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.axis import Axis as MatplotlibAxis
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LogNorm, Normalize, to_hex, to_rgb
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patheffects import withStroke
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter, NullLocator
from scipy.interpolate import RegularGridInterpolator

from lidar_mi.assessment.digits import three
from lidar_mi.assessment.figures.linked import Mark, as_svg, panel, wrapped
from lidar_mi.assessment.figures.panels import one_to_one
from lidar_mi.assessment.metrics.campaign import MEMBER, Interval, over_members
from lidar_mi.assessment.metrics.sensitivity import SobolIndices

FAILED, ABSENT, DOT = "#a4161a", "#e4e4e4", "#3b6ea5"
_FEW = 6
"""Most values of an axis with a tick each, and numbers in the cells."""
COLOURS = ("#1f5fa8", "#c2571a", "#2c7a3f", "#8a3a8f", "#7a6200", "#4a4a4a", "#b0306a", "#0d7f86")


class Points(NamedTuple):
    """What every point is, over the dimensions of the sweep or the sample.

    number: 0, 1, ...
    failed: whether no member of it is done.
    """

    number: xr.DataArray
    failed: xr.DataArray
    link: xr.DataArray


class Axis(NamedTuple):
    """A knob as an axis; labels are at 0, 1, ..."""

    name: str
    label: str
    logarithmic: bool
    labels: tuple[str, ...] = ()

    def places(self, values: np.ndarray) -> np.ndarray:
        """Where values are along the axis."""
        if self.labels:
            return np.array([self.labels.index(str(value)) for value in values], dtype=float)
        return np.asarray(values, dtype=float)


def colour_scale(values: xr.DataArray) -> Normalize:
    """From the smallest to the largest of all panels, by factors beyond a ratio of 20."""
    finite = values.values[np.isfinite(values.values)]
    low, high = (float(finite.min()), float(finite.max())) if finite.size else (0.0, 1.0)
    if low > 0 and high > 20 * low:
        return LogNorm(low, high)
    return Normalize(low, high if high > low else low + (abs(low) or 1.0))


Limits = Mapping[str, xr.DataArray]
"""Margins over the knobs, by the name of the limit; negative where it is not met."""


def draw_map(
    title: str,
    values: xr.DataArray,
    x: Axis,
    y: Axis,
    points: Points,
    label: str,
    norm: Normalize,
    limits: Limits | None = None,
) -> str:
    """A metric over two knobs, and where it is at its limits.

    Failed points are crossed out, those without a value grey. Cells of a small grid have numbers.
    """
    figure, axes = panel(title)
    values = values.transpose(y.name, x.name)
    cmap = colormaps["viridis"]
    marks = _cells(
        axes,
        values,
        x,
        y,
        points,
        lambda v: to_hex(cmap(norm(v))),
        lambda v: f"{label}: {three(v)}",
        three,
    )
    bar = figure.colorbar(ScalarMappable(norm, cmap), ax=axes, label=wrapped(label))
    if isinstance(norm, LogNorm):
        _plain_decades(bar.ax.yaxis)
    handles = []
    for (name, margin), style in zip((limits or {}).items(), cycle(("-", "--", ":")), strict=False):
        if _boundary(
            axes, margin.transpose(y.name, x.name), x, y, **_OVER_COLOURS, linestyles=style
        ):
            handles.append(Line2D([], [], color="k", ls=style, label=name))
    _legend_below(figure, handles)
    return as_svg(axes, marks, f"{label}, {title}{_span(values)}")


def draw_requirements(
    title: str, margins: Mapping[str, Interval], x: Axis, y: Axis, points: Points
) -> str:
    """Where all requirements are met (green), and the boundary of each with its uncertainty."""
    figure, axes = panel(title)
    order = (y.name, x.name)
    means = {name: margin.mean.transpose(*order) for name, margin in margins.items()}
    worst = xr.concat(list(means.values()), "row", coords="minimal", compat="override").min(
        "row", skipna=False
    )
    marks = _cells(
        axes,
        worst.transpose(*order),
        x,
        y,
        points,
        lambda v: "#cfe8d3" if v >= 0 else "#f3d5cf",
        lambda v: f"smallest margin {100 * v:+.0f} %",
        lambda v: f"{100 * v:+.0f} %",
    )
    handles = []
    for (name, margin), colour in zip(margins.items(), COLOURS * 3, strict=False):
        if not _boundary(axes, means[name], x, y, colors=colour, linewidths=1.8):
            continue
        for end in (margin.low, margin.high):
            style = {"linewidths": 0.8, "linestyles": "--"}
            _boundary(axes, end.transpose(*order), x, y, colors=colour, **style)
        handles.append(Line2D([], [], color=colour, label=name))
    _legend_below(figure, handles)
    met = f"all rows met at {int((worst >= 0).sum())} of {int(np.isfinite(worst).sum())} points"
    return as_svg(axes, marks, f"{title}, {met}")


_OVER_COLOURS = {
    "colors": "k",
    "linewidths": 1.8,
    # seen on every colour of a map
    "path_effects": [withStroke(linewidth=3.6, foreground="w")],
}


def _boundary(axes: Axes, margin: xr.DataArray, x: Axis, y: Axis, **style: Any) -> bool:
    """Draw where a margin (y, x) is 0; false where it nowhere is."""
    values = margin.values
    if min(values.shape) < 2 or not _crosses_zero(values):
        return False
    places = (x.places(margin[x.name].values), y.places(margin[y.name].values))
    finer = _finer(places[0], x.logarithmic), _finer(places[1], y.logarithmic)
    between = _between(values, places, finer, (x.logarithmic, y.logarithmic))
    effects = style.pop("path_effects", None)
    drawn = axes.contour(*finer, np.ma.masked_invalid(between), [0.0], **style)
    drawn.set_path_effects(effects)
    return True


def _legend_below(figure: Figure, handles: Sequence[Line2D]) -> None:
    """Beside the map: inside it would hide boundaries."""
    if handles:
        figure.legend(
            handles=handles, fontsize=8, loc="outside lower center", ncols=3, frameon=False
        )


def _span(values: xr.DataArray) -> str:
    """From the smallest to the largest value, as words after a label."""
    finite = values.values[np.isfinite(values.values)]
    return f": {three(float(finite.min()))} to {three(float(finite.max()))}" if finite.size else ""


MET, UNMET = "#2c7a3f", FAILED


def draw_margins(
    title: str,
    worst: np.ndarray,
    x: Axis,
    across: np.ndarray,
    y: Axis,
    up: np.ndarray,
    points: Points,
) -> str:
    """Points of a sample in the plane of two knobs: green where all requirements are met."""
    figure, axes = panel(title)
    axes.plot(across, up, ",", alpha=0)
    marks = []
    for k, value in enumerate(worst):
        finite = np.isfinite(value)
        missing = "failed" if bool(points.failed.values[k]) else "no value"
        text = f"smallest margin {100 * value:+.0f} %" if finite else missing
        colour = (MET if value >= 0 else UNMET) if finite else ABSENT
        marks.append(_dot(across[k], up[k], text, colour, points, k))
    _scale(axes, x, y)
    axes.grid(alpha=0.3)
    handles = [
        Line2D([], [], ls="", marker="o", color=colour, label=name)
        for name, colour in (("all rows met", MET), ("some row not met", UNMET))
    ]
    figure.legend(handles=handles, fontsize=8, loc="outside lower center", ncols=2, frameon=False)
    return as_svg(axes, marks, f"{title}, all rows met at {int((worst >= 0).sum())} points")


def draw_lines(
    title: str,
    groups: Mapping[str, tuple[xr.DataArray, Points]],
    x: Axis,
    label: str,
    limit: float | None = None,
) -> str:
    """A metric along one knob, a line per group: mean of the members, band of 68 % of them.

    A limit is marked.
    """
    _, axes = panel(title)
    marks, means = [], []
    for (name, (values, points)), colour in zip(groups.items(), COLOURS * 3, strict=False):
        mean = over_members(values).mean
        place = x.places(mean[x.name].values)
        line = "--" if x.labels else "-"
        axes.plot(place, mean.values, line, lw=1.3, color=colour, label=name or None)
        if MEMBER in values.dims and x.name != MEMBER:
            low, high = values.quantile([0.16, 0.84], MEMBER).transpose("quantile", x.name).values
            axes.fill_between(place, low, high, color=colour, alpha=0.18, lw=0)
        means.append(mean.values)
        marks += [
            _dot(p, v, f"{label}: {three(v)}", colour, points, {x.name: k})
            for k, (p, v) in enumerate(zip(place, mean.values, strict=True))
            if np.isfinite(v)
        ]
    low = _lowest(means)
    for _, points in groups.values():
        for k in np.flatnonzero(points.failed.values):
            p = x.places(points.failed[x.name].values)[k]
            axes.plot(p, low, "x", color=FAILED, ms=7, mew=2, clip_on=False)
            marks.append(_dot(p, low, "failed", FAILED, points, {x.name: int(k)}))
    _scale(axes, x, None)
    for values, _ in list(groups.values())[:1]:
        _ticks(axes.xaxis, x, x.places(values[x.name].values))
    axes.set_ylabel(wrapped(label))
    _by_factors(axes, means)
    if limit is not None:
        axes.axhline(limit, color=FAILED, ls="--", lw=1, label="limit")
    if len(groups) > 1 or limit is not None:
        axes.legend(fontsize=8)
    axes.grid(alpha=0.3)
    return as_svg(axes, marks, f"{label}, {title}")


def draw_scatter(
    title: str,
    x: Axis,
    across: np.ndarray,
    y: Axis,
    up: np.ndarray,
    points: Points,
    front: np.ndarray | None = None,
    line: np.ndarray | None = None,
) -> str:
    """Two numbers of every point of a sample; failed points are at the lower edge.

    Points of a front (bool per point) are coloured, those of a line joined.
    """
    _, axes = panel(title)
    across, up = np.asarray(across, dtype=float), np.asarray(up, dtype=float)
    finite = np.isfinite(across) & np.isfinite(up)
    axes.plot(across[finite], up[finite], ",", alpha=0)
    _by_factors(axes, [up])
    low = _lowest([up[finite]])
    marks = []
    for k in range(len(up)):
        if finite[k]:
            colour = COLOURS[1] if front is not None and front[k] else DOT
            marks.append(_dot(across[k], up[k], f"{y.label}: {three(up[k])}", colour, points, k))
        elif np.isfinite(across[k]):
            failed = bool(points.failed.values[k])
            text = "failed" if failed else f"{y.label}: no value"
            if failed:
                axes.plot(across[k], low, "x", color=FAILED, ms=6, clip_on=False)
            marks.append(_dot(across[k], low, text, FAILED if failed else ABSENT, points, k))
    if line is not None:
        chosen = np.flatnonzero(line)
        order = chosen[np.argsort(across[chosen])]
        axes.plot(across[order], up[order], color=COLOURS[1], lw=1)
    _scale(axes, x, None)
    axes.set_ylabel(wrapped(y.label))
    axes.grid(alpha=0.3)
    return as_svg(axes, marks, f"{y.label} against {x.label}")


def draw_distributions(
    title: str, groups: Mapping[str, np.ndarray], label: str, limit: float | None = None
) -> str:
    """Fractions of values up to each value, a line per group; a limit is marked.

    Values that differ by factors are on a logarithmic axis.
    """
    figure, axes = panel(title)
    for (name, values), colour in zip(groups.items(), COLOURS, strict=False):
        axes.ecdf(values, color=colour, label=name)
    if limit is not None:
        axes.axvline(limit, color=FAILED, ls="--", lw=1, label="limit")
    low, high = (end([end(values) for values in groups.values()]) for end in (np.min, np.max))
    if low > 0 and high > 30 * low:
        axes.set(xscale="log")
        _plain_decades(axes.xaxis)
    else:
        axes.set(xlim=(0, None))
    axes.set(xlabel=wrapped(label, 55), ylabel="fraction of flights")
    axes.grid(alpha=0.3)
    figure.legend(fontsize=8, loc="outside lower center", ncols=4, frameon=False)
    return as_svg(axes, [], f"{label}, {title}")


def draw_against(
    label: str, x: tuple[str, np.ndarray], groups: Mapping[str, np.ndarray], limit: float
) -> str:
    """Values of several groups against those of one, on logarithmic axes; a limit is marked."""
    figure, axes = panel("")
    name, across = x
    for (group, values), colour in zip(groups.items(), COLOURS[1:], strict=False):
        axes.plot(across, values, "o", ms=3.5, alpha=0.7, color=colour, label=group)
    one_to_one(axes, name, logarithmic=True)
    axes.axhline(limit, color=FAILED, ls="--", lw=1, label="limit")
    axes.set(xlabel=f"{label}, {name}", ylabel=label)
    for side in (axes.xaxis, axes.yaxis):
        _plain_decades(side)
    figure.legend(fontsize=8, loc="outside lower center", ncols=4, frameon=False)
    return as_svg(axes, [], f"{label} against {name}")


def draw_indices(title: str, indices: SobolIndices, labels: Mapping[str, str], of: str) -> str:
    """First-order and total indices of every knob for a metric, with their intervals."""
    _, axes = panel(title)
    rows = np.arange(len(indices.knobs), dtype=float)[::-1]
    for shift, name, values, interval, colour in (
        (0.17, "first order", indices.first, indices.first_interval, COLOURS[0]),
        (-0.17, "total", indices.total, indices.total_interval, COLOURS[1]),
    ):
        axes.barh(rows + shift, values, 0.3, color=colour, label=name, alpha=0.8)
        axes.hlines(rows + shift, *interval.T, color="k", lw=1)
    axes.set_yticks(rows, [labels[name] for name in indices.knobs])
    axes.set(xlim=(0, 1), xlabel="fraction of the variance")
    axes.legend(fontsize=8)
    return as_svg(axes, [], f"{title} of {of}")


def _finer(places: np.ndarray, logarithmic: bool) -> np.ndarray:
    """Places along an axis, sixteen steps from each to the next in the axis's scale."""
    at = np.log(places) if logarithmic else places
    steps = np.arange(16 * (len(at) - 1) + 1) / 16
    inner = np.interp(steps, np.arange(len(at)), at)
    return np.exp(inner) if logarithmic else inner


def _between(
    values: np.ndarray,
    places: tuple[np.ndarray, np.ndarray],
    finer: tuple[np.ndarray, np.ndarray],
    logarithmic: tuple[bool, bool],
) -> np.ndarray:
    """Values (y, x) between the points, linear in the scale of each axis."""
    (across, up), (fine_x, fine_y) = (
        [np.log(axis) if log else axis for axis, log in zip(axes, logarithmic, strict=True)]
        for axes in (places, finer)
    )
    interpolate = RegularGridInterpolator((up, across), values)
    return interpolate(tuple(np.meshgrid(fine_y, fine_x, indexing="ij")))


def _crosses_zero(values: np.ndarray) -> bool:
    """Whether known values have both signs."""
    finite = values[np.isfinite(values)]
    return bool(finite.size and finite.min() < 0 <= finite.max())


def _cells(
    axes: Axes,
    values: xr.DataArray,
    x: Axis,
    y: Axis,
    points: Points,
    colour: Callable[[float], str],
    text: Callable[[float], str],
    number: Callable[[float], str],
) -> list[Mark]:
    """Cells of a map around its points, (y, x); with their numbers where there are few."""
    across, up = (axis.places(values[axis.name].values) for axis in (x, y))
    edges = _edges(across, x.logarithmic), _edges(up, y.logarithmic)
    marks = []
    failed = points.failed.transpose(y.name, x.name).values
    for i, j in np.ndindex(*values.shape):
        value = float(values.values[i, j])
        fill = ABSENT if not np.isfinite(value) else colour(value)
        words = text(value) if np.isfinite(value) else "failed" if failed[i, j] else "no value"
        at = {y.name: i, x.name: j}
        marks.append(
            Mark(
                int(points.number.isel(at)),
                (float(edges[0][j]), float(edges[0][j + 1])),
                (float(edges[1][i]), float(edges[1][i + 1])),
                words,
                fill,
                str(points.link.isel(at).values),
            )
        )
        if failed[i, j]:
            axes.plot(across[j], up[i], "x", color=FAILED, ms=9, mew=2)
        elif max(values.shape) <= _FEW:
            # on the cell's colour, where a boundary crosses it
            axes.text(
                float(across[j]),
                float(up[i]),
                number(value) if np.isfinite(value) else "no value",
                color="k" if _luminance(fill) > 0.4 else "w",
                ha="center",
                va="center",
                bbox={"facecolor": fill, "edgecolor": "none", "pad": 1},
            )
    # how many numbers an axis has follows from its limits
    axes.set_xlim(edges[0].min(), edges[0].max())
    axes.set_ylim(edges[1].min(), edges[1].max())
    _scale(axes, x, y)
    _ticks(axes.xaxis, x, across)
    _ticks(axes.yaxis, y, up)
    return marks


def _luminance(colour: str) -> float:
    """From 0 (black) to 1 (white), Rec. 709 on the values as displayed."""
    return float(np.dot(to_rgb(colour), (0.2126, 0.7152, 0.0722)))


def _ticks(side: MatplotlibAxis, axis: Axis, places: np.ndarray) -> None:
    """Ticks at the values themselves, where they are few and their numbers do not overlap."""
    at = np.sort(np.log(places) if axis.logarithmic else places)
    if axis.labels or not 1 < len(at) <= _FEW or np.diff(at).min() < np.ptp(at) / 10:
        return
    side.set_ticks(places, [three(float(value)) for value in places])
    side.set_minor_locator(NullLocator())


def _dot(
    x: float, y: float, text: str, colour: str, points: Points, at: int | dict[str, int]
) -> Mark:
    if isinstance(at, int):
        at = {str(dim): at for dim in points.number.dims}
    number, link = int(points.number.isel(at)), str(points.link.isel(at).values)
    return Mark(number, (x, x), (y, y), text, colour, link)


def _edges(places: np.ndarray, logarithmic: bool) -> np.ndarray:
    at = np.log(places) if logarithmic else places
    if len(at) == 1:
        inner = np.array([at[0] - 0.5, at[0] + 0.5])
    else:
        middle = (at[1:] + at[:-1]) / 2
        inner = np.concatenate([[2 * at[0] - middle[0]], middle, [2 * at[-1] - middle[-1]]])
    if not logarithmic and np.min(places) > 0:
        # no energies or ranges below 0
        inner = np.maximum(inner, 0.0)
    return np.exp(inner) if logarithmic else inner


def _lowest(values: Sequence[np.ndarray]) -> float:
    finite = np.concatenate([part[np.isfinite(part)] for part in values]) if values else np.zeros(0)
    return float(finite.min()) if finite.size else 0.0


def _scale(axes: Axes, x: Axis, y: Axis | None) -> None:
    for knob, side, set_scale, set_label in (
        (x, axes.xaxis, axes.set_xscale, axes.set_xlabel),
        (y, axes.yaxis, axes.set_yscale, axes.set_ylabel),
    ):
        if knob is None:
            continue
        set_label(wrapped(knob.label, 55 if side is axes.xaxis else 34))
        if knob.logarithmic:
            set_scale("log")
            _plain_decades(side)
        if knob.labels:
            side.set_ticks(range(len(knob.labels)), knob.labels)


def _by_factors(axes: Axes, values: Sequence[np.ndarray]) -> None:
    finite = np.concatenate([part[np.isfinite(part)] for part in values])
    if finite.size and finite.min() > 0 and finite.max() > 20 * finite.min():
        axes.set_yscale("log")
        _plain_decades(axes.yaxis)


def _plain_decades(side: MatplotlibAxis) -> None:
    low, high = side.get_view_interval()
    few = high > 50 * low > 0
    side.set_major_locator(LogLocator(subs=(1.0,) if few else (1.0, 2.0, 5.0)))
    side.set_major_formatter(FuncFormatter(lambda value, _: three(value)))
    side.set_minor_formatter(NullFormatter())
