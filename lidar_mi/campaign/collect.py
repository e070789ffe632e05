"""The points of a campaign as one data set."""

from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from lidar_mi import __version__
from lidar_mi.arguments import checked_arguments
from lidar_mi.assessment.labels import title_of
from lidar_mi.assessment.metrics.units import unit_of
from lidar_mi.campaign.folder import DATA, CampaignFolder, open_folder
from lidar_mi.campaign.points import MEMBER, tied
from lidar_mi.errors import InputError
from lidar_mi.experiment.log import silent
from lidar_mi.io.netcdf import read_netcdf, write_netcdf
from lidar_mi.progress import Notice

STATUS = ("done", "failed", "missing")

_POINTS_PER_NOTICE = 200


@checked_arguments
def open_campaign(folder: str | Path) -> xr.Dataset:
    """The data set of a campaign's folder, collected if that was not done.

    Parameters
    ----------
    folder : path

    Returns
    -------
    xr.Dataset
        As of `run_campaign`; ``folder`` is relative to the campaign's folder.

    Raises
    ------
    InputError
        No campaign in the folder.

    Examples
    --------
    >>> import lidar_mi as lm
    >>> table = lm.open_campaign("outputs/design_map")            # doctest: +SKIP
    >>> table["sensor.rmse_u"].sel(sky="day").mean("member")      # doctest: +SKIP
    """
    opened = open_folder(folder)
    path = opened.path / DATA
    if path.is_file():
        with suppress(InputError):  # damaged: collected again
            return read_netcdf(path)
    return collect(opened)


def collect(folder: CampaignFolder, notice: Notice = silent) -> xr.Dataset:
    """Collect the metrics of all points, and write ``campaign.nc``.

    The same points give the same file, by whichever workers and in whichever order they were
    computed. Durations are omitted: they are never the same.

    Returns
    -------
    xr.Dataset
        Dimensions in the order of the description, then ``member`` if there are several. A point
        without metrics has NaN, and its ``status`` and ``message`` say why. A metric with the name
        of a swept key is ``NAME.metric``: the time ahead of flights, where the distance is swept.
    """
    points = folder.points
    total = len(points)
    values: dict[str, np.ndarray] = {}
    status = np.full(total, STATUS.index("missing"), np.int8)
    messages, places = np.full(total, "", object), np.full(total, "", object)
    for number in range(total):
        if number % _POINTS_PER_NOTICE == 0:
            notice("collecting points", number / total)
        place = folder.place(number)
        places[number] = str(place.relative_to(folder.path))
        metrics = folder.metrics(number)
        if metrics is not None:
            status[number] = STATUS.index("done")
            # points may have different metrics: those of others are NaN
            for key, value in metrics.items():
                if not key.startswith("timing."):
                    values.setdefault(key, np.full(total, np.nan))[number] = value
        elif (outcome := folder.outcome(number)) is not None:
            # metrics are written last: without them the point is not done
            status[number] = STATUS.index("failed")
            messages[number] = outcome.message
    data = _data_set(folder, values, status, messages, places)
    write_netcdf(data, folder.path / DATA)
    return data


def _data_set(
    folder: CampaignFolder,
    values: dict[str, np.ndarray],
    status: np.ndarray,
    messages: np.ndarray,
    places: np.ndarray,
) -> xr.Dataset:
    """The data set of arrays over all points, shape (points,)."""
    points, campaign = folder.points, folder.campaign
    dims = [dimension.name for dimension in points.dimensions]
    shape = points.shape
    if campaign.members > 1:
        dims.append(MEMBER)
    else:
        # a single member is no dimension
        shape = shape[:-1]
    units = points.units()
    coords: dict[str, Any] = {}
    scales = {dimension.name: dimension.scale for dimension in points.dimensions}
    if campaign.sample:
        scales |= {tied(keys)[0]: span.scale for keys, span in campaign.sample.over.items()}
    for name, (dim, along) in points.coordinates().items():
        about = {"long_name": knob_name(name)}
        if name in units:
            about["units"] = units[name]
        if scales.get(name):
            about["scale"] = scales[name]
        # object arrays: NetCDF stores text of any length
        coords[name] = (dim, np.array(along, object if isinstance(along[0], str) else None), about)
    if MEMBER in dims:
        coords[MEMBER] = (MEMBER, np.arange(campaign.members), {"long_name": "member"})
    # sorted: the file does not depend on which point has a metric first
    variables: dict[str, Any] = {
        # a metric may have the name of a key of the campaign
        f"{key}.metric" if key in coords else key: (dims, values[key].reshape(shape), _about(key))
        for key in sorted(values)
    }
    variables["status"] = (
        dims,
        status.reshape(shape),
        {
            "long_name": "what became of the point",
            # CF flags: whole numbers whose meanings are attributes
            "flag_values": np.arange(len(STATUS), dtype=np.int8),
            "flag_meanings": " ".join(STATUS),
        },
    )
    variables["message"] = (dims, messages.reshape(shape), {"long_name": "why it failed"})
    variables["folder"] = (dims, places.reshape(shape), {"long_name": "folder of the point"})
    attributes = {
        "Conventions": "CF-1.11",
        "name": campaign.name,
        "base": campaign.base,
        "seed": points.seed,
        "kind": "sample" if campaign.sample else "sweep",
        "keep": campaign.keep,
        "version": __version__,
    }
    return xr.Dataset(variables, coords, attributes)


def knob_name(key: str) -> str:
    """What a key of an experiment is called on an axis: ``doppler.lidar.range``, as words."""
    if key == "platform.dt":
        return "time between the images"
    words = key.replace("doppler.lidar.", "Doppler lidar ").replace("doppler.", "Doppler lidar's ")
    return words.replace(".", " ").replace("_", " ")


def _about(key: str) -> dict[str, str]:
    """Attributes of a metric."""
    unit = unit_of(key)
    return {"long_name": title_of(key), **({"units": unit} if unit else {})}
