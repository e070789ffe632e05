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
``to_world``              transform  light leaves along local +z, e_h is local +x         identity
========================= ========== ==================================================== =======

.. code-block:: xml

    <emitter type="laser">
      <float name="beam_radius" value="0.1"/> <float name="beam_cut" value="0.1"/>
      <float name="divergence_full_mrad" value="2"/>
      <string name="stokes" value="1, 1, 0, 0"/>
    </emitter>

.. code-block:: python

    {"type": "laser", "beam_radius": 0.1, "beam_cut": 0.1, "divergence_full_mrad": 2.0}
"""

import math

import drjit as dr
import mitsuba as mi

from .parameters import at_least, fail, pose, positive
from .polarization import rotate_stokes, transverse
from .registration import register

NAME, KIND = "laser", "emitter"


def define():
    """The plugin's class in the variant in force."""

    class Laser(mi.Emitter):
        def __init__(self, props):
            super().__init__(props)
            radius = positive(props, NAME, "beam_radius", 0.1)
            cut = positive(props, NAME, "beam_cut", math.inf)
            divergence = at_least(props, NAME, "divergence_full_mrad", 0.0, 0.0) * 1e-3
            self.wavelength = positive(props, NAME, "wavelength", 532e-9)
            self.pulse_energy = positive(props, NAME, "pulse_energy", 1.0)
            self.pulse_duration = at_least(props, NAME, "pulse_duration", 0.0, 0.0)
            self.stokes = _stokes(props.get("stokes", "1, 1, 0, 0"))
            self.m_pose = pose(props, NAME)
            dr.make_opaque(self.m_pose)
            self.m_radius = dr.opaque(mi.Float, radius)
            # fraction of an uncut beam inside the aperture; radii are drawn from that fraction
            self.m_inside = dr.opaque(mi.Float, -math.expm1(-2 * (cut / radius) ** 2))
            self.m_divergence_half = dr.opaque(mi.Float, divergence / 2)
            self.m_flags = mi.EmitterFlags.DeltaDirection  # not hit by rays traced backwards

        def sample_local(self, sample_position, sample_direction):
            """Origin and direction of a ray in the laser's own frame, axis along +z."""
            origin = mi.Point3f(0, 0, 0)
            radius = self.m_radius * dr.sqrt(-0.5 * dr.log(1 - self.m_inside * sample_position.x))
            sine, cosine = dr.sincos(dr.two_pi * sample_position.y)
            origin.x, origin.y = radius * cosine, radius * sine
            # 1 - sample lies in (0, 1]: the logarithm stays finite
            tangent = self.m_divergence_half * dr.sqrt(-0.5 * dr.log(1 - sample_direction.x))
            sine, cosine = dr.sincos(dr.two_pi * sample_direction.y)
            return origin, dr.normalize(mi.Vector3f(tangent * cosine, tangent * sine, 1))

        def sample_ray(self, time, sample1, sample2, sample3, active=True):
            """A ray of the beam; the weight's first column is its Stokes vector, in joules."""
            origin, local = self.sample_local(sample2, sample3)
            to_world = self.m_pose
            direction = dr.normalize(to_world @ local)
            axis = transverse(to_world @ mi.Vector3f(1, 0, 0), direction)
            ray = mi.Ray3f(to_world @ origin, direction, time, self.wavelengths())
            if not mi.is_polarized:
                return ray, mi.Spectrum(self.pulse_energy)
            stokes = rotate_stokes(
                [mi.Float(s) for s in self.stokes],
                direction,
                axis,
                mi.mueller.stokes_basis(direction),
            )
            weight = mi.Spectrum(0)
            for row, value in enumerate(stokes):
                weight[row, 0] = value * self.pulse_energy
            return ray, weight

        def wavelengths(self):
            """The laser's wavelength in nm, for a ray (empty outside spectral variants)."""
            kind = type(mi.Ray3f().wavelengths)
            return kind(self.wavelength * 1e9) if mi.is_spectral else kind()

        def eval(self, si, active=True):
            return mi.Spectrum(0)

        def bbox(self):
            return mi.ScalarBoundingBox3f(mi.ScalarPoint3f(0))

        def to_string(self):
            return (
                f"Laser[wavelength={self.wavelength:g} m, pulse_energy={self.pulse_energy:g} J, "
                f"beam_radius={self.m_radius[0]:g} m, "
                f"divergence_full={2e3 * self.m_divergence_half[0]:g} mrad]"
            )

    return Laser


def _stokes(text) -> tuple[float, float, float, float]:
    try:
        values = [float(v) for v in str(text).replace(",", " ").split()]
    except ValueError:
        values = []
    if len(values) != 4:
        fail(NAME, "stokes", text, "four numbers I, Q, U, V, for example '1, 1, 0, 0'")
    degree = math.hypot(*values[1:])
    if values[0] != 1 or not degree <= 1 + 1e-6:
        fail(NAME, "stokes", text, "I = 1 and Q^2 + U^2 + V^2 <= 1")
    return tuple(values)


register(KIND, NAME, define)
