"""
.. _emitter-laser:

Pulsed laser (``laser``)
------------------------

A pulsed laser with a truncated Gaussian beam. Position in the aperture and direction are
independent, as in the far field of a beam expander. The fluence is proportional to
exp(-2 r^2 / beam_radius^2) over the aperture, the radiant intensity to
exp(-2 a^2 / (divergence_full / 2)^2) with a the tangent of the angle to the axis.

========================= ========== ==================================================== =======
Parameter                 Type       Meaning                                              Default
========================= ========== ==================================================== =======
``beam_radius``           float      1/e^2 radius in the aperture, m                      0.1
``beam_cut``              float      outer radius of the aperture, m                      uncut
``divergence_full_mrad``  float      1/e^2 divergence, full angle, mrad; 0 = collimated   0
``stokes``                string     I, Q, U, V about e_h (local x), I = 1                1, 1, 0, 0
``wavelength``            float      vacuum wavelength, m                                 532e-9
``pulse_energy``          float      energy of a pulse, J                                 1
``pulse_duration``        float      full width at half maximum of the pulse, s;          0
                                     Gaussian in time; 0 = instantaneous
``to_world``              transform  light leaves along local +z, e_h is local +x. In a   identity
                                     lidar, the pose in the frame of each of its beams
========================= ========== ==================================================== =======

.. code-block:: xml

    <emitter type="laser">
      <float name="beam_radius" value="0.1"/> <float name="beam_cut" value="0.1"/>
      <float name="divergence_full_mrad" value="2"/>
      <string name="stokes" value="1, 1, 0, 0"/>
    </emitter>

.. code-block:: python

    {"type": "laser", "beam_radius": 0.1, "beam_cut": 0.1, "divergence_full_mrad": 2.0}

The laser can also illuminate the surfaces and media of any scene, with ``path``, ``volpath``,
``ptracer`` and other integrators of Mitsuba. Their results are then those of a pulse: fluence in
J/m^2 in place of irradiance. Rays cannot hit the laser; it is always sampled. Near the laser, where
the beam is about as wide as the aperture, directions are sampled; further away, where the
divergence has widened it, points of the aperture. Both are unbiased. Spectral variants draw random
wavelengths, none of which is that of the laser: in these variants only ``gated_volpath`` renders
it. Energy, radius, cut, divergence and pose can be changed through ``mi.traverse``.
"""

import math
from collections.abc import Sequence

import drjit as dr
import mitsuba as mi

from .parameters import at_least, check_pose, fail, pose, positive
from .polarization import rotate_stokes, transverse
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
    Ray,
    Spectrum,
    Traversal,
    Vector,
)

NAME, KIND = "laser", "emitter"


