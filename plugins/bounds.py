"""Bounds of the extinction coefficient in blocks of grid cells.

Transmittance and free flights walk a line block by block, each with the block's own majorant, so
that a dense place takes lookups and makes noise only where it is. The size of the blocks is a
matter of speed alone.
"""

import functools
import math
import re
from collections.abc import Callable, Iterable
from typing import Any, TypeAlias

import drjit as dr
import mitsuba as mi
import numpy as np

from .variant_types import Cell, Float, Medium, MediumPtr, Point, Tensor, UInt, Vector, Volume

# Least number of cells along the edge of a block, largest number of blocks along an axis, and the
# optical depth of an axis, at the difference of the field's bounds, for which one more block pays.
CELLS, BLOCKS, DEPTH = 4, 64, 0.5

Source: TypeAlias = tuple[int, float, int, bytes, bool]
"""What the blocks of a grid depend on: its array's index, scale, channel, place, whether a flow
carries it."""

UNKNOWN, UNIFORM, BLOCKED = 0, 1, 2
"""What is known of a medium: its majorant alone, that it is the same everywhere, its blocks."""


class Bounds:
    """Bounds of all media of a scene, in tables that a wavefront looks up.

    Regular grids (``gridvolume``, `moving_volume`) have blocks of cells, those of a moving volume
    over all its states. Beyond the grid the bounds are those of the whole grid, whatever its
    ``wrap_mode``. Other volumes have their majorant.
    """

    def __init__(self) -> None:
        self._read: dict[Medium, _Blocks] = {}

    def update(self, media: Iterable[Medium], channel: int) -> None:
        """Read the media that have changed since the last call."""
        read = {medium: _blocks(medium, channel, self._read.get(medium)) for medium in media}
        if not self._read or read != self._read:
            self._tabulate(read)
        self._read = read

    def _tabulate(self, read: "dict[Medium, _Blocks]") -> None:
        # medium 0 is none: one block without any extinction, so that lanes in a vacuum need no
        # branch of their own
        numbers = [0, *(_number(mi.MediumPtr(medium))[0] for medium in read)]
        tables = [_Blocks(BLOCKED), *read.values()]
        size, first, values = max(numbers) + 1, 0, []
        kinds, firsts = np.zeros(size, np.uint32), np.zeros(size, np.uint32)
        counts, frames = np.zeros((size, 3), np.int32), np.zeros((size, 4, 3), np.float32)
        for number, blocks in zip(numbers, tables, strict=True):
            kinds[number], firsts[number] = blocks.kind, first
            counts[number], frames[number] = blocks.counts, blocks.frame
            values.append(blocks.values)
            first += len(blocks.values)
        self.varies = any(blocks.kind != UNIFORM for blocks in read.values())
        self.kinds, self.firsts = mi.UInt32(kinds), mi.UInt32(firsts)
        self.counts, self.frames = mi.Int32(counts.ravel()), mi.Float(frames.ravel())
        self.values = mi.Float(np.concatenate(values).ravel())
        # opaque, also where there is one entry only, so that other fields run in the same kernel
        dr.make_opaque(self.kinds, self.firsts, self.counts, self.frames, self.values)

    def kind(self, medium: MediumPtr) -> UInt:
        """What is known of the medium of each lane."""
        return dr.gather(mi.UInt32, self.kinds, _number(medium))

    def enter(
        self, medium: MediumPtr, origin: Point, direction: Vector
    ) -> tuple[Vector, Vector, Cell, UInt]:
        """A line in the blocks of a medium: its start, step per metre, counts and first value."""
        number = _number(medium)
        rows = [dr.gather(mi.Vector3f, self.frames, 4 * number + row) for row in range(4)]
        start = mi.Vector3f([dr.dot(row, origin) for row in rows[:3]]) + rows[3]
        step = mi.Vector3f([dr.dot(row, direction) for row in rows[:3]])
        counts = dr.gather(mi.Vector3i, self.counts, number)
        return start, step, counts, dr.gather(mi.UInt32, self.firsts, number)

    def extinction(self, block: Cell, counts: Cell, first: UInt) -> Vector:
        """Least, mean and largest extinction of a block, m^-1."""
        # a layer of blocks around the grid holds the bounds of all that lies beyond
        place = block + 1
        index = (place.z * (counts.y + 2) + place.y) * (counts.x + 2) + place.x
        return dr.gather(mi.Vector3f, self.values, first + mi.UInt32(index))


