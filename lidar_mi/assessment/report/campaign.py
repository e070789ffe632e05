"""The report of a campaign: one self-contained HTML file, from its data set alone."""

import re
from collections.abc import Container, Hashable, Iterator, Mapping, Sequence
from importlib.resources import files
from itertools import product

import numpy as np
import xarray as xr
from markupsafe import Markup
from matplotlib.colors import Normalize

from lidar_mi.assessment.digits import three, with_error
from lidar_mi.assessment.figures import campaign as figures
from lidar_mi.assessment.figures.campaign import Axis, Points
from lidar_mi.assessment.metrics import campaign as numbers
from lidar_mi.assessment.metrics.campaign import MEMBER, SAMPLE, Interval
from lidar_mi.assessment.metrics.encounter_hazard import ACCEPTED_BANK
from lidar_mi.assessment.metrics.requirements import QUANTITIES
from lidar_mi.assessment.report.block import Block, label_of
from lidar_mi.assessment.report.encounters import encounter_blocks
from lidar_mi.assessment.report.page import template
from lidar_mi.assessment.report.sample import margin_blocks, sample_blocks
from lidar_mi.assessment.report.simulation import points_sentence
from lidar_mi.units import conversion, usual_unit

_PANELS = 16
_FEW = 4
_ROWS = 36
"""Most rows of the table of points."""
_DONE, _FAILED = 0, 1


def page(dataset: xr.Dataset, resolved: str, metrics: Sequence[str] | None = None) -> str:
    """The report as HTML; all text of the user is escaped.

    dataset: the campaign's data set, as `lidar_mi.assessment.metrics.campaign` describes it, with
        ``status``, ``message`` and ``folder`` of every point. Links are relative to the folder of
        the campaign, where the page belongs.
    resolved: the campaign with all defaults, as YAML.
    metrics: names of metrics to show. Default: errors, coverage, vortices, pulses needed.
    """
    flown = list(encounter_blocks(numbers.metrics_of(dataset)))
    dataset = _in_usual_units(dataset)
    values = numbers.metrics_of(dataset)
    keys = numbers.chosen(values, metrics)
    axes, points, margins = _axes(dataset), _points(dataset), _margins(dataset)
    if SAMPLE in dataset.dims:
        blocks = list(sample_blocks(dataset, values, keys, axes, points))
        required = list(margin_blocks(dataset, margins, axes, points))
    else:
        blocks = [_sweep_block(dataset, key, values[key], axes, points) for key in keys]
        required = list(_requirement_maps(dataset, margins, axes, points))
    blocks = [*flown, *blocks]
    return template("campaign.html").render(
        name=dataset.attrs.get("name", "campaign"),
        lead=_lead(dataset, keys, axes, margins),
        numbers=_table(dataset, keys, axes),
        members=MEMBER in dataset.dims,
        rows=_requirement_rows(margins, axes),
        required=_marked(required),
        blocks=_marked(blocks),
        coverages=_coverage_rows(values),
        failures=_failures(dataset),
        resolved=resolved,
        points=_descriptions(dataset),
        script=Markup(files("lidar_mi.assessment.report").joinpath("campaign.js").read_text()),
    )


def answer(dataset: xr.Dataset) -> str:
    """How large errors are, where they are least, and where requirements are met: the lead."""
    dataset = _in_usual_units(dataset)
    keys = numbers.chosen(numbers.metrics_of(dataset), None)
    return _lead(dataset, keys, _axes(dataset), _margins(dataset))


Margins = Mapping[tuple[str, str], Mapping[str, numbers.Interval]]
"""Margins of each quantity, by application and phase of flight."""


def _axes(dataset: xr.Dataset) -> dict[str, Axis]:
    return {name: _axis(dataset, name) for name in numbers.knobs(dataset)}


def _margins(dataset: xr.Dataset) -> Margins:
    """Margins over members of all rows, by requirement table."""
    values = numbers.metrics_of(dataset)
    return {
        group: {
            QUANTITIES.get(q, (q, ""))[0]: numbers.over_members(numbers.judged(dataset, k))
            for q, k in rows.items()
        }
        for group, rows in numbers.requirements(values).items()
    }


