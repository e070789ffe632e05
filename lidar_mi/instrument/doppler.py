"""The fringe-imaging Doppler lidar: signal photons, sunlight and speckle."""

import math
from collections.abc import Callable
from typing import Annotated, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from lidar_mi.atmosphere.scattering.line import Line
from lidar_mi.description import Description
from lidar_mi.errors import InputError
from lidar_mi.instrument.detector import gate_duration, photons_per_energy
from lidar_mi.instrument.etalon import Etalon, harmonics, series
from lidar_mi.instrument.fringe_camera import FringeCamera
from lidar_mi.instrument.speckle import spatial_modes, temporal_modes
from lidar_mi.units import (
    Angle,
    Area,
    Backscatter,
    Energy,
    Extinction,
    Frequency,
    Length,
    Number,
    Pressure,
    SpectralRadiance,
    Temperature,
    Time,
    Within,
    quantity,
)


class DopplerLidar(Description):
    """A monostatic direct-detection Doppler lidar; defaults are the paper's Table 2.

    The paper has ranges of 56 m and 76 m. Not from the paper are: the widths of the laser's line
    and of the filter, the field of view (which holds the beam from 34 m on), the sky's radiance,
    the line's shape and ``aerosol_fraction``.

    ``instrument_constant`` is taken to hold everything between telescope and photoelectron, so that
    the lidar equation counts detected photons. With ``counted: before_etalon`` it ends in front of
    the etalon, whose transmission and the CCD's quantum efficiency then come on top.

    The default ``sky_radiance`` is that of a white surface of reflectance 0.5, such as a sunlit
    cloud, under an overhead sun of 1.1 W m^-2 nm^-1 (ASTM E490, 355 nm).
    """

    wavelength: Annotated[
        Length, Within(1e-7, 2e-5, "from the vacuum ultraviolet to the far infrared")
    ] = Field(354.7e-9, description="vacuum wavelength of the laser")
    pulse_energy: Annotated[
        Energy, Within(1e-15, 10000, "from thousands of photons to the lasers of fusion")
    ] = Field(quantity("70 mJ"), description="energy of a pulse")
    pulse_duration: Annotated[Time, Within(0, 0.001, "a millisecond is 150 km of air")] = Field(
        10e-9, description="full width at half maximum of a pulse"
    )
    laser_width: Annotated[
        Frequency, Within(1, 1e13, "from the narrowest lasers to 4 nm at 355 nm")
    ] = Field(
        quantity("100 MHz"),
        description="full width at half maximum of the emitted line, at least the Fourier limit "
        "of the pulse",
    )
    beam_radius: Annotated[
        Length, Within(1e-6, 10, "from the mode of a fibre to the largest telescope")
    ] = Field(0.025, description="of the outgoing beam")
    divergence_full: Annotated[Angle, Within(0, 0.5, "a collimated to a widely spread beam")] = (
        Field(quantity("500 urad"), description="full angle")
    )
    telescope_area: Annotated[
        Area, Within(1e-12, 1000, "from the core of a fibre to the largest telescope")
    ] = Field(0.13, description="of the receiving telescope")
    fov_half: Annotated[
        Angle, Within(1e-7, 0.5, "from the diffraction of a telescope of 10 m to a camera's lens")
    ] = Field(quantity("1 mrad"), description="field of view, half angle")
    instrument_constant: Annotated[
        Number, Within(1e-9, 1, "from a blocking filter of 90 dB to all light")
    ] = Field(0.15, description="efficiency of the lidar")
    counted: Literal["detected", "before_etalon"] = Field(
        "detected",
        description="photons that the lidar equation counts: detected on the CCD, or in front of "
        "the etalon",
    )
    range: Annotated[
        Length, Within(0.1, 100000, "from a wind tunnel to the top of the atmosphere")
    ] = Field(56.0, description="middle of the range bin")
    range_bin: Annotated[
        Length, Within(0.001, 100000, "from a pulse of 7 ps to all of the atmosphere")
    ] = Field(10.0, description="length of the range bin")
    altitude: Annotated[Length, Within(-5004, 81020, "the standard atmosphere")] = Field(
        8500.0, description="of the air, for temperature and pressure"
    )
    temperature: (
        Annotated[Temperature, Within(50, 2000, "from the mesopause to a flame")] | None
    ) = Field(None, description="of the air; default: the standard atmosphere's at altitude")
    pressure: (
        Annotated[Pressure, Within(1e-3, 1e7, "from 100 km altitude to a pressure cell")] | None
    ) = Field(None, description="of the air; default: the standard atmosphere's at altitude")
    backscatter: Annotated[
        Backscatter, Within(1e-15, 1, "from the thermosphere to the densest smoke")
    ] = Field(3.104e-6, description="backscatter coefficient")
    extinction: Annotated[Extinction, Within(0, 10, "visibility is 0.3 m in the densest smoke")] = (
        Field(2.70e-5, description="extinction coefficient")
    )
    aerosol_fraction: Annotated[Number, Within(0, 1, "definition of a fraction")] = Field(
        0.0, description="fraction of the backscattered photons that aerosol scatters"
    )
    line_shape: Literal["rayleigh", "rayleigh_brillouin"] = Field(
        "rayleigh_brillouin", description="spectral line of the molecular backscatter"
    )
    sky_radiance: Annotated[SpectralRadiance, Within(0, 1e14, "the disc of the sun has 3e13")] = (
        Field(quantity("0.18 W/m^2/sr/nm"), description="spectral radiance of the sky's background")
    )
    filter_bandwidth: Annotated[
        Length, Within(1e-16, 1e-5, "from 100 kHz at 355 nm to no filter")
    ] = Field(quantity("1 nm"), description="equivalent width of the filter")

    @model_validator(mode="after")
    def _pulse_has_its_width(self) -> Self:
        # time-bandwidth product of a Gaussian pulse, 2 ln 2 / pi
        if self.laser_width * self.pulse_duration < 0.44 and self.pulse_duration > 0:
            raise ValueError(
                f"laser_width: {self.laser_width:g} Hz is not allowed with pulses of "
                f"{self.pulse_duration:g} s; expected at least {0.44 / self.pulse_duration:g} Hz"
            )
        return self

    @property
    def gate_duration(self) -> float:
        """Duration of the echo from the range bin, s: 67 ns for 10 m."""
        return float(gate_duration(self.range_bin))

    @property
    def beam_width(self) -> float:
        """Diameter of the beam at ``range``, m: aperture plus divergence, as in the paper."""
        return 2 * self.beam_radius + self.divergence_full * self.range


