"""What every figure keeps to: an arrow has a scale, a panel has data, a 1:1 line has equal axes."""

import re
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.lines import AxLine
from matplotlib.quiver import Quiver, QuiverKey

from lidar_mi.assessment.figures import campaign, linked, panels
from lidar_mi.assessment.figures.alt_text import TRUE_CORE
from lidar_mi.io import png


def faults(figure, marks=0):
    """Rules that a figure breaks, as sentences; marks: what a page adds to an SVG."""
    FigureCanvasAgg(figure)
    figure.draw_without_rendering()
    panels = [axes for axes in figure.axes if axes.get_label() != "<colorbar>"]
    found = [f"{_name(axes)}: {what}" for axes in panels for what in _of_panel(axes, marks)]
    return found + [f"{text!r} is cut" for text in _cut(figure)]


def _name(axes):
    return axes.get_title() or axes.get_title(loc="left") or axes.get_ylabel() or "a panel"


def _of_panel(axes, marks):
    if not axes.axison or not (marks or _has_values(axes)):
        yield "no data"
    arrows = [one for one in axes.collections if isinstance(one, Quiver)]
    keys = [one for one in axes.get_children() if isinstance(one, QuiverKey)]
    texts = [key.text.get_text() for key in keys]
    if arrows and not any(re.match(r"[\d.]+ m( s|/s)", text) for text in texts):
        yield "arrows without a scale"
    if len({one.scale for one in arrows}) > 1:
        yield "arrows of several scales"
    titles = [
        text.get_window_extent() for text in (axes.title, axes._left_title) if text.get_text()
    ]
    if any(key.text.get_window_extent().overlaps(title) for key in keys for title in titles):
        yield "the scale of the arrows is on the title"
    if any(map(_is_one_to_one, axes.lines)) and axes.get_xlim() != axes.get_ylim():
        yield "a 1:1 line on unequal axes"
    (left, right), (bottom, top) = axes.get_xlim(), axes.get_ylim()
    if axes.get_xlabel().startswith("y / m") and left < right:
        yield "y to the right"
    if axes.get_ylabel().startswith("z / m") and top < bottom:
        yield "z downwards"


def _has_values(axes):
    of_collections = [one for one in axes.collections if not isinstance(one, Quiver)]
    values = [
        *(np.ravel(line.get_ydata()) for line in axes.lines if _is_of_values(axes, line)),
        *(
            np.ma.filled(q.N * 0.0 + np.ma.hypot(q.U, q.V), np.nan)
            for q in axes.collections
            if isinstance(q, Quiver)
        ),
        *(
            one.get_array()
            for one in (*of_collections, *axes.images)
            if one.get_array() is not None
        ),
        *(patch.get_extents().get_points() for patch in axes.patches),
    ]
    return any(np.isfinite(np.ma.filled(np.ma.asarray(v, float), np.nan)).any() for v in values)


def _is_of_values(axes, line):
    """Not a line across the panel, nor crosses of true cores: they say nothing of results."""
    across = isinstance(line, AxLine) or not all(
        line.get_transform().contains_branch_seperately(axes.transData)
    )
    return not across and TRUE_CORE not in str(line.get_label())


def _is_one_to_one(line):
    if isinstance(line, AxLine):
        return line.get_slope() == 1
    x, y = (np.ravel(np.asarray(line.get_xdata(), float)), np.ravel(np.asarray(line.get_ydata())))
    try:
        y = y.astype(float)
    except ValueError:
        return False
    return x.size > 1 and x[0] != x[-1] and np.array_equal(x, y)


def _cut(figure):
    """Texts beyond the edges of the figure."""
    texts = [*figure.texts]
    for legend in figure.legends:
        texts += legend.get_texts()
    for axes in figure.axes:
        texts += [axes.title, axes._left_title, axes.xaxis.label, axes.yaxis.label, *axes.texts]
        texts += [one.text for one in axes.get_children() if isinstance(one, QuiverKey)]
    width, height = figure.bbox.size
    for text in texts:
        if not text.get_text().strip() or not text.get_visible():
            continue
        box = text.get_window_extent()
        if box.x0 < -2 or box.y0 < -2 or box.x1 > width + 2 or box.y1 > height + 2:
            yield text.get_text()


@contextmanager
def judged_figures():
    """Judges every figure that is saved or made a part of a page: names of figures, faults."""
    found = {}
    svg = linked.as_svg

    def write(figure, path, **_):
        found[Path(path).stem] = faults(figure)
        figure.set_layout_engine("none")
        figure.savefig(path, dpi=40)

    def as_svg(axes, marks, label):
        found[f"svg: {label}"] = faults(axes.figure, len(marks))
        return svg(axes, marks, label)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(panels, "write_png", write)
        # that of the commands, which import it when they draw
        patch.setattr(png, "write_png", write)
        for module in (linked, campaign):
            patch.setattr(module, "as_svg", as_svg)
        yield found
