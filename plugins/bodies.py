"""Shapes around media: what of a straight line is inside of them.

A line crosses cubes and spheres at two distances, in closed form. For any other shape rays are
traced, to each shape alone: where surfaces coincide, a common search would find one of them. Light
that leaves a closed mesh where it meets it next is inside.
"""

import abc
import itertools
from collections.abc import Sequence
from typing import TypeAlias

import drjit as dr
import mitsuba as mi
import numpy as np

from .variant_types import Float, Mask, Medium, MediumPtr, Point, Scene, Shape, Vector

Line: TypeAlias = tuple[Float, Float]
"""Distances along a line at which it enters and leaves a body, or a box around it."""
Crossing: TypeAlias = tuple[Float, MediumPtr, MediumPtr]
"""Distance of an open surface along a line, the media in front of it and behind."""

# A ray is traced from this far behind the last surface, relative to the position's size: several
# roundings of a coordinate in single precision (0.5 mm at 500 m).
STEP = 1e-6
# of a line across the cube of half edge 1, per m
SLOWEST = 1e-30
# open surfaces of a mesh that are distinguished
MOST_SHEETS = 64


def parts_of_shape(shape: Shape) -> "list[Body | Sheet]":
    """Media on both sides of shapes whose surface lets light pass: bodies and open surfaces."""
    if shape.class_name() == "Sphere":
        return [Sphere(shape)]
    if not shape.is_mesh():
        return [Sheet(shape, shape)]
    corners = _corners(shape)
    if (affine := _affine(corners)) is not None:
        return [Cube(shape, *affine)]
    faces = _faces(shape)
    pieces = _pieces(corners, faces)
    volumes = [_volume(corners, faces) if closed else 0 for faces, closed in pieces]
    boxes = [(corners[faces].min((0, 1)), corners[faces].max((0, 1))) for faces, _ in pieces]
    whole = len(pieces) == 1
    # two open surfaces at one place that face each other enclose nothing
    return [
        _part(shape, corners, faces, volume, _is_hollow(k, volumes, boxes), whole)
        for k, ((faces, closed), volume) in enumerate(zip(pieces, volumes, strict=True))
        if volume or not closed
    ]


class Body(abc.ABC):
    """A closed shape: its volume (m^3), the media on both sides of its surface.

    ``hollow``: a cavity of the shape, which has the exterior medium in it.
    """

    def __init__(self, shape: Shape, volume: float, hollow: bool = False) -> None:
        self.volume, self.shape, self.hollow = volume, shape, hollow
        media = shape.interior_medium(), shape.exterior_medium()
        self.interior, self.exterior = media[::-1] if _is_flipped(shape) != hollow else media
        self.inside, self.outside = mi.MediumPtr(self.interior), mi.MediumPtr(self.exterior)
        dr.make_opaque(self.inside, self.outside)

    @abc.abstractmethod
    def line(self, origin: Point, direction: Vector) -> Line:
        """Where a line enters and leaves it, or is near it; infinity, if it misses."""

    @abc.abstractmethod
    def next_crossing(
        self, line: Line, origin: Point, direction: Vector, start: Float, active: Mask
    ) -> tuple[Float, Mask]:
        """Distance of the next crossing behind ``start``, and whether that is inside."""

    def contains(self, places: np.ndarray) -> np.ndarray:
        """Whether places (n, 3) are inside."""
        low, high = extent(self.shape)
        near = ((places >= low) & (places <= high)).all(1)
        if not near.any():
            return near
        origin = mi.Point3f(*(mi.Float(np.ascontiguousarray(axis)) for axis in places.T))
        direction = mi.Vector3f(1, 0, 0)
        line = self.line(origin, direction)
        _, inside = self.next_crossing(line, origin, direction, mi.Float(0), mi.Bool(True))
        return np.broadcast_to(np.array(inside), len(places))


class Convex(Body):
    """A body that lines enter and leave once, at distances in closed form."""

    def next_crossing(
        self, line: Line, origin: Point, direction: Vector, start: Float, active: Mask
    ) -> tuple[Float, Mask]:
        """Distance of the next crossing behind ``start``, and whether that is inside."""
        near, far = line
        outside, leaves = near > start, far > start
        return dr.select(outside, near, dr.select(leaves, far, dr.inf)), ~outside & leaves


