"""Names for values of Mitsuba and Dr.Jit in signatures.

Each variant has types of its own, and a plugin is defined in whichever is in force. No type checker
can tell which, so that every name but `Stokes` and `Table` stands for `Any`; what it is called in a
variant stands in its comment.
"""

from typing import Any, TypeAlias

import numpy as np

# --- one value a lane

Float: TypeAlias = Any  # mi.Float
Int: TypeAlias = Any  # mi.Int32
UInt: TypeAlias = Any  # mi.UInt32
Mask: TypeAlias = Any  # mi.Bool
Complex: TypeAlias = Any  # mi.Complex2f
Point: TypeAlias = Any  # mi.Point2f, mi.Point3f
Vector: TypeAlias = Any  # mi.Vector3f
Cell: TypeAlias = Any  # mi.Vector3i
Frame: TypeAlias = Any  # mi.Frame3f
Ray: TypeAlias = Any  # mi.Ray3f
Spectrum: TypeAlias = Any  # mi.Spectrum: numbers, or Mueller matrices in polarised variants
Interaction: TypeAlias = Any  # mi.SurfaceInteraction3f, mi.MediumInteraction3f
MediumPtr: TypeAlias = Any  # mi.MediumPtr
Drawn: TypeAlias = Any  # mi.BSDFSample3f, mi.DirectionSample3f, mi.PositionSample3f
Generator: TypeAlias = Any  # mi.PCG32
Numbers: TypeAlias = Any  # arrays of Dr.Jit or of NumPy, and plain numbers

# --- one for all lanes

Tensor: TypeAlias = Any  # mi.TensorXf
Transform: TypeAlias = Any  # mi.Transform4f
Context: TypeAlias = Any  # mi.BSDFContext, mi.PhaseFunctionContext
Box: TypeAlias = Any  # mi.ScalarBoundingBox3f
Properties: TypeAlias = Any  # mi.Properties
Parameters: TypeAlias = Any  # mi.SceneParameters
Traversal: TypeAlias = Any  # mi.TraversalCallback

# --- objects of a scene

Scene: TypeAlias = Any  # mi.Scene
Sensor: TypeAlias = Any  # mi.Sensor
Emitter: TypeAlias = Any  # mi.Emitter
Shape: TypeAlias = Any  # mi.Shape, mi.Mesh
Medium: TypeAlias = Any  # mi.Medium
PhaseFunction: TypeAlias = Any  # mi.PhaseFunction
Volume: TypeAlias = Any  # mi.Volume
Texture: TypeAlias = Any  # mi.Texture

# --- made of these

Stokes: TypeAlias = list[Float]
"""I, Q, U, V; I alone in unpolarised variants."""

Table: TypeAlias = Tensor | np.ndarray | str
"""Numbers, or the name of a file of them."""
