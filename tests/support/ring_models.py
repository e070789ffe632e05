"""The ring model of the default instrument, and the bounds that belong to its cases."""

import numpy as np

from lidar_mi.retrieval.rings.model import PixelNoise, RingModel
from tests.support import ring_reference as reference

TEMPERATURES = reference.TEMPERATURE * np.array([0.75, 0.875, 1, 1.125, 1.25])


def ring_model(shape=reference.SHAPE, pixel=reference.PIXEL, temperatures=TEMPERATURES, **changes):
    centre = ((shape[1] - 1) / 2, (shape[0] - 1) / 2)
    rows = np.array([reference.harmonics(t) for t in temperatures])
    values = {
        "shape": shape,
        "centre": centre,
        "pixel": pixel,
        "focal_length": reference.FOCAL_LENGTH,
        "wavelength": reference.WAVELENGTH,
        "order_at_centre": reference.ORDER,
        "harmonics": rows,
        "temperatures": temperatures,
    }
    return RingModel(**{**values, **changes})


# velocity bound (m/s), photons, noise, centre
TABLE = {
    "poisson": (0.085, 2.4e7, PixelNoise(), None),
    "read noise": (0.115, 2.4e7, PixelNoise(5), None),
    "speckle": (0.19, 2.4e7, PixelNoise(5, 10), None),
    "76 m": (0.18, 1.3e7, PixelNoise(5), None),
    "off centre": (0.114, 2.4e7, PixelNoise(), (300.0, 250.0)),
}
