"""
.. _sensor-scanning_lidar:

Scanning lidar (``scanning_lidar``)
-----------------------------------

A telescope that points along many beams, one per pixel of its film, and receives the light of a
nested :ref:`laser <emitter-laser>` that is scattered back from range gates. The telescope of each
beam is a disc perpendicular to its axis, centred at the laser aperture. Light is received if it
arrives at the disc within the field of view and half its optical path length lies in a gate. All
beams start at the lidar's origin at once, or, with ``beams``, each at a place and a time of its
own, as those of a scanner on an aircraft.

============================ ========= ==================================================== =======
Parameter                    Type      Meaning                                              Default
============================ ========= ==================================================== =======
``aperture_radius``          float     telescope radius, m                                  0.5
``fov_half_mrad``            float,    field of view, half angle, mrad; or as many of them  5
                             string    as beams, film row by row from the top left
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
``beams``                    tensor,   N x 7 numbers in place of ``directions``: x, y, z    none
                             string    (origin of a beam in the lidar's frame, m),
                                       dx, dy, dz (its direction) and t (its time, s)
``to_world``                 transform of the lidar's frame (x forward, y left, z up)       identity
*(nested)*                   emitter   a ``laser``                                          required
*(nested)*                   medium    the environment in which the telescope is            vacuum
============================ ========= ==================================================== =======

Angles are equidistant and include both ends; a beam direction is (1, tan azimuth, tan elevation),
normalised. A single column (row) is at the middle of its angles. The local +z axis of the laser is
the beam axis, its local +x axis the horizontal axis e_h.

The range of a light path is half its optical length. A ``planar`` gate between x = X0 and X1 covers
the ranges from X0 to X1 over the cosine of the angle between beam axis and x. A beam whose origin
is at x reaches these planes at ranges that are shorter by x over that cosine. ``spherical`` gates
are ranges from each beam's own origin, shorter by x: the gates follow the air, not the lidar.

The laser's ``to_world`` is its pose in the frame of each beam (e_h, e_v, beam axis), from the
middle of the telescope; light leaves along its z. With an offset or a tilt, laser and telescope are
bistatic: the range of a path is half its length from laser to telescope, and light scattered once
is received only where the beam is in the field of view. The laser must be in the telescope's
medium. Turned about its axis, it emits its Stokes vector about a turned e_h.

A telescope of several fields of view (MFOV) is a film with one pixel for each: beams of the same
direction, each with a field of its own, in one rendering.

Files of tables are ``.npy``, or text with numbers separated by blanks or commas and ``#`` comments.
They are searched beside the scene, in Mitsuba's other folders and among those of the package.
Integrators other than :ref:`gated_volpath <integrator-gated_volpath>` use this sensor as a camera
along the beams, without laser and gates, and a warning says so.

All light of a beam has the time of the beam, in a
:ref:`volume that changes with time <volume-moving_volume>` for instance; the pulse itself takes
none. Directions, ``origins`` (x, y, z of every beam) and ``times``, gates, aperture, field of view,
pose and the laser (as ``laser.divergence_full_mrad``) can be changed through ``mi.traverse``
without recompilation.

.. code-block:: xml

    <sensor type="scanning_lidar">
      <string name="beams" value="raster.csv"/>
      <float name="gate_start" value="498.75"/> <float name="gate_stop" value="501.25"/>
      <emitter type="laser"/>
      <film type="hdrfilm">
        <integer name="width" value="3"/> <integer name="height" value="2"/>
        <rfilter type="box"/>
      </film>
    </sensor>
"""

import warnings
from collections.abc import Sequence

import drjit as dr
import mitsuba as mi
import numpy as np

from .parameters import check_pose, choice, fail, number, numbers, pose, positive, whole
from .parameters import table as read_table
from .polarization import level_frame
from .registration import register
from .variant_types import (
    Box,
    Float,
    Frame,
    Mask,
    Point,
    Properties,
    Ray,
    Spectrum,
    Table,
    Transform,
    Traversal,
    UInt,
    Vector,
)

NAME, KIND = "scanning_lidar", "sensor"
CAMERA = (
    f"{NAME}: this integrator takes it for a camera along the beams, without its laser and its "
    "gates; expected 'gated_volpath', or a 'laser' beside it that lights the scene"
)


