"""
.. _volume-moving_volume:

Volume that changes with time (``moving_volume``)
-------------------------------------------------

Numbers on a regular grid at several times, such as the extinction coefficient of air that moves
while a :ref:`scanner <sensor-scanning_lidar>` looks at it. Light meets the air as it is at the
light's own time: that of its beam.

========================== ============== ==================================================
Parameter                  Type           Meaning
========================== ============== ==================================================
``data``                   tensor, string T x Z x Y x X numbers, or a ``.npy`` file of them:
                                          states at equally spaced times, values at the
                                          centres of cells
``time_start, time_stop``  float          time of the first and of the last state, s
``to_world``               transform      from the unit cube, which the grid fills, to its
                                          place
``flow``                   tensor, string optional: Z x Y x X x 3 numbers, or a ``.npy`` file of
                                          them: the wind in m/s along the world's axes at the
                                          centres of cells of a grid that fills the same cube,
                                          of any size. It advects the single state of ``data``
========================== ============== ==================================================

Values are interpolated linearly between states and between cells. Beyond the ends they are those of
the nearest state or cell. A pattern of wavelength L that moves by d from one state to the next is
displaced by at most 0.63 d^3 / L^2 in between, and its amplitude is smaller by at most 5 (d / L)^2,
for d well below L. With a ``flow`` u there is one state, at ``time_start``; s seconds later the
value at p is that of the state at p - s u(p - s u(p) / 2): frozen air, traced back by one step of
the midpoint rule. Air from outside the grid has the value of the nearest cell. The bounds of the
extinction are those of the whole grid.

``data`` (with a last axis of one channel) and ``flow``, both differentiable, ``time_start`` and
``time_stop`` can be changed through ``mi.traverse`` without recompilation. Integrators other than
:ref:`gated_volpath <integrator-gated_volpath>` use the time of their rays.

.. code-block:: xml

    <medium type="heterogeneous">
      <volume type="moving_volume" name="sigma_t">
        <string name="data" value="puff.npy"/>
        <float name="time_start" value="-0.05"/> <float name="time_stop" value="0.05"/>
        <transform name="to_world">
          <scale x="4" y="40" z="40"/> <translate x="498" y="-20" z="-20"/>
        </transform>
      </volume>
    </medium>
"""

from collections.abc import Sequence
from itertools import product

import drjit as dr
import mitsuba as mi
import numpy as np

from .parameters import fail, number
from .parameters import table as read_table
from .registration import register
from .variant_types import (
    Cell,
    Float,
    Interaction,
    Mask,
    Point,
    Properties,
    Spectrum,
    Table,
    Tensor,
    Traversal,
    Vector,
)

NAME, KIND = "moving_volume", "volume"


def define() -> type:
    """The plugin's class in the variant in force."""

    class MovingVolume(mi.Volume):
        def __init__(self, props: Properties) -> None:
            super().__init__(props)
            for field in ("data", "time_start", "time_stop"):
                if field not in props:
                    fail(NAME, field, "nothing", "states of a grid and their times")
            states = read_states(props["data"])
            self.m_data = mi.TensorXf(states[..., None])
            self.m_start = dr.opaque(mi.Float, number(props, NAME, "time_start", 0.0))
            self.m_stop = dr.opaque(mi.Float, number(props, NAME, "time_stop", 0.0))
            matrix = np.eye(4)
            if "to_world" in props:
                matrix = np.array(props["to_world"].matrix, float).reshape(4, 4)
            if not (np.isfinite(matrix).all() and np.linalg.det(matrix) != 0):
                fail(NAME, "to_world", matrix.tolist(), "a finite transform that has an inverse")
            inverse = np.linalg.inv(matrix)
            self.m_to_local = mi.Matrix3f(inverse[:3, :3])
            self.m_offset = mi.Vector3f(inverse[:3, 3])
            dr.make_opaque(self.m_to_local, self.m_offset)
            self.m_flow: Tensor = None
            if "flow" in props:
                self.m_flow = mi.TensorXf(read_flow(props["flow"]))
            self._check()

        def eval_1(self, it: Interaction, active: Mask = True) -> Float:
            """Values at the places and times of interactions."""
            place = mi.Point3f(it.p)
            if self.m_flow is not None:
                age = it.time - self.m_start
                half = place - 0.5 * age * self._wind(place, active)
                place -= age * self._wind(half, active)
            time = (it.time - self.m_start) * self.m_rate
            # time first, as in the table
            places = [time, *self._cells(place, self.m_cells)]
            return lookup(self.m_data.array, places, self.m_data.shape, self.m_last, active)[0]

        def _cells(self, place: Point, cells: Sequence[Float]) -> list[Float]:
            """Places in a grid, from centre to centre, along z, y and x."""
            local = self.m_to_local @ mi.Vector3f(place) + self.m_offset
            return [local[k] * cells[k] - 0.5 for k in (2, 1, 0)]

        def _wind(self, place: Point, active: Mask) -> Vector:
            flow, places = self.m_flow, self._cells(place, self.m_flow_cells)
            return mi.Vector3f(lookup(flow.array, places, flow.shape, self.m_flow_last, active, 3))

        def eval(self, it: Interaction, active: Mask = True) -> Spectrum:
            return mi.UnpolarizedSpectrum(self.eval_1(it, active))

        def to_grid(self) -> np.ndarray:
            """The map from the world to the unit cube that the grid fills, 4 x 4."""
            matrix = np.eye(4)
            matrix[:3, :3] = np.array(self.m_to_local)[..., 0]
            matrix[:3, 3] = np.array(self.m_offset).ravel()
            return matrix

        def carried(self) -> bool:
            """Whether values are found elsewhere than where they are."""
            return self.m_flow is not None

        def max(self) -> float:
            return float(dr.max(dr.detach(self.m_data.array))[0])

        def resolution(self) -> Cell:
            return mi.ScalarVector3i(*self.m_data.shape[3:0:-1])

        def channel_count(self) -> int:
            return 1

        def traverse(self, callback: Traversal) -> None:
            callback.put("data", self.m_data, mi.ParamFlags.Differentiable)
            if self.m_flow is not None:
                callback.put("flow", self.m_flow, mi.ParamFlags.Differentiable)
            callback.put("time_start", self.m_start, mi.ParamFlags.NonDifferentiable)
            callback.put("time_stop", self.m_stop, mi.ParamFlags.NonDifferentiable)

        def parameters_changed(self, keys: Sequence[str] = ()) -> None:
            self._check()

        def _check(self) -> None:
            shape = self.m_data.shape
            if len(shape) != 5 or shape[4] != 1 or min(shape) < 1:
                fail(NAME, "data", f"shape {shape}", "times x z x y x x x 1")
            start, stop = self.m_start[0], self.m_stop[0]
            if not (np.isfinite([start, stop]).all() and start <= stop):
                fail(NAME, "time_stop", stop, f"a time after time_start = {start:g} s")
            if shape[0] > 1 and start == stop:
                fail(NAME, "time_stop", stop, f"a time after the first of {shape[0]} states")
            if self.m_flow is not None:
                check_flow(shape, self.m_flow)
                self.m_flow_last, self.m_flow_cells = _sizes(self.m_flow.shape[:3])
            # opaque, so that grids of other sizes and times run in the same kernel
            last, self.m_cells = _sizes(shape[1:4])
            self.m_last = [dr.opaque(mi.Float, shape[0] - 1), *last]
            rate = (shape[0] - 1) / (stop - start) if shape[0] > 1 else 0.0
            self.m_rate = dr.opaque(mi.Float, rate)
            dr.make_opaque(self.m_start, self.m_stop)

        def to_string(self) -> str:
            times, *cells = self.m_data.shape[:4]
            start, stop = self.m_start[0], self.m_stop[0]
            return f"MovingVolume[{times} states of {cells} cells from {start:g} to {stop:g} s]"

    return MovingVolume


