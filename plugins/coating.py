"""Dielectric and metal coatings of mirrors: layers, and the waves that they reflect."""

from collections.abc import Sequence
from types import ModuleType

import drjit as dr
import mitsuba as mi
import numpy as np

from .parameters import fail
from .variant_types import Numbers, Properties


def read_coating(props: Properties, plugin: str) -> list[tuple[complex, float]]:
    """Layers (index + i extinction, thickness in m) of a mirror from its plate to the gap."""
    text = str(props.get("coating", "")).strip()
    try:
        layers = [tuple(float(v) for v in layer.split()) for layer in text.split(",") if text]
    except ValueError:
        layers = [()]
    for layer in layers:
        fine = len(layer) in (2, 3) and np.isfinite(layer).all()
        if not fine or layer[0] < 1 or layer[1] <= 0 or min(layer[2:], default=0) < 0:
            fail(plugin, "coating", text, "layers 'index thickness' (>= 1, > 0 m), comma-separated")
    return [(complex(index, *extinction), thickness) for index, thickness, *extinction in layers]


def admittance(index: Numbers, cosine: Numbers, polarisation: str) -> Numbers:
    """Ratio of the transverse magnetic to the transverse electric field, in vacuum's."""
    return index * cosine if polarisation == "s" else index / cosine


def amplitudes_of(
    layers: Sequence[tuple[Numbers, Numbers]], gap: Numbers, plate: Numbers, xp: ModuleType
) -> tuple[Numbers, Numbers, Numbers]:
    """Amplitudes of a mirror by the characteristic matrices of its layers (Macleod 2010, ch. 2).

    Parameters
    ----------
    layers : list
        (admittance, phase thickness) from the plate to the gap.
    gap, plate : array
        Admittances of the media on both sides.
    xp : module
        ``drjit`` or ``numpy``.

    Returns
    -------
    tuple
        Reflection on the side of the gap, product of the transmissions both ways, reflection from
        the plate, for the transverse electric field and exp(-i omega t).
    """
    number = mi.Complex2f if xp is dr else complex
    a, b, c, d = number(1, 0), number(0, 0), number(0, 0), number(1, 0)
    for admittance, phase in reversed(layers):
        cosine, sine = xp.cos(phase), number(0, -1) * xp.sin(phase)
        a, b, c, d = (
            a * cosine + b * sine * admittance,
            a * sine / admittance + b * cosine,
            c * cosine + d * sine * admittance,
            c * sine / admittance + d * cosine,
        )
    forward, backward = gap * (a + b * plate), c + d * plate
    total = forward + backward
    inside = (forward - backward) / total
    # the same stack from the other side has a and d exchanged
    outside = (plate * (d + b * gap) - (c + a * gap)) / total
    return inside, 4 * gap * plate / (total * total), outside
