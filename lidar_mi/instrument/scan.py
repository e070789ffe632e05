"""Scan geometry: where the beams of a scan go and which ranges are recorded."""

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Annotated, Literal, Self

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field, field_validator, model_validator

from lidar_mi.description import Description
from lidar_mi.errors import InputError
from lidar_mi.instrument.beams import Beams
from lidar_mi.instrument.scan_timing import ScanTiming
from lidar_mi.units import Angle, Length, Speed, Within, quantity

MOST_BEAMS = 10**7
"""An image of this many beams has about 1 GB, with a layer for each order and its errors."""

HalfAngle = Annotated[
    Angle, Within(1e-9, 1.5, "from a nanoradian to nearly across the scan's axis")
]


class Scan(Description):
    """How the beams are aimed and gated; defaults are the paper's slab at 500 m.

    ``aim: grid`` sends every beam to a node of the wake's (y, z) grid in the middle of the gates,
    at both times to the same nodes. ``aim: angles`` takes equidistant angles (paper): columns in
    +-azimuth_half by rows in +-elevation_half, given for t1 and t2.

    Pixels are placed in the plane x = middle of the gates. With ``gates: spherical`` the light of
    an oblique beam comes from nearer than that: at 6 degrees off axis the place is wrong by 0.3 m,
    and by a little more from 485 m than from 500 m, which looks like an outward wind of up to
    0.3 m/s at the image's corners.
    """

    aim: Literal["grid", "angles"] = Field(
        "grid", description="beams through the nodes of the wake's grid, or at equidistant angles"
    )
    range: Annotated[
        Length, Within(0.1, 100000, "from a wind tunnel to the top of the atmosphere")
    ] = Field(500.0, description="distance of the first gate's start at t1")
    thickness: Annotated[
        Length, Within(0.001, 100000, "from a pulse of 7 ps to all of the atmosphere")
    ] = Field(2.5, description="depth of all gates together")
    gates: Literal["planar", "spherical"] = Field(
        "planar", description="shape of the gates: planes across x, or shells of equal range"
    )
    gate_count: Annotated[int, Within(1, 10000, "10 m each through all of the atmosphere")] = Field(
        1, description="number of equal gates in the thickness; image pairs are of the first one"
    )
    follow: Annotated[Speed, Within(-1000, 1000, "the fastest jets")] = Field(
        0.0, description="wind along x with which the gates go along from scan to scan"
    )
    air: Literal["frozen", "moving"] = Field(
        "frozen", description="each beam sees the air of the scan's reference time, or of its own"
    )
    columns: Annotated[int, Within(1, 10**7, "an image has at most 1e7 beams")] = Field(
        219, description="beams across, with aim: angles"
    )
    rows: Annotated[int, Within(1, 10**7, "an image has at most 1e7 beams")] = Field(
        139, description="beams up, with aim: angles"
    )
    azimuth_half: tuple[HalfAngle, HalfAngle] = Field(
        (quantity("6.2 deg"), quantity("6.4 deg")),
        description="half angle in azimuth of the first and the second scan, with aim: angles",
    )
    elevation_half: tuple[HalfAngle, HalfAngle] = Field(
        (quantity("3.9 deg"), quantity("4.1 deg")),
        description="half angle in elevation of the first and the second scan, with aim: angles",
    )
    timing: ScanTiming | None = Field(
        None, description="when each beam is sent; default: all at once"
    )

    @field_validator("azimuth_half", "elevation_half", mode="before")
    @classmethod
    def _one_for_both_scans(cls, value: object) -> object:
        return [value, value] if isinstance(value, str | int | float) else value

    @property
    def pulses_per_beam(self) -> int:
        """Pulses averaged in every beam."""
        return self.timing.pulses_per_beam if self.timing else 1

    @model_validator(mode="after")
    def _fits_into_memory(self) -> Self:
        count = self.columns * self.rows
        if count > MOST_BEAMS:
            raise ValueError(
                f"columns, rows: {self.columns} x {self.rows} is not allowed; expected at most "
                f"{MOST_BEAMS:g} beams"
            )
        return self


