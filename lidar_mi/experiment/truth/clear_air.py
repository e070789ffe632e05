"""The molecules of the air at the site: extinction and backscatter."""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, NamedTuple

import numpy as np

from lidar_mi.atmosphere.air.standard_atmosphere import standard_atmosphere
from lidar_mi.atmosphere.scattering.molecules import molecular_scattering
from lidar_mi.errors import InputError
from lidar_mi.experiment.graph import Only
from lidar_mi.instrument.doppler import DopplerLidar
from lidar_mi.instrument.lidar import BackscatterLidar
from lidar_mi.io.sounding import read_sounding
from lidar_mi.schema.encounter import Encounter
from lidar_mi.schema.experiment import Experiment
from lidar_mi.schema.input_files import find_file
from lidar_mi.schema.scattering import Scattering
from lidar_mi.schema.site import Site
from lidar_mi.schema.wake import ExtinctionMapping

SHORTEST_WAVELENGTH, LONGEST_WAVELENGTH = 0.2e-6, 2e-6
"""Wavelengths (m) of the refractive index of air; beyond, molecules scatter less than 7e-8 m^-1."""


class ClearAir(NamedTuple):
    """Molecular extinction (m^-1) and backscatter (m^-1 sr^-1), and of which air in words."""

    extinction: float
    backscatter: float
    origin: str


def clear_air(
    wake_extinction: ExtinctionMapping,
    site: Site,
    lidar: Annotated[BackscatterLidar, Only("wavelength")],
    scattering: Annotated[Scattering, Only("phase", "parts", "band")],
    encounter: Encounter | None,
    search_path: Path,
) -> ClearAir:
    """Molecules of the air, as stated or from the site's pressure and temperature.

    Raises InputError: a sounding that cannot be used, that does not reach the site's altitude, or
    whose pressure there is below half or above twice that of the standard atmosphere; a wavelength
    at which the refractive index of air is not known.
    """
    molecules = wake_extinction.molecules
    if molecules == 0:
        return ClearAir(0.0, 0.0, "none, as wake.extinction.molecules says")
    if molecules == "auto" and not are_particles(scattering):
        return ClearAir(0.0, 0.0, f"none beside scattering.phase {scattering.phase}")
    if molecules == "auto" and lidar.wavelength > LONGEST_WAVELENGTH:
        return ClearAir(0.0, 0.0, "none worth mention at this wavelength")
    if lidar.wavelength < SHORTEST_WAVELENGTH:
        raise InputError(
            f"lidar.wavelength: {lidar.wavelength:g} m is not allowed with molecules, whose "
            f"scattering is known from {SHORTEST_WAVELENGTH:g} m on; expected a longer one, or "
            "wake.extinction.molecules: 0"
        )
    altitude = site_altitude(site, encounter)
    pressure, temperature = _air_at(altitude, site, search_path)
    air = molecular_scattering(lidar.wavelength, pressure, temperature, scattering.band)
    if molecules != "auto":
        return ClearAir(molecules, molecules / air.lidar_ratio, "as wake.extinction.molecules says")
    source = site.sounding or "standard atmosphere"
    origin = f"{source} at {altitude:g} m: {pressure / 100:.4g} hPa, {temperature:.4g} K"
    return ClearAir(air.extinction, air.backscatter, origin)


def in_air_of_its_site(experiment: Experiment, search_path: Path) -> Experiment:
    """The experiment with its fringe-imaging Doppler lidar in the air of the site.

    Altitude, pressure, temperature, backscatter and extinction are those of the site where
    ``doppler.lidar`` does not state its own. Backscatter is that of molecules plus the
    ``aerosol_fraction``, extinction that of molecules; neither changes if all light is of aerosol.
    Without a site nothing changes.
    """
    doppler, site = experiment.fringes, experiment.site
    if doppler is None or site == Site():
        return experiment
    lidar, set_keys = doppler.lidar, doppler.lidar.model_fields_set
    altitude = (
        lidar.altitude if "altitude" in set_keys else site_altitude(site, experiment.encounter)
    )
    of_site: dict[str, float] = {"altitude": altitude}
    if site.sounding is not None:
        of_site["pressure"], of_site["temperature"] = _air_at(altitude, site, search_path)
    lidar = _where_unstated(lidar, of_site)
    if lidar.aerosol_fraction < 1:
        molecules = molecular_scattering(
            lidar.wavelength, *air_of(lidar), experiment.scattering.band
        )
        backscatter = molecules.backscatter / (1 - lidar.aerosol_fraction)
        of_site = {"backscatter": backscatter, "extinction": molecules.extinction}
        lidar = _where_unstated(lidar, of_site)
    changes = {"doppler": doppler.model_copy(update={"lidar": lidar})}
    return experiment.model_copy(update=changes).read_from(experiment.folder)


def air_of(lidar: DopplerLidar) -> tuple[float, float]:
    """Pressure (Pa) and temperature (K) of a Doppler lidar's air."""
    pressure, temperature, _ = standard_atmosphere(lidar.altitude)
    return (
        pressure if lidar.pressure is None else lidar.pressure,
        temperature if lidar.temperature is None else lidar.temperature,
    )


def _where_unstated(lidar: DopplerLidar, values: Mapping[str, float]) -> DopplerLidar:
    set_keys = lidar.model_fields_set
    return lidar.model_copy(update={key: v for key, v in values.items() if key not in set_keys})


def site_altitude(site: Site, encounter: Encounter | None) -> float:
    """Altitude of the observed air above sea level, m; that of a flight unless stated."""
    if site.altitude is not None:
        return site.altitude
    return encounter.path.altitude if encounter else 0.0


def are_particles(scattering: Scattering) -> bool:
    """Whether the scatterers are particles alone, which are in clear air."""
    if scattering.phase == "mixture":
        return all(part.phase in ("aerosol", "table") for part in scattering.parts or ())
    return scattering.phase in ("aerosol", "table")


def _air_at(altitude: float, site: Site, search_path: Path) -> tuple[float, float]:
    """Pressure (Pa) and temperature (K)."""
    if site.sounding is None:
        return standard_atmosphere(altitude)[:2]
    file = find_file(site.sounding, search_path, "site.sounding")
    sounding = read_sounding(file)
    lowest, highest = sounding.altitude[[0, -1]]
    if not lowest <= altitude <= highest:
        raise InputError(
            f"site.altitude: {altitude:g} m is not allowed with {file}, which has {lowest:g} to "
            f"{highest:g} m; expected an altitude that it has"
        )
    # pressure falls exponentially between levels
    logarithm = np.interp(altitude, sounding.altitude, np.log(sounding.pressure))
    pressure = float(np.exp(logarithm))
    temperature = float(np.interp(altitude, sounding.altitude, sounding.temperature))
    # a factor of two is no weather, but a wrong unit
    usual = standard_atmosphere(altitude).pressure
    for name, value, least, most in (
        ("pressure", pressure / 100, usual / 200, usual / 50),
        ("temperature", temperature, 150.0, 350.0),
    ):
        if not least <= value <= most:
            unit = "hPa" if name == "pressure" else "K"
            raise InputError(
                f"{file}: {name}: {value:.4g} {unit} at {altitude:g} m is not allowed; expected "
                f"{least:.4g} to {most:.4g} {unit}"
            )
    return pressure, temperature


def air_in_words(lidar: DopplerLidar) -> str:
    """Altitude, pressure and temperature of a Doppler lidar's air."""
    pressure, temperature = air_of(lidar)
    return f"at {lidar.altitude:g} m: {pressure / 100:.4g} hPa, {temperature:.4g} K"
