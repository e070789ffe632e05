"""The etalon: two mirrors with a gap, which transmits light in rings.

The order of light at the angle theta inside the gap is m = 2 n d nu cos(theta) / c, counted so that
light passes where m is an integer: the phase of reflection is tuned away with the gap. m is about
77 000, so it is computed in float64 and its integer part split off; the rest fits in float32.

As a series in the order the transmission is T(m) = A_0 + 2 sum A_n cos(2 pi n m). A line with the
Fourier transform chi (`scattering.line.Line`) replaces A_n by A_n chi(n / FSR), uneven
plates into A_n D_n: all convolutions are products.

The Mitsuba plugin `etalon` computes the same transmission ray by ray; tests compare the two.
"""

import math
from typing import Annotated, NamedTuple, Self

import numpy as np
import scipy
from numpy.typing import ArrayLike
from pydantic import Field, model_validator

from lidar_mi.atmosphere.scattering.line import Line
from lidar_mi.description import Description
from lidar_mi.errors import InputError
from lidar_mi.units import Length, Number, Within

POLARIZATIONS = ("s", "p")
# Transmittance below which a mirror counts as opaque: even lossless, it would transmit no photon of
# a pulse.
_LEAST_TRANSMITTANCE = 1e-6
# A finesse of 9000: the series is for rings on a camera, and has to fit into memory.
_MOST_HARMONICS = 100_000


class Layer(NamedTuple):
    """One layer of a coating: refractive index, thickness (m), extinction coefficient."""

    index: float  # type: ignore[assignment]  # hides a method of tuples
    thickness: Length
    extinction: float = 0.0


class Mirrors(NamedTuple):
    """Reflectance and transmittance of one mirror, and its shift of the orders (phase over pi)."""

    reflectance: float
    transmittance: float
    order_shift: float


class Etalon(Description):
    """A plane Fabry-Perot etalon; lengths in m, text with units is read as such.

    The paper gives no numbers for its etalon. The defaults are derived: they give four rings on
    960 x 780 pixels of 7.4 um behind a lens of 300 mm.

    Mirrors are given by ``reflectivity`` and ``absorption``, or by ``coatings`` on the inner faces
    of both plates. Outer faces are taken as perfectly antireflecting. A tilt is no property of the
    etalon: it moves the centre of the rings (`lidar_mi.instrument.fringe_camera.FringeCamera`).
    """

    gap: Annotated[
        Length, Within(1e-6, 1, "from a few wavelengths to the coherence length of the laser")
    ] = Field(
        13.7e-3,
        description="distance of the mirrors; derived, as the paper does not state its etalon",
    )
    order_fraction: Annotated[Number, Within(0, 1, "definition of a fraction", "[)")] | None = (
        Field(
            0.5,
            description="fractional order at the centre, to which the gap is tuned; "
            "null: as it comes",
        )
    )
    index: Annotated[Number, Within(1, 4, "from air to germanium")] = Field(
        1.0, description="refractive index in the gap"
    )
    reflectivity: Annotated[
        Number, Within(1e-9, 0.999999, "from the best antireflection coating to the best mirror")
    ] = Field(0.70, description="of each mirror")
    absorption: Annotated[Number, Within(0, 1, "definition of a fraction", "[)")] = Field(
        0.0, description="fraction of the light absorbed by a mirror"
    )
    surface_rms: Annotated[Length, Within(0, 1e-6, "a wavelength leaves no rings")] = Field(
        2e-9, description="standard deviation of the gap by irregular plates"
    )
    bow: Annotated[Length, Within(0, 0.0001, "hundreds of wavelengths leave no rings")] = Field(
        0.0, description="gap in the middle less gap at the rim"
    )
    coatings: tuple[Layer, ...] | None = Field(
        None,
        min_length=1,
        description="(index, thickness) from plate to gap, instead of reflectivity and absorption",
    )
    plate_index: Annotated[Number, Within(1, 4, "from air to germanium")] = Field(
        1.476, description="refractive index of the plates; default: fused silica"
    )

    @model_validator(mode="after")
    def _mirrors_make_sense(self) -> Self:
        if self.reflectivity + self.absorption >= 1:
            raise ValueError(
                f"absorption: {self.absorption:g} is not allowed with reflectivity "
                f"{self.reflectivity:g}; expected less than {1 - self.reflectivity:g}"
            )
        for layer in self.coatings or ():
            index, thickness, extinction = layer
            if not (1 <= index <= 10 and 1e-10 <= thickness <= 1e-3 and 0 <= extinction <= 100):
                raise ValueError(
                    f"coatings: {tuple(layer)} is not allowed; expected an index of 1 to 10, a "
                    "thickness of 1e-10 to 0.001 m (an atom to a plate), an extinction of 0 to 100"
                )
        return self

    def order_at_centre(self, wavelength: float) -> float:
        """Order of light of the wavelength (m, in vacuum) at normal incidence."""
        if not (math.isfinite(wavelength) and wavelength > 0):
            raise InputError(f"wavelength: {wavelength!r} m is not allowed; expected more than 0 m")
        order = 2 * self.index * self.gap / wavelength + mirrors(self, wavelength).order_shift
        if self.order_fraction is not None:
            # the nearest order: gaps are tuned by a quarter of a wavelength at most
            order = round(order - self.order_fraction) + self.order_fraction
        return order

    def tuned_gap(self, wavelength: float) -> float:
        """The gap that has ``order_fraction``, m; within a quarter of a wavelength of ``gap``."""
        order = self.order_at_centre(wavelength) - mirrors(self, wavelength).order_shift
        return order * wavelength / (2 * self.index)

    def free_spectral_range(self, wavelength: float) -> float:
        """Frequency from one order to the next, c / (2 n d), Hz."""
        return scipy.constants.c / (2 * self.index * self.tuned_gap(wavelength))


