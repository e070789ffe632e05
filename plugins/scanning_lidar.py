"""
.. _sensor-scanning_lidar:

Scanning monostatic lidar (``scanning_lidar``)
----------------------------------------------

A telescope at the origin that points along many beams, one per pixel of its film, and receives the
light of a nested :ref:`laser <emitter-laser>` that is scattered back from range gates. The
telescope of each beam is a disc perpendicular to its axis, centred at the laser aperture. Light is
received if it arrives at the disc within the field of view and half its optical path length lies
in a gate.

============================ ========= ==================================================== =======
Parameter                    Type      Meaning                                              Default
============================ ========= ==================================================== =======
``aperture_radius``          float     telescope radius, m                                  0.5
``fov_half_mrad``            float     field of view, half angle, mrad                      5
``gate_kind``                string    ``planar``: between planes perpendicular to the      planar
                                       scan's axis; ``spherical``: equal two-way time
``gate_start, gate_stop``    float     start of the first and end of the last gate, m       required
``gate_count``               int       number of equal gates between start and stop         1
``azimuth_min_deg, .._max``  float     beams across the film's width; the left column is    0, 0
                                       the largest azimuth (positive to port, +y)
``elevation_min_deg, .._max`` float    beams down the film's height; the top row is the     0, 0
                                       largest elevation (positive up, +z)
``directions``               tensor,   N x 3 beam directions in place of the angles, film   none
                             string    row by row from the top left; or a ``.npy`` or text
                                       file of them
``to_world``                 transform of the lidar's frame (x forward, y left, z up)       identity
*(nested)*                   emitter   a ``laser``                                          required
*(nested)*                   medium    the environment in which the telescope is            vacuum
============================ ========= ==================================================== =======

Angles are equidistant and include both ends; a beam direction is (1, tan azimuth, tan elevation),
normalised. A single column (row) is at the middle of its angles. The local +z axis of the laser is
the beam axis, its local +x axis the horizontal axis e_h.

The range of a light path is half its optical length. A ``planar`` gate between x = X0 and X1 covers
the ranges from X0 to X1 over the cosine of the angle between beam axis and x. Directions, gates,
aperture and pose can be changed through ``mi.traverse`` without recompilation.
"""

import drjit as dr
import mitsuba as mi
import numpy as np

from .parameters import check_pose, choice, fail, number, pose, positive, whole
from .parameters import table as read_table
from .polarization import horizontal_axis
from .registration import register

NAME, KIND = "scanning_lidar", "sensor"


