"""
.. _sensor-ccd:

Lens and CCD (``ccd``)
----------------------

A camera focused at infinity: parallel light through a round stop is focused to a point on a CCD.
The lens is part of the camera. Rays are traced through it in its own coordinates, surface by
surface, which avoids the displacement of ray origins at Mitsuba shapes (1e-4 m, some m/s of wind).

=========================== ========== ==================================================== =======
Parameter                   Type       Meaning                                              Default
=========================== ========== ==================================================== =======
``focal_length``            float      m                                                    0.3
``pixel``                   float      side of a square pixel, m                            7.4e-6
``centre_x, centre_y``      float      where the optical axis meets the CCD, px right and   middle
                                       down from the centre of the top left pixel
``tilt_x, tilt_y``          float      rad, of the CCD about its y and x axis: the sides of  0
                                       larger x, of larger y lie farther from the lens
``distortion``              float      k of r = r_ideal (1 + k (r_ideal / R)^2), R half the 0
                                       CCD's diagonal; up to 0.05 each way
``defocus``                 float      diameter of the image of a point of light, m         0
``stop_radius``             float      m                                                    5e-3
``lens``                    string,    ``ideal``: light at an angle goes to r = f tan       ideal
                            tensor     (angle), from everywhere on the stop; or N x 4
                                       numbers, row by row, or the name of a file of them
                                       (``.npy``, text with ``#`` comments): a real lens
``to_world``                transform  of the camera's frame: stop at the origin, x to the  identity
                                       scene, y to the left, z up
=========================== ========== ==================================================== =======

The image is upright: its top is z up, its left is y. A lens has a row for each surface along the
light path, the stop first: radius of curvature (m; positive: the centre is on the side of the CCD;
0: plane), conic constant, distance to the next surface or the CCD (m), refractive index behind. The
lens is assumed to be coated: without loss and without effect on the polarisation. For a real lens
``focal_length`` does not affect the image; other parts of the program use it.

Tilt and distortion are about the point (``centre_x``, ``centre_y``), and add to those of a real
lens. A defocus spreads a point of light over a disc that is the same everywhere on the CCD: light
through the middle of the stop is not displaced, light through its rim by the radius of the disc.
(Rays traced from the CCD through a real lens use their position on its last surface in place of
that in the stop, which causes an error of 1 to 2 % of the disc.)

The weight of a sampled ray is the étendue (m^2 sr) of its pixel, so that the mean of weight times
radiance is the power on the pixel.

.. code-block:: xml

    <sensor type="ccd">
      <float name="focal_length" value="0.3"/> <float name="pixel" value="7.4e-6"/>
      <film type="hdrfilm">
        <integer name="width" value="960"/> <integer name="height" value="780"/>
        <rfilter type="box"/>
      </film>
    </sensor>
"""

import math
from types import ModuleType

import drjit as dr
import mitsuba as mi
import numpy as np

from .parameters import fail, number, pose, positive
from .parameters import table as read_table
from .registration import register
from .variant_types import (
    Box,
    Float,
    Mask,
    Numbers,
    Point,
    Properties,
    Ray,
    Spectrum,
    Table,
    Transform,
    Vector,
)

NAME, KIND = "ccd", "sensor"