def mirrors(etalon: Etalon, wavelength: float) -> Mirrors:
    """One mirror at normal incidence.

    At the angles of a ring image (10 mrad) coatings of quarter waves reflect the same to 2e-5 and
    shift the orders by 2e-5 more, equivalent to 0.03 m/s there (others up to 0.1 m/s), the same in
    every image; `coated_transmission` has it all.
    """
    if etalon.coatings is None:
        reflectivity = etalon.reflectivity
        return Mirrors(reflectivity, 1 - reflectivity - etalon.absorption, 0.0)
    r, t = _mirror_amplitudes(etalon, wavelength, np.array(1.0), 0.0, "s")
    transmittance = float(abs(t) ** 2)
    if not transmittance >= _LEAST_TRANSMITTANCE:
        raise InputError(
            f"etalon.coatings: a mirror that transmits {transmittance:.1e} at {wavelength:g} m is "
            f"not allowed; expected at least {_LEAST_TRANSMITTANCE:g}"
        )
    phase = float(np.angle(r)) / np.pi
    # the phase is periodic in the order
    return Mirrors(float(abs(r) ** 2), transmittance, phase - round(phase))


def cosine_inside(etalon: Etalon, cosine: ArrayLike) -> np.ndarray:
    """Cosine of the angle in the gap, of light from outside (index 1): Snell's law."""
    cosine = np.asarray(cosine, float)
    return np.sqrt(1 - (1 - cosine**2) / etalon.index**2)


def fractional_order(
    etalon: Etalon, wavelength: float, cosine: ArrayLike, offset: ArrayLike = 0.0
) -> np.ndarray:
    """Order less the integer part of the order at the centre.

    wavelength: m, in vacuum, of the laser.
    cosine: of the angle inside the gap.
    offset: frequency less that of the laser, Hz.
    """
    gap = 2 * etalon.index * etalon.tuned_gap(wavelength) / wavelength
    centre = etalon.order_at_centre(wavelength)
    return _less_whole_orders(centre, gap, wavelength, cosine, offset)