def _number(medium: MediumPtr) -> UInt:
    return dr.reinterpret_array(mi.UInt32, medium)


def locate(start: Vector, step: Vector, counts: Cell, travelled: Float) -> Cell:
    """The block of a line at a distance; -1 and ``counts`` are all that lies beyond the grid."""
    place = dr.clip(dr.floor(start + step * travelled), -1, mi.Vector3f(counts))
    return mi.Vector3i(place)


def leave(start: Vector, step: Vector, counts: Cell, block: Cell) -> tuple[Float, Cell]:
    """Distance at which a line leaves a block, and the block behind it."""
    forward = step > 0
    onward = (forward & (block < counts)) | ((step < 0) & (block >= 0))
    face = mi.Vector3f(dr.select(forward, block + 1, block))
    # along an axis in which it leaves the grid or does not move, it stays in its block
    ends = dr.select(onward, (face - start) / step, dr.inf)
    end = dr.min(ends)
    # one axis only, so that every block on the way is visited
    along_x = ends.x == end
    along_y = ~along_x & (ends.y == end)
    unit = mi.Vector3i(
        dr.select(along_x, 1, 0), dr.select(along_y, 1, 0), dr.select(along_x | along_y, 0, 1)
    )
    return end, block + dr.select(forward, unit, -unit)


class _Blocks:
    """Bounds of one medium; ``frame`` maps world coordinates to blocks."""

    def __init__(
        self,
        kind: int,
        counts: tuple[int, ...] = (0, 0, 0),
        frame: np.ndarray | None = None,
        values: np.ndarray | None = None,
        source: tuple[Source, Float] | None = None,
    ) -> None:
        self.kind, self.counts, self.source = kind, counts, source
        self.frame = np.zeros((4, 3)) if frame is None else frame
        blocks = math.prod(count + 2 for count in counts)
        self.values = np.zeros((blocks, 3)) if values is None else values


def _blocks(medium: Medium, channel: int, known: _Blocks | None) -> _Blocks:
    """Bounds of a medium; ``known`` again if it is unchanged."""
    volume = _parts(medium).get("sigma_t")
    data = _grid(volume)
    if data is None:
        constant = volume is not None and volume.class_name() == "ConstVolume"
        kind = UNIFORM if constant or medium.is_homogeneous() else UNKNOWN
        # the same object for the same bounds: the tables are not written again
        return known if known and known.kind == kind else _Blocks(kind)
    scale, to_local = float(mi.traverse(medium)["scale"]), _to_local(volume)
    # an array has its index for as long as it is in use, and `known` uses it: an equal index is
    # the same values, without reading them
    array = mi.Float(dr.detach(data.array))
    carried = volume is not None and hasattr(volume, "carried") and volume.carried()
    source = array.index, scale, channel, to_local.tobytes(), carried
    if known and known.source and known.source[0] == source:
        return known
    # states, z, y, x, channels; a grid that does not change has one state
    field = np.array(array, float).reshape(-1, *data.shape[-4:])
    field = scale * field[..., channel if data.shape[-1] == 3 else 0]
    least, most = field.min(0), field.max(0)
    mean, outside = field.mean(0), (least.min(), field.mean(), most.max())
    extents = np.linalg.norm(np.linalg.inv(to_local[:3, :3]), axis=0)[::-1]
    # an even field gains nothing from blocks, whose borders each cost a step
    wanted = np.clip((outside[2] - outside[0]) * extents / DEPTH, 1, BLOCKS)
    edges = np.maximum(CELLS, np.ceil(mean.shape / wanted)).astype(int)
    if carried:
        # a value may come from anywhere
        edges = np.array(mean.shape)
    for axis, edge in enumerate(edges):
        least = _reduced(np.minimum, least, axis, edge)
        most = _reduced(np.maximum, most, axis, edge)
        mean = _averaged(mean, axis, edge)
    counts = mean.shape[::-1]
    bounds = zip((least, mean, most), outside, strict=True)
    values = np.stack([np.pad(part, 1, constant_values=value) for part, value in bounds], -1)
    blocks = (np.array(field.shape[1:]) / edges)[::-1]
    frame = np.vstack([to_local[:3, :3] * blocks[:, None], to_local[:3, 3] * blocks])
    return _Blocks(BLOCKED, counts, frame, values.reshape(-1, 3), (source, array))


