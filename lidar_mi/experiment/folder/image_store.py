"""Rendered images in a folder, finished and unfinished, each with a signature of its inputs."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import xarray as xr

from lidar_mi.errors import InputError
from lidar_mi.experiment.stages import rendering
from lidar_mi.instrument.detector_noise import without_noise
from lidar_mi.io import exr
from lidar_mi.io.arrays import read_arrays, write_arrays

MADE_BY = "run_sha256"
"""Attribute of an image: the hash of its inputs."""
BATCHES = "_batches.npz"
"""Suffix to the name of an unfinished image: its samples so far."""


@dataclass(frozen=True)
class ImageStore:
    """Images of both lidars, by the names of the parts of their stages.

    Rendered images are read back, so that new and stored ones have the same float32 values.

    folder_of: ``folder_of(part)``: the folder of an image.
    signature_of: ``signature_of(part)``: what an image there is signed with.
    """

    folder_of: Callable[[str], Path]
    signature_of: Callable[[str], str]

    def path(self, part: str) -> Path:
        """File of an image."""
        return self.folder_of(part) / f"{part}.exr"

    def stored(self, part: str) -> xr.Dataset | None:
        """A rendered image, without a detector's noise; None: it is not there.

        Raises InputError: it was made by another experiment or version.
        """
        path = self.path(part)
        if not path.is_file():
            return None
        try:
            image = exr.read_scan(path) if part in rendering.IMAGES else exr.read_fringes(path)
        except InputError:  # damaged: the image is rendered again
            return None
        if image.attrs.pop(MADE_BY, None) != self.signature_of(part):
            raise InputError(
                f"{path}: was made by another experiment; expected the image of this one"
            )
        # a killed process may have left samples beside the finished image
        self._batches(part).unlink(missing_ok=True)
        return without_noise(image) if part in rendering.IMAGES else image

    def unfinished(self, part: str) -> dict[str, Any] | None:
        """Samples of an image unfinished by an earlier run; None: there are none."""
        path = self._batches(part)
        if not path.is_file():
            return None
        try:
            arrays = read_arrays(path)
        except InputError:  # damaged: the image is rendered from the start
            return None
        return arrays if str(arrays.pop(MADE_BY, "")) == self.signature_of(part) else None

    def store_unfinished(self, part: str, arrays: dict[str, Any]) -> None:
        """Save samples of an image until the image itself is saved."""
        write_arrays(self._batches(part), arrays | {MADE_BY: self.signature_of(part)})

    def store_part(self, part: str, value: xr.Dataset) -> xr.Dataset:
        """Write a rendered image; returns it as it is read."""
        self.write(part, value)
        stored = self.stored(part)
        assert stored is not None
        return stored

    def write(self, part: str, value: xr.Dataset) -> None:
        """Write an image with its signature."""
        write = exr.write_scan if part in rendering.IMAGES else exr.write_fringes
        write(self.path(part), value.assign_attrs({MADE_BY: self.signature_of(part)}))

    def _batches(self, part: str) -> Path:
        return self.folder_of(part) / f"{part}{BATCHES}"