def _marked(blocks: Sequence[Block]) -> list[Block]:
    return [block._replace(panels=[Markup(panel) for panel in block.panels]) for block in blocks]


def _in_usual_units(dataset: xr.Dataset) -> xr.Dataset:
    """Angles in degrees or mrad, energies in mJ: by the largest value of each variable."""
    converted = {}
    for name, variable in dataset.variables.items():
        values = variable.values
        if values.dtype.kind != "f" or "units" not in variable.attrs:
            continue
        largest = np.abs(values[np.isfinite(values)]).max(initial=0.0)
        factor, unit = usual_unit(float(largest), variable.attrs["units"])
        if factor != 1:
            converted[name] = (variable.dims, factor * values, variable.attrs | {"units": unit})
    return dataset.assign({key: xr.Variable(*parts) for key, parts in converted.items()})


def _axis(dataset: xr.Dataset, name: str) -> Axis:
    at = dataset[name]
    if not numbers.is_numeric(dataset, name):
        return Axis(name, label_of(at, name), False, tuple(str(value) for value in at.values))
    # the description of a list does not state its scale
    guess = "log" if numbers.spaced_by_factors(at.values) else "linear"
    return Axis(name, label_of(at, name), at.attrs.get("scale", guess) == "log")


def _points(dataset: xr.Dataset) -> Points:
    status, folder = dataset["status"], dataset["folder"].astype(str)
    failed, link = status != _DONE, _links(dataset, folder)
    if MEMBER in status.dims:
        failed, link = failed.all(MEMBER), link.isel({MEMBER: 0})
    number = xr.DataArray(np.arange(failed.size).reshape(failed.shape), failed.coords, failed.dims)
    return Points(number, failed, link)


def _links(dataset: xr.Dataset, folder: xr.DataArray) -> xr.DataArray:
    """The report of a point, where reports are stored; else its folder."""
    stored = (dataset["status"] == _DONE) & (dataset.attrs.get("keep") == "everything")
    ends = [
        f"{path}/run/report.html" if has_report else f"{path}/"
        for path, has_report in zip(folder.values.ravel(), stored.values.ravel(), strict=True)
    ]
    return folder.copy(data=np.array(ends, dtype=object).reshape(folder.shape))


def _place(dataset: xr.Dataset, at: Mapping[str, int]) -> str:
    """A point's coordinates as text."""
    names = (
        [name for name in dataset.coords if dataset[name].dims == (SAMPLE,)]
        if SAMPLE in dataset.dims
        else list(at)
    )
    words = []
    for name in names:
        coordinate = dataset[name].isel(at, missing_dims="ignore")
        value, about = coordinate.item(), coordinate.attrs
        number = f"{value:.4g}" if isinstance(value, float) else str(value)
        words.append(f"{about.get('long_name', name)} = {number} {about.get('units', '')}".strip())
    return ", ".join(words)


def _indices(array: xr.DataArray) -> Iterator[dict[str, int]]:
    for index in np.ndindex(*array.shape):
        yield dict(zip(map(str, array.dims), index, strict=True))


def _descriptions(dataset: xr.Dataset) -> list[str]:
    status = dataset["status"]
    if MEMBER in status.dims:
        status = status.isel({MEMBER: 0})
    return [_place(dataset, at) for at in _indices(status)]


def _failures(dataset: xr.Dataset) -> list[tuple[str, str, str, str]]:
    rows = []
    for at in _indices(dataset["status"]):
        point = dataset[["status", "message", "folder"]].isel(at)
        code = int(point["status"])
        if code != _DONE:
            word = "failed" if code == _FAILED else "missing"
            message = str(point["message"].item())
            rows.append((_place(dataset, at), word, message, f"{point['folder'].item()}/"))
    return rows


