"""Lines of sight as CfRadial 1.4 (NCAR/TN-504+STR), which xradar, Py-ART and wradlib read."""

from pathlib import Path

import numpy as np
import xarray as xr

from lidar_mi.arguments import checked_arguments
from lidar_mi.errors import InputError
from lidar_mi.io.lines_of_sight.dataset import scan_kind
from lidar_mi.io.netcdf import write_netcdf

_NEEDED = ("radial_velocity", "azimuth", "elevation", "range", "time")
_MODES = {"rhi": "rhi", "stare": "pointing", "ppi": "azimuth_surveillance"}
_FULL_CIRCLE = 300.0  # degrees: smaller ones are sectors
_STANDARD = {
    "radial_velocity": "radial_velocity_of_scatterers_away_from_instrument",
    "spectral_width": "doppler_spectrum_width",
    "snr": "signal_to_noise_ratio",
}


@checked_arguments
def write_cfradial(lines: xr.Dataset, path: str | Path) -> None:
    r"""Write lines of sight as a CfRadial 1.4 file.

    Variables and their names: ``radial_velocity`` (m/s, positive away), ``spectral_width`` (m/s),
    ``snr`` (dB) and all others on (time, range), with ``flag`` (0: valid); ``azimuth``,
    ``elevation``, ``time``, ``range``; of every sweep ``sweep_number``, ``sweep_mode``,
    ``fixed_angle`` and its first and last line. Lines are in the order of their sweeps. Flagged
    values are written as they are.

    Parameters
    ----------
    lines : xr.Dataset
        As of `read_lines_of_sight`, or lines_of_sight.nc of a coherent lidar's run.
    path : path

    Raises
    ------
    InputError
        A data set without lines of sight, or a file that cannot be written.

    Examples
    --------
    >>> import lidar_mi as lm
    >>> import xarray as xr
    >>> rows = "time,azimuth,elevation,range,radial_velocity\n0,10,60,300,1.5\n1,20,60,300,1.4\n"
    >>> with open("lines.csv", "w") as file:
    ...     _ = file.write(rows)
    >>> lm.write_cfradial(lm.read_lines_of_sight("lines.csv"), "lines.nc")
    >>> float(xr.load_dataset("lines.nc")["fixed_angle"][0])
    60.0
    """
    for name in _NEEDED:
        if name not in lines.variables:
            raise InputError(
                f"lines: {name} is missing; expected a data set of read_lines_of_sight"
            )
    number = lines["sweep"].values if "sweep" in lines.coords else np.zeros(lines.sizes["time"])
    order = np.lexsort((lines["time"].values, number))
    lines, number = lines.isel(time=order), number[order]
    _, first, counts = np.unique(number, return_index=True, return_counts=True)
    sweeps = [slice(start, start + count) for start, count in zip(first, counts, strict=True)]
    modes, fixed = zip(*(_mode(lines.isel(time=sweep)) for sweep in sweeps), strict=True)
    fields = {
        name: values.transpose("time", "range").reset_coords(drop=True)
        for name, values in lines.data_vars.items()
        if set(values.dims) == {"time", "range"}
    }
    if "snr" in fields:
        about = {"units": "dB", "long_name": "signal-to-noise ratio of the powers"}
        with np.errstate(divide="ignore", invalid="ignore"):
            ratio = fields["snr"].copy(data=10 * np.log10(fields["snr"].values))
        fields["snr"] = ratio.where(np.isfinite(ratio)).assign_attrs(about)
    for name, standard in _STANDARD.items():
        if name in fields:
            fields[name] = fields[name].assign_attrs(standard_name=standard)
    start = lines["time"].values[0].astype("datetime64[s]")
    ends = [str(lines["time"].values[k].astype("datetime64[s]")) + "Z" for k in (0, -1)]
    data = xr.Dataset(fields, {"time": lines["time"], "range": lines["range"]})
    data["time"].encoding = {"units": f"seconds since {start}Z", "dtype": "float64"}
    nearest = float(lines["range"].values[0])
    data["range"].attrs |= {"units": "meters", "meters_to_center_of_first_gate": nearest}
    for name in ("azimuth", "elevation"):
        about = {
            "units": "degrees",
            "standard_name": f"ray_{name}_angle",
            "axis": f"radial_{name}_coordinate",
        }
        data[name] = "time", lines[name].values.astype(np.float32), about
    for name, unit in (
        ("latitude", "degrees_north"),
        ("longitude", "degrees_east"),
        ("altitude", "meters"),
    ):
        place = float(lines[name]) if name in lines.variables else np.nan
        data[name] = (), place, {"units": unit}
    data["volume_number"] = (), np.int32(0)
    for name, end in zip(("start", "end"), ends, strict=True):
        data[f"time_coverage_{name}"] = (), np.bytes_(end)
    data["sweep_number"] = "sweep", np.arange(len(sweeps), dtype=np.int32)
    data["sweep_mode"] = "sweep", np.array(modes, "S32")
    data["fixed_angle"] = "sweep", np.array(fixed, np.float32), {"units": "degrees"}
    data["sweep_start_ray_index"] = "sweep", first.astype(np.int32)
    data["sweep_end_ray_index"] = "sweep", (first + counts - 1).astype(np.int32)
    data.attrs = {
        "Conventions": "CF/Radial instrument_parameters",
        "version": "1.4",
        "title": "Lines of sight of a Doppler lidar",
        "institution": "",
        "references": "",
        "source": str(lines.attrs.get("source", "")),
        "history": str(lines.attrs.get("history", "written by lidar-mi")),
        "comment": str(lines.attrs.get("remarks", "")),
        "instrument_name": str(lines.attrs.get("instrument", "unknown")),
    } | {
        key: lines.attrs[key]
        for key in ("gate_length", "pulse_length", "nyquist_velocity")
        if key in lines.attrs
    }
    write_netcdf(data, path)


def _mode(sweep: xr.Dataset) -> tuple[str, float]:
    """The name of its mode, and its fixed angle, degrees."""
    azimuth, elevation = sweep["azimuth"].values, sweep["elevation"].values
    kind = scan_kind(azimuth, elevation)
    if kind == "rhi":
        return "rhi", float(np.median(azimuth))
    if kind != "stare" and np.ptp(np.mod(azimuth, 360)) < _FULL_CIRCLE:
        return "sector", float(np.median(elevation))
    return _MODES.get(kind, "sector"), float(np.median(elevation))
