"""
.. _phase-rayleigh_polarized:

Polarised Rayleigh scattering (``rayleigh_polarized``)
------------------------------------------------------

Scattering by anisotropic molecules as a Mueller matrix (Hansen & Travis 1974, Space
Sci. Rev. 16, eq. 2.15). In unpolarised variants it is the phase function for natural light.

============================ ======= ============================================================
Parameter                    Type    Meaning
============================ ======= ============================================================
``depolarization``           float   depolarisation factor of natural light at 90 degrees,
                                     0 <= d < 0.5 (0: isotropic molecules; air at 532 nm about
                                     0.028 for the whole Cabannes and Raman bands). Default 0
============================ ======= ============================================================

The linear depolarisation ratio in backscatter is d / (2 - d). ``depolarization`` can be changed
through ``mi.traverse`` without recompilation. Values are per steradian and
integrate to one over the sphere.

.. code-block:: xml

    <phase type="rayleigh_polarized"><float name="depolarization" value="0.028"/></phase>
"""

import drjit as dr
import mitsuba as mi

from .parameters import fail, number
from .polarization import rotate_from_scattering_plane
from .registration import register

NAME, KIND = "rayleigh_polarized", "phase"


def define():
    """The plugin's class in the variant in force."""

    class RayleighPolarized(mi.PhaseFunction):
        def __init__(self, props):
            super().__init__(props)
            self.m_depolarization = mi.Float(number(props, NAME, "depolarization", 0.0))
            self.parameters_changed()
            self.m_flags = +mi.PhaseFunctionFlags.Isotropic

        def traverse(self, callback):
            kind = mi.ParamFlags.NonDifferentiable
            callback.put("depolarization", self.m_depolarization, kind)

        def parameters_changed(self, keys=()):
            given = self.m_depolarization[0]
            if not 0 <= given < 0.5:
                fail(NAME, "depolarization", given, "0 <= value < 0.5")
            self.depolarization = given
            # Delta and Delta' of Hansen & Travis
            self.m_dipole = dr.opaque(mi.Float, (1 - given) / (1 + given / 2))
            self.m_circular = dr.opaque(mi.Float, (1 - 2 * given) / (1 - given))

        def phase(self, cosine):
            """Phase function of natural light, per steradian."""
            dipole = 0.75 * (1 + cosine * cosine)
            return dr.inv_four_pi * (self.m_dipole * dipole + (1 - self.m_dipole))

        def eval_pdf(self, ctx, mei, wo, active=True):
            incident = -mei.wi
            cosine = dr.dot(incident, wo)
            pdf = self.phase(cosine)
            if not mi.is_polarized:
                return mi.Spectrum(pdf), pdf
            scale = self.m_dipole * dr.inv_four_pi
            diagonal = 0.75 * (1 + cosine * cosine) * scale
            mixed = -0.75 * (1 - cosine * cosine) * scale
            linear = 1.5 * cosine * scale
            matrix = rotate_from_scattering_plane(
                incident, wo, (pdf, diagonal, linear, self.m_circular * linear, mixed, 0)
            )
            return matrix, pdf

        def sample(self, ctx, mei, sample1, sample2, active=True):
            # dipole part: invert 3/8 (mu + mu^3 / 3) + 1/2 = xi (Cardano); rest: isotropic
            xi = 2 * (2 * sample2.x - 1)
            root = dr.cbrt(xi + dr.sqrt(1 + xi * xi))
            dipole = root - dr.rcp(root)
            cosine = dr.select(sample1 < self.m_dipole, dipole, 2 * sample2.x - 1)
            cosine = dr.clip(cosine, -1, 1)
            sine = dr.safe_sqrt(1 - cosine * cosine)
            sin_azimuth, cos_azimuth = dr.sincos(dr.two_pi * sample2.y)
            wo = mi.Frame3f(-mei.wi).to_world(
                mi.Vector3f(sine * cos_azimuth, sine * sin_azimuth, cosine)
            )
            value, pdf = self.eval_pdf(ctx, mei, wo, active)
            return wo, value * dr.rcp(pdf), pdf

        def to_string(self):
            return f"RayleighPolarized[depolarization={self.depolarization:g}]"

    return RayleighPolarized


register(KIND, NAME, define)