def define() -> type:
    """The plugin's class in the variant in force."""

    class Laser(mi.Emitter):
        def __init__(self, props: Properties) -> None:
            super().__init__(props)
            radius = positive(props, NAME, "beam_radius", 0.1)
            cut = positive(props, NAME, "beam_cut", math.inf)
            divergence = at_least(props, NAME, "divergence_full_mrad", 0.0, 0.0)
            self.wavelength = positive(props, NAME, "wavelength", 532e-9)
            self.pulse_duration = at_least(props, NAME, "pulse_duration", 0.0, 0.0)
            self.stokes = _stokes(props.get("stokes", "1, 1, 0, 0"))
            # opaque: kernels of other polarisations and pulses are the same
            self.m_stokes = [dr.opaque(mi.Float, value) for value in self.stokes]
            self.m_energy = mi.Float(positive(props, NAME, "pulse_energy", 1.0))
            self.m_radius, self.m_cut = mi.Float(radius), mi.Float(cut)
            self.m_divergence = mi.Float(divergence)
            self.m_pose = pose(props, NAME)
            self._derive()
            self.m_flags = mi.EmitterFlags.DeltaDirection  # not hit by rays traced backwards

        @property
        def pulse_energy(self) -> float:
            """Energy of a pulse, J."""
            return float(self.m_energy[0])

        def _derive(self) -> None:
            dr.make_opaque(self.m_energy, self.m_radius, self.m_cut, self.m_divergence, self.m_pose)
            # fraction of an uncut beam inside the aperture; radii are drawn from that fraction
            cut = self.m_cut[0] / self.m_radius[0]
            self.m_inside = dr.opaque(mi.Float, -math.expm1(-2 * cut**2))
            self.m_divergence_half = dr.opaque(mi.Float, self.m_divergence[0] * 1e-3 / 2)

        def sample_local(
            self, sample_position: Point, sample_direction: Point
        ) -> tuple[Point, Vector]:
            """Origin and direction of a ray in the laser's own frame, axis along +z."""
            origin = mi.Point3f(0, 0, 0)
            radius = self.m_radius * dr.sqrt(beam_radius_squared(self.m_inside, sample_position.x))
            sine, cosine = dr.sincos(dr.two_pi * sample_position.y)
            origin.x, origin.y = radius * cosine, radius * sine
            # 1 - sample lies in (0, 1], without rounding: the logarithm stays finite
            tangent = self.m_divergence_half * dr.sqrt(-0.5 * dr.log(1 - sample_direction.x))
            sine, cosine = dr.sincos(dr.two_pi * sample_direction.y)
            return origin, dr.normalize(mi.Vector3f(tangent * cosine, tangent * sine, 1))

        def _fluence(self, r2: Float) -> Float:
            """Fluence of a 1 J pulse, J/m^2, at a squared distance from the aperture's middle."""
            scale2 = dr.square(self.m_radius)
            return 2 * dr.inv_pi / (scale2 * self.m_inside) * dr.exp(-2 * r2 / scale2)

        def sample_ray(
            self, time: Float, sample1: Float, sample2: Point, sample3: Point, active: Mask = True
        ) -> tuple[Ray, Spectrum]:
            """A ray of the beam; the weight's first column is its Stokes vector, in joules."""
            origin, local = self.sample_local(sample2, sample3)
            to_world = self.m_pose
            direction = dr.normalize(to_world @ local)
            ray = mi.Ray3f(to_world @ origin, direction, time, self.wavelengths())
            return ray, self._polarised(self.m_energy, direction)

        def _polarised(self, value: Float, direction: Vector) -> Spectrum:
            """Light of that intensity along a direction, with the laser's Stokes vector."""
            if not mi.is_polarized:
                return mi.Spectrum(value)
            stokes = rotate_stokes(
                self.m_stokes,
                direction,
                transverse(self.m_pose @ mi.Vector3f(1, 0, 0), direction),
                mi.mueller.stokes_basis(direction),
            )
            weight = mi.Spectrum(0)
            for row, component in enumerate(stokes):
                weight[row, 0] = component * value
            return weight

        def sample_direction(
            self, it: Interaction, sample: Point, active: Mask = True
        ) -> tuple[Drawn, Spectrum]:
            """A place of the aperture that lights a point, and the fluence that it brings there."""
            place = self.m_pose.inverse() @ it.p
            half = self.m_divergence_half
            wide = half * place.z > self.m_radius
            from_aperture, local = self.sample_local(sample, sample)
            slope = local.xy / local.z
            back = mi.Point3f(place.x - place.z * slope.x, place.y - place.z * slope.y, 0)
            origin = dr.select(wide, from_aperture, back)
            ds = dr.zeros(mi.DirectionSample3f)
            ds.p = self.m_pose @ origin
            ds.n = mi.Normal3f(dr.normalize(self.m_pose @ mi.Vector3f(0, 0, 1)))
            ds.time = it.time
            ds.pdf, ds.delta = mi.Float(1), mi.Bool(True)
            ds.emitter = mi.EmitterPtr(self)
            ds.d = ds.p - it.p
            ds.dist = dr.norm(ds.d)
            ds.d *= dr.rcp(ds.dist)
            return ds, self.eval_direction(it, ds, active)

        def eval_direction(self, it: Interaction, ds: Drawn, active: Mask = True) -> Spectrum:
            """Fluence (J/m^2) at a point from a place of the aperture, over the place's density.

            With places drawn from the aperture's fluence f, the energy times the density of
            directions over the squared distance; with directions drawn, the energy times f over
            the cosine.
            """
            if mi.is_spectral:
                raise RuntimeError(
                    f"{NAME}: variant {mi.variant()} is not allowed with this integrator; expected "
                    "gated_volpath, or a variant without spectrum: the laser has one wavelength"
                )
            to_local = self.m_pose.inverse()
            place, origin = to_local @ it.p, to_local @ ds.p
            half, radius = self.m_divergence_half, self.m_radius
            way = place - origin
            distance = dr.norm(way)
            cosine = way.z / distance
            # the tangent's density, over the cosine's cube a density of directions
            tangent2 = (dr.square(way.x) + dr.square(way.y)) / dr.square(way.z)
            narrow = dr.maximum(half, 1e-20)
            directions = (
                2 * dr.inv_pi / dr.square(narrow) * dr.exp(-2 * tangent2 / dr.square(narrow))
            )
            directions /= cosine**3
            r2 = dr.square(origin.x) + dr.square(origin.y)
            fluence = dr.select(r2 <= dr.square(self.m_cut), self._fluence(r2), 0)
            wide = half * place.z > radius
            value = dr.select(wide, directions / dr.square(distance), fluence / cosine)
            value = dr.select(active & (place.z > 0), value * self.m_energy, 0)
            return self._polarised(value, -ds.d)

        def pdf_direction(self, it: Interaction, ds: Drawn, active: Mask = True) -> Float:
            """0: no other way of sampling finds the laser."""
            return mi.Float(0)

        def sample_position(
            self, time: Float, sample: Point, active: Mask = True
        ) -> tuple[Drawn, Float]:
            """A place of the aperture, by its fluence, and the inverse of its density (m^2)."""
            origin, _ = self.sample_local(sample, sample)
            ps = dr.zeros(mi.PositionSample3f)
            ps.p = self.m_pose @ origin
            ps.n = mi.Normal3f(dr.normalize(self.m_pose @ mi.Vector3f(0, 0, 1)))
            ps.time, ps.delta = time, mi.Bool(False)
            ps.pdf = self._fluence(dr.squared_norm(mi.Vector2f(origin.x, origin.y)))
            return ps, dr.rcp(ps.pdf)

        def sample_wavelengths(
            self, si: Interaction, sample: Float, active: Mask = True
        ) -> tuple[Float, Spectrum]:
            """The laser's own."""
            return self.wavelengths(), mi.Spectrum(1)

        def traverse(self, callback: Traversal) -> None:
            super().traverse(callback)
            kind = mi.ParamFlags.NonDifferentiable
            callback.put("pulse_energy", self.m_energy, kind)
            callback.put("beam_radius", self.m_radius, kind)
            callback.put("beam_cut", self.m_cut, kind)
            callback.put("divergence_full_mrad", self.m_divergence, kind)
            callback.put("to_world", self.m_pose, kind)

        def parameters_changed(self, keys: Sequence[str] = ()) -> None:
            for field, value, least in (
                ("pulse_energy", self.m_energy[0], "above 0"),
                ("beam_radius", self.m_radius[0], "above 0"),
                ("beam_cut", self.m_cut[0], "above 0"),
                ("divergence_full_mrad", self.m_divergence[0], "0 or more"),
            ):
                enough = value > 0 or (value == 0 and least == "0 or more")
                if not enough or (math.isinf(value) and field != "beam_cut"):
                    fail(NAME, field, value, f"a number {least}")
            check_pose(self.m_pose, NAME)
            self._derive()

        def wavelengths(self) -> Float:
            """The laser's wavelength in nm, for a ray (empty outside spectral variants)."""
            kind = type(mi.Ray3f().wavelengths)
            return kind(self.wavelength * 1e9) if mi.is_spectral else kind()

        def eval(self, si: Interaction, active: Mask = True) -> Spectrum:
            return mi.Spectrum(0)

        def bbox(self) -> Box:
            return mi.ScalarBoundingBox3f(mi.ScalarPoint3f(0))

        def to_string(self) -> str:
            return (
                f"Laser[wavelength={self.wavelength:g} m, pulse_energy={self.pulse_energy:g} J, "
                f"beam_radius={self.m_radius[0]:g} m, "
                f"divergence_full={2e3 * self.m_divergence_half[0]:g} mrad]"
            )

    return Laser


def channel_of(wavelength: float) -> int:
    """Index of a spectrum's entry for a laser: a colour in RGB variants."""
    return (2 if wavelength < 490e-9 else 1 if wavelength < 580e-9 else 0) if mi.is_rgb else 0


def _stokes(text: object) -> tuple[float, float, float, float]:
    try:
        i, q, u, v = (float(word) for word in str(text).replace(",", " ").split())
    except ValueError:
        fail(NAME, "stokes", text, "four numbers I, Q, U, V, for example '1, 1, 0, 0'")
    if i != 1 or not math.hypot(q, u, v) <= 1 + 1e-6:
        fail(NAME, "stokes", text, "I = 1 and Q^2 + U^2 + V^2 <= 1")
    return i, q, u, v


register(KIND, NAME, define)
