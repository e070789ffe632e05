"""
.. _emitter-plane_waves:

Plane waves from an extended source (``plane_waves``)
-----------------------------------------------------

Light from a distant source: plane waves from all directions of a cone, as emitted by an extended
source or by the end of a multimode fibre behind a collimator. It surrounds the scene like an
environment emitter. If traced forward, every plane wave has a random direction, frequency,
polarisation and position on the stop of the :ref:`camera <sensor-ccd>`.

=========================== ========== ==================================================== =======
Parameter                   Type       Meaning                                              Default
=========================== ========== ==================================================== =======
``field_half_mrad``         float      half angle of the cone, mrad                         16
``radiance_radius_mrad``    float      angle at which the radiance is 1/e^2 of that on the  infinite
                                       axis; Gaussian in its tangent
``stokes``                  string     I, Q, U, V with I = 1, about the horizontal axis     1, 0,
                                                                                            0, 0
``to_world``                transform  of a frame whose x axis points to the centre of      identity
                                       the source
*(nested)*                  texture    the :ref:`line <texture-spectral_line>`              required
=========================== ========== ==================================================== =======

Natural light (the default) is a plane wave of random elliptical polarisation, uniformly distributed
on the Poincaré sphere. The unpolarised fraction of partially polarised light is drawn in this way.

.. code-block:: xml

    <emitter type="plane_waves">
      <float name="field_half_mrad" value="16"/>
      <texture type="spectral_line"/>
    </emitter>
"""

import math

import drjit as dr
import mitsuba as mi
import numpy as np

from .parameters import fail, numbers, pose, positive
from .polarization import horizontal_axis, rotate_stokes
from .random_numbers import beam_radius_squared
from .registration import register
from .variant_types import (
    Box,
    Drawn,
    Float,
    Interaction,
    Mask,
    Point,
    Properties,
    Spectrum,
    Stokes,
    Traversal,
    Vector,
)

NAME, KIND = "plane_waves", "emitter"