def photons(lidar: DopplerLidar) -> float:
    """Photons of a pulse received from the range bin, counted as in ``lidar.counted``.

    The single-scattering lidar equation n = E lambda / (h c) k A / r^2 beta dr exp(-2 alpha r). It
    is evaluated at the middle of the bin: the mean of 1 / r^2 over 10 m at 56 m gives 0.8 % more.
    """
    emitted = lidar.pulse_energy * photons_per_energy(lidar.wavelength)
    collected = lidar.instrument_constant * lidar.telescope_area / lidar.range**2
    transmittance = math.exp(-2 * lidar.extinction * lidar.range)
    return emitted * collected * lidar.backscatter * lidar.range_bin * transmittance


def solar_background(lidar: DopplerLidar, etalon: Etalon) -> float:
    """Photons of scattered sunlight in the gate, on the whole CCD, counted like `photons`.

    Radiance x filter x area x solid angle x time x instrument constant; behind the etalon (with
    ``counted: before_etalon``) times its mean transmission, that of white light.
    """
    # of a cone, 2 pi (1 - cos), without the cancellation at small angles
    solid_angle = 4 * math.pi * math.sin(lidar.fov_half / 2) ** 2
    power = lidar.sky_radiance * lidar.filter_bandwidth * lidar.telescope_area * solid_angle
    energy = power * lidar.gate_duration * lidar.instrument_constant
    if lidar.counted == "before_etalon":
        energy *= harmonics(etalon, lidar.wavelength)[0].real
    return energy * photons_per_energy(lidar.wavelength)


