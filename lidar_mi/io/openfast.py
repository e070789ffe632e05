"""What a lidar on a nacelle measured, as OpenFAST writes the output of its own lidar."""

from pathlib import Path

import numpy as np
import xarray as xr

from lidar_mi.errors import InputError
from lidar_mi.io.text import write_text

_WIDTH = 14


def write_openfast(path: str | Path, lines: xr.Dataset) -> None:
    """Write lines of one direction in the tabular layout of OpenFAST (``.out``).

    A row a line: ``Time`` (s, from the first line) and, for each gate k from the nearest on,
    ``WindMeas``k (m/s), the channels of the pulsed lidar of OpenFAST's InflowWind; it has five at
    most, here there are as many as gates. Values are as with its ``LidRadialVel`` False, positive
    for air that approaches: the wind along the horizontal direction of the beam, as if there were
    none across it. Gates with a flag are NaN.

    Raises InputError: lines of several directions, or upwards; as of `write_text`.
    """
    angles = [np.unwrap(np.deg2rad(lines[name].values)) for name in ("azimuth", "elevation")]
    if max(float(np.ptp(angle)) for angle in angles) > 1e-3:
        raise InputError(
            f"{path}: lines of several directions are not allowed; expected those of one "
            "(doppler.scan.kind: stare)"
        )
    elevation = float(angles[1].mean())
    level = np.cos(elevation)
    if level < 0.5:
        raise InputError(
            f"{path}: an elevation of {np.rad2deg(elevation):.3g} deg is not allowed; "
            "expected at most 60 deg, as a beam that looks up measures no wind towards it"
        )
    ahead = lines.sortby("range").transpose("time", "range")
    towards = (-ahead["radial_velocity"] / level).where(ahead["flag"] == 0).values
    seconds = (ahead["time"] - ahead["time"][0]).values / np.timedelta64(1, "s")
    gates = ", ".join(f"{k + 1}: {r:g} m" for k, r in enumerate(ahead["range"].values))
    names = ["Time", *(f"WindMeas{k + 1}" for k in range(towards.shape[1]))]
    head = [
        "",
        "Written by lidar-mi in the layout of OpenFAST's output",
        f"Middles of the gates, {gates}",
        "",
        "Description from the FST input file: none, a simulated pulsed lidar",
        "",
        "\t".join(f"{name:>{_WIDTH}}" for name in names),
        "\t".join(f"{unit:>{_WIDTH}}" for unit in ["(s)"] + ["(m/s)"] * towards.shape[1]),
    ]
    table = np.column_stack([seconds, towards])
    rows = ["\t".join(f"{value:>{_WIDTH}.6E}" for value in row) for row in table]
    write_text(path, "\n".join([*head, *rows, ""]))
