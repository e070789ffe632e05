"""Single scattering in layered air: signal of gates and its derivatives in closed form."""

import numpy as np

_SUBDIVISIONS, _POINTS = 8, 4
"""Of a gate, and of a subdivision: few nodes, between which extinction is linear, lie in a gate."""


class Layers:
    """Light that gates receive from air whose extinction changes only along x.

    The extinction is linear between nodes and constant beyond them, as the renderer's grid is. A
    gate from r_1 to r_2 along a beam receives, but for a factor,

        a = int_r1^r2 s(r) / r^2 exp(-2 q t(r)) dr,

    with the optical depth t from the first node's outer face on and a factor q of attenuation: 1
    in single scattering; below 1 it stands for scattered light that stays in the field of view
    (Platt 1981, J. Atmos. Sci. 38, 156).

    nodes (nodes,): x of the extinction's values, equally spaced, m.
    edges (gates + 1,): ranges of the gates along a beam, m.
    cosines (beams,): between the beams and x.
    """

    def __init__(self, nodes: np.ndarray, edges: np.ndarray, cosines: np.ndarray) -> None:
        points, weights = np.polynomial.legendre.leggauss(_POINTS)
        fine = np.linspace(edges[:-1], edges[1:], _SUBDIVISIONS + 1, axis=1)
        middle, half = (fine[:, 1:] + fine[:, :-1]) / 2, (fine[:, 1:] - fine[:, :-1]) / 2
        ranges = (middle[..., None] + half[..., None] * points).reshape(len(middle), -1)
        steps = (half[..., None] * weights).reshape(ranges.shape)
        shape = (*ranges.shape, len(cosines))
        x = ranges[..., None] * cosines
        step = nodes[1] - nodes[0]
        face = nodes[0] - step / 2
        # the air ends half a step beyond the outermost nodes
        inside = (x > face) & (x < nodes[-1] + step / 2)
        self._weights = np.broadcast_to((steps / ranges**2)[..., None], shape) * inside
        self._values = _hats(x, nodes)
        along = _hat_integrals(x, nodes) - _hat_integrals(np.array(face), nodes)
        self._depths = along / np.broadcast_to(cosines, shape)[..., None]

    def signal(self, extinction: np.ndarray, factor: float) -> tuple[np.ndarray, np.ndarray]:
        """The integral a (gates, beams), and its derivative by the logarithm of every node.

        The extinction (m^-1) is above 0; the factor q is that of attenuation.
        """
        weights = self._weights * np.exp(-2 * factor * (self._depths @ extinction))
        local = self._values @ extinction
        signal = (weights * local).sum(1)
        slope = np.einsum("gpb,gpbn->gbn", weights, self._values)
        slope -= 2 * factor * np.einsum("gpb,gpbn->gbn", weights * local, self._depths)
        return signal, slope * extinction

    def depth(self, extinction: np.ndarray) -> np.ndarray:
        """Mean optical depth of the way to each gate, (gates, beams)."""
        return (self._depths @ extinction).mean(1)


def _hats(x: np.ndarray, nodes: np.ndarray) -> np.ndarray:
    """Weight of every node in the extinction at x, (..., nodes)."""
    step = nodes[1] - nodes[0]
    place = np.clip((x - nodes[0]) / step, 0, len(nodes) - 1)[..., None]
    return np.maximum(1 - np.abs(place - np.arange(len(nodes))), 0)


def _hat_integrals(x: np.ndarray, nodes: np.ndarray) -> np.ndarray:
    """Integral of `_hats` from the first node to x, m, (..., nodes)."""
    step = nodes[1] - nodes[0]
    place = (x[..., None] - nodes[0]) / step
    within = np.clip(place, 0, len(nodes) - 1) - np.arange(len(nodes))
    up = np.clip(within, -1, 0)
    down = np.clip(within, 0, 1)
    # areas of the hats' two sides; the first node has no left one
    area = (1 + up) ** 2 / 2 + down - down**2 / 2
    area[..., 0] -= 0.5
    area[..., 0] += np.minimum(place[..., 0], 0)
    area[..., -1] += np.maximum(place[..., -1] - (len(nodes) - 1), 0)
    return step * area