def define() -> type:
    """The plugin's class in the variant in force."""

    class Ccd(mi.Sensor):
        def __init__(self, props: Properties) -> None:
            super().__init__(props)
            width, height = self.film().size()
            self.focal_length = positive(props, NAME, "focal_length", 0.3)
            self.pixel = positive(props, NAME, "pixel", 7.4e-6)
            self.centre = (
                number(props, NAME, "centre_x", (width - 1) / 2),
                number(props, NAME, "centre_y", (height - 1) / 2),
            )
            for axis, value in zip("xy", self.centre, strict=True):
                if not np.isfinite(value):
                    fail(NAME, f"centre_{axis}", value, "a finite number")
            self.stop_radius = positive(props, NAME, "stop_radius", 5e-3)
            self.tilt = tuple(number(props, NAME, f"tilt_{axis}", 0.0) for axis in "xy")
            for axis, value in zip("xy", self.tilt, strict=True):
                if not abs(value) < 0.5:
                    fail(NAME, f"tilt_{axis}", value, "less than 0.5 rad each way")
            self.distortion = number(props, NAME, "distortion", 0.0)
            if not abs(self.distortion) <= 0.05:
                fail(NAME, "distortion", self.distortion, "up to 0.05 each way")
            self.defocus = number(props, NAME, "defocus", 0.0)
            if not 0 <= self.defocus <= 0.01:
                fail(NAME, "defocus", self.defocus, "0 to 0.01 m")
            self.half_diagonal = float(np.hypot(width, height)) / 2 * self.pixel
            lens = props.get("lens", "ideal")
            ideal = isinstance(lens, str) and lens == "ideal"
            self.lens = None if ideal else read_lens(lens)
            self.m_focal_length = dr.opaque(mi.Float, self.focal_length)
            self.m_pixel = dr.opaque(mi.Float, self.pixel)
            self.m_centre = dr.opaque(mi.Point2f, self.centre)
            self.m_stop = dr.opaque(mi.Float, self.stop_radius)
            self.m_pose = pose(props, NAME)
            dr.make_opaque(self.m_pose)
            if self.lens is not None:
                self.m_exit = dr.opaque(mi.Float, self._exit_radius(self.lens))

        # --- light towards the CCD; (right, down, onward) are the lens's own coordinates

        def sample_stop(self, sample: Point) -> Point:
            """Points of the stop, uniformly (world)."""
            disc = mi.warp.square_to_uniform_disk(sample) * self.m_stop
            return self.m_pose @ mi.Point3f(0, disc.x, disc.y)

        def stop_area(self) -> Float:
            """Area of the stop, m^2."""
            return dr.pi * self.m_stop * self.m_stop

        def receive(self, point: Point, direction: Vector) -> tuple[Point, Mask]:
            """Position on the CCD of light through ``point`` of the stop along ``direction``.

            Both in world coordinates. The position is in px right and down from the centre of the
            top left pixel; also returns whether it is on the CCD.
            """
            inverse = self.m_pose.inverse()
            point, direction = inverse @ point, inverse @ direction
            if self.lens is None:
                scale = self.m_focal_length / -direction.x
                right, down = direction.y * scale, direction.z * scale
                arrives = direction.x < 0
            else:
                (right, down), _, arrives = _traced(
                    self.lens, (point.y, point.z), (direction.y, direction.z, -direction.x), dr
                )
                arrives &= direction.x < 0
            at = self._distorted(right, down)
            if self.defocus:
                at += mi.Point2f(point.y, point.z) * (self.defocus / 2 / self.m_stop)
            place = at / self.m_pixel + self.m_centre
            width, height = self.film().size()
            arrives &= (place.x >= -0.5) & (place.x < width - 0.5)
            arrives &= (place.y >= -0.5) & (place.y < height - 0.5)
            return place, arrives

        # --- rays from the CCD into the scene

        def sample_towards_scene(self, place: Point, sample: Point) -> tuple[Point, Vector, Float]:
            """A ray from ``place`` (px, as above) through the lens: stop point, direction, weight.

            The mean of the weight over ``sample`` is a pixel's étendue.
            """
            at = (place - self.m_centre) * self.m_pixel
            disc = mi.warp.square_to_uniform_disk(sample)
            if self.defocus:
                at -= disc * (self.defocus / 2)
            at, stretch = self._ideal(at)
            area = self.m_pixel * self.m_pixel * stretch
            if self.lens is None:
                point = mi.Point3f(0, disc.x * self.m_stop, disc.y * self.m_stop)
                direction = dr.normalize(mi.Vector3f(self.m_focal_length, -at.x, -at.y))
                distance, weight = self.m_focal_length, area * self.stop_area()
                weight *= dr.square(dr.square(direction.x)) / dr.square(distance)
                return self.m_pose @ point, self.m_pose @ direction, weight
            distance = float(self.lens[-1, 2])
            behind = disc * self.m_exit  # a point in the last surface's tangent plane
            inward = dr.normalize(mi.Vector3f(behind.x - at.x, behind.y - at.y, distance))
            (right, down), out, passes = _traced(
                _reversed(self.lens), (at.x, at.y), (inward.x, inward.y, inward.z), dr
            )
            passes &= dr.square(right) + dr.square(down) <= dr.square(self.m_stop)
            weight = area * dr.pi * dr.square(self.m_exit) * dr.square(dr.square(inward.z))
            weight = dr.select(passes, weight / distance**2, 0)
            point, direction = mi.Point3f(0, right, down), mi.Vector3f(out[2], out[0], out[1])
            return self.m_pose @ point, self.m_pose @ direction, weight

        # --- from the CCD to the image of an ideal lens on an upright CCD, and back

        def _ideal(self, at: Point) -> tuple[Point, Float]:
            """Place in the ideal image of a place on the CCD, and its area there over the CCD's.

            Light through the middle of the lens meets the tilted CCD in P = (0, 0, f) + x e_x +
            y e_y, and the ideal image in f P / P_z.
            """
            stretch = mi.Float(1)
            if any(self.tilt):
                (cos_x, sin_x), (cos_y, sin_y) = ((math.cos(t), math.sin(t)) for t in self.tilt)
                nearer = 1 / (1 + (at.x * sin_x * cos_y + at.y * sin_y) / self.m_focal_length)
                at = mi.Point2f(at.x * cos_x, at.y * cos_y - at.x * sin_x * sin_y) * nearer
                stretch = cos_x * cos_y * nearer * nearer * nearer
            if self.distortion:
                k, far2 = self.distortion, dr.squared_norm(at) / self.half_diagonal**2
                ideal2 = far2
                # Newton's method for q (1 + k q)^2, the squared radius of the distorted image
                for _ in range(3):
                    wide = 1 + k * ideal2
                    ideal2 = ideal2 - (ideal2 * wide * wide - far2) / (wide * (1 + 3 * k * ideal2))
                wide = 1 + k * ideal2
                at, stretch = at / wide, stretch / (wide * (1 + 3 * k * ideal2))
            return at, stretch

        def _distorted(self, right: Float, down: Float) -> Point:
            """Place on the CCD of a place in the ideal image."""
            at = mi.Point2f(right, down)
            if self.distortion:
                at *= 1 + self.distortion * dr.squared_norm(at) / self.half_diagonal**2
            if any(self.tilt):
                (cos_x, sin_x), (cos_y, sin_y) = ((math.cos(t), math.sin(t)) for t in self.tilt)
                # the light's way meets the CCD: with n = e_x x e_y, t n.(x, y, f) = n_z f
                normal = -sin_x, -cos_x * sin_y, cos_x * cos_y
                toward = normal[0] * at.x + normal[1] * at.y
                # t - 1, without the loss of digits of t
                step = -toward / (normal[2] * self.m_focal_length + toward)
                x, y, z = at.x * (1 + step), at.y * (1 + step), step * self.m_focal_length
                at = mi.Point2f(
                    cos_x * x - sin_x * sin_y * y + sin_x * cos_y * z, cos_y * y + sin_y * z
                )
            return at

        def _exit_radius(self, lens: np.ndarray) -> float:
            """Radius of the light's cross-section in the tangent plane of a lens's last surface."""
            width, height = self.film().size()
            corner = np.abs(np.array([[0, 0], [width, height]]) - 0.5 - self.centre).max(0)
            field = np.hypot(*corner) * self.pixel / self.focal_length
            angle = np.linspace(0, 2 * np.pi, 64, endpoint=False)
            slopes = np.linspace(0, 1.01 * field, 16)[:, None]
            length = np.sqrt(1 + slopes**2)
            rim = self.stop_radius * np.cos(angle), self.stop_radius * np.sin(angle)
            rays = slopes / length, np.zeros_like(slopes), 1 / length
            (right, down), out, passes = _traced(lens, rim, rays, np)
            if not passes.all():
                fail(NAME, "lens", "light misses a surface", "surfaces that all light meets")
            back = -lens[-1, 2] / out[2]
            return 1.01 * float(np.hypot(right + back * out[0], down + back * out[1]).max())

        # --- Mitsuba

        def world_transform(self) -> Transform:
            return self.m_pose

        def sample_ray(
            self, time: Float, sample1: Float, sample2: Point, sample3: Point, active: Mask = True
        ) -> tuple[Ray, Spectrum]:
            """A ray of a film position in [0, 1]^2; its weight is a pixel's étendue."""
            place = mi.Point2f(sample2) * mi.Point2f(self.film().size()) - 0.5
            point, direction, weight = self.sample_towards_scene(place, sample3)
            return mi.Ray3f(point, direction, time, type(mi.Ray3f().wavelengths)()), (
                mi.Spectrum(weight) & active
            )

        def sample_ray_differential(
            self, time: Float, sample1: Float, sample2: Point, sample3: Point, active: Mask = True
        ) -> tuple[Ray, Spectrum]:
            ray, weight = self.sample_ray(time, sample1, sample2, sample3, active)
            return mi.RayDifferential3f(ray), weight

        def bbox(self) -> Box:
            return mi.ScalarBoundingBox3f(mi.ScalarPoint3f(0))

        def to_string(self) -> str:
            width, height = self.film().size()
            kind = "ideal lens" if self.lens is None else f"lens of {len(self.lens) - 1} surfaces"
            return (
                f"Ccd[{width} x {height} pixels of {self.pixel:g} m, {kind}, "
                f"focal_length={self.focal_length:g} m]"
            )

    return Ccd


