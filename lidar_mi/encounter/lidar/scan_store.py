"""The scans of an unfinished flight: one that was stopped does not render them again."""

from dataclasses import asdict, dataclass
from pathlib import Path
from shutil import rmtree

import numpy as np
import xarray as xr

from lidar_mi.aircraft.pose import AircraftPose
from lidar_mi.errors import InputError
from lidar_mi.experiment.folder.image_store import MADE_BY
from lidar_mi.io.folder import make_folder
from lidar_mi.io.netcdf import read_netcdf, write_netcdf

# m and rad: poses of a flight that is simulated again differ by rounding, which moves no image.
_ROUNDING = 1e-6
# Images of a scan and their gates: both gates have axes of their own.
_PARTS = (("near", "near"), ("far", "far"), ("far_noise", "far"))


@dataclass(frozen=True, eq=False)
class Scan:
    """Both images of a scan with the standard deviations of their noise, path frame.

    near, far, far_noise (z, y): attenuated backscatter of the first and the last gate, and the
        latter's noise, m^-1 sr^-1.
    """

    near: xr.DataArray
    far: xr.DataArray
    far_noise: xr.DataArray


@dataclass(frozen=True)
class ScanStore:
    """Scans in a folder of their own, by number.

    folder: made with the first scan.
    made_by: signature of the flight; scans of another one do not count.
    """

    folder: Path
    made_by: str

    def read(
        self, number: int, pose: AircraftPose, window: tuple[float, float] = (0.0, 0.0)
    ) -> Scan | None:
        """The scan of this number, if it was made from this pose about this middle (y, z)."""
        path = self._path(number)
        if not path.is_file():
            return None
        try:
            scan = read_netcdf(path)
        except InputError:  # damaged: it is rendered again
            return None
        about = _about(pose, window)
        if scan.attrs.get(MADE_BY) != self.made_by or not np.allclose(
            [scan.attrs.get(name, np.nan) for name in about],
            list(about.values()),
            rtol=0,
            atol=_ROUNDING,
        ):
            return None
        return Scan(
            *(scan[name].rename({f"{gate}_{axis}": axis for axis in "zy"}) for name, gate in _PARTS)
        )

    def write(
        self, number: int, pose: AircraftPose, scan: Scan, window: tuple[float, float] = (0.0, 0.0)
    ) -> None:
        """Write a scan."""
        make_folder(self.folder)
        images = {
            name: getattr(scan, name).rename({axis: f"{gate}_{axis}" for axis in "zy"})
            for name, gate in _PARTS
        }
        about = {MADE_BY: self.made_by, **_about(pose, window)}
        write_netcdf(xr.Dataset(images, attrs=about), self._path(number))

    @property
    def number(self) -> int:
        """Of stored scans."""
        return len(list(self.folder.glob("scan_*.nc")))

    def remove(self) -> None:
        """All scans: the flight is over."""
        rmtree(self.folder, ignore_errors=True)

    def _path(self, number: int) -> Path:
        return self.folder / f"scan_{number:04d}.nc"


def _about(pose: AircraftPose, window: tuple[float, float]) -> dict[str, float]:
    """What the images of a scan depend on, by name."""
    return asdict(pose) | {"window_y": window[0], "window_z": window[1]}
