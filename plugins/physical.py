"""Checks for unphysical scenes: media, surfaces and poses, each with its reason.

Media and volumes are mostly Mitsuba's own, which accept any number: a negative extinction
coefficient or an albedo of 2 render without a warning. An integrator calls `Physical` before it
traces. Arrays that have passed are not checked again until they are replaced, so that an
optimisation only needs the extremes of the array that it changes.
"""

import re
from collections.abc import Iterable, Sequence
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from .bodies import extent, name_of
from .parameters import fail
from .surfaces import media_of
from .variant_types import Float, Medium, Scene, Sensor

# rounding to single precision may leave an albedo of 1 this much above it
ROUNDING = 1e-5

# of single precision
LARGEST = float(np.finfo(np.float32).max)

# the density at the peak, ((1 - g)^2 + 2 g (1 - cosine))^(-3/2), is wrong by a per cent where the
# cosine is rounded by 2^-22
SHARPEST = "-0.99 to 0.99, as single precision does not resolve a sharper peak"

RULES = (
    (re.compile(r"(sigma_t\..*\b(value|values|data)|scale)$"), 0.0, LARGEST, "finite, at least 0"),
    (re.compile(r"albedo\..*\b(value|values|data)$"), 0.0, 1.0, "0 to 1"),
    (re.compile(r"phase_function\..*weight\..*\b(value|values|data)$"), 0.0, 1.0, "0 to 1"),
    (re.compile(r"phase_function\.(.*\.)?g$"), -0.99, 0.99, SHARPEST),
)
"""Parameters of a medium, their least and largest value, and the allowed range in words."""


class Physical:
    """Checks the media and surfaces of a scene for an integrator.

    Parameters
    ----------
    plugin : str
        Its name, with which messages begin.
    """

    def __init__(self, plugin: str) -> None:
        self.plugin = plugin
        self.passed: dict[tuple[Medium, str], list[Float]] = {}

    def check(self, scene: Scene, sensor: Sensor) -> None:
        """Raise an error for the first unphysical parameter.

        Raises
        ------
        ValueError
            A coefficient, albedo, weight or asymmetry out of its range or NaN; a shape or volume
            whose position is not finite.
        """
        for shape in scene.shapes():
            self._place(name_of(shape), *extent(shape))
        passed = {}
        for medium, where in media_of(scene, sensor).items():
            parameters = mi.traverse(medium)
            for name, (_, _, node, _) in parameters.properties.items():
                if isinstance(node, mi.Volume):
                    self._place(f"{where}.{name}", node.bbox().min, node.bbox().max)
                value = parameters[name]
                rule = next((rule for rule in RULES if rule[0].fullmatch(name)), None)
                if rule is None or not _is_coefficient(node, value):
                    continue
                arrays = _flat(value)
                if not _same(self.passed.get((medium, name), ()), arrays):
                    self.check_values(f"{where}.{name}", arrays, *rule[1:])
                # the arrays themselves, so that no other one gets their index
                passed[medium, name] = arrays
        self.passed = passed

    def _place(self, field: str, low: Any, high: Any) -> None:
        # NaN compares as false
        if not (np.isfinite([low, high]).all() and (np.array(low) <= np.array(high)).all()):
            box = mi.ScalarBoundingBox3f(low, high)
            fail(self.plugin, field, str(box), "a finite position; its transform is not finite")

    def check_values(
        self, field: str, arrays: Iterable[Any], least: float, most: float, allowed: str
    ) -> None:
        """Raise an error if a parameter has a value out of its range."""
        highest = most + ROUNDING if most == 1 else most
        for array in arrays:
            values = np.array(array)
            # NaN makes both NaN, and compares as false
            if not (values.min() >= least and values.max() <= highest):
                wrong = values[~((values >= least) & (values <= highest))]
                fail(self.plugin, field, float(wrong[0]), allowed)


def _flat(value: Any) -> list[Float]:
    """Copies of a parameter's values: the parameter itself changes in place."""
    if not dr.is_array_v(value):
        return [value]
    if dr.is_tensor_v(value):
        value = value.array
    parts = value if dr.depth_v(value) > 1 else [value]
    return [mi.Float(dr.detach(part)) for part in parts]


def _is_coefficient(node: Any, value: Any) -> bool:
    """Whether a parameter is the quantity itself: in spectral variants colours are polynomials."""
    if not mi.is_spectral:
        return True
    colours = node.class_name().startswith("SRGB")
    return not colours and not (dr.is_tensor_v(value) and value.shape[-1] != 1)


def _same(before: Sequence[Any], now: Sequence[Any]) -> bool:
    """Whether arrays are identical to those before, without reading their values."""
    identities = [[getattr(part, "index", part) for part in parts] for parts in (before, now)]
    return identities[0] == identities[1]
