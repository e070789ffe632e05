"""Successive frames of one instrument: rings of one spacing."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from lidar_mi.errors import InputError
from lidar_mi.retrieval.rings.analysis import Rings, analyse_rings
from lidar_mi.tables import Table, Tabular, with_error

SAME = 0.02  # relative difference of spacings that are one


@dataclass(frozen=True, eq=False, repr=False)
class RingSeries(Tabular):
    """Rings of every frame, None where a frame is refused, and why it is."""

    rings: tuple[Rings | None, ...]
    refused: tuple[str, ...]

    def tables(self) -> list[Table]:
        """One row for each frame."""
        rows = []
        for number, (rings, reason) in enumerate(zip(self.rings, self.refused, strict=True)):
            if rings is None:
                rows.append((str(number), "-", "-", "-", reason))
                continue
            (x, y), (x_std, y_std) = rings.centre, rings.centre_std
            fractions = ", ".join(map(with_error, rings.fraction, rings.fraction_std))
            rows.append(
                (
                    str(number),
                    f"{with_error(x, x_std)}, {with_error(y, y_std)}",
                    with_error(rings.spacing, rings.spacing_std),
                    fractions,
                    rings.doubt,
                )
            )
        heads = ("frame", "centre x, y / px", "spacing / px^2", "fractional orders", "note")
        return [Table("frames", rows, heads)]

    def columns(self) -> dict[str, list[Any]]:
        """The same as numbers, one value for each frame; NaN where there is none."""
        columns: dict[str, list[Any]] = {"frame": list(range(len(self.rings)))}

        def column(name: str, value: Callable[[Rings], Any]) -> None:
            columns[name] = [np.nan if rings is None else value(rings) for rings in self.rings]

        column("centre_x", lambda r: r.centre[0])
        column("centre_x_std", lambda r: r.centre_std[0])
        column("centre_y", lambda r: r.centre[1])
        column("centre_y_std", lambda r: r.centre_std[1])
        column("spacing", lambda r: r.spacing)
        column("spacing_std", lambda r: r.spacing_std)
        lines = max((len(r.fraction) for r in self.rings if r is not None), default=0)
        for k in range(lines):
            for name in ("fraction", "fraction_std", "height"):
                column(f"{name}_{k}", partial(_of_line, name, k))
        column("misfit", lambda r: r.misfit)
        columns["note"] = [
            reason if rings is None else rings.doubt
            for rings, reason in zip(self.rings, self.refused, strict=True)
        ]
        return columns


def _of_line(name: str, line: int, rings: Rings) -> float:
    """Value of one line; NaN where a frame has fewer lines."""
    values = getattr(rings, name)
    return values[line] if line < len(values) else np.nan


def analyse_series(
    frames: Iterable[np.ndarray],
    centre: tuple[float, float] | None = None,
    saturation: float | None = None,
    spacing: float | None = None,
) -> RingSeries:
    """Rings of all frames of one instrument, at one spacing of the orders.

    Lines at equal distances look like one line of a shorter spacing, so that a frame in which a
    moving line crosses the middle between two orders does not determine it. The spacing of
    most of the frames, or the given one, is that of all. Centre, saturation and spacing are those
    of `analyse_rings`.
    """
    stored = list(frames)
    series: list[Rings | None] = []
    refused: list[str] = []
    for frame in stored:
        rings, reason = _tried(frame, centre, saturation, spacing)
        series.append(rings)
        refused.append(reason)
    known = np.array([rings.spacing for rings in series if rings is not None])
    if spacing is not None or not len(known):
        return RingSeries(tuple(series), tuple(refused))
    same = np.abs(known[:, None] / known - 1) < SAME
    common = float(np.median(known[same[same.sum(1).argmax()]]))
    for number, rings in enumerate(series):
        if rings is not None and abs(rings.spacing / common - 1) < SAME:
            series[number] = replace(rings, doubt="")
            continue
        again, reason = _tried(stored[number], centre, saturation, common)
        if again is not None:
            series[number], refused[number] = replace(again, doubt=""), ""
        elif rings is not None:
            doubt = f"{rings.spacing / common:.3g} times the spacing of the other frames"
            series[number] = replace(rings, doubt=doubt)
    return RingSeries(tuple(series), tuple(refused))


def _tried(
    frame: np.ndarray,
    centre: tuple[float, float] | None,
    saturation: float | None,
    spacing: float | None,
) -> tuple[Rings | None, str]:
    try:
        return analyse_rings(frame, centre, saturation, spacing), ""
    except InputError as error:
        return None, str(error)
