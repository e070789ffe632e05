"""Surfaces between media along a straight line, and the media behind them.

Shapes whose surface lets light pass unchanged (``null`` BSDF) separate media; any other surface is
opaque. The distance travelled is counted along the unperturbed line, so path lengths are exact;
only the start of the *search* for the next surface is moved past the last one, by `SURFACE_SKIP` of
the position's size (5 mm at 500 m). Media thinner than that along the line are missed.
"""

import drjit as dr
import mitsuba as mi
import numpy as np

SURFACE_SKIP = 1e-5
# m, beyond any air
FAR = 1e9


class Air:
    """A scene's media and the surfaces between them.

    Where all of these are cubes that let light pass, a straight line's crossings are found in
    closed form, in less than half of the time. For any other scene rays are traced, and only
    within the box that holds all surfaces. Outside, on most of the path between telescope and slab,
    there is nothing to intersect.
    """

    def __init__(self, scene):
        self.scene = scene
        self.cubes = _cubes(scene)
        box = mi.ScalarBoundingBox3f()
        for shape in scene.shapes():
            box.expand(shape.bbox())
        if not box.valid():
            box = mi.ScalarBoundingBox3f(mi.ScalarPoint3f(0))
        margin = SURFACE_SKIP * (1 + max(dr.max(dr.abs(box.min)), dr.max(dr.abs(box.max))))
        self.low, self.high = mi.Point3f(box.min - margin), mi.Point3f(box.max + margin)
        # opaque, so that no scene's size is compiled into a kernel
        dr.make_opaque(self.low, self.high)

    def bounds(self, outside):
        """Corners of a box that holds all air, for a telescope in the medium ``outside``."""
        shapes = self.scene.shapes()
        within = [shape.interior_medium() for shape in shapes]
        beyond = [shape.exterior_medium() for shape in shapes]
        if outside is None and all(medium is None or medium in within for medium in beyond):
            return self.low, self.high
        return dr.opaque(mi.Point3f, -FAR), dr.opaque(mi.Point3f, FAR)

    def crossings(self, origin, direction):
        """Where a line enters and leaves each cube, if it does: first and last distance."""
        found = []
        for to_local, offset, _, _ in self.cubes or ():
            start, step = to_local @ origin + offset, to_local @ direction
            near, far = slabs(mi.Vector3f(-1), mi.Vector3f(1), start, step)
            found.append((dr.select(near < far, near, dr.inf), dr.select(near < far, far, -dr.inf)))
        return found

    def next_surface(self, crossings, origin, direction, start, distance, medium, active):
        """The next surface of a line between two distances, and the medium behind it.

        Returns the end of the present segment, whether a surface ends it, whether light passes that
        surface and the medium behind it.
        """
        active = active & (start < distance)
        if self.cubes is None:
            return self._trace(origin, direction, start, distance, medium, active)
        end, behind = mi.Float(distance), mi.MediumPtr(medium)
        for (near, far), (_, _, interior, exterior) in zip(crossings, self.cubes, strict=True):
            enters = near > start
            place = dr.select(enters, near, far)
            nearest = active & (place > start) & (place < end)
            end = dr.select(nearest, place, end)
            behind = dr.select(nearest, dr.select(enters, interior, exterior), behind)
        return end, end < distance, mi.Bool(True), behind

    def _trace(self, origin, direction, start, distance, medium, active):
        ray = mi.Ray3f(origin + direction * start, direction)
        ray.maxt = distance - start
        near, far = slabs(self.low, self.high, ray.o, ray.d)
        active &= ~((near > far) | (far < 0) | (near > ray.maxt))
        # one by one: packets of rays are slower here, coherent or not
        si = self.scene.ray_intersect(
            ray, ray_flags=+mi.RayFlags.Minimal, coherent=False, active=active
        )
        hit = active & si.is_valid()
        end = dr.select(hit, dr.minimum(start + si.t, distance), distance)
        passes = mi.has_flag(si.bsdf().flags(), mi.BSDFFlags.Null)
        behind = dr.select(hit & si.is_medium_transition(), si.target_medium(direction), medium)
        return end, hit, passes, behind


def slabs(low, high, origin, direction):
    """Distances along a line at which it is inside a box, first and last."""
    # a component of 0 makes infinities; where it makes NaN (0 times infinity), comparisons fail
    first, last = (low - origin) / direction, (high - origin) / direction
    return dr.max(dr.minimum(first, last)), dr.min(dr.maximum(first, last))


def _cubes(scene):
    """Of all surfaces between media: the map to the cube of half edge 1, interior and exterior.

    None, if a surface is not a cube or does not let light pass unchanged.
    """
    corners = _corners(mi.load_dict({"type": "cube"}))
    found = []
    for shape in scene.shapes():
        bsdf = shape.bsdf()
        passes = bsdf is not None and mi.has_flag(bsdf.flags(), mi.BSDFFlags.Null)
        if shape.class_name() != "Cube" or not passes or shape.has_flipped_normals():
            return None
        # x = A c + b for each corner c; a mirrored cube's normals point inwards
        reference, moved = np.column_stack([corners, np.ones(len(corners))]), _corners(shape)
        if moved.shape != corners.shape:
            return None
        affine, *_ = np.linalg.lstsq(reference, moved, rcond=None)
        matrix, centre = affine[:3].T, affine[3]
        bent = np.abs(reference @ affine - moved).max() > 1e-5 * np.abs(moved).max()
        if bent or np.linalg.det(matrix) <= 0:
            return None
        if not shape.is_medium_transition():
            continue
        inverse = np.linalg.inv(matrix)
        cube = (
            mi.Matrix3f(inverse),
            mi.Vector3f(-inverse @ centre),
            mi.MediumPtr(shape.interior_medium()),
            mi.MediumPtr(shape.exterior_medium()),
        )
        dr.make_opaque(cube)
        found.append(cube)
    return found


def _corners(cube):
    return np.array(cube.vertex_positions_buffer(), float).reshape(-1, 3)
