"""The fringe-imaging Michelson interferometer: two arms, and straight fringes on a line detector.

Light of the frequency nu leaves the output A of an interferometer whose arms differ by the optical
path D with the fraction 2 R T (1 + V cos(2 pi nu D / c)) of what enters, the output B, back to the
entrance, with the rest. One mirror is tilted, so that the phase grows along the detector: straight
fringes, equally spaced. Glass in one of the arms lets D depend on the angle of the light in fourth
order only (field widening), so that a telescope of large field loses no contrast.

A fringe is a cosine, so that a line with the Fourier transform chi
(`scattering.line.Line`) leaves the contrast V |chi(D / c)| and the phase arg chi(D / c).
"""

import math
from typing import Annotated, Literal

import numpy as np
import scipy
from numpy.typing import ArrayLike
from pydantic import Field

from lidar_mi.description import Description
from lidar_mi.units import Length, Number, Within


class Michelson(Description):
    """A field-widened Michelson interferometer with a line detector; lengths in m.

    ``path_difference`` is the one published for molecules at 355 nm, about 3 cm (Bruneau 2002,
    Appl. Opt. 41, 503, of the equivalent Mach-Zehnder interferometer). The other defaults are
    assumed. ``contrast`` 0.95 is that of a path difference that varies by lambda/20 rms within an
    element; it stands for all defects of the optics: plates, polarisation, what field widening
    leaves.
    """

    path_difference: Annotated[
        Length, Within(1e-6, 100, "from a few wavelengths to the coherence length of the laser")
    ] = Field(0.03, description="optical path, to one mirror and back less the other's")
    contrast: Annotated[Number, Within(1e-6, 1, "definition of a contrast")] = Field(
        0.95, description="of the fringes of monochromatic light"
    )
    splitter_reflectance: Annotated[Number, Within(1e-6, 0.999999, "both arms have light")] = Field(
        0.5, description="of the beam splitter, which absorbs nothing"
    )
    transmittance: Annotated[Number, Within(1e-9, 1, "definition of a fraction", "(]")] = Field(
        1.0, description="of the glass and the coatings"
    )
    outputs: Literal[1, 2] = Field(
        2, description="detected; 2 needs a tilt that separates the light that returns"
    )
    elements: Annotated[int, Within(3, 100_000, "level, contrast, phase; the longest sensors")] = (
        Field(32, description="of the line detector behind each output")
    )
    fringes: Annotated[Number, Within(0.5, 10_000, "half a fringe to hundreds")] = Field(
        1.0, description="across the detector, which the light fills evenly"
    )
    order_fraction: Annotated[Number, Within(0, 1, "definition of a fraction", "[)")] = Field(
        0.0, description="order of the laser's light at the edge of the detector, less its integer"
    )

    @property
    def delay(self) -> float:
        """Path difference over the speed of light, s."""
        return self.path_difference / scipy.constants.c


def harmonics(michelson: Michelson) -> np.ndarray:
    """C_0 and C_1 of every element: fraction of the light C_0 + 2 Re C_1 exp(2 pi i nu delay).

    nu is the frequency less that of the laser. Averaged over an element, so that the contrast falls
    by sinc(fringes / elements). Shape (outputs x elements, 2), output A first.
    """
    reflected = michelson.splitter_reflectance
    product = reflected * (1 - reflected)
    middle = (np.arange(michelson.elements) + 0.5) / michelson.elements
    order = michelson.order_fraction + michelson.fringes * middle
    blur = np.sinc(michelson.fringes / michelson.elements)
    # half of the amplitude 2 R T V: the conjugate has the other half
    cosine = product * michelson.contrast * blur * np.exp(2j * math.pi * order)
    a = np.stack([np.full_like(cosine, 2 * product), cosine], 1)
    b = np.stack([np.full_like(cosine, 1 - 2 * product), -cosine], 1)
    channels = np.concatenate([a, b][: michelson.outputs])
    # each element receives an equal part of the light
    return channels * michelson.transmittance / michelson.elements


def transmission(michelson: Michelson, offset: ArrayLike) -> np.ndarray:
    """Fraction (elements, N) of light ``offset`` (N,) Hz from the laser's that they receive."""
    constant, cosine = harmonics(michelson).T[..., None]
    phasor = np.exp(2j * math.pi * np.asarray(offset, float) * michelson.delay)
    return constant.real + 2 * (cosine * phasor).real
