"""The keys of the site: where above the sea the air is, or what a sounding measured there."""

from typing import Annotated

from pydantic import Field

from lidar_mi.schema.section import Section
from lidar_mi.units import Length, Within


class Site(Section):
    """The air's pressure and temperature, from which its molecules scatter.

    Without ``sounding``, those of the U.S. Standard Atmosphere 1976 at ``altitude``.
    """

    altitude: Annotated[Length, Within(-5000, 80000, "the standard atmosphere")] | None = Field(
        None,
        description="of the observed air above sea level, also for doppler.lidar where that does "
        "not say otherwise; default: encounter.path.altitude of a flight, else 0 m, and without "
        "sounding for doppler.lidar its own",
    )
    sounding: str | None = Field(
        None,
        description="CSV or NetCDF file of altitude (m), pressure (hPa) and temperature (K), in "
        "the experiment's folder; default: the standard atmosphere",
    )
