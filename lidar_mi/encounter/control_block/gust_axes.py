"""The wind on a wing as four numbers: its means over the span, and its rotation about the x axis.

They are the linear part of the wind along the span, of which lift and rolling moment of a wing
consist (Etkin, J. Aircraft 18, 327-345, 1981), with the weights of an elliptic chord. An aircraft
at rest feels a roll gust p as one in calm air that rolls at -p.
"""

import numpy as np
from numpy.typing import ArrayLike

from lidar_mi.aircraft.strips import wing_strips

GUSTS = {
    "u": ("m s-1", "wind along the path, mean over the span"),
    "v": ("m s-1", "wind to the left, mean over the span"),
    "w": ("m s-1", "wind upwards, mean over the span"),
    "p": ("rad s-1", "roll gust: rotation of the wind about the x axis, port side up"),
}
"""Axes, their units and meanings."""


def span_nodes(span: float) -> tuple[np.ndarray, np.ndarray]:
    """Places y (m) along a span, and weights of an elliptic chord that sum to 1; each (n,)."""
    # area and slope have no effect on places and on relative areas
    strips = wing_strips(span, span**2, 1.0)
    return strips.places[:, 1], strips.areas / strips.areas.sum()


def gusts(span: float, wind: ArrayLike) -> np.ndarray:
    """The gusts of a wind on a level wing.

    span: m.
    wind (3, ..., n): u, v, w (m/s) at the places of `span_nodes`.

    Returns
    -------
    ndarray, shape (..., 4)
        Along `GUSTS`. The wind w(y) = p y has the roll gust p; a rolling moment that is linear in
        the wind is -L_p p with the roll damping L_p.
    """
    y, weights = span_nodes(span)
    wind = np.asarray(wind, float)
    means = wind @ weights
    rotation = wind[2] @ (weights * y) / (weights @ y**2)
    return np.moveaxis(np.concatenate([means, rotation[None]]), 0, -1)