class Cube(Convex):
    """The image of the cube of half edge 1."""

    def __init__(
        self, shape: Shape, matrix: np.ndarray, centre: np.ndarray, hollow: bool = False
    ) -> None:
        super().__init__(shape, 8 * abs(np.linalg.det(matrix)), hollow)
        inverse = np.linalg.inv(matrix)
        self.to_local, self.offset = mi.Matrix3f(inverse), mi.Vector3f(-inverse @ centre)
        dr.make_opaque(self.to_local, self.offset)

    def line(self, origin: Point, direction: Vector) -> Line:
        """Where a line enters and leaves it; infinity, if it misses."""
        start, step = self.to_local @ origin + self.offset, self.to_local @ direction
        # along a face, the slowest of steps: products with the inverse stay finite
        slow = dr.rcp(dr.select(dr.abs(step) > SLOWEST, step, SLOWEST))
        middle, half = -start * slow, dr.abs(slow)
        near, far = dr.max(middle - half), dr.min(middle + half)
        return dr.select(near < far, near, dr.inf), far


class Sphere(Convex):
    """A sphere."""

    def __init__(self, shape: Shape) -> None:
        low, high = extent(shape)
        radius = (high - low).mean() / 2
        super().__init__(shape, 4 / 3 * np.pi * radius**3)
        self.centre, self.radius = mi.Point3f((low + high) / 2), mi.Float(radius)
        dr.make_opaque(self.centre, self.radius)

    def line(self, origin: Point, direction: Vector) -> Line:
        """Where a line enters and leaves it; infinity, if it misses."""
        offset = self.centre - origin
        middle = dr.dot(offset, direction)
        impact = dr.norm(offset - direction * middle)
        # not radius^2 - impact^2: of a large sphere that a line grazes it would have no digits
        half2 = (self.radius - impact) * (self.radius + impact)
        half = dr.safe_sqrt(half2)
        return dr.select(half2 > 0, middle - half, dr.inf), middle + half


class Closed(Body):
    """A closed mesh. Light that leaves it at the next surface is inside."""

    def __init__(self, shape: Shape, piece: Shape, volume: float, hollow: bool) -> None:
        super().__init__(shape, abs(volume), hollow)
        self.scene, (self.low, self.high) = scene_of([piece]), box_around([piece])
        # whether normals point outwards: they follow the order of corners, unless flipped
        self.outwards = _sign((volume > 0) != piece.has_flipped_normals())

    def line(self, origin: Point, direction: Vector) -> Line:
        """Where a line is near it."""
        return slabs(self.low, self.high, origin, direction)

    def next_crossing(
        self, line: Line, origin: Point, direction: Vector, start: Float, active: Mask
    ) -> tuple[Float, Mask]:
        """Distance of the next crossing behind ``start``, and whether that is inside."""
        near, far = line
        place, normal = _next(
            self.scene, origin, direction, start, active & (near <= far) & (far >= start)
        )
        leaves = dr.dot(normal, direction) * self.outwards > 0
        return place, (place < dr.inf) & leaves


class Sheet:
    """An open surface: a rectangle, a disc, a cylinder, a mesh with a rim."""

    def __init__(self, shape: Shape, piece: Shape) -> None:
        self.shape, self.scene = shape, scene_of([piece])
        self.interior, self.exterior = shape.interior_medium(), shape.exterior_medium()
        self.inside, self.outside = mi.MediumPtr(self.interior), mi.MediumPtr(self.exterior)
        dr.make_opaque(self.inside, self.outside)
        # whether the interior is behind the normal
        self.outwards = _sign(shape.has_flipped_normals() == piece.has_flipped_normals())

    def next_crossing(
        self, origin: Point, direction: Vector, start: Float, active: Mask
    ) -> Crossing:
        """Distance of the surface behind ``start``, the media in front of it and behind."""
        place, normal = _next(self.scene, origin, direction, start, active)
        leaves = dr.dot(normal, direction) * self.outwards > 0
        front = dr.select(leaves, self.inside, self.outside)
        return place, front, dr.select(leaves, self.outside, self.inside)


def passes_light(shape: Shape) -> bool:
    """Whether light passes a shape's surface unchanged."""
    bsdf = shape.bsdf()
    return bsdf is not None and mi.has_flag(bsdf.flags(), mi.BSDFFlags.Null)


def reflects(shape: Shape) -> bool:
    """Whether light that meets a shape is reflected diffusely, and in no other way."""
    bsdf, kinds = shape.bsdf(), mi.BSDFFlags
    return bsdf is not None and bsdf.flags() & +kinds.All == +kinds.DiffuseReflection