def define() -> type:
    """The plugin's class in the variant in force."""

    class PlaneWaves(mi.Emitter):
        def __init__(self, props: Properties) -> None:
            super().__init__(props)
            lines = [o for _, o in props.objects() if hasattr(o, "characteristic")]
            if len(lines) != 1:
                fail(NAME, "line", len(lines), "exactly one nested texture of type 'spectral_line'")
            self.line = lines[0]
            half = positive(props, NAME, "field_half_mrad", 16.0) * 1e-3
            if half >= math.pi / 2:
                fail(NAME, "field_half_mrad", half * 1e3, "less than a half space, 1570.8 mrad")
            self.field_half = half
            radius = positive(props, NAME, "radiance_radius_mrad", math.inf) * 1e-3
            self.uniform = math.isinf(radius)
            scale = radius if self.uniform else math.tan(min(radius, 1.57))
            self.stokes = numbers(props, NAME, "stokes", "1, 0, 0, 0")
            if (
                len(self.stokes) != 4
                or self.stokes[0] != 1
                or math.hypot(*self.stokes[1:]) > 1 + 1e-6
            ):
                fail(NAME, "stokes", props["stokes"], "I = 1 and Q^2 + U^2 + V^2 <= 1")
            self.m_sine = dr.opaque(mi.Float, math.sin(half))
            self.m_scale2 = dr.opaque(mi.Float, scale**2)
            # flux per area of a wavefront, and that of `sample_direction_of_light`, which has the
            # sine where the radiance has the tangent
            limit = math.sin(half) ** 2
            nodes, weights = np.polynomial.legendre.leggauss(200)
            sine2 = limit * (nodes + 1) / 2
            radiance = np.exp(-2 * sine2 / (1 - sine2) / scale**2)
            self.m_flux = dr.opaque(mi.Float, math.pi * limit * (weights @ radiance) / 2)
            inside = -math.expm1(-2 * limit / scale**2)
            drawn = limit if self.uniform else inside * scale**2 / 2
            self.m_inside = dr.opaque(mi.Float, inside)
            self.m_drawn = dr.opaque(mi.Float, math.pi * drawn)
            self.m_pose = pose(props, NAME)
            dr.make_opaque(self.m_pose)
            self.m_flags = +mi.EmitterFlags.Infinite

        def flux(self) -> Float:
            """Power per area across the axis, for a radiance of 1 in the middle."""
            return mi.Float(self.m_flux)

        def sample_direction_of_light(self, sample: Point) -> tuple[Vector, Float, Float]:
            """A direction of propagation (world), its weight (at most 1), the sampled flux."""
            if self.uniform:
                disc = mi.warp.square_to_uniform_disk(sample) * self.m_sine
            else:
                radius2 = self.m_scale2 * beam_radius_squared(self.m_inside, sample.x)
                radius = dr.minimum(dr.sqrt(radius2), self.m_sine)
                sine, cosine = dr.sincos(dr.two_pi * sample.y)
                disc = mi.Point2f(radius * cosine, radius * sine)
            sine2 = dr.squared_norm(disc)
            weight = (
                mi.Float(1)
                if self.uniform
                else dr.exp(-2 * sine2 * sine2 / ((1 - sine2) * self.m_scale2))
            )
            local = mi.Vector3f(-dr.sqrt(1 - sine2), disc.x, disc.y)
            return dr.normalize(self.m_pose @ local), weight, mi.Float(self.m_drawn)

        def radiance(self, direction: Vector) -> Float:
            """Radiance of light travelling along ``direction`` (world), 1 in the middle."""
            local = self.m_pose.inverse() @ direction
            sine2 = dr.square(local.y) + dr.square(local.z)
            value = (
                mi.Float(1) if self.uniform else dr.exp(-2 * sine2 / (1 - sine2) / self.m_scale2)
            )
            return dr.select((local.x < 0) & (sine2 <= dr.square(self.m_sine)), value, 0)

        def mean_stokes(self, direction: Vector) -> Stokes:
            """Stokes vector of all waves along ``direction``, about Mitsuba's axis."""
            return self._turned([mi.Float(s) for s in self.stokes], direction)

        def sample_stokes(self, direction: Vector, which: Float, sample: Point) -> Stokes:
            """A fully polarised state whose mean is `mean_stokes`."""
            degree = math.hypot(*self.stokes[1:])
            state = mi.warp.square_to_uniform_sphere(sample)
            polarised = which < degree
            drawn = [
                dr.select(polarised, s / max(degree, 1e-30), r)
                for s, r in zip(self.stokes[1:], (state.x, state.y, state.z), strict=True)
            ]
            return self._turned([mi.Float(1), *drawn], direction)

        def _turned(self, stokes: Stokes, direction: Vector) -> Stokes:
            axis = mi.mueller.stokes_basis(direction)
            return rotate_stokes(stokes, direction, horizontal_axis(direction), axis)

        def eval(self, si: Interaction, active: Mask = True) -> Spectrum:
            """Radiance, for integrators that look along a ray."""
            direction = si.wi  # of a ray that left the scene: the direction of the light
            value = dr.select(active, self.radiance(direction), 0)
            if not mi.is_polarized:
                return mi.Spectrum(value)
            radiance = mi.Spectrum(0)
            for row, stokes in enumerate(self.mean_stokes(direction)):
                radiance[row, 0] = stokes * value
            return radiance

        def sample_direction(
            self, it: Interaction, sample: Point, active: Mask = True
        ) -> tuple[Drawn, Spectrum]:
            """Nothing: other integrators find the source by following rays, see `pdf_direction`."""
            return dr.zeros(mi.DirectionSample3f), mi.Spectrum(0)

        def pdf_direction(self, it: Interaction, ds: Drawn, active: Mask = True) -> Float:
            return mi.Float(0)

        def bbox(self) -> Box:
            return mi.ScalarBoundingBox3f()

        def traverse(self, callback: Traversal) -> None:
            callback.put("line", self.line, mi.ParamFlags.NonDifferentiable)

        def to_string(self) -> str:
            return f"PlaneWaves[field_half={1e3 * self.field_half:g} mrad, line={self.line}]"

    return PlaneWaves


register(KIND, NAME, define)