def lookup(
    values: Float,
    places: Sequence[Float],
    shape: Sequence[int],
    last: Sequence[Float],
    active: Mask,
    channels: int = 1,
) -> list[Float]:
    """Values of a grid between its nodes, linear along each axis.

    Parameters
    ----------
    values : Float
        Of the nodes, with all axes in a row and the channels last.
    places : sequence of Float
        Along each axis, in nodes from the first one; beyond the ends they are those of the ends.
    shape : sequence of int
        Nodes along each axis.
    last : sequence of Float
        One less, opaque.
    channels : int
    """
    lookups = [(mi.UInt32(0), mi.Float(1))]
    for coordinate, nodes, most in zip(places, shape, last, strict=False):
        # an axis of one node has nothing to be interpolated
        if nodes == 1:
            continue
        coordinate = dr.clip(coordinate, 0, most)
        low = dr.minimum(mi.UInt32(coordinate), mi.UInt32(most) - 1)
        weight = coordinate - mi.Float(low)
        nodes = mi.UInt32(most) + 1
        steps = ((low, 1 - weight), (low + 1, weight))
        lookups = [
            (index * nodes + node, value * part)
            for (index, value), (node, part) in product(lookups, steps)
        ]
    return [
        sum(
            weight * dr.gather(mi.Float, values, index * channels + channel, active)
            for index, weight in lookups
        )
        for channel in range(channels)
    ]


def _sizes(shape: Sequence[int]) -> tuple[list[Float], list[Float]]:
    """Of a grid by z, y and x: last nodes in this order, and cells along x, y and z."""
    last = [dr.opaque(mi.Float, nodes - 1) for nodes in shape]
    return last, [dr.opaque(mi.Float, nodes) for nodes in shape[::-1]]


def read_states(source: Table) -> np.ndarray:
    """States of a grid (tensor or file name), (times, z, y, x)."""
    states = read_table(NAME, "data", source, 4)
    if states.ndim != 4 or min(states.shape) < 1:
        fail(NAME, "data", f"shape {states.shape}", "numbers by time, z, y and x")
    if not np.isfinite(states).all():
        fail(NAME, "data", f"{np.sum(~np.isfinite(states))} values that are none", "finite ones")
    return states.astype(np.float32)


def read_flow(source: Table) -> np.ndarray:
    """Wind on a grid (tensor or file name), (z, y, x, 3)."""
    return read_table(NAME, "flow", source, 3).astype(np.float32)


def check_flow(states: Sequence[int], flow: Tensor) -> None:
    """Refuse a flow that is no wind on a grid, or that has several states to carry."""
    shape = flow.shape
    if len(shape) != 4 or shape[3] != 3 or min(shape) < 1:
        fail(NAME, "flow", f"shape {shape}", "z x y x x x 3 numbers")
    if states[0] > 1:
        fail(NAME, "flow", f"a wind of {states[0]} states", "a wind of one state")
    if not np.isfinite(flow.numpy()).all():
        fail(NAME, "flow", "numbers that are none", "finite ones")


register(KIND, NAME, define)
