"""
.. _phase-mueller:

Tabulated scattering matrix (``mueller``)
-----------------------------------------

A phase function from a table of the six independent elements of the scattering matrix of a
macroscopically isotropic, mirror-symmetric medium (spheres, randomly oriented spheroids, ...).
In unpolarised variants only a1 is used.

============================ =============== ====================================================
Parameter                    Type            Meaning
============================ =============== ====================================================
``table``                    tensor, string  N x 7 numbers, or the name of a file of N lines
                                             (``.npy``, or text with ``#`` comments): scattering
                                             angle in degrees, a1, a2, a3, a4, b1, b2. Angles
                                             ascend from 0 to 180; linear interpolation in angle
============================ =============== ====================================================

The matrix has the rows (a1, b1, 0, 0), (b1, a2, 0, 0), (0, 0, a3, b2), (0, 0, -b2, a4) and refers
to the scattering plane, Q > 0 parallel to it. The table is scaled so that a1 integrates to one
over the sphere (values are then per steradian); all elements are scaled by the same factor.
``table`` can be changed through ``mi.traverse``, also to one of other angles, and is
scaled as well.

.. code-block:: xml

    <phase type="mueller"><string name="table" value="spheroids_532nm.txt"/></phase>

.. code-block:: python

    {"type": "mueller", "table": mi.TensorXf(table)}
"""

import drjit as dr
import mitsuba as mi
import numpy as np

from .parameters import fail
from .parameters import table as read_table
from .polarization import rotate_from_scattering_plane, scattering_angle
from .registration import register

NAME, KIND = "mueller", "phase"


def define():
    """The plugin's class in the variant in force."""

    class Mueller(mi.PhaseFunction):
        def __init__(self, props):
            super().__init__(props)
            if "table" not in props:
                fail(NAME, "table", None, "a tensor of N x 7 numbers or a file name")
            table = read_table(NAME, "table", props["table"], 7)
            self._tabulate(table)
            self.m_table = mi.TensorXf(np.array(table, np.float32))
            self.m_flags = +mi.PhaseFunctionFlags.Isotropic

        def _tabulate(self, table):
            """Elements, and the distribution of the cosine, of a table as it was given."""
            table = check_table(table)
            self.m_angle = mi.Float(np.radians(table[:, 0]))
            self.m_elements = [mi.Float(column) for column in table[:, 1:].T]
            cosine, first = np.unique(np.cos(np.radians(table[:, 0])).astype(np.float32), True)
            density = np.maximum(table[first, 1], 1e-6 * table[:, 1].max()).astype(np.float32)
            self.m_cosine = mi.IrregularContinuousDistribution(mi.Float(cosine), mi.Float(density))
            self.m_cell = mi.DiscreteDistribution(
                mi.Float(np.diff(cosine) * (density[1:] + density[:-1]))
            )

        def traverse(self, callback):
            callback.put("table", self.m_table, mi.ParamFlags.NonDifferentiable)

        def parameters_changed(self, keys=()):
            self._tabulate(self.m_table.numpy())

        def elements(self, angle, active=True):
            """The six elements at a scattering angle in radians, per steradian."""
            last = dr.width(self.m_angle) - 1
            index = dr.binary_search(
                0, last, lambda i: dr.gather(mi.Float, self.m_angle, i, active) < angle
            )
            index = dr.clip(index, 1, last)
            low = dr.gather(mi.Float, self.m_angle, index - 1, active)
            high = dr.gather(mi.Float, self.m_angle, index, active)
            weight = dr.clip((angle - low) / (high - low), 0, 1)
            return [
                dr.lerp(
                    dr.gather(mi.Float, column, index - 1, active),
                    dr.gather(mi.Float, column, index, active),
                    weight,
                )
                for column in (self.m_elements if mi.is_polarized else self.m_elements[:1])
            ]

        def sample_cosine(self, sample, active=True):
            """Cosines distributed as ``m_cosine``, whose own inversion cancels where a1 is flat."""
            cell, sample = self.m_cell.sample_reuse(sample, active)
            low, high = (
                dr.gather(mi.Float, self.m_cosine.pdf, cell + end, active) for end in (0, 1)
            )
            root = dr.sqrt(dr.lerp(low * low, high * high, sample))
            first, last = (
                dr.gather(mi.Float, self.m_cosine.nodes, cell + end, active) for end in (0, 1)
            )
            return dr.lerp(first, last, sample * (low + high) / (low + root))

        def eval_pdf(self, ctx, mei, wo, active=True):
            incident = -mei.wi
            elements = self.elements(scattering_angle(incident, wo), active)
            pdf = self.m_cosine.eval_pdf_normalized(dr.dot(incident, wo), active)
            pdf *= dr.inv_two_pi
            if not mi.is_polarized:
                return mi.Spectrum(elements[0]), pdf
            return rotate_from_scattering_plane(incident, wo, elements), pdf

        def sample(self, ctx, mei, sample1, sample2, active=True):
            cosine = self.sample_cosine(sample2.x, active)
            sine = dr.safe_sqrt(1 - cosine * cosine)
            sin_azimuth, cos_azimuth = dr.sincos(dr.two_pi * sample2.y)
            wo = mi.Frame3f(-mei.wi).to_world(
                mi.Vector3f(sine * cos_azimuth, sine * sin_azimuth, cosine)
            )
            value, pdf = self.eval_pdf(ctx, mei, wo, active)
            return wo, dr.select(pdf > 0, value * dr.rcp(pdf), 0), pdf

        def to_string(self):
            return f"Mueller[{dr.width(self.m_angle)} angles]"

    return Mueller


def check_table(table: np.ndarray) -> np.ndarray:
    """A scattering-matrix table (N x 7, degrees first), checked and scaled to per steradian.

    Raises
    ------
    ValueError
        Not N x 7, angles not rising from 0 to 180, a1 not positive, or an element above a1.
    """
    table = np.array(table, float)
    if table.ndim != 2 or table.shape[1] != 7 or len(table) < 3:
        fail(NAME, "table", f"shape {table.shape}", "N x 7 numbers with N >= 3")
    angle, a1 = table[:, 0], table[:, 1]
    if not np.isfinite(table).all():
        fail(NAME, "table", "NaN or infinity", "finite numbers")
    if angle[0] != 0 or abs(angle[-1] - 180) > 1e-9 or (np.diff(angle) <= 0).any():
        fail(NAME, "table", f"angles {angle[0]:g} ... {angle[-1]:g}", "angles rising from 0 to 180")
    if (a1 <= 0).any():
        fail(NAME, "table", f"a1 down to {a1.min():g}", "a1 above 0 at every angle")
    if (np.abs(table[:, 2:]) > a1[:, None] * (1 + 1e-6)).any():
        fail(NAME, "table", "an element above a1", "no element larger than a1 in magnitude")
    # exact for a1 linear in angle between the nodes
    theta = np.radians(angle)
    slope = np.diff(a1) / np.diff(theta)
    integral = (a1[:-1] * np.cos(theta[:-1]) - a1[1:] * np.cos(theta[1:])).sum()
    integral += (slope * np.diff(np.sin(theta))).sum()
    table[:, 1:] /= 2 * np.pi * integral
    return table


register(KIND, NAME, define)