def define() -> type:
    """The plugin's class in the variant in force."""

    class ScanningLidar(mi.Sensor):
        def __init__(self, props: Properties) -> None:
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
            self.m_fov = mi.Float(
                numbers(props, NAME, "fov_half_mrad", "")
                if isinstance(props.get("fov_half_mrad", 5.0), str)
                else positive(props, NAME, "fov_half_mrad", 5.0)
            )
            for field in ("gate_start", "gate_stop"):
                if field not in props:
                    fail(NAME, field, "nothing", "a range in m")
            self.m_gate_start = dr.opaque(mi.Float, number(props, NAME, "gate_start", 0.0))
            self.m_gate_stop = dr.opaque(mi.Float, number(props, NAME, "gate_stop", 0.0))
            beams = width * height
            origins, times = np.zeros((beams, 3)), np.zeros(beams)
            if "beams" in props:
                if "directions" in props:
                    fail(NAME, "beams", "with directions", "one of both")
                origins, directions, times = read_beams(props["beams"], beams)
            elif "directions" in props:
                directions = read_directions(props["directions"], beams)
            else:
                directions = angle_directions(
                    _angles(props, "azimuth", width), _angles(props, "elevation", height)
                )
            self.m_directions = mi.Float(directions.ravel())
            self.m_origins, self.m_times = mi.Float(origins.ravel()), mi.Float(times)
            self.m_pose = pose(props, NAME)
            dr.make_opaque(self.m_pose)
            self._check()

        @property
        def beam_count(self) -> int:
            return int(np.prod(self.film().size()))

        def beam_frame(self, beam: UInt) -> Frame:
            """Axes (e_h, e_v, beam axis) of beams given by their index, in the lidar's frame."""
            axis = dr.gather(mi.Vector3f, self.m_directions, beam)
            return level_frame(axis)

        def beam_origin(self, beam: UInt) -> Point:
            """Where beams start: the middle of the telescope, in the lidar's frame."""
            return dr.gather(mi.Point3f, self.m_origins, beam)

        def beam_time(self, beam: UInt) -> Float:
            """Time of beams, s."""
            return dr.gather(mi.Float, self.m_times, beam)

        def ranges(self, axis: Vector, origin: Point) -> tuple[Float, Float]:
            """First and last range (m) of all gates together along a beam axis."""
            scale = dr.rcp(axis.x) if self.gate_kind == "planar" else mi.Float(1)
            return (self.m_gate_start - origin.x) * scale, (self.m_gate_stop - origin.x) * scale

        def sample_aperture(self, frame: Frame, sample: Point) -> Vector:
            """A point of the telescope disc of a beam, uniformly, from its middle."""
            disc = mi.warp.square_to_uniform_disk(sample) * self.m_aperture
            return frame.s * disc.x + frame.t * disc.y

        def aperture_area(self) -> Float:
            """Area of the telescope, m^2."""
            return dr.pi * self.m_aperture * self.m_aperture

        def field_tangent(self, beam: UInt) -> Float:
            """Tangent of the field of view of beams, half angle."""
            return dr.gather(mi.Float, self.m_fov_tan, dr.minimum(beam, self.m_fov_last))

        def in_field_of_view(self, frame: Frame, to_source: Vector, tangent: Float) -> Mask:
            """Whether the direction ``to_source`` (any length) is in a field of view about z."""
            local = frame.to_local(to_source)
            limit = tangent * local.z
            return (local.z > 0) & (dr.squared_norm(local.xy) <= limit * limit)

        def beam_axes(self) -> tuple[np.ndarray, np.ndarray]:
            """Origins and directions of all beams in the world, (n, 3) each."""
            beam = dr.arange(mi.UInt32, self.beam_count)
            to_world = self.world_transform()
            axes = to_world @ dr.gather(mi.Vector3f, self.m_directions, beam)
            return np.array(to_world @ self.beam_origin(beam), float).T, np.array(axes, float).T

        def origins_and_ranges(self) -> tuple[np.ndarray, np.ndarray]:
            """Of all beams: origins in the world, (n, 3), first and last recorded range, (2, n)."""
            beam = dr.arange(mi.UInt32, self.beam_count)
            origin = self.beam_origin(beam)
            ranges = self.ranges(dr.gather(mi.Vector3f, self.m_directions, beam), origin)
            places = np.array(self.world_transform() @ origin, float).T
            return places, np.array([np.array(end, float) for end in ranges])

        def laser_places(self) -> np.ndarray:
            """Places of the laser for all beams, in the world, (n, 3)."""
            beam = dr.arange(mi.UInt32, self.beam_count)
            offset = self.beam_frame(beam).to_world(self.laser.m_pose.translation())
            return np.array(self.world_transform() @ (self.beam_origin(beam) + offset), float).T

        def world_transform(self) -> Transform:
            return self.m_pose

        def sample_ray(
            self, time: Float, sample1: Float, sample2: Point, sample3: Point, active: Mask = True
        ) -> tuple[Ray, Spectrum]:
            """The axis of the beam at a film position, for any other integrator.

            Its laser lights nothing then, and it has no gates: a warning says so.
            """
            warnings.warn(CAMERA, stacklevel=2)
            width, height = self.film().size()
            column = dr.clip(mi.UInt32(sample2.x * width), 0, width - 1)
            row = dr.clip(mi.UInt32(sample2.y * height), 0, height - 1)
            beam = row * width + column
            to_world = self.world_transform()
            direction = dr.normalize(to_world @ self.beam_frame(beam).n)
            origin, time = to_world @ self.beam_origin(beam), time + self.beam_time(beam)
            return mi.Ray3f(origin, direction, time, self.laser.wavelengths()), mi.Spectrum(1)

        def sample_ray_differential(
            self, time: Float, sample1: Float, sample2: Point, sample3: Point, active: Mask = True
        ) -> tuple[Ray, Spectrum]:
            ray, weight = self.sample_ray(time, sample1, sample2, sample3, active)
            return mi.RayDifferential3f(ray), weight

        def traverse(self, callback: Traversal) -> None:
            super().traverse(callback)
            kind = mi.ParamFlags.NonDifferentiable
            callback.put("directions", self.m_directions, kind)
            callback.put("origins", self.m_origins, kind)
            callback.put("times", self.m_times, kind)
            callback.put("gate_start", self.m_gate_start, kind)
            callback.put("gate_stop", self.m_gate_stop, kind)
            callback.put("aperture_radius", self.m_aperture, kind)
            callback.put("fov_half_mrad", self.m_fov, kind)
            callback.put("to_world", self.m_pose, kind)
            callback.put("laser", self.laser, kind)

        def parameters_changed(self, keys: Sequence[str] = ()) -> None:
            dr.make_opaque(self.m_gate_start, self.m_gate_stop, self.m_aperture, self.m_pose)
            self._check()

        def _check(self) -> None:
            start, stop = self.m_gate_start[0], self.m_gate_stop[0]
            if not 0 < self.m_aperture[0] < np.inf:
                fail(NAME, "aperture_radius", self.m_aperture[0], "a finite radius above 0 m")
            fov = np.array(self.m_fov, float) * 1e-3
            if fov.size not in (1, self.beam_count):
                expected = f"one, or {self.beam_count}, one per film pixel"
                fail(NAME, "fov_half_mrad", f"{fov.size} numbers", expected)
            wrong = np.flatnonzero(~((fov > 0) & (fov < np.pi / 2)))
            if wrong.size:
                expected = "an angle above 0 and less than a half space, 1570.8 mrad"
                fail(NAME, "fov_half_mrad", self.m_fov[int(wrong[0])], expected)
            # a list is copied to where kernels read it alike, an array stays where it is
            self.m_fov_tan = mi.Float(np.tan(fov).tolist())
            self.m_fov_last = dr.opaque(mi.UInt32, fov.size - 1)
            dr.make_opaque(self.m_fov_tan)
            check_pose(self.m_pose, NAME)
            if not 0 < start < np.inf:
                fail(NAME, "gate_start", start, "a range above 0 m")
            if not start < stop < np.inf:
                fail(NAME, "gate_stop", stop, f"a range beyond gate_start = {start:g} m")
            flat = np.array(self.m_directions)
            directions = read_directions(
                flat.reshape(-1, 3) if flat.size % 3 == 0 else flat, self.beam_count
            )
            # in place: parameters of a traversed scene refer to this array
            self.m_directions[:] = mi.Float(directions.ravel())
            if self.gate_kind == "planar" and directions[:, 0].min() <= 0:
                fail(NAME, "gate_kind", "planar", "'spherical' when a beam does not point forward")
            for name, values, each in (("origins", self.m_origins, 3), ("times", self.m_times, 1)):
                values = np.array(values)
                if values.size != each * self.beam_count or not np.isfinite(values).all():
                    what = f"{values.size} numbers, {np.sum(~np.isfinite(values))} of them NaN"
                    fail(NAME, name, what, f"{each * self.beam_count} finite ones")
            origins = np.array(self.m_origins, float).reshape(-1, 3)
            farthest = origins[:, 0].max()
            matrix = np.array(self.m_pose.matrix, float).reshape(4, 4)
            # where beams start, in the world; a single place, if it is that of all
            one_place = (origins == origins[0]).all()
            self.places = origins[: 1 if one_place else None] @ matrix[:3, :3].T + matrix[:3, 3]
            if not farthest < start:
                fail(NAME, "origins", f"x = {farthest:g} m", f"before gate_start = {start:g} m")

        def bbox(self) -> Box:
            return mi.ScalarBoundingBox3f(mi.ScalarPoint3f(0))

        def to_string(self) -> str:
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


