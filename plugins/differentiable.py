"""Which parameters of a scene have gradients."""

import re
from typing import Any

import drjit as dr
import mitsuba as mi

from .parameters import fail
from .variant_types import Scene

COEFFICIENT = re.compile(r"(.*\.)?(sigma_t|albedo|weight)\.(data|flow|value|value\.value)")
PHASE = re.compile(r"(.*\.)?(g|table)")
ALLOWED = (
    "extinction coefficients, albedos and weights of blends, as numbers and as grids, the flow of "
    "a moving_volume, g of hg and tables of mueller; nothing else has a gradient"
)


def differentiable(plugin: str, scene: Scene) -> tuple[list[Any], bool]:
    """The parameters with gradients, and whether they concern phase functions, blends among them.

    Raises
    ------
    ValueError
        A parameter with gradients enabled has none, or no parameter has them enabled.
    """
    wanted, phases = [], False
    parameters = mi.traverse(scene)
    for name, (_, _, node, _) in parameters.properties.items():
        if not dr.grad_enabled(parameters[name]):
            continue
        wanted.append(parameters[name])
        phase = isinstance(node, mi.PhaseFunction) and PHASE.fullmatch(name)
        phases |= bool(phase) or ".weight." in name
        if not (phase or COEFFICIENT.fullmatch(name)):
            fail(plugin, "gradients", name, ALLOWED)
        if name.endswith("table"):
            # what follows from the table, which a derivative may have detached from it
            node.parameters_changed()
    if not wanted:
        fail(plugin, "gradients", "no parameter", "dr.enable_grad of " + ALLOWED)
    return wanted, phases