def name_of(thing: Shape | Medium) -> str:
    """What a message calls a shape or medium: those that Mitsuba has merged have no name."""
    return thing.id() or thing.class_name()


def extent(shape: Shape) -> np.ndarray:
    """Lowest and highest corner, (2, 3); Mitsuba's own is missing where it has merged meshes."""
    if shape.is_mesh():
        corners = _corners(shape)
        return np.stack([corners.min(0), corners.max(0)])
    return np.array([shape.bbox().min, shape.bbox().max], float)


def scene_extent(shapes: Sequence[Shape]) -> np.ndarray:
    """Corners of all shapes' boxes, (n, 3); the origin, if there is no shape."""
    return np.concatenate([extent(shape) for shape in shapes]) if shapes else np.zeros((1, 3))


def slabs(low: Point, high: Point, origin: Point, direction: Vector) -> Line:
    """Distances along a line at which it is inside a box, first and last."""
    # a component of 0 makes infinities; where it makes NaN (0 times infinity), comparisons fail
    first, last = (low - origin) / direction, (high - origin) / direction
    return dr.max(dr.minimum(first, last)), dr.min(dr.maximum(first, last))


def first_hit(scene: Scene, origin: Point, direction: Vector, active: Mask) -> tuple[Float, Vector]:
    """Distance of the first surface, infinite if there is none, and its normal."""
    # single rays: packets are slower here, coherent or not
    si = scene.ray_intersect(
        mi.Ray3f(origin, direction), ray_flags=+mi.RayFlags.Minimal, coherent=False, active=active
    )
    return dr.select(active & si.is_valid(), si.t, dr.inf), si.n


def _next(
    scene: Scene, origin: Point, direction: Vector, start: Float, active: Mask
) -> tuple[Float, Vector]:
    """Distance of the next surface behind ``start``, infinite if there is none, and its normal."""
    start = start + STEP * (dr.max(dr.abs(origin)) + start)
    place, normal = first_hit(scene, origin + direction * start, direction, active)
    return start + place, normal


def scene_of(shapes: Sequence[Shape]) -> Scene:
    """A scene of some shapes alone. Mitsuba renames them; their names are restored."""
    names = [shape.id() for shape in shapes]
    parts = {f"shape{number}": shape for number, shape in enumerate(shapes)}
    scene = mi.load_dict({"type": "scene", **parts}, optimize=False)
    for shape, name in zip(shapes, names, strict=True):
        shape.set_id(name)
    return scene


def _sign(positive: bool) -> Float:
    return dr.opaque(mi.Float, 1 if positive else -1)


def box_around(shapes: Sequence[Shape]) -> tuple[Point, Point]:
    """Corners of a box around shapes, opaque, so that no scene's size is compiled into a kernel."""
    corners = scene_extent(shapes)
    margin = 10 * STEP * (1 + np.abs(corners).max())
    low, high = mi.Point3f(corners.min(0) - margin), mi.Point3f(corners.max(0) + margin)
    dr.make_opaque(low, high)
    return low, high


def _is_hollow(
    index: int, volumes: Sequence[float], boxes: Sequence[tuple[np.ndarray, np.ndarray]]
) -> bool:
    """Whether a piece is a cavity: within a larger one, and wound the other way round."""
    volume, (low, high) = volumes[index], boxes[index]
    return any(
        other_volume * volume < 0
        and abs(other_volume) > abs(volume)
        and (first <= low).all()
        and (high <= last).all()
        for other_volume, (first, last) in zip(volumes, boxes, strict=True)
    )


def _part(
    shape: Shape, corners: np.ndarray, faces: np.ndarray, volume: float, hollow: bool, whole: bool
) -> Body | Sheet:
    if volume:
        used = corners[faces.min() : faces.max() + 1]
        affine = _affine(used)
        if affine is not None:
            return Cube(shape, *affine, hollow)
    piece = shape if whole else _mesh(corners, faces)
    return Closed(shape, piece, volume, hollow) if volume else Sheet(shape, piece)