def read_directions(source: Table, count: int) -> np.ndarray:
    """A table of beam directions (tensor or file name), checked and normalised, (count, 3)."""
    table = read_table(NAME, "directions", source, 3)
    if table.shape != (count, 3):
        fail(NAME, "directions", f"shape {table.shape}", f"({count}, 3), one beam per film pixel")
    length = np.linalg.norm(table.astype(float), axis=1, keepdims=True)
    if not (np.isfinite(length).all() and (length > 0).all()):
        fail(NAME, "directions", "a row of zero length or NaN", "finite vectors")
    return table / length


def read_beams(source: Table, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A table of beams (tensor or file name), checked: origins, directions (count, 3), times."""
    table = read_table(NAME, "beams", source, 7).astype(float)
    if table.shape != (count, 7):
        fail(NAME, "beams", f"shape {table.shape}", f"({count}, 7), one beam per film pixel")
    length = np.linalg.norm(table[:, 3:6], axis=1, keepdims=True)
    bad = np.flatnonzero(~(np.isfinite(table).all(1) & (length[:, 0] > 0)))
    if bad.size:
        values = ", ".join(f"{value:g}" for value in table[bad[0]])
        fail(NAME, f"beams[{bad[0]}]", values, "finite numbers and a direction longer than 0")
    return table[:, :3], table[:, 3:6] / length, table[:, 6]


def _angles(props: Properties, name: str, count: int) -> np.ndarray:
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
