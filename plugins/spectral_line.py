"""
.. _texture-spectral_line:

Spectral line (``spectral_line``)
---------------------------------

The spectrum of backscattered light as a sum of Gaussians about the Doppler-shifted laser line, in
frequency offsets from the laser line. The float32 wavelength of a spectral variant does not resolve
the shifts that fringes measure (1 m/s is 5.6 MHz in 845 THz at 355 nm); an offset does.

=========================== ======= ====================================================== =========
Parameter                   Type    Meaning                                                Default
=========================== ======= ====================================================== =========
``wavelength``              float   of the laser line, m                                   354.7e-9
``v_los``                   float   line-of-sight velocity, m/s; positive: the scatterers  0
                                    approach and the frequency rises by
                                    2 v_los / wavelength
``weights``                 string  fractions of the Gaussians; scaled to a sum of one     1
``offsets``                 string  their centres about the shifted line, Hz               0
``sigmas``                  string  their standard deviations, Hz; 0: a sharp line         1.46e9
=========================== ======= ====================================================== =========

The default is the Rayleigh line of air at 232.9 K. The same line is used by the :ref:`plane waves
<emitter-plane_waves>`, which draw their frequencies from it, and by the :ref:`etalon
<bsdf-etalon>`, which can average over it analytically. ``v_los`` can be changed through
``mi.traverse`` without recompilation.

.. code-block:: xml

    <texture type="spectral_line" id="line">
      <float name="v_los" value="50"/>
      <string name="weights" value="0.1, 0.9"/>
      <string name="offsets" value="0, 0"/> <string name="sigmas" value="42e6, 1.46e9"/>
    </texture>
"""

from collections.abc import Sequence

import drjit as dr
import mitsuba as mi
import numpy as np

from .parameters import fail, number, numbers, positive
from .registration import register
from .variant_types import Float, Point, Properties, Traversal

NAME, KIND = "spectral_line", "texture"


def define() -> type:
    """The plugin's class in the variant in force."""

    class SpectralLine(mi.Texture):
        def __init__(self, props: Properties) -> None:
            super().__init__(props)
            self.wavelength = positive(props, NAME, "wavelength", 354.7e-9)
            weights = np.array(numbers(props, NAME, "weights", "1"))
            offsets = np.array(numbers(props, NAME, "offsets", "0"))
            sigmas = np.array(numbers(props, NAME, "sigmas", "1.46e9"))
            if (weights < 0).any() or not weights.sum() > 0:
                fail(NAME, "weights", weights.tolist(), "numbers of at least 0, not all 0")
            if (sigmas < 0).any():
                fail(NAME, "sigmas", sigmas.tolist(), "numbers of at least 0")
            for field, values in (("offsets", offsets), ("sigmas", sigmas)):
                if len(values) != len(weights):
                    fail(NAME, field, values.tolist(), f"as many as weights, {len(weights)}")
            self.gaussians = np.column_stack([weights / weights.sum(), offsets, sigmas])
            self.m_reached = mi.Float(np.cumsum(self.gaussians[:, 0])[:-1])
            self.m_offsets, self.m_sigmas = mi.Float(offsets), mi.Float(sigmas)
            self.m_v_los = dr.opaque(mi.Float, number(props, NAME, "v_los", 0.0))
            self._check()

        def shift(self) -> Float:
            """Frequency of the line's centre less the laser's, Hz."""
            return self.m_v_los * (2 / self.wavelength)

        def sample(self, which: Float, sample: Point) -> Float:
            """Frequency offsets from the laser line, Hz; ``which`` selects the Gaussian."""
            index = mi.UInt32(0)
            for k in range(dr.width(self.m_offsets) - 1):
                index += dr.select(which < dr.gather(mi.Float, self.m_reached, k), 0, 1)
            normal = mi.warp.square_to_std_normal(sample).x
            sigma = dr.gather(mi.Float, self.m_sigmas, index)
            return self.shift() + dr.fma(sigma, normal, dr.gather(mi.Float, self.m_offsets, index))

        def characteristic(self, time: np.ndarray) -> np.ndarray:
            """Mean of exp(2 pi i offset time) about the shifted centre; time in s, float64."""
            weight, offset, sigma = self.gaussians.T[:, :, None]
            width = np.exp(-2 * (np.pi * sigma * time) ** 2)
            return (weight * width * np.exp(2j * np.pi * offset * time)).sum(0)

        def traverse(self, callback: Traversal) -> None:
            callback.put("v_los", self.m_v_los, mi.ParamFlags.NonDifferentiable)

        def parameters_changed(self, keys: Sequence[str] = ()) -> None:
            dr.make_opaque(self.m_v_los)
            self._check()

        def _check(self) -> None:
            if not np.isfinite(self.m_v_los[0]):
                fail(NAME, "v_los", self.m_v_los[0], "a finite number")

        def to_string(self) -> str:
            return (
                f"SpectralLine[wavelength={self.wavelength:g} m, v_los={self.m_v_los[0]:g} m/s, "
                f"{len(self.gaussians)} Gaussians]"
            )

    return SpectralLine


register(KIND, NAME, define)