def plate_defects(etalon: Etalon, wavelength: float, n: ArrayLike) -> np.ndarray:
    """Factor of harmonic ``n`` of the transmission by plate defects.

    Irregularities vary the order by a Gaussian of standard deviation 2 n rms / wavelength; a bow,
    over a circular aperture in even light, uniformly by 2 n bow / wavelength about the mean gap,
    which is the one that is tuned (Hernandez 1986, Fabry-Perot Interferometers, chap. 2).
    """
    orders = 2 * etalon.index / wavelength * np.asarray(n, float)
    return np.exp(-2 * (np.pi * orders * etalon.surface_rms) ** 2) * np.sinc(orders * etalon.bow)


def harmonics(
    etalon: Etalon, wavelength: float, line: Line | None = None, count: int | None = None
) -> np.ndarray:
    """A_0 ... A_count of T = A_0 + 2 Re sum A_n exp(2 pi i n m), m the order of the laser's light.

    A_n = T^2 / (1 - R^2) R^n of the mirrors, times `plate_defects`, times the line's Fourier
    transform.

    wavelength: m, in vacuum, of the laser.
    line: default: monochromatic light.
    count: highest harmonic; default: beyond it all others together are below 1e-12 of A_0.
    """
    reflectance, transmittance, _ = mirrors(etalon, wavelength)
    if count is None:
        # the sum of all R^k from n on is R^n / (1 - R)
        count = math.ceil(math.log(1e-12 * (1 - reflectance)) / math.log(reflectance))
    if count > _MOST_HARMONICS:
        raise InputError(
            f"etalon: mirrors of reflectance {reflectance:.9g} need {count} harmonics; expected at "
            f"most {_MOST_HARMONICS}, a reflectance of about 0.9996"
        )
    n = np.arange(count + 1)
    amplitudes = transmittance**2 / (1 - reflectance**2) * reflectance ** n.astype(float)
    amplitudes = amplitudes * plate_defects(etalon, wavelength, n)
    chi = 1 if line is None else line.characteristic(n / etalon.free_spectral_range(wavelength))
    amplitudes = amplitudes * (chi + 0j)
    # the error of a series that ends before n: the sum of all amplitudes from n on
    remainder = np.cumsum(abs(amplitudes[::-1]))[::-1]
    return amplitudes[: max(2, np.count_nonzero(remainder > 1e-12 * remainder[0]))]


def series(amplitudes: np.ndarray, order: ArrayLike) -> np.ndarray:
    """A_0 + 2 Re sum A_n exp(2 pi i n m) at the orders ``m``, by Horner's rule in float64."""
    z = np.exp(2j * math.pi * np.asarray(order, float))
    total = np.zeros_like(z)
    # without A_0, which is not doubled
    for amplitude in amplitudes[:0:-1].tolist():
        total += amplitude
        total *= z
    return amplitudes[0].real + 2 * total.real


def transmission(
    etalon: Etalon,
    wavelength: float,
    cosine: ArrayLike,
    offset: ArrayLike = 0.0,
    line: Line | None = None,
) -> np.ndarray:
    """Transmission of the etalon with its plate defects, mean of both polarisations.

    wavelength: m, in vacuum, of the laser.
    cosine, offset: of the angle inside the gap; frequency less that of the laser, Hz.
    line: average over this line, shifted by ``offset``; default: monochromatic light.
    """
    order = fractional_order(etalon, wavelength, cosine, offset)
    return series(harmonics(etalon, wavelength, line), order)


def finesse(etalon: Etalon, wavelength: float, line: Line | None = None) -> float:
    """Free spectral range over the full width of a fringe at half its height above zero.

    Raises InputError: fringes so broad that they nowhere fall to half their height.
    """
    amplitudes = harmonics(etalon, wavelength, line)

    def above_half(order: float) -> float:
        transmitted = series(amplitudes, [order, 0.0])
        return float(transmitted[0] - transmitted[1] / 2)

    if above_half(0.5) >= 0:
        raise InputError("etalon: no finesse; its fringes nowhere fall to half their height")
    return 0.5 / scipy.optimize.brentq(above_half, 0, 0.5, xtol=1e-12)