def _table(
    dataset: xr.Dataset, keys: Sequence[str], axes: Mapping[str, Axis]
) -> tuple[list[str], list[tuple[str, str, list[str]]]] | None:
    """Heads and rows of the metrics at every point, with standard errors over members.

    None: there is one point, or there are too many.
    """
    metrics = numbers.metrics_of(dataset)
    points = dataset["status"].size // dataset.sizes.get(MEMBER, 1)
    if not axes or not 1 < points <= _ROWS:
        return None
    columns = []
    for key in keys:
        values = metrics[key]
        count = values.notnull().sum(MEMBER) if MEMBER in values.dims else None
        error = None if count is None else values.std(MEMBER, ddof=1) / np.sqrt(count)
        columns.append((numbers.over_members(values).mean, error))
    status = dataset["status"]
    first = status.isel({MEMBER: 0}) if MEMBER in status.dims else status
    rows = []
    for at in _indices(first):
        varied = {dim: k for dim, k in at.items() if dim in axes or dim == SAMPLE}
        rows.append((_place(dataset, varied), "", [_cell(*column, at) for column in columns]))
    return [label_of(metrics[key], key) for key in keys], rows


def _cell(mean: xr.DataArray, error: xr.DataArray | None, at: Mapping[str, int]) -> str:
    value = float(mean.isel(at))
    if not np.isfinite(value):
        return "-"
    stderr = np.nan if error is None else float(error.isel(at))
    return with_error(value, stderr) if stderr > 0 else three(value)


def _best_sentence(dataset: xr.Dataset, keys: Sequence[str]) -> str:
    """Values of the first metric, where it is least, and how often errors are as stated."""
    metrics = numbers.metrics_of(dataset)
    if not keys:
        return ""
    key = keys[0]
    mean = numbers.over_members(metrics[key]).mean
    values = mean.values[np.isfinite(mean.values)]
    if not values.size:
        return ""
    name, _, unit = label_of(metrics[key], key).partition(" / ")
    text = f"{name[:1].upper()}{name[1:]}: {_from_to(values)} {unit}".rstrip()
    if values.size > 1:
        lowest = np.unravel_index(int(np.nanargmin(mean.values)), mean.shape)
        at = dict(zip(map(str, mean.dims), map(int, lowest), strict=True))
        varied = {dim: k for dim, k in at.items() if mean.sizes[dim] > 1}
        text += f", least at {_place(dataset, varied)}"
    if values.size < mean.size:
        text += f", none at {mean.size - values.size} of {mean.size} points"
    head, split, component = key.rpartition(".rmse_")
    covered = metrics.get(f"{head}.coverage_95_{component}") if split else None
    if covered is not None and np.isfinite(covered).any():
        fractions = 100 * numbers.over_members(covered).mean.values
        text += f"; {_from_to(fractions[np.isfinite(fractions)])} % of errors are within 1.96 "
        text += "standard errors (95 % if as stated)"
    return f"{text}. "


def _from_to(values: np.ndarray) -> str:
    low, high = three(float(values.min())), three(float(values.max()))
    return low if low == high else f"{low} to {high}"


def _lead(
    dataset: xr.Dataset, keys: Sequence[str], axes: Mapping[str, Axis], margins: Margins
) -> str:
    status = dataset["status"]
    runs, done = status.size, int((status == _DONE).sum())
    failed = int((status == _FAILED).sum())
    members = dataset.sizes.get(MEMBER, 1)
    points = runs // (status.sizes.get(MEMBER, 1))
    text = points_sentence(dataset, lambda at: _place(dataset, at))
    text += _best_sentence(dataset, keys)
    text += f"{points} point{'s' * (points != 1)} of {dataset.attrs.get('base', 'an experiment')}"
    if members > 1:
        text += f" with {members} members each"
    text += f": {done} of {runs} runs done, {failed} failed"
    missing = runs - done - failed
    text += f", {missing} missing." if missing else "."
    if axes:
        sizes = [
            f"{axis.label.partition(' / ')[0]} ({_range(dataset, name)})"
            for name, axis in axes.items()
        ]
        kind = "Sampled" if SAMPLE in dataset.dims else "Varied"
        text += f" {kind}: {', '.join(sizes)}."
    if not margins and any(str(name).startswith("encounter.") for name in dataset):
        return text
    if not margins:
        return text + " No requirement was judged."
    counts, missed = [], []
    for group, rows in margins.items():
        met = [numbers.met(margin) for margin in rows.values()]
        every = xr.concat(met, "row", coords="minimal", compat="override").min("row", skipna=False)
        judged = int(np.isfinite(every).sum())
        counts.append(f"{_title(group)}: at {int(every.sum())} of {judged} points")
        missed += _missed(dataset, _title(group), rows, every)
    text += f" All rows of the requirements are met for {'; '.join(counts)}."
    return " ".join([text, *missed])


