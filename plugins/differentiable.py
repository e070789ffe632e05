"""Which parameters of a scene have gradients."""

import re

import drjit as dr
import mitsuba as mi

from .parameters import fail
from .variant_types import Scene

COEFFICIENT = re.compile(r"(.*\.)?(sigma_t|albedo|weight)\.(data|value|value\.value)")
PHASE = re.compile(r"(.*\.)?(g|table)")
ALLOWED = (
    "extinction coefficients, albedos and weights of blends, as numbers and as grids, g of hg and "
    "tables of mueller; nothing else has a gradient"
)


def check_differentiable(plugin: str, scene: Scene) -> None:
    """Raise an error if gradients of a scene are asked for that do not exist.

    Raises
    ------
    ValueError
        A parameter with gradients enabled has none, or no parameter has them enabled.
    """
    wanted = 0
    parameters = mi.traverse(scene)
    for name, (_, _, node, _) in parameters.properties.items():
        if not dr.grad_enabled(parameters[name]):
            continue
        wanted += 1
        phase = isinstance(node, mi.PhaseFunction) and PHASE.fullmatch(name)
        if not (phase or COEFFICIENT.fullmatch(name)):
            fail(plugin, "gradients", name, ALLOWED)
    if not wanted:
        fail(plugin, "gradients", "no parameter", "dr.enable_grad of " + ALLOWED)
