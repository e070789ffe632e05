"""The double-edge receiver: two Fabry-Perot filters, one on each flank of the line.

Two etalons that differ in their gaps alone transmit peaks ``spacing`` apart, the laser's frequency
in the middle. A Doppler shift moves the line toward one peak and away from the other; the ratio of
the two signals is the measurement (Flesia & Korb 1999, Appl. Opt. 38, 432). The light falls
through the etalons as a collimated beam onto one detector each.
"""

import math
from typing import Annotated, Literal, Self

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field, model_validator

from lidar_mi.description import Description
from lidar_mi.instrument import etalon as fabry_perot
from lidar_mi.instrument.etalon import Etalon
from lidar_mi.units import Angle, Frequency, Number, Within, quantity


class DoubleEdge(Description):
    """Two etalons of one design on both flanks of the line.

    The defaults are derived: a free spectral range of 12 GHz and peaks of 1.7 GHz full width (1.8
    with plate defects and field), 5.1 GHz apart, have a Cramer-Rao bound for molecules at 355 nm
    within 4 % of the smallest at that free spectral range. The plates are as good as those of the
    ring-imaging etalon.

    ``arrangement`` ``split`` divides the light between both etalons by a beam splitter;
    ``sequential`` sends all of it to the first, and what that reflects to the second.
    """

    etalon: Etalon = Field(
        Etalon(gap=12.5e-3, reflectivity=0.64, order_fraction=None),
        description="both; only their gaps differ, by a fraction of a wavelength",
    )
    spacing: Annotated[
        Frequency, Within(1e3, 1e13, "from the narrowest lines to 4 nm at 355 nm")
    ] = Field(quantity("5.1 GHz"), description="from peak to peak")
    arrangement: Literal["split", "sequential"] = "split"
    transmittance: Annotated[Number, Within(1e-9, 1, "definition of a fraction", "(]")] = Field(
        1.0, description="of all optics but the etalons' mirrors"
    )
    field_half_angle: Annotated[Angle, Within(0, 0.1, "paraxial light")] = Field(
        quantity("1 mrad"), description="of the light in the gap, a uniform disc"
    )

    @model_validator(mode="after")
    def _reflects_what_it_does_not_transmit(self) -> Self:
        if self.arrangement == "sequential" and (self.etalon.absorption or self.etalon.coatings):
            raise ValueError(
                "arrangement: sequential is not allowed with absorption or coatings; expected "
                "mirrors that reflect what they do not transmit"
            )
        return self

    def delay(self, wavelength: float) -> float:
        """Time of a round trip through the gap, the inverse of the free spectral range, s."""
        return 1 / self.etalon.free_spectral_range(wavelength)


def harmonics(receiver: DoubleEdge, wavelength: float) -> np.ndarray:
    """C_n of both filters: fraction of the light C_0 + 2 Re sum C_n exp(2 pi i n nu delay).

    nu is the frequency less that of the laser (``wavelength``, m, in vacuum). The peaks are tuned
    to their places for light of the mean angle; a disc of directions of the half angle a spreads
    the order evenly over m a^2 / 2. The filter below the laser's frequency is first.
    """
    etalon = receiver.etalon
    amplitudes = fabry_perot.harmonics(etalon, wavelength)
    n = np.arange(len(amplitudes))
    inside = receiver.field_half_angle / etalon.index
    amplitudes = amplitudes * np.sinc(n * etalon.order_at_centre(wavelength) * inside**2 / 2)
    # half of the spacing on either side: pi, not 2 pi
    below = amplitudes * np.exp(1j * math.pi * n * receiver.spacing * receiver.delay(wavelength))
    above = below.conj()
    if receiver.arrangement == "split":
        return receiver.transmittance / 2 * np.stack([below, above])
    reflected = -below
    # 1 - T, as nothing is absorbed
    reflected[0] += 1
    # products of series are convolutions of both sides, n from -K to K
    product = np.convolve(_both_sides(reflected), _both_sides(above))
    width = len(product) // 2 + 1
    return receiver.transmittance * np.stack(
        [np.pad(below, (0, width - len(below))), product[len(product) // 2 :]]
    )


def _both_sides(amplitudes: np.ndarray) -> np.ndarray:
    """Coefficients of a real series for n from -K to K."""
    return np.concatenate([amplitudes[:0:-1].conj(), amplitudes])


def transmission(receiver: DoubleEdge, wavelength: float, offset: ArrayLike) -> np.ndarray:
    """Fraction (2, N) of light ``offset`` Hz (N,) from the laser's that passes each filter."""
    series = harmonics(receiver, wavelength)
    n = np.arange(series.shape[1])[:, None]
    turns = np.exp(2j * math.pi * n * np.asarray(offset, float) * receiver.delay(wavelength))
    # the constant counts once
    return 2 * (series @ turns).real - series[:, :1].real