def read_lens(source: Table) -> np.ndarray:
    """A lens (tensor or file name), checked: rows of radius, conic, distance, index behind."""
    lens = np.asarray(read_table(NAME, "lens", source, 4), float)
    if lens.ndim == 1 and lens.size % 4 == 0:
        lens = lens.reshape(-1, 4)
    if lens.ndim != 2 or lens.shape[1] != 4 or len(lens) < 2:
        fail(NAME, "lens", f"shape {lens.shape}", "N x 4 numbers, the stop and at least a surface")
    if not np.isfinite(lens).all():
        fail(NAME, "lens", "NaN or infinity", "finite numbers; a plane has the radius 0")
    if (lens[0, [0, 3]] != (0, 1)).any() or lens[-1, 3] != 1:
        fail(NAME, "lens", lens[[0, -1]].tolist(), "a plane stop first, and air (1) at both ends")
    if (lens[:, 2] < 0).any() or lens[-1, 2] == 0 or (lens[:, 3] < 1).any():
        fail(NAME, "lens", lens.tolist(), "distances of at least 0 and indices of at least 1")
    return lens


def _reversed(lens: np.ndarray) -> np.ndarray:
    """The lens in reverse order: the CCD first, the stop's plane at the end."""
    back = np.zeros_like(lens)
    back[0, 2], back[0, 3] = lens[-1, 2], 1
    back[1:, :2] = lens[:0:-1, :2] * (-1, 1)
    back[1:, 2] = lens[-2::-1, 2]
    back[1:, 3] = lens[-2::-1, 3]
    return back