def _parts(medium: Medium) -> dict[str, Any]:
    """Parts of a medium, by name."""
    parts: dict[str, Any] = {}

    class Parts(mi.TraversalCallback):
        def put(self, name: str, value: Any, *_: object) -> None:
            parts[name] = value

    medium.traverse(Parts())
    return parts


def _grid(volume: Volume) -> Tensor | None:
    """Values of a volume that is a regular grid of extinction coefficients; None for others."""
    if volume is None or not (volume.class_name() == "GridVolume" or hasattr(volume, "to_grid")):
        return None
    data = mi.traverse(volume)["data"]
    # in spectral variants colours are coefficients of polynomials
    return data if data.shape[-1] == 1 or (mi.is_rgb and data.shape[-1] == 3) else None


def _to_local(volume: Volume) -> np.ndarray:
    """The map from the world to the unit cube that a grid fills, 4 x 4.

    Mitsuba states a grid's map in words only, to six digits: the middle of the bounding box gives
    its place to the rounding of single precision, and its axes are right to a millionth of it.
    """
    if hasattr(volume, "to_grid"):
        return volume.to_grid()
    match = re.search(r"matrix=\[\[(.*?)\]\]", str(volume), re.DOTALL)
    assert match is not None  # every version of Mitsuba that is allowed prints it
    numbers = [float(word) for word in re.split(r"[\s,\[\]]+", match[1]) if word]
    matrix = np.array(numbers).reshape(4, 4)
    box = volume.bbox()
    middle = (np.array(box.min, float).ravel() + np.array(box.max, float).ravel()) / 2
    matrix[:3, 3] = 0.5 - matrix[:3, :3] @ middle
    return matrix


def _reduced(
    extreme: Callable[[np.ndarray, np.ndarray], np.ndarray], field: np.ndarray, axis: int, edge: int
) -> np.ndarray:
    """Extremes of blocks along an axis, each with one cell more on either side.

    Interpolation looks up half of that cell; the other half is a margin for rounding. Beside the
    first and the last cell lies the opposite one, too: a grid may repeat.
    """
    cells = field.shape[axis]
    starts = np.arange(0, cells, edge)
    places = [starts + offset for offset in range(-1, edge + 1)]
    repeated = [np.where((p == -1) | (p == cells), p % cells, p) for p in (places[0], places[-1])]
    parts = [field.take(np.clip(p, 0, cells - 1), axis) for p in places + repeated]
    return functools.reduce(extreme, parts)


def _averaged(field: np.ndarray, axis: int, edge: int) -> np.ndarray:
    """Means of blocks along an axis."""
    starts = np.arange(0, field.shape[axis], edge)
    lengths = np.diff([*starts, field.shape[axis]])
    sums = np.add.reduceat(field, starts, axis)
    return sums / lengths.reshape([-1 if dim == axis else 1 for dim in range(3)])