def define():
    """The plugin's class in the variant in force."""

    class ScanningLidar(mi.Sensor):
        def __init__(self, props):
            super().__init__(props)
            lasers = [o for _, o in props.objects() if hasattr(o, "sample_local")]
            if len(lasers) != 1:
                fail(NAME, "emitter", len(lasers), "exactly one nested emitter of type 'laser'")
            self.laser = lasers[0]
            width, height = self.film().size()
            if min(width, height) < 1:
                fail(NAME, "film", f"{width} x {height}", "at least 1 x 1 beams")
            self.gate_kind = choice(props, NAME, "gate_kind", "planar", ("planar", "spherical"))
            self.gate_count = whole(props, NAME, "gate_count", 1, 1)
            self.m_aperture = dr.opaque(mi.Float, positive(props, NAME, "aperture_radius", 0.5))
            fov = positive(props, NAME, "fov_half_mrad", 5.0) * 1e-3
            if fov >= np.pi / 2:
                fail(NAME, "fov_half_mrad", fov * 1e3, "less than a half space, 1570.8 mrad")
            self.m_fov_tan = dr.opaque(mi.Float, np.tan(fov))
            for field in ("gate_start", "gate_stop"):
                if field not in props:
                    fail(NAME, field, "nothing", "a range in m")
            self.m_gate_start = dr.opaque(mi.Float, number(props, NAME, "gate_start", 0.0))
            self.m_gate_stop = dr.opaque(mi.Float, number(props, NAME, "gate_stop", 0.0))
            if "directions" in props:
                directions = read_directions(props["directions"], width * height)
            else:
                directions = angle_directions(
                    _angles(props, "azimuth", width), _angles(props, "elevation", height)
                )
            self.m_directions = mi.Float(directions.ravel())
            self.m_pose = pose(props, NAME)
            dr.make_opaque(self.m_pose)
            self._check()

        @property
        def beam_count(self) -> int:
            return int(np.prod(self.film().size()))

        def beam_frame(self, beam):
            """Axes (e_h, e_v, beam axis) of beams given by their index, in the lidar's frame."""
            axis = dr.gather(mi.Vector3f, self.m_directions, beam)
            horizontal = horizontal_axis(axis)
            return mi.Frame3f(horizontal, dr.cross(axis, horizontal), axis)

        def ranges(self, axis):
            """First and last range (m) of all gates together along a beam axis."""
            scale = dr.rcp(axis.x) if self.gate_kind == "planar" else mi.Float(1)
            return self.m_gate_start * scale, self.m_gate_stop * scale

        def sample_aperture(self, frame, sample):
            """A point of the telescope disc of a beam, uniformly."""
            disc = mi.warp.square_to_uniform_disk(sample) * self.m_aperture
            return mi.Point3f(frame.s * disc.x + frame.t * disc.y)

        def aperture_area(self):
            """Area of the telescope, m^2."""
            return dr.pi * self.m_aperture * self.m_aperture

        def in_field_of_view(self, frame, to_source):
            """Whether the direction ``to_source`` (any length) is in a beam's field of view."""
            local = frame.to_local(to_source)
            limit = self.m_fov_tan * local.z
            return (local.z > 0) & (dr.squared_norm(local.xy) <= limit * limit)

        def nearest_and_farthest(self) -> tuple[float, float]:
            """Smallest and largest range (m) any beam records."""
            first, last = self.ranges(dr.gather(mi.Vector3f, self.m_directions, self._beams()))
            return float(dr.min(first)[0]), float(dr.max(last)[0])

        def _beams(self):
            return dr.arange(mi.UInt32, self.beam_count)

        def world_transform(self):
            return self.m_pose

        def sample_ray(self, time, sample1, sample2, sample3, active=True):
            """The axis of the beam at a film position, for any other integrator."""
            width, height = self.film().size()
            column = dr.clip(mi.UInt32(sample2.x * width), 0, width - 1)
            row = dr.clip(mi.UInt32(sample2.y * height), 0, height - 1)
            frame = self.beam_frame(row * width + column)
            to_world = self.world_transform()
            direction = dr.normalize(to_world @ frame.n)
            ray = mi.Ray3f(to_world @ mi.Point3f(0), direction, time, self.laser.wavelengths())
            return ray, mi.Spectrum(1)

        def sample_ray_differential(self, time, sample1, sample2, sample3, active=True):
            ray, weight = self.sample_ray(time, sample1, sample2, sample3, active)
            return mi.RayDifferential3f(ray), weight

        def traverse(self, callback):
            super().traverse(callback)
            kind = mi.ParamFlags.NonDifferentiable
            callback.put("directions", self.m_directions, kind)
            callback.put("gate_start", self.m_gate_start, kind)
            callback.put("gate_stop", self.m_gate_stop, kind)
            callback.put("aperture_radius", self.m_aperture, kind)
            callback.put("to_world", self.m_pose, kind)

        def parameters_changed(self, keys=()):
            dr.make_opaque(self.m_gate_start, self.m_gate_stop, self.m_aperture, self.m_pose)
            self._check()

        def _check(self):
            start, stop = self.m_gate_start[0], self.m_gate_stop[0]
            if not 0 < self.m_aperture[0] < np.inf:
                fail(NAME, "aperture_radius", self.m_aperture[0], "a finite radius above 0 m")
            check_pose(self.m_pose, NAME)
            if not 0 < start < np.inf:
                fail(NAME, "gate_start", start, "a range above 0 m")
            if not start < stop < np.inf:
                fail(NAME, "gate_stop", stop, f"a range beyond gate_start = {start:g} m")
            flat = np.array(self.m_directions)
            directions = read_directions(
                flat.reshape(-1, 3) if flat.size % 3 == 0 else flat, self.beam_count
            )
            self.m_directions = mi.Float(directions.ravel())
            if self.gate_kind == "planar" and directions[:, 0].min() <= 0:
                fail(NAME, "gate_kind", "planar", "'spherical' when a beam does not point forward")

        def bbox(self):
            return mi.ScalarBoundingBox3f(mi.ScalarPoint3f(0))

        def to_string(self):
            width, height = self.film().size()
            return (
                f"ScanningLidar[{width} x {height} beams, {self.gate_count} {self.gate_kind} "
                f"gates from {self.m_gate_start[0]:g} to {self.m_gate_stop[0]:g} m]"
            )

    return ScanningLidar


def angle_directions(azimuth: np.ndarray, elevation: np.ndarray) -> np.ndarray:
    """Unit vectors of a scan by angles (radians), film order: top left beam first.

    Both angles ascend; the film's first row holds the largest elevation, its first column the
    largest azimuth. Returns (rows * columns, 3), float64.
    """
    vertical, lateral = np.meshgrid(np.tan(elevation)[::-1], np.tan(azimuth)[::-1], indexing="ij")
    beams = np.stack([np.ones_like(lateral), lateral, vertical], -1).reshape(-1, 3)
    return beams / np.linalg.norm(beams, axis=1, keepdims=True)


def read_directions(source, count: int) -> np.ndarray:
    """A table of beam directions (tensor or file name), checked and normalised, (count, 3)."""
    table = read_table(NAME, "directions", source, 3)
    if table.shape != (count, 3):
        fail(NAME, "directions", f"shape {table.shape}", f"({count}, 3), one beam per film pixel")
    length = np.linalg.norm(table.astype(float), axis=1, keepdims=True)
    if not (np.isfinite(length).all() and (length > 0).all()):
        fail(NAME, "directions", "a row of zero length or NaN", "finite vectors")
    return table / length


def _angles(props, name: str, count: int) -> np.ndarray:
    low = number(props, NAME, f"{name}_min_deg", 0.0)
    high = number(props, NAME, f"{name}_max_deg", 0.0)
    if not (-90 < low <= high < 90):
        fail(NAME, f"{name}_min_deg, {name}_max_deg", (low, high), "-90 < min <= max < 90")
    if count == 1:
        return np.radians([(low + high) / 2])
    if low == high:
        fail(NAME, f"{name}_max_deg", high, f"more than the minimum for {count} beams")
    return np.radians(np.linspace(low, high, count))


register(KIND, NAME, define)
