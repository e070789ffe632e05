"""Winds in the layout of the ACTRIS product of Doppler lidars, as doppy and Cloudnet write it."""

import xarray as xr

_NAMES = {"u": ("uwind", "zonal wind"), "v": ("vwind", "meridional wind")}


def in_actris_layout(winds: xr.Dataset) -> xr.Dataset:
    """Winds under the names of doppy (github.com/actris-cloudnet/doppy).

    winds: as of `fit_winds_to_lines`.

    Returns
    -------
    xr.Dataset, dims (time, height)
        ``uwind`` and ``vwind`` (m s-1; NaN where flagged), ``uwind_raw`` and ``vwind_raw`` (all),
        ``uwind_stderr``, ``vwind_stderr``, ``wind_speed``, ``wind_direction`` (degrees, from) and
        ``flag``; attributes of the winds.
    """
    variables = {}
    valid = winds["flag"] == 0
    for ours, (theirs, long_name) in _NAMES.items():
        raw = winds[ours]
        variables[theirs] = raw.where(valid).assign_attrs(raw.attrs, long_name=long_name)
        about = {"units": raw.attrs["units"], "long_name": f"{long_name}, not screened"}
        variables[f"{theirs}_raw"] = raw.copy().drop_attrs().assign_attrs(about)
        variables[f"{theirs}_stderr"] = winds[f"{ours}_stderr"]
    for ours, theirs in (("wind_speed", "wind_speed"), ("wind_from_direction", "wind_direction")):
        variables[theirs] = winds[ours].where(valid).assign_attrs(winds[ours].attrs)
    return xr.Dataset(variables | {"flag": winds["flag"]}, attrs=winds.attrs)
