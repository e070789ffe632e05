"""Render the pairs: images as 16-bit TIFF and CF NetCDF, the true wind as .flo and CF NetCDF."""

from pathlib import Path

import numpy as np
import tifffile
import xarray as xr

import lidar_mi as lm
from lidar_mi.io.flo_file import write_flo

from . import turbulent
from .cases import ENERGIES, Case, names, settings

DT = 0.1
FULL = 65535


def make(folder: Path, only: str = "") -> None:
    """Write a folder for each pair whose name begins with ``only``."""
    for case, level, name in names():
        if name.startswith(only) and not (folder / name / "truth.flo").exists():
            write_pair(folder / name, case, level)
            print(folder / name, flush=True)


def write_pair(folder: Path, case: Case, level: str) -> None:
    """Render a pair; ``truth.flo`` comes last."""
    folder.mkdir(parents=True, exist_ok=True)
    keys = settings(case, ENERGIES[level])
    if case.turbulence:
        file = folder / "wake.nc"
        turbulent.write(file.absolute(), keys.pop("wake.vortex_pair"), case.turbulence, case.seed)
        keys |= {"wake.file": str(file.absolute()), "wake.extinction.aerosol": None}
    result = lm.run(lm.load_experiment(case.base, **keys), notice=lambda text, fraction: None)
    first, second = (scan["Y_noisy"].values.astype(float) for scan in result.scans)
    if case.defect:
        first, second = case.defect(first, second)
    grid = {axis: result.scans[0][axis] for axis in ("z", "y")}
    truth = result.truth.wind[["v", "w"]].interp(grid).transpose("z", "y").astype(np.float32)
    scale = FULL / max(first.max(), second.max())
    counts = [
        np.clip(np.rint(image * scale), 0, FULL).astype(np.uint16) for image in (first, second)
    ]
    for letter, pixels in zip("ab", counts, strict=True):
        # as seen by the pilot: top row first, port on the left
        tifffile.imwrite(folder / f"{letter}.tif", pixels[::-1, ::-1])
    on = ("z", "y")
    images = {letter: (on, pixels) for letter, pixels in zip("ab", counts, strict=True)}
    about = {"case": case.name, "kind": case.kind, "noise": level, "dt": DT}
    xr.Dataset(images, grid, about).to_netcdf(folder / "images.nc", engine="h5netcdf")
    moved = {f"displacement_{axis}": truth[name] * DT for axis, name in (("y", "v"), ("z", "w"))}
    flag = {"flag": (on, np.zeros(truth["v"].shape, np.int16))}
    truth = truth.assign(**moved, **flag).assign_attrs(about)
    truth.to_netcdf(folder / "truth.nc", engine="h5netcdf")
    pixel = tuple(float(np.diff(grid[axis].values).mean()) for axis in on)
    write_flo(folder / "truth.flo", truth, pixel)
