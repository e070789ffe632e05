"""The detector: its description, and the mean photoelectrons of echo, sky and dark current."""

from typing import Annotated, Self

import numpy as np
import scipy
from numpy.typing import ArrayLike
from pydantic import Field, model_validator

from lidar_mi.description import Description
from lidar_mi.units import Frequency, Length, Number, SpectralRadiance, Within, quantity


class Detector(Description):
    """Optics and detector behind the telescope; defaults: a photomultiplier by day.

    Transmission of the filter at the laser's wavelength is part of ``optics_efficiency``.

    ``excess_noise_factor`` is <g^2> / <g>^2 of the gain g of one photoelectron: d / (d - 1) for a
    photomultiplier whose every dynode multiplies by d (1.25 for 5); k G + (1 - k)(2 - 1 / G) for an
    avalanche photodiode of gain G and ionisation ratio k (McIntyre 1966, IEEE Trans. Electron
    Devices 13, 164); 1 for a detector without gain.

    The default ``sky_radiance`` is that of a white surface of reflectance 0.5, such as a sunlit
    cloud, under an overhead sun of 1.9 W m^-2 nm^-1 (ASTM G173, 532 nm, above the atmosphere):
    0.5 x 1.9 / pi. Blue sky is several times darker.

    ``line_width`` is that of the received light: the laser's (30 GHz: a Nd:YAG laser without
    seeding; 0.44 / pulse duration: a perfect one) and, for molecules, their Doppler broadening.
    """

    optics_efficiency: Annotated[
        Number, Within(1e-9, 1, "from a blocking filter of 90 dB to all light")
    ] = Field(0.5, description="telescope to detector")
    quantum_efficiency: Annotated[
        Number, Within(1e-9, 1, "one photoelectron per photon at most")
    ] = Field(0.4, description="photoelectrons per photon")
    excess_noise_factor: Annotated[
        Number, Within(1, 1000, "avalanche photodiodes have 100 at most")
    ] = Field(1.25, description="variance added by the gain")
    dark_rate: Annotated[Frequency, Within(0, 1e12, "one electron per picosecond")] = Field(
        quantity("1 kHz"), description="photoelectrons without light"
    )
    readout_noise: Annotated[Number, Within(0, 1e6, "capacity of the largest pixels")] = Field(
        0.0, description="rms photoelectrons per gate, at the input"
    )
    sky_radiance: Annotated[SpectralRadiance, Within(0, 1e14, "the disc of the sun has 3e13")] = (
        Field(quantity("0.3 W/m^2/sr/nm"), description="solar background")
    )
    filter_bandwidth: Annotated[
        Length, Within(1e-16, 1e-5, "from 100 kHz at 532 nm to no filter")
    ] = Field(quantity("1 nm"), description="equivalent width of the filter")
    speckle: bool = Field(True, description="whether the coherence of the laser causes speckle")
    line_width: Annotated[
        Frequency, Within(1, 1e15, "from the narrowest lasers to white light")
    ] = Field(quantity("30 GHz"), description="of the echo, full width at half maximum")
    speckle_modes: (
        Annotated[Number, Within(1, 1e15, "from one mode to white light for a second")] | None
    ) = Field(
        None, description="number of modes; default: from line width, telescope and footprint"
    )

    @model_validator(mode="after")
    def _modes_of_speckle(self) -> Self:
        if self.speckle_modes is not None and not self.speckle:
            raise ValueError(
                f"speckle_modes: {self.speckle_modes:g} is not allowed without speckle"
            )
        return self


def gate_duration(gate_length: ArrayLike) -> np.ndarray:
    """Time in which a gate is recorded, s: 2 dr / c for a gate dr (m) long."""
    return 2 * np.asarray(gate_length, float) / scipy.constants.c


def photons_per_energy(wavelength: float) -> float:
    """Photons in one joule of light, lambda / (h c), J^-1."""
    return wavelength / (scipy.constants.h * scipy.constants.c)


def signal_photoelectrons(
    s0: ArrayLike, pulse_energy: float, wavelength: float, detector: Detector
) -> np.ndarray:
    """Mean photoelectrons of an echo with ``s0`` of the emitted ``pulse_energy`` (J)."""
    return np.asarray(s0, float) * (
        pulse_energy * photons_per_energy(wavelength) * efficiency(detector)
    )


def background_photoelectrons(
    detector: Detector,
    duration: ArrayLike,
    aperture_area: float,
    fov_half: float,
    wavelength: float,
) -> np.ndarray:
    """Mean photoelectrons of scattered sunlight: radiance x filter x area x solid angle x time.

    Their number is Poisson distributed: sunlight through a filter has far too many modes for
    speckle (paper's telescope, 1 nm: 10^13). The gate is recorded for a duration (s); the area is
    in m^2, ``fov_half`` the half angle (rad).
    """
    # of a cone, 2 pi (1 - cos), without the cancellation at small angles
    solid_angle = 4 * np.pi * np.sin(fov_half / 2) ** 2
    power = detector.sky_radiance * detector.filter_bandwidth * aperture_area * solid_angle
    return np.asarray(duration, float) * (
        power * photons_per_energy(wavelength) * efficiency(detector)
    )


def dark_counts(detector: Detector, duration: ArrayLike) -> np.ndarray:
    """Mean dark counts in ``duration`` (s), photoelectrons."""
    return detector.dark_rate * np.asarray(duration, float)


def efficiency(detector: Detector) -> float:
    """Photoelectrons per photon at the telescope."""
    return detector.optics_efficiency * detector.quantum_efficiency