def coated_transmission(
    etalon: Etalon,
    wavelength: float,
    cosine: ArrayLike,
    offset: ArrayLike = 0.0,
    polarization: str = "s",
) -> np.ndarray:
    """Transmittance of perfectly even coated plates, by transfer matrices.

    It has the dispersion of the coatings and their dependence on angle and polarisation, which the
    series neglects.

    wavelength: m, in vacuum, of the laser, for which the gap is tuned.
    cosine, offset: of the angle inside the gap; frequency less that of the laser, Hz.
    polarization {"s", "p"}
    """
    r, t = _mirror_amplitudes(etalon, wavelength, cosine, offset, polarization)
    round_trip = _round_trip(etalon, wavelength, cosine, offset)
    return abs(t**2 / (1 - r**2 * round_trip)) ** 2


def _round_trip(
    etalon: Etalon, wavelength: float, cosine: ArrayLike, offset: ArrayLike
) -> np.ndarray:
    """Phase factor of a round trip through the gap, without the mirrors'."""
    gap = 2 * etalon.index * etalon.tuned_gap(wavelength) / wavelength
    return np.exp(2j * np.pi * _less_whole_orders(gap, gap, wavelength, cosine, offset))


def _less_whole_orders(
    centre: float, gap: float, wavelength: float, cosine: ArrayLike, offset: ArrayLike
) -> np.ndarray:
    relative = np.asarray(offset, float) * wavelength / scipy.constants.c
    change = gap * (np.asarray(cosine, float) * (1 + relative) - 1)
    # whole orders are taken off first: of 77 000 they would cost the fraction's digits
    return (centre - math.floor(centre)) + change


def _mirror_amplitudes(
    etalon: Etalon, wavelength: float, cosine: ArrayLike, offset: ArrayLike, polarization: str
) -> tuple[np.ndarray, np.ndarray]:
    """Amplitudes of one mirror: reflection in the gap, transmission.

    Characteristic matrices of the layers (Macleod 2010, Thin-Film Optical Filters, chap. 2) for
    fields as exp(-i omega t), normalised so that |t|^2 is the transmitted fraction of the power.
    """
    if polarization not in POLARIZATIONS:
        raise InputError(f"polarization: {polarization!r} is not allowed; expected s or p")
    if etalon.coatings is None:
        raise InputError("etalon.coatings: null is not allowed here; expected layers")
    cosine = np.asarray(cosine, float)
    wavenumber = 2 * np.pi * (1 / wavelength + np.asarray(offset, float) / scipy.constants.c)
    # squared component along the layers, the same in all of them (Snell)
    across = etalon.index**2 * (1 - cosine**2)

    def admittance(index: complex) -> tuple[np.ndarray, np.ndarray]:
        slope = np.sqrt(index**2 - across + 0j) / index
        return (index * slope if polarization == "s" else index / slope), slope

    gap, _ = admittance(etalon.index)
    plate, _ = admittance(etalon.plate_index)
    # Fields (E, H) at the gap from those at the plate, and vice versa
    a, b, c, d = 1 + 0j, 0j, 0j, 1 + 0j
    for layer in reversed(etalon.coatings):
        index = layer.index + 1j * layer.extinction
        eta, slope = admittance(index)
        phase = wavenumber * index * slope * layer.thickness
        cos, sin = np.cos(phase), -1j * np.sin(phase)
        a, b, c, d = (
            a * cos + b * eta * sin,
            a * sin / eta + b * cos,
            c * cos + d * eta * sin,
            c * sin / eta + d * cos,
        )
    common = gap * a + gap * plate * b + c + plate * d
    inside = (gap * a + gap * plate * b - c - plate * d) / common
    return inside, 2 * np.sqrt(gap * plate) / common