def coherence_time(etalon: Etalon, line: Line, order: float = 0.0) -> float:
    """Coherence time of the light of a line in one place behind the etalon, s.

    line: of air at rest, every Gaussian with a width.
    order: fractional order of the laser's light; 0 is the peak of a fringe, where the spectrum is
        narrowest and the coherence time longest: light of other places has more modes.

    Raises InputError: a line with a monochromatic part.
    """
    return filtered_coherence_time(line, _behind_etalon(etalon, line, order))


def filtered_coherence_time(line: Line, transmission: Callable[[np.ndarray], np.ndarray]) -> float:
    """Coherence time of the light of a line behind a filter, s.

    int |g|^2 dt over all times, which by Parseval's theorem is int p^2 dnu, with p the spectrum
    behind the filter, of integral 1 (Goodman 1985, Statistical Optics, section 5.1).

    line: of air at rest, every Gaussian with a width.
    transmission: of the frequency less that of the laser (array, Hz).

    Raises InputError: a line with a monochromatic part.
    """
    if not line.sigmas.all():
        raise InputError("line.sigmas: 0 Hz is not allowed; expected a line with a width")
    extent = 8 * line.sigmas.max() + abs(line.offsets).max()
    # steps of sigma / 8 of the narrowest Gaussian: sums of its square are exact to rounding
    nu = np.arange(-extent, extent, line.sigmas.min() / 8)
    transmitted = line.pdf(nu) * transmission(nu)
    # int p^2 dnu, p normalised
    return float((transmitted**2).sum() / transmitted.sum() ** 2 / (nu[1] - nu[0]))


def _behind_etalon(etalon: Etalon, line: Line, order: float) -> Callable[[np.ndarray], np.ndarray]:
    """Transmission as a function of the frequency, in the place of a fractional order."""
    amplitudes = harmonics(etalon, line.wavelength)
    spectral_range = etalon.free_spectral_range(line.wavelength)
    return lambda nu: series(amplitudes, order + nu / spectral_range)


def speckle_modes(lidar: DopplerLidar, camera: FringeCamera, etalon: Etalon, line: Line) -> float:
    """Degrees of freedom M of the speckle in one pixel of a ring image.

    That is `channel_modes` with one channel a pixel, at the peak of a fringe, where modes are
    fewest.
    """
    return channel_modes(
        lidar, line, _behind_etalon(etalon, line, 0.0), camera.width * camera.height
    )


def channel_modes(
    lidar: DopplerLidar, line: Line, transmission: Callable[[np.ndarray], np.ndarray], channels: int
) -> float:
    """Degrees of freedom M of the speckle in a channel of a receiver: its relative variance is 1/M.

    Modes in time, for a Gaussian line of the `filtered_coherence_time`, times modes in space: those
    of the telescope, A Omega / lambda^2, spread evenly over the channels, and one at least.
    Polarised light is taken, the least that molecules leave; the polarisations of depolarised light
    would add modes.

    transmission: of the channel, of the frequency less that of the laser (array, Hz).
    channels: that the light is spread over: pixels of a camera, elements of a line detector.
    """
    # FWHM of the Gaussian line with that coherence time
    width = math.sqrt(2 * math.log(2) / math.pi) / filtered_coherence_time(line, transmission)
    # light from outside the field of view does not arrive
    footprint = min(lidar.beam_width / 2, lidar.fov_half * lidar.range)
    radius = math.sqrt(lidar.telescope_area / math.pi)
    space = spatial_modes(radius, lidar.wavelength, footprint, lidar.range)
    return float(temporal_modes(width, lidar.gate_duration)) * max(1.0, float(space) / channels)