def _missed(
    dataset: xr.Dataset, phase: str, rows: Mapping[str, numbers.Interval], every: xr.DataArray
) -> list[str]:
    """Where a row is not met, and which by most: each point if they are few, else the counts."""
    where = [at for at in _indices(every) if float(every.isel(at)) == 0]
    if not where:
        return []
    if len(where) <= _FEW:
        texts = []
        for at in where:
            margins = {name: float(margin.mean.isel(at)) for name, margin in rows.items()}
            judged = {name: value for name, value in margins.items() if np.isfinite(value)}
            worst = min(judged, key=lambda name: judged[name])
            place = _place(dataset, at) or "the point"
            texts.append(f"{place} ({worst}: margin {100 * judged[worst]:+.0f} %)")
        return [f"Not met for {phase}: {'; '.join(texts)}."]
    counts = {name: int((numbers.met(margin) == 0).sum()) for name, margin in rows.items()}
    most = sorted((name for name in counts if counts[name]), key=lambda name: -counts[name])
    texts = [f"{name} at {counts[name]}" for name in most[:_FEW]]
    return [f"Not met for {phase} at {len(where)} points, most often {', '.join(texts)}."]


def _range(dataset: xr.Dataset, name: str) -> str:
    values = dataset[name]
    if not numbers.is_numeric(dataset, name):
        return ", ".join(str(value) for value in values.values)
    unit = values.attrs.get("units", "")
    ends = f"{three(float(values.min()))} to {three(float(values.max()))} {unit}".strip()
    return ends if SAMPLE in dataset.dims else f"{values.size} values, {ends}"


def _title(group: tuple[str, str]) -> str:
    """Application and phase of flight."""
    return f"{group[0].replace('_', ' ')}, {group[1]}"


def _along(array: xr.DataArray, dims: Container[Hashable]) -> xr.DataArray:
    """An array without its other dimensions, which have the length 1."""
    return array.squeeze([dim for dim in array.dims if dim not in dims], drop=True)


def _requirement_rows(
    margins: Margins, axes: Mapping[str, Axis]
) -> list[tuple[str, str, list[str]]]:
    rows = []
    for group, quantities in margins.items():
        for name, margin in quantities.items():
            met = numbers.met(margin)
            judged, many = int(np.isfinite(met).sum()), int(met.sum())
            open_ = (
                str(int(numbers.undecided(margin).sum()))
                if np.isfinite(margin.low).any()
                else "not known"
            )
            where = _boundary_text(margin, axes)
            rows.append((f"{_title(group)}: {name}", "", [f"{many} of {judged}", open_, where]))
    return rows


