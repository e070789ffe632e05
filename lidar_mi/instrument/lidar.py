"""The backscatter lidar: laser and telescope."""

import math
from typing import Annotated

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field, field_validator

from lidar_mi.description import Description
from lidar_mi.units import Angle, Energy, Length, Time, Within, quantity


class BackscatterLidar(Description):
    """A monostatic pulsed lidar; defaults are the paper's.

    Lengths in m, angles in rad, energy in J, time in s; text with units is read as such.
    """

    wavelength: Annotated[
        Length, Within(1e-7, 2e-5, "from the vacuum ultraviolet to the far infrared")
    ] = Field(
        532e-9,
        description="vacuum wavelength of the laser; that of named aerosols, photon energies and "
        "the channel of RGB variants, too",
    )
    beam_radius: Annotated[
        Length, Within(1e-6, 10, "from the mode of a fibre to the largest telescope")
    ] = Field(0.1, description="1/e^2 radius of the beam at the aperture")
    beam_cut: Annotated[
        Length,
        Within(1e-6, 1000, "from the mode of a fibre to wider than any beam", or_infinite=True),
    ] = Field(0.1, allow_inf_nan=True, description="outer radius of the emitted beam; inf: uncut")
    divergence_full: Annotated[Angle, Within(0, 0.5, "a collimated to a widely spread beam")] = (
        Field(quantity("2 mrad"), description="1/e^2 divergence, full angle")
    )
    stokes: tuple[float, float, float, float] = Field(
        (1.0, 1.0, 0.0, 0.0), description="Stokes vector (I, Q, U, V) about the horizontal axis"
    )
    pulse_energy: Annotated[
        Energy, Within(1e-15, 10000, "from thousands of photons to the lasers of fusion")
    ] = Field(
        quantity("1 mJ"),
        description="energy of a pulse in one beam; images are normalised by it, the detector's "
        "noise depends on it",
    )
    pulse_duration: Annotated[Time, Within(0, 0.001, "a millisecond is 150 km of air")] = Field(
        0.0,
        description="full width at half maximum of the Gaussian pulse, which limits the range "
        "resolution",
    )
    aperture_radius: Annotated[
        Length, Within(1e-6, 10, "from the core of a fibre to the largest telescope")
    ] = Field(0.5, description="radius of the telescope")
    fov_half: Annotated[
        Angle, Within(1e-7, 0.5, "from the diffraction of a telescope of 10 m to a camera's lens")
    ] = Field(quantity("5 mrad"), description="field of view, half angle")

    @field_validator("stokes")
    @classmethod
    def _physical(
        cls, value: tuple[float, float, float, float]
    ) -> tuple[float, float, float, float]:
        if value[0] != 1 or not math.hypot(*value[1:]) <= 1 + 1e-6:
            raise ValueError(f"{value} is not allowed; expected I = 1 and Q^2 + U^2 + V^2 <= 1")
        return value

    @property
    def aperture_area(self) -> float:
        """Area of the telescope, m^2."""
        return math.pi * self.aperture_radius**2

    def radius_at(self, distance: ArrayLike) -> np.ndarray:
        """1/e^2 radius of the Gaussian with the beam's variance at a distance (m), m.

        Variance of the truncated aperture plus that of the divergence.
        """
        edge = 2 * (self.beam_cut / self.beam_radius) ** 2
        # a Gaussian cut at c keeps 1 - x / (exp(x) - 1) of its variance, x = 2 c^2 / radius^2
        lost = edge / math.expm1(edge) if edge < 500 else 0.0
        spread = self.divergence_full / 2 * np.asarray(distance, float)
        return np.sqrt(self.beam_radius**2 * (1 - lost) + spread**2)
