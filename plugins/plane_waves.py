"""
.. _emitter-plane_waves:

Plane waves from an extended source (``plane_waves``)
-----------------------------------------------------

Light from far away: plane waves from all directions of a cone, of equal radiance, as an extended
source or the end of a multimode fibre behind a collimator sends them. It lies around the scene like
an environment. Traced forward, every plane wave has a random direction, frequency, polarisation and
place on the stop of the :ref:`camera <sensor-ccd>`.

============================ ========== ==================================================== =======
Parameter                    Type       Meaning                                              Default
============================ ========== ==================================================== =======
``field_half_mrad``          float      half angle of the cone, mrad                         16
``stokes``                   string     I, Q, U, V with I = 1, about the horizontal axis     1, 0,
                                                                                             0, 0
``to_world``                 transform  of a frame whose x axis points to the source's       identity
                                        middle
*(nested)*                   texture    the :ref:`line <texture-spectral_line>`              required
============================ ========== ==================================================== =======

Natural light (the default) is a plane wave of random elliptical polarisation, evenly distributed on
the Poincaré sphere; partially polarised light has that for its unpolarised share.

.. code-block:: xml

    <emitter type="plane_waves">
      <float name="field_half_mrad" value="16"/>
      <texture type="spectral_line"/>
    </emitter>
"""

import math

import drjit as dr
import mitsuba as mi

from .parameters import fail, numbers, pose, positive
from .polarization import horizontal_axis, rotate_stokes

NAME, KIND = "plane_waves", "emitter"


def define():
    class PlaneWaves(mi.Emitter):
        def __init__(self, props):
            super().__init__(props)
            lines = [o for _, o in props.objects() if hasattr(o, "characteristic")]
            if len(lines) != 1:
                fail(NAME, "line", len(lines), "exactly one nested texture of type 'spectral_line'")
            self.line = lines[0]
            half = positive(props, NAME, "field_half_mrad", 16.0) * 1e-3
            if half >= math.pi / 2:
                fail(NAME, "field_half_mrad", half * 1e3, "less than a half space, 1570.8 mrad")
            self.field_half = half
            self.stokes = numbers(props, NAME, "stokes", "1, 0, 0, 0")
            if (
                len(self.stokes) != 4
                or self.stokes[0] != 1
                or math.hypot(*self.stokes[1:]) > 1 + 1e-6
            ):
                fail(NAME, "stokes", props["stokes"], "I = 1 and Q^2 + U^2 + V^2 <= 1")
            self.m_sine = dr.opaque(mi.Float, math.sin(half))
            self.m_pose = pose(props)
            dr.make_opaque(self.m_pose)
            self.m_flags = +mi.EmitterFlags.Infinite

        def projected_solid_angle(self):
            """Of the cone, sr."""
            return dr.pi * self.m_sine * self.m_sine

        def sample_direction_of_light(self, sample):
            """A direction light travels in (world), evenly in projected solid angle."""
            disc = mi.warp.square_to_uniform_disk(sample) * self.m_sine
            x = -dr.sqrt(1 - dr.squared_norm(disc))
            return dr.normalize(self.m_pose @ mi.Vector3f(x, disc.x, disc.y))

        def in_field(self, direction):
            """Whether light travelling along ``direction`` (world) belongs to the source."""
            local = self.m_pose.inverse() @ direction
            return (local.x < 0) & (dr.square(local.y) + dr.square(local.z) <= dr.square(self.m_sine))

        def mean_stokes(self, direction):
            """Stokes vector of all waves along ``direction``, about Mitsuba's axis."""
            return self._turned([mi.Float(s) for s in self.stokes], direction)

        def sample_stokes(self, direction, which, sample):
            """A fully polarised state whose mean is `mean_stokes`."""
            degree = math.hypot(*self.stokes[1:])
            state = mi.warp.square_to_uniform_sphere(sample)
            polarised = which < degree
            drawn = [
                dr.select(polarised, s / max(degree, 1e-30), r)
                for s, r in zip(self.stokes[1:], (state.x, state.y, state.z))
            ]
            return self._turned([mi.Float(1), *drawn], direction)

        def _turned(self, stokes, direction):
            axis = mi.mueller.stokes_basis(direction)
            return rotate_stokes(stokes, direction, horizontal_axis(direction), axis)

        def eval(self, si, active=True):
            """Radiance (1 inside the cone), for integrators that look along a ray."""
            direction = si.wi  # of a ray that left the scene: the way the light comes
            inside = self.in_field(direction) & active
            if not mi.is_polarized:
                return mi.Spectrum(dr.select(inside, mi.Float(1), 0))
            radiance = mi.Spectrum(0)
            for row, value in enumerate(self.mean_stokes(direction)):
                radiance[row, 0] = dr.select(inside, value, 0)
            return radiance

        def bbox(self):
            return mi.ScalarBoundingBox3f()

        def traverse(self, callback):
            callback.put("line", self.line, mi.ParamFlags.NonDifferentiable)

        def to_string(self):
            return f"PlaneWaves[field_half={1e3 * self.field_half:g} mrad, line={self.line}]"

    return PlaneWaves
