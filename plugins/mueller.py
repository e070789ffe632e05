"""
.. _phase-mueller:

Tabulated scattering matrix (``mueller``)
-----------------------------------------

A phase function from a table of the six independent elements of the scattering matrix of a
macroscopically isotropic, mirror-symmetric medium (spheres, randomly oriented spheroids, ...).
In unpolarised variants only a1 is used. Samples have the density a1 at every angle: the weight of
each is 1.

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
scaled as well. Its elements are differentiable; a change of their angles has no gradient.

.. code-block:: xml

    <phase type="mueller"><string name="table" value="spheroids_532nm.txt"/></phase>

.. code-block:: python

    {"type": "mueller", "table": mi.TensorXf(table)}
"""

from collections.abc import Sequence

import drjit as dr
import mitsuba as mi
import numpy as np

from .parameters import fail
from .parameters import table as read_table
from .polarization import level_frame, rotate_from_scattering_plane, scattering_angle
from .registration import register
from .variant_types import (
    Context,
    Float,
    Interaction,
    Mask,
    Point,
    Properties,
    Spectrum,
    Tensor,
    Traversal,
    UInt,
    Vector,
)

NAME, KIND = "mueller", "phase"

# widest cell, degrees: there the fourth power of half of it is below single precision
CELL = 1.0
# where a1 changes by a factor of 2 at most, they leave 1e-6 of a cell
NEWTON_STEPS = 3


def define() -> type:
    """The plugin's class in the variant in force."""

    class Mueller(mi.PhaseFunction):
        def __init__(self, props: Properties) -> None:
            super().__init__(props)
            if "table" not in props:
                fail(NAME, "table", None, "a tensor of N x 7 numbers or a file name")
            table = read_table(NAME, "table", props["table"], 7)
            self.m_table = mi.TensorXf(np.array(table, np.float32))
            self._tabulate(table)
            self.m_flags = +mi.PhaseFunctionFlags.Isotropic

        def _tabulate(self, table: np.ndarray) -> None:
            """Elements, and the probabilities of cells, of a table as it was stated."""
            table = check_table(table)
            table = _refined(table)
            self.m_angle = mi.Float(np.radians(table[:, 0]))
            self.m_elements = [mi.Float(column) for column in table[:, 1:].T]
            if dr.grad_enabled(self.m_table):
                attached = _attached(self.m_table, table[:, 0])
                pairs = zip(self.m_elements, attached, strict=True)
                self.m_elements = [dr.replace_grad(exact, tracked) for exact, tracked in pairs]
            # probability of every cell but for the factor of 2 pi, exact for a1 linear in angle
            self.m_cell = mi.DiscreteDistribution(mi.Float(_cells(table)))

        def traverse(self, callback: Traversal) -> None:
            callback.put("table", self.m_table, mi.ParamFlags.Differentiable)

        def parameters_changed(self, keys: Sequence[str] = ()) -> None:
            self._tabulate(self.m_table.numpy())

        def elements(self, angle: Float, active: Mask = True) -> list[Float]:
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

        def sample_angle(self, which: Float, sample: Float, active: Mask = True) -> Float:
            """Scattering angles of the density a1 per steradian; ``which`` selects the cell.

            Within a cell, where the density in angle is nearly linear, its integral is inverted by
            Newton's method from the inverse for the straight line between its ends.
            """
            cell = self.m_cell.sample(which, active)
            first, last, low, high = (
                dr.gather(mi.Float, values, cell + end, active)
                for values in (self.m_angle, self.m_elements[0])
                for end in (0, 1)
            )
            width, slope = last - first, (high - low) / (last - first)
            whole = _integral(first, width, low, slope)
            near, far = low * dr.sin(first), dr.maximum(high * dr.sin(last), 0)
            root = dr.sqrt(dr.lerp(near * near, far * far, sample))
            step = width * sample * (near + far) / dr.maximum(near + root, dr.smallest(mi.Float))
            for _ in range(NEWTON_STEPS):
                excess = _integral(first, step, low, slope) - sample * whole
                density = (low + slope * step) * dr.sin(first + step)
                change = dr.select(density > 0, excess / density, 0)
                step = dr.clip(step - change, 0, width)
            return first + step

        def eval_pdf(
            self, ctx: Context, mei: Interaction, wo: Vector, active: Mask = True
        ) -> tuple[Spectrum, Float]:
            incident = -mei.wi
            elements = self.elements(scattering_angle(incident, wo), active)
            pdf = elements[0]
            if not mi.is_polarized:
                return mi.Spectrum(pdf), pdf
            return rotate_from_scattering_plane(incident, wo, elements), pdf

        def sample(
            self,
            ctx: Context,
            mei: Interaction,
            sample1: Float,
            sample2: Point,
            active: Mask = True,
        ) -> tuple[Vector, Spectrum, Float]:
            sine, cosine = dr.sincos(self.sample_angle(sample1, sample2.x, active))
            sin_azimuth, cos_azimuth = dr.sincos(dr.two_pi * sample2.y)
            wo = level_frame(-mei.wi).to_world(
                mi.Vector3f(sine * cos_azimuth, sine * sin_azimuth, cosine)
            )
            value, pdf = self.eval_pdf(ctx, mei, wo, active)
            return wo, dr.select(pdf > 0, value * dr.rcp(pdf), 0), pdf

        def to_string(self) -> str:
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
    table[:, 1:] /= 2 * np.pi * _cells(table).sum()
    return table