def _affine(corners: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
    """The map from the cube of half edge 1 to a cube with these corners, or None."""
    reference = _corners(mi.load_dict({"type": "cube"}))
    if corners.shape != reference.shape:
        return None
    # x = A c + b for each corner c
    reference = np.column_stack([reference, np.ones(len(reference))])
    affine, *_ = np.linalg.lstsq(reference, corners, rcond=None)
    sheared = np.abs(reference @ affine - corners).max() > 1e-5 * np.abs(corners).max()
    return None if sheared else (affine[:3].T, affine[3])


def _pieces(corners: np.ndarray, faces: np.ndarray) -> list[tuple[np.ndarray, bool]]:
    """Parts of a mesh, each with whether it is closed: Mitsuba merges shapes of one medium.

    A part ends at the first face after which every edge, except those of a rim, has been passed as
    often in either direction.
    """
    # corners of one place are one, whatever their normals and texture coordinates
    _, same = np.unique(corners, axis=0, return_inverse=True)
    ends = same.reshape(-1)[faces].astype(np.int64)
    ends = np.stack([ends, np.roll(ends, -1, axis=1)], -1).reshape(-1, 2)
    face = np.repeat(np.arange(len(faces)), 3)
    key, sign = ends.min(1) * len(corners) + ends.max(1), np.sign(ends[:, 1] - ends[:, 0])
    order = np.lexsort((face, key))
    key, sign, face = key[order], sign[order], face[order]
    first = np.flatnonzero(np.diff(key, prepend=-1))
    total = np.add.reduceat(sign, first)
    count = np.diff(first, append=len(key))
    rim = np.repeat(total != 0, count)
    # zero at the end of each edge that is no rim
    passed = np.where(rim, 0, sign).cumsum()
    pending = np.zeros(len(faces) + 1, int)
    np.add.at(pending, face[:-1], passed[:-1] != 0)
    np.subtract.at(pending, face[1:], passed[:-1] != 0)
    last = np.flatnonzero(pending.cumsum()[:-1] == 0)
    open_ = np.zeros(len(faces), bool)
    open_[face[rim]] = True
    starts = np.concatenate([[0], last + 1])
    pieces = [(faces[a:b], not open_[a:b].any()) for a, b in itertools.pairwise(starts)]
    return [
        (part, closed)
        for piece, closed in pieces
        for part in ([piece] if closed else _sheets(piece))
    ]


def _sheets(faces: np.ndarray) -> list[np.ndarray]:
    """Open surfaces that share no corner, as Mitsuba has merged them."""
    before = np.maximum.accumulate(faces.max(1))
    behind = np.minimum.accumulate(faces.min(1)[::-1])[::-1]
    sheets = np.split(faces, np.flatnonzero(before[:-1] < behind[1:]) + 1)
    # beyond that, a surface of separate triangles
    return sheets if len(sheets) <= MOST_SHEETS else [faces]


def _mesh(corners: np.ndarray, faces: np.ndarray) -> Shape:
    """A mesh of some faces."""
    used, faces = np.unique(faces, return_inverse=True)
    if hasattr(mi.Mesh, "positions"):  # Mitsuba 3.10
        parts = mi.TensorXu(faces.reshape(-1, 3)), mi.TensorXf(corners[used])
        return mi.Mesh("part", faces=parts[0], positions=parts[1])
    mesh = mi.Mesh("part", len(used), faces.size // 3)
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = mi.Float(corners[used].ravel())
    parameters["faces"] = mi.UInt32(faces.ravel())
    parameters.update()
    return mesh


def _is_flipped(shape: Shape) -> bool:
    """Whether a scene asks for flipped normals; a mirrored sphere's are flipped by Mitsuba."""
    mirrored = False
    if shape.class_name() == "Sphere":
        place = np.array(mi.traverse(shape)["to_world"].matrix, float).reshape(4, 4)
        mirrored = np.linalg.det(place[:3, :3]) < 0
    return shape.has_flipped_normals() != mirrored


def _volume(corners: np.ndarray, faces: np.ndarray) -> float:
    """Volume (m^3) of a closed mesh, negative where corners run clockwise from outside."""
    first, second, third = (corners[faces[:, k]] - corners[faces[0, 0]] for k in range(3))
    parts = (first * np.cross(second, third)).sum(1) / 6
    # 0 where it is no more than the rounding of its parts
    return float(parts.sum() if abs(parts.sum()) > 1e-12 * np.abs(parts).sum() else 0)


def _corners(mesh: Shape) -> np.ndarray:
    """Corners (P, 3), which are a tensor from Mitsuba 3.10 on and a flat buffer before."""
    corners = mesh.positions() if hasattr(mi.Mesh, "positions") else mesh.vertex_positions_buffer()
    return np.array(corners, float).reshape(-1, 3)


def _faces(mesh: Shape) -> np.ndarray:
    """Numbers of the corners of every face (F, 3)."""
    faces = mesh.faces() if hasattr(mi.Mesh, "positions") else mesh.faces_buffer()
    return np.array(faces).reshape(-1, 3)