def _boundary_text(margin: Interval, axes: Mapping[str, Axis]) -> str:
    met = numbers.met(margin)
    if not (met == 0).any():
        return "met everywhere"
    if not (met == 1).any():
        return "met nowhere"
    numeric = [axis for axis in axes.values() if not axis.labels and axis.name in margin.mean.dims]
    if len(numeric) != 1 or SAMPLE in margin.mean.dims:
        return "see the figures" if SAMPLE not in margin.mean.dims else "see the lead"
    axis, texts = numeric[0], []
    unit = margin.mean[axis.name].attrs.get("units", "")
    remaining = [dim for dim in margin.mean.dims if dim != axis.name]
    for labels in product(*(margin.mean[dim].values for dim in remaining)):
        at = dict(zip(remaining, labels, strict=True))
        line = Interval(*(part.sel(at) for part in (margin.mean, margin.low, margin.high)))
        for boundary in numbers.boundaries(line, axis.logarithmic):
            side = "from" if boundary.above else "up to"
            words = f"{side} {three(boundary.value)} {unit}".strip()
            if np.isnan(boundary.low):
                words += " (uncertainty not known)"
            else:
                low = three(boundary.low) if np.isfinite(boundary.low) else "beyond the sweep"
                high = three(boundary.high) if np.isfinite(boundary.high) else "beyond the sweep"
                words += f" (95 %: {low} to {high})"
            place = [str(x) for dim, x in zip(remaining, labels, strict=True) if dim in axes]
            texts.append(": ".join([*place, words]))
    return "; ".join(texts)


def _layout(
    axes: Mapping[str, Axis], dims: Mapping[Hashable, int]
) -> tuple[list[Axis], Axis | None, list[str]]:
    """Axes of a panel (one or two), the axis whose labels are lines, dims of the panels."""
    numeric = [axis for name, axis in axes.items() if name in dims and not axis.labels]
    labelled = [axis for name, axis in axes.items() if name in dims and axis.labels]
    if len(numeric) >= 2:
        # the finest two are the axes
        numeric.sort(key=lambda axis: -dims[axis.name])
        return numeric[:2], None, [axis.name for axis in (*numeric[2:], *labelled)]
    if numeric:
        lines = labelled[0] if labelled else None
        return numeric, lines, [axis.name for axis in labelled[1:]]
    return labelled[:1], labelled[1] if len(labelled) > 1 else None, [a.name for a in labelled[2:]]


def _panels(dataset: xr.Dataset, names: Sequence[str]) -> list[tuple[str, dict[str, int]]]:
    """Title and selection of every panel."""
    panels = []
    for index in product(*(range(dataset.sizes[name]) for name in names)):
        at = dict(zip(names, index, strict=True))
        panels.append((_place(dataset, at), at))
    return panels


def _sweep_block(
    dataset: xr.Dataset, key: str, values: xr.DataArray, axes: Mapping[str, Axis], points: Points
) -> Block:
    label = label_of(values, key)
    values = _along(values, (*axes, MEMBER))
    flat = Points(*(_along(p, axes) for p in points))
    title = f"{label.partition(' / ')[0]}"
    if not axes:
        return Block(
            title, f"{_by_member(values)} Key: {key}.", _member_panel(dataset, values, label)
        )
    at, lines, remaining = _layout(axes, values.sizes)
    selections = _panels(dataset, remaining)
    text = "Mean over members. " if MEMBER in values.dims else ""
    if len(selections) > _PANELS:
        text += f"The first {_PANELS} of {len(selections)} panels. "
    drawn, mean = [], numbers.over_members(values).mean
    bank = _bank_limit(key, values)
    limits = _limits(dataset, key, axes)
    if bank is not None:
        limits["limit"] = bank - mean
    if limits and len(at) == 2:
        text += "Black lines: where the limit is reached. "
    is_fraction = re.search(r"\bcoverage_|fraction$", key)
    norm = Normalize(0, 1) if is_fraction else figures.colour_scale(mean)
    for name, where in selections[:_PANELS]:
        selected = Points(*(p.isel(where) for p in flat))
        if len(at) == 2:
            bounds = {table: margin.isel(where) for table, margin in limits.items()}
            drawn.append(
                figures.draw_map(
                    name, mean.isel(where), at[0], at[1], selected, label, norm, limits=bounds
                )
            )
            continue
        groups = {"": (values.isel(where), selected)}
        if lines:
            groups = {
                line: (
                    values.isel(where).isel({lines.name: k}),
                    Points(*(p.isel({lines.name: k}) for p in selected)),
                )
                for k, line in enumerate(lines.labels)
            }
        drawn.append(figures.draw_lines(name, groups, at[0], label, bank))
    if len(at) == 1 and MEMBER in values.dims:
        text += "Bands: 16 to 84 % of the members. "
    return Block(title, f"{text}Key: {key}.", drawn)


