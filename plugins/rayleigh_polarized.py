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

from collections.abc import Sequence

import drjit as dr
import mitsuba as mi

from .parameters import fail, number
from .polarization import level_frame, rotate_from_scattering_plane
from .registration import register
from .variant_types import (
    Context,
    Float,
    Interaction,
    Mask,
    Point,
    Properties,
    Spectrum,
    Traversal,
    Vector,
)

NAME, KIND = "rayleigh_polarized", "phase"


def define() -> type:
    """The plugin's class in the variant in force."""

    class RayleighPolarized(mi.PhaseFunction):
        def __init__(self, props: Properties) -> None:
            super().__init__(props)
            self.m_depolarization = mi.Float(number(props, NAME, "depolarization", 0.0))
            self.parameters_changed()
            self.m_flags = +mi.PhaseFunctionFlags.Isotropic

        def traverse(self, callback: Traversal) -> None:
            kind = mi.ParamFlags.NonDifferentiable
            callback.put("depolarization", self.m_depolarization, kind)

        def parameters_changed(self, keys: Sequence[str] = ()) -> None:
            depolarization = self.m_depolarization[0]
            if not 0 <= depolarization < 0.5:
                fail(NAME, "depolarization", depolarization, "0 <= value < 0.5")
            self.depolarization = depolarization
            # Delta and Delta' of Hansen & Travis
            self.m_dipole = dr.opaque(mi.Float, (1 - depolarization) / (1 + depolarization / 2))
            self.m_circular = dr.opaque(mi.Float, (1 - 2 * depolarization) / (1 - depolarization))

        def phase(self, cosine: Float) -> Float:
            """Phase function of natural light, per steradian."""
            dipole = 0.75 * (1 + cosine * cosine)
            return dr.inv_four_pi * (self.m_dipole * dipole + (1 - self.m_dipole))

        def eval_pdf(
            self, ctx: Context, mei: Interaction, wo: Vector, active: Mask = True
        ) -> tuple[Spectrum, Float]:
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

        def sample(
            self,
            ctx: Context,
            mei: Interaction,
            sample1: Float,
            sample2: Point,
            active: Mask = True,
        ) -> tuple[Vector, Spectrum, Float]:
            # dipole part: invert 3/8 (mu + mu^3 / 3) + 1/2 = xi (Cardano); rest: isotropic
            xi = 2 * (2 * sample2.x - 1)
            root = dr.cbrt(xi + dr.sqrt(1 + xi * xi))
            dipole = root - dr.rcp(root)
            cosine = dr.select(sample1 < self.m_dipole, dipole, 2 * sample2.x - 1)
            cosine = dr.clip(cosine, -1, 1)
            sine = dr.safe_sqrt(1 - cosine * cosine)
            sin_azimuth, cos_azimuth = dr.sincos(dr.two_pi * sample2.y)
            wo = level_frame(-mei.wi).to_world(
                mi.Vector3f(sine * cos_azimuth, sine * sin_azimuth, cosine)
            )
            value, pdf = self.eval_pdf(ctx, mei, wo, active)
            return wo, value * dr.rcp(pdf), pdf

        def to_string(self) -> str:
            return f"RayleighPolarized[depolarization={self.depolarization:g}]"

    return RayleighPolarized


register(KIND, NAME, define)
