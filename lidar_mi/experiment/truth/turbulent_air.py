"""Turbulence of an experiment: its own numbers, or those of a standard."""

from lidar_mi.atmosphere.air.standards import CS_25_LENGTH, mil_f_8785c
from lidar_mi.atmosphere.air.turbulence import Turbulence, turbulence
from lidar_mi.errors import InputError
from lidar_mi.schema import air as schema


def turbulent_air(keys: schema.Turbulence, height: float, seed: int, section: str) -> Turbulence:
    """Turbulence at a height above the ground, m.

    height: at which a standard is read, m.
    seed: of the experiment, where the section has none.
    section: that has the key ``turbulence``, for messages.

    Raises InputError: a shortest wavelength above a tenth of the length.
    """
    sigma, length = turbulence_scales(keys, height)
    if keys.shortest > length / 10:
        raise InputError(
            f"{section}.turbulence.shortest: {keys.shortest:g} m is not allowed with the "
            f"length of {length:.3g} m at {height:g} m; expected at most {length / 10:.3g} m"
        )
    return turbulence(
        sigma,
        length,
        seed if keys.seed is None else keys.seed,
        spectrum=keys.spectrum,
        shortest=keys.shortest,
        evolution=keys.evolution,
    )


def turbulence_scales(keys: schema.Turbulence, height: float) -> tuple[float, float]:
    """Rms (m/s) and length (m) of turbulence: its own, or those of the standard."""
    sigma, length = keys.sigma, keys.length
    if keys.standard == "cs_25":
        assert sigma is not None  # the section refuses its absence with cs_25
        return sigma, length or CS_25_LENGTH
    rms, scale = mil_f_8785c(height, keys.level)
    return rms if sigma is None else sigma, length or scale