def _limits(dataset: xr.Dataset, key: str, axes: Mapping[str, Axis]) -> dict[str, xr.DataArray]:
    """Margins of the requirements of a metric, by application and phase of flight."""
    limits = {}
    for group, rows in numbers.requirements(numbers.metrics_of(dataset)).items():
        row = rows.get(key.replace("sensor.rmse_", "error_"))
        if row is None:
            continue
        mean = numbers.over_members(numbers.judged(dataset, row)).mean
        limits[_title(group)] = _along(mean, axes)
    return limits


def _bank_limit(key: str, values: xr.DataArray) -> float | None:
    """The largest bank angle that is accepted, in the unit of the values."""
    if not re.fullmatch(r"encounter\.\w+\.largest_roll", key):
        return None
    return ACCEPTED_BANK * conversion("rad", values.attrs.get("units", "rad"))


def _by_member(values: xr.DataArray) -> str:
    finite = values.values[np.isfinite(values.values)]
    if not finite.size:
        return "No value."
    if finite.size == 1:
        return f"{three(float(finite[0]))}."
    mean, spread = float(finite.mean()), float(finite.std(ddof=1))
    return (
        f"Mean {with_error(mean, spread / np.sqrt(finite.size))}, standard deviation "
        f"{three(spread)}, from {three(float(finite.min()))} to {three(float(finite.max()))} over "
        f"{finite.size} members."
    )


def _member_panel(dataset: xr.Dataset, values: xr.DataArray, label: str) -> list[str]:
    """A metric of every member of a single point."""
    if MEMBER not in values.dims:
        return []
    runs = xr.Dataset(
        {
            "number": (MEMBER, np.zeros(values.size, int)),
            "failed": _along(dataset["status"], (MEMBER,)) != _DONE,
            "link": _along(_links(dataset, dataset["folder"].astype(str)), (MEMBER,)),
            "value": values,
        }
    ).rename({MEMBER: "run"})
    points = Points(runs["number"], runs["failed"], runs["link"])
    along = Axis("run", "member", False)
    return [figures.draw_lines("", {"": (runs["value"], points)}, along, label)]


def _requirement_maps(
    dataset: xr.Dataset, margins: Margins, axes: Mapping[str, Axis], points: Points
) -> Iterator[Block]:
    for group, rows in margins.items():
        dims = next(iter(rows.values())).mean.sizes
        at, _, remaining = _layout(axes, dims) if axes else ([], None, [])
        if len(at) != 2:
            continue
        flat = Points(*(_along(p, axes) for p in points))
        drawn = []
        for name, where in _panels(dataset, remaining)[:_PANELS]:
            intervals = {
                row: Interval(
                    *(_along(x, axes).isel(where) for x in (margin.mean, margin.low, margin.high))
                )
                for row, margin in rows.items()
            }
            if not any(margin.mean.notnull().any() for margin in intervals.values()):
                continue  # of another phase of flight
            spots = Points(*(p.isel(where) for p in flat))
            drawn.append(figures.draw_requirements(name, intervals, at[0], at[1], spots))
        with_members = any(np.isfinite(margin.low).any() for margin in rows.values())
        text = "Green: all rows are met. Lines: where the margin of a row is 0"
        text += (
            "; dashed: 95 % interval of that, from the members."
            if with_members
            else ". Their uncertainty is not known: there is one member."
        )
        yield Block(_title(group), text, drawn)


def _coverage_rows(metrics: Mapping[str, xr.DataArray]) -> list[tuple[str, str, list[str]]]:
    def cell(value: float, error: float) -> str:
        if np.isnan(error):
            return f"{100 * value:.1f}"
        return with_error(100 * value, 100 * error) if error else f"{100 * value:.1f} ± 0"

    return [
        (
            row.quantity,
            "",
            [
                str(row.count),
                cell(row.within_68, row.stderr_68),
                cell(row.within_95, row.stderr_95),
            ],
        )
        for row in numbers.coverages(metrics)
    ]
