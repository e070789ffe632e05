"""The backscatter lidar: what its laser sends and its telescope receives."""

import math

import numpy as np
from numpy.typing import ArrayLike
from pydantic import BaseModel, ConfigDict, Field, field_validator

from lidar_mi.units import Angle, Energy, Length, Time, quantity


class BackscatterLidar(BaseModel):
    """A monostatic pulsed lidar; defaults are the paper's.

    Lengths in m, angles in rad, energy in J, time in s; text with units is read as such.
    """

    model_config = ConfigDict(
        frozen=True, extra="forbid", validate_default=True, allow_inf_nan=False
    )

    wavelength: Length = Field(
        532e-9, ge=100e-9, le=20e-6, description="vacuum wavelength of the laser"
    )
    beam_radius: Length = Field(
        0.1, gt=0, le=10, description="1/e^2 radius of the beam at the aperture"
    )
    beam_cut: Length = Field(
        0.1, gt=0, allow_inf_nan=True, description="outer radius of the emitted beam; inf: uncut"
    )
    divergence_full: Angle = Field(
        quantity("2 mrad"), ge=0, lt=0.5, description="1/e^2 divergence, full angle"
    )
    stokes: tuple[float, float, float, float] = Field(
        (1.0, 1.0, 0.0, 0.0), description="Stokes vector (I, Q, U, V) about the horizontal axis"
    )
    pulse_energy: Energy = Field(1e-3, gt=0, description="energy of a pulse in one beam")
    pulse_duration: Time = Field(
        0.0, ge=0, le=1e-3, description="full width at half maximum of the pulse"
    )
    aperture_radius: Length = Field(0.5, gt=0, le=10, description="radius of the telescope")
    fov_half: Angle = Field(
        quantity("5 mrad"), gt=0, lt=0.5, description="field of view, half angle"
    )

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
        lost = edge / math.expm1(edge) if edge < 500 else 0.0
        spread = self.divergence_full / 2 * np.asarray(distance, float)
        return np.sqrt(self.beam_radius**2 * (1 - lost) + spread**2)