def _traced(
    lens: np.ndarray,
    place: tuple[Numbers, Numbers],
    direction: tuple[Numbers, Numbers, Numbers],
    xp: ModuleType,
) -> tuple[tuple[Numbers, Numbers], tuple[Numbers, Numbers, Numbers], Numbers]:
    """Follow light through a lens: from the plane of its first row to that at its end.

    ``place`` (2 arrays) and ``direction`` (3 arrays, a unit vector) are (right, down) and
    (right, down, onward). Returns the same at the end, and whether all surfaces were hit and
    passed. Every surface has coordinates about its own vertex, to avoid rounding errors.
    """
    (x, y), (u, v, w) = place, direction
    z, met, before = 0.0, True, float(lens[0, 3])
    distance = float(lens[0, 2])
    for radius, conic, after, index in lens[1:].tolist():
        step = (distance - z) / w
        x, y = x + step * u, y + step * v
        curvature = 1 / radius if radius else 0.0
        # c (x^2 + y^2 + (1 + k) z^2) = 2 z from the vertex's tangent plane
        high = curvature * (x * x + y * y)
        slope = w - curvature * (u * x + v * y)
        root = slope * slope - high * curvature * (1 + conic * w * w)
        met = met & (root > 0)
        step = high / (slope + xp.sqrt(xp.maximum(root, 0)))
        x, y, z = x + step * u, y + step * v, step * w
        nx, ny, nz = -curvature * x, -curvature * y, 1 - curvature * (1 + conic) * z
        scale = 1 / xp.sqrt(nx * nx + ny * ny + nz * nz)
        nx, ny, nz = nx * scale, ny * scale, nz * scale
        arriving = u * nx + v * ny + w * nz
        ratio = before / index
        leaving2 = 1 - ratio * ratio * (1 - arriving * arriving)
        met = met & (leaving2 > 0)
        # Snell's law: the direction changes along the normal alone
        change = xp.sqrt(xp.maximum(leaving2, 0)) - ratio * arriving
        u, v, w = ratio * u + change * nx, ratio * v + change * ny, ratio * w + change * nz
        distance, before = after, index
    step = (distance - z) / w
    return (x + step * u, y + step * v), (u, v, w), met


register(KIND, NAME, define)