@dataclass(frozen=True)
class ScanPlan:
    """One scan, ready to be rendered. All lengths in m, in the lidar's frame.

    y, z (columns,), (rows,) arrays: where the beams hit the plane in the middle of the gates,
        ascending.
    gate_start, gate_stop: the gates together: distances along x (planar) or ranges (spherical).
    gate_kind ("planar" or "spherical")
    position: distance of the telescope along x from the first scan, in the frame of the air, in
        which the gates are fixed.
    beams: time and pose of every beam. None: all at once, from one place, to the nodes (y, z).
    aside: y and z of the telescope where there are no `beams`: of a scan about another direction
        than straight ahead, whose nodes are about its own middle.
    """

    y: np.ndarray
    z: np.ndarray
    gate_start: float
    gate_stop: float
    gate_kind: str
    gate_count: int
    position: float
    beams: Beams | None = None
    aside: tuple[float, float] = (0.0, 0.0)

    @property
    def centre(self) -> float:
        """Distance of the middle of the gates, m."""
        return (self.gate_start + self.gate_stop) / 2

    def directions(self) -> np.ndarray:
        """Unit vectors of the beams, (rows * columns, 3), row by row from the top left."""
        # film order begins at the top left of the pilot's view, where y and z are largest
        y, z = self.y - self.aside[0], self.z - self.aside[1]
        vertical, lateral = np.meshgrid(z[::-1], y[::-1], indexing="ij")
        beams = np.stack([np.full_like(lateral, self.centre), lateral, vertical], -1)
        beams = beams.reshape(-1, 3)
        return beams / np.linalg.norm(beams, axis=1, keepdims=True)

    def obliquity(self) -> np.ndarray:
        """1 / cos of the angle between beam and x axis, (rows, columns), y and z ascending.

        With ``beams`` of the reported ones, as are `ranges` and `gate_length`: an instrument
        corrects its signal by the geometry that it knows.
        """
        if self.beams is not None:
            return self.as_image(1 / self.beams.reported_direction[:, 0])
        y, z = self.y[None, :] - self.aside[0], self.z[:, None] - self.aside[1]
        return np.sqrt(1 + (y / self.centre) ** 2 + (z / self.centre) ** 2)

    def ranges(self) -> np.ndarray:
        """Middle of every gate along every beam from its own origin, m, (gates, rows, columns)."""
        edges = np.linspace(self.gate_start, self.gate_stop, self.gate_count + 1)
        middle = (edges[1:] + edges[:-1])[:, None, None] / 2
        if self.beams is not None:
            # the gates stay in the air: an advance of the beam's origin shortens the way
            middle = middle - self.as_image(self.beams.reported_origin[:, 0] - self.position)
        return middle * self._along_beam()

    def gate_length(self) -> np.ndarray:
        """Length of one gate along every beam, m, (rows, columns)."""
        return (self.gate_stop - self.gate_start) / self.gate_count * self._along_beam()

    def as_image(self, values: np.ndarray) -> np.ndarray:
        """Values of the beams in film order as (rows, columns), y and z ascending."""
        return values.reshape(len(self.z), len(self.y))[::-1, ::-1]

    def _along_beam(self) -> np.ndarray:
        oblique = self.obliquity()
        return oblique if self.gate_kind == "planar" else np.ones_like(oblique)


def plan_scans(
    scan: Scan, y: ArrayLike, z: ArrayLike, travelled: Iterable[float]
) -> list[ScanPlan]:
    """The scans of one slab of air from a moving telescope.

    y, z: nodes of the wake's grid (used with ``aim: grid``), m, ascending.
    travelled: distance of the telescope along x at each scan, m, in the frame of the air. The gates
        are fixed in that frame, so they are nearer by as much. Negative: the air moves away.

    Raises InputError: the telescope would reach the slab, or a distance is not finite.
    """
    plans = []
    for index, position in enumerate(travelled):
        start = scan.range - position
        if not math.isfinite(start):
            raise InputError(f"travelled: {position} m is not allowed; expected finite distances")
        if start <= 0:
            raise InputError(
                f"scan.range: {scan.range:g} m is not allowed; expected more than the "
                f"{position:g} m flown until the last scan"
            )
        stop = start + scan.thickness
        nodes_y, nodes_z = np.asarray(y, float), np.asarray(z, float)
        if scan.aim == "angles":
            middle = (start + stop) / 2
            # angles are given for t1 and t2
            half = min(index, 1)
            nodes_y = middle * np.tan(_angles(scan.azimuth_half[half], scan.columns))
            nodes_z = middle * np.tan(_angles(scan.elevation_half[half], scan.rows))
        plans.append(
            ScanPlan(nodes_y, nodes_z, start, stop, scan.gates, scan.gate_count, float(position))
        )
    return plans


def _angles(half: float, count: int) -> np.ndarray:
    return np.linspace(-half, half, count) if count > 1 else np.zeros(1)
