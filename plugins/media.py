"""Walking a straight line through nested media: transmittance and analog collisions.

Both walks cross any number of shapes whose surface lets light pass unchanged (``null`` BSDF) and
that separate media. The distance travelled is counted along the unperturbed line, so path lengths
are exact; only the start of the *search* for the next surface is moved past the last one, by
`SURFACE_SKIP` of the position's size (5 mm at 500 m). Media thinner than that along the line are
missed. Any other surface is opaque.
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


def interaction(medium, position, direction, wavelengths, time):
    """The medium interaction of light that arrives at ``position`` along ``direction``."""
    mei = dr.zeros(mi.MediumInteraction3f)
    mei.p = position
    mei.wi = -direction
    mei.sh_frame = mi.Frame3f(-direction)
    mei.medium = medium
    mei.wavelengths = wavelengths
    mei.time = time
    return mei


def coefficients(medium, mei, channel, active):
    """Scattering and extinction coefficient (m^-1) at an interaction."""
    scattering, _, extinction = medium.get_scattering_coefficients(mei, active)
    return scattering[channel], extinction[channel]


def transmittance(
    air,
    medium,
    origin,
    direction,
    distance,
    channel,
    wavelengths,
    time,
    rng,
    active,
    differentiable=False,
):
    """Unbiased estimate of the transmittance along a straight line, and the medium at its end.

    Homogeneous media in closed form; others by residual ratio tracking (Novak et al. 2014, ACM TOG
    33(6)), unbiased for any majorant that bounds the extinction coefficient.

    With ``differentiable``, gradients are unbiased too: d ln T, the integral of -d(extinction), is
    estimated at one uniform place of the line, independent of the estimate of T.
    """
    where = rng.next_float32(active) * distance if differentiable else mi.Float(-1)
    with dr.suspend_grad():
        value, end, between = _walk(
            air,
            medium,
            dr.detach(origin),
            dr.detach(direction),
            dr.detach(distance),
            where,
            channel,
            wavelengths,
            time,
            rng,
            active,
        )
    if differentiable:
        mei = interaction(between, origin + direction * where, direction, wavelengths, time)
        inside = active & (between != None)
        _, extinction = coefficients(between, mei, channel, inside)
        depth = dr.select(inside, extinction * distance, 0)
        value *= dr.exp(dr.detach(depth) - depth)
    return value, end


@dr.syntax
def _walk(air, medium, origin, direction, distance, where, channel, wavelengths, time, rng, active):
    """Transmittance, medium at the end, and medium at the distance ``where``."""
    active = mi.Bool(active)
    medium = mi.MediumPtr(medium)
    travelled, skip, value = mi.Float(0), mi.Float(0), mi.Float(1)
    between = mi.MediumPtr(medium)
    crossings, size = air.crossings(origin, direction), dr.max(dr.abs(origin))
    while dr.hint(active, label="transmittance"):
        end, hit, passes, behind = air.next_surface(
            crossings, origin, direction, travelled + skip, distance, medium, active
        )
        skip = SURFACE_SKIP * (size + end)
        inside = active & (medium != None)
        # control variate: the extinction in the middle of the segment; the remainder is tracked
        middle = origin + direction * (0.5 * (travelled + end))
        mei = interaction(medium, middle, direction, wavelengths, time)
        _, control = coefficients(medium, mei, channel, inside)
        value = dr.select(inside, value * dr.exp(-control * (end - travelled)), value)
        majorant = medium.get_majorant(mei, inside)[channel]
        tracking = inside & ~medium.is_homogeneous() & (majorant > 0)
        position = mi.Float(travelled)
        while dr.hint(tracking, label="ratio tracking"):
            position -= dr.log(1 - rng.next_float32(tracking)) / majorant
            tracking &= position < end
            mei = interaction(medium, origin + direction * position, direction, wavelengths, time)
            _, extinction = coefficients(medium, mei, channel, tracking)
            excess = (extinction - control) / majorant
            value = dr.select(tracking, value * (1 - excess), value)
        value = dr.select(hit & ~passes, 0, value)
        medium = dr.select(hit, behind, medium)
        between = dr.select(hit & (end <= where), behind, between)
        travelled = end
        active &= hit & (value > 0)
    return value, medium, between


@dr.syntax
def collision(air, medium, origin, direction, distance, channel, wavelengths, time, rng, active):
    """Distance to the first real collision by delta tracking, its medium, and whether it happened.

    Not forced: a sample without a collision within ``distance``, or at an opaque surface, is lost.
    """
    active = mi.Bool(active)
    medium = mi.MediumPtr(medium)
    travelled, skip = mi.Float(0), mi.Float(0)
    found = mi.Bool(False)
    crossings, size = air.crossings(origin, direction), dr.max(dr.abs(origin))
    while dr.hint(active, label="free flight"):
        end, hit, passes, behind = air.next_surface(
            crossings, origin, direction, travelled + skip, distance, medium, active
        )
        skip = SURFACE_SKIP * (size + end)
        inside = active & (medium != None)
        mei = interaction(medium, origin + direction * travelled, direction, wavelengths, time)
        majorant = medium.get_majorant(mei, inside)[channel]
        tracking = inside & (majorant > 0)
        while dr.hint(tracking, label="delta tracking"):
            travelled -= dr.select(tracking, dr.log(1 - rng.next_float32(tracking)) / majorant, 0)
            tracking &= travelled < end
            mei = interaction(medium, origin + direction * travelled, direction, wavelengths, time)
            _, extinction = coefficients(medium, mei, channel, tracking)
            real = tracking & (rng.next_float32(tracking) * majorant < extinction)
            found |= real
            tracking &= ~real
        active &= ~found & hit & passes
        medium = dr.select(active, behind, medium)
        travelled = dr.select(found, travelled, end)
    return travelled, medium, found
