"""Records the image and the wind vectors of every slab, for figures."""

from dataclasses import dataclass, field

import numpy as np
import xarray as xr

from lidar_mi.encounter.ahead.preview import Lidar
from lidar_mi.encounter.lidar.estimate import Estimate

# Vectors along y that a figure has room for.
_VECTORS = 24


@dataclass(eq=False)
class SlabRecorder:
    """Records images and vectors, estimate by estimate.

    lidar: its ``images``, if it has them, are those of the last slab.
    """

    lidar: Lidar
    _slabs: list[xr.Dataset] = field(default_factory=list)

    def add(self, estimate: Estimate) -> None:
        """The slab of the last scan; the first scan completes none."""
        images = getattr(self.lidar, "images", None)
        if estimate.wind is None and images is None:
            return
        variables = {}
        if images is not None:
            image = images.first.transpose("z", "y").astype(np.float32)
            variables["image"] = image.rename({"y": "image_y", "z": "image_z"})
        if estimate.wind is not None:
            vectors = estimate.wind
            every = max(1, round(vectors.sizes["y"] / _VECTORS))
            some = slice(every // 2, None, every)
            vectors = vectors[["v", "w", "flag"]].reset_coords(drop=True)
            vectors = vectors.isel(y=some, z=some).transpose("z", "y")
            valid = vectors["flag"] == 0
            variables |= {
                name: vectors[name].where(valid).astype(np.float32) for name in ("v", "w")
            }
        late = estimate.delivered if estimate.wind_delivered is None else estimate.wind_delivered
        about = {"time": estimate.time, "x": estimate.x, "delivered": late}
        self._slabs.append(xr.Dataset(variables).assign(about))

    def dataset(self) -> xr.Dataset | None:
        """All slabs, dims (slab, z, y) and (slab, image_z, image_y); None: there are none.

        On the nodes of the first slab; NaN where a later one has none.
        """
        if not self._slabs:
            return None
        first = next((one for one in self._slabs if "v" in one), self._slabs[0])
        grid = {name: first[name] for name in first.dims}
        # a slab whose wind the computer skipped has images alone
        nothing = {name: np.nan * first[name] for name in "vw" if name in first}
        slabs = [one if "v" in one else one.assign(nothing) for one in self._slabs]
        dataset = xr.concat([one.interp(grid) for one in slabs], "slab")
        # interpolation gives double precision, which no figure needs
        return dataset.assign(
            {name: dataset[name].astype(np.float32) for name in first if first[name].ndim}
        )