def _refined(table: np.ndarray) -> np.ndarray:
    """The same elements, linear in angle, at more nodes: cells of a degree, a1 of a factor of 2."""
    angle, a1 = table[:, 0], table[:, 1]
    parts = [angle, np.arange(0, 180, CELL)]
    for cell in np.flatnonzero(np.abs(np.diff(np.log2(a1))) > 1):
        ends = a1[cell : cell + 2]
        steps = int(np.ceil(abs(np.log2(ends[1] / ends[0]))))
        levels = np.geomspace(ends[0], ends[1], 1 + steps)
        fraction = (levels[1:-1] - ends[0]) / (ends[1] - ends[0])
        parts.append(angle[cell] + fraction * (angle[cell + 1] - angle[cell]))
    nodes = np.concatenate(parts)
    # as single precision distinguishes them
    nodes = nodes[np.unique(np.radians(nodes).astype(np.float32), return_index=True)[1]]
    return np.column_stack([nodes, *(np.interp(nodes, angle, c) for c in table[:, 1:].T)])


def _cells(table: np.ndarray) -> np.ndarray:
    """Integral of a1 sin(angle) over each cell of a table, for a1 linear in angle."""
    low, high = _shares(table[:, 0])
    return low * table[:-1, 1] + high * table[1:, 1]


def _shares(angle: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """What both ends of each cell, each of a1 = 1, add to the integral over it; degrees."""
    theta = np.radians(angle)
    slope = np.diff(np.sin(theta)) / np.diff(theta)
    return np.cos(theta[:-1]) - slope, slope - np.cos(theta[1:])


def _attached(table: Tensor, nodes: np.ndarray) -> list[Float]:
    """Elements at nodes (degrees) as functions of a stated table's, single precision."""
    angle = table.numpy()[:, 0].astype(float)
    low = np.clip(np.searchsorted(angle, nodes, "right") - 1, 0, len(angle) - 2)
    part = mi.Float((nodes - angle[low]) / (angle[low + 1] - angle[low]))
    low, shares = mi.UInt32(low), np.zeros(len(angle))
    near, far = _shares(angle)
    shares[:-1] += near
    shares[1:] += far
    whole = _column(table, 1, dr.arange(mi.UInt32, len(angle))) * mi.Float(shares)
    scale = 1 / (dr.two_pi * dr.sum(whole))
    return [
        scale * dr.lerp(_column(table, k, low), _column(table, k, low + 1), part)
        for k in range(1, 7)
    ]


def _column(table: Tensor, column: int, row: UInt) -> Float:
    return dr.gather(mi.Float, table.array, row * 7 + column)


def _integral(first: Float, step: Float, low: Float, slope: Float) -> Float:
    """Integral of (low + slope s) sin(first + s) ds from 0 to ``step``, without cancellation."""
    half = 0.5 * step
    sine, cosine = dr.sincos(first + half)
    even = step * (1 - dr.square(half) / 6)  # 2 sin(half), for cells of a degree
    odd = step * dr.square(half) / 3  # sin(half) - half cos(half), times 2
    return even * sine * low + slope * (odd * cosine + half * even * sine)


register(KIND, NAME, define)
