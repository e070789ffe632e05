"""FITS images and cubes: scaling in float64, compressed ones too."""

import math
import warnings
from pathlib import Path
from typing import Any

import numpy as np

from lidar_mi.errors import InputError
from lidar_mi.io.pixels.frames import Frames, frames_of, reading
from lidar_mi.io.size import check_size

_KIND = "FITS"


def read_fits(path: Path, layer: str | None) -> Frames:
    """The image or the planes of a cube, first row first, BSCALE, BZERO and BLANK applied.

    layer: name (EXTNAME) or number of the part that has the image. Default: the only one.

    Raises InputError: astropy is not installed; a damaged file; no or several images; more than
    three dimensions.
    """
    try:
        from astropy.io import fits
    except ImportError:
        raise InputError(
            f"{path}: FITS files need the library astropy: pip install 'lidar-mi[fits]'"
        ) from None
    with reading(path, _KIND):
        with warnings.catch_warnings():
            # a last block that is not filled up loses nothing; missing values are an error
            warnings.simplefilter("ignore")
            with fits.open(path, memmap=False, do_not_scale_image_data=True) as parts:
                images = {}
                for number, part in enumerate(parts):
                    if part.is_image and part.shape and math.prod(part.shape):
                        check_size(path, 8 * math.prod(part.shape))
                        images[number] = part
                cube = _values(_chosen(path, images, layer))
    shape = cube.shape
    while cube.ndim > 2 and cube.shape[0] == 1:
        cube = cube[0]
    if cube.ndim not in (2, 3):
        raise InputError(
            f"{path}: its image is {' x '.join(map(str, shape))}; expected two or three dimensions"
        )
    return frames_of(path, cube.reshape(-1, *cube.shape[-2:]))


def _chosen(path: Path, images: dict[int, Any], layer: str | None) -> Any:
    """The part named by ``layer``, or the only one."""
    names = {str(number): part for number, part in images.items()}
    names |= {part.name: part for part in images.values() if part.name}
    listed = ", ".join(part.name or str(number) for number, part in images.items())
    if layer is not None:
        if layer not in names:
            raise InputError(f"{path}: layer {layer!r} is not there; expected one of {listed}")
        return names[layer]
    if not images:
        raise InputError(f"{path}: has no image; expected a FITS image or cube")
    if len(images) > 1:
        raise InputError(f"{path}: {len(images)} images; expected --layer, one of {listed}")
    return next(iter(images.values()))


def _values(part: Any) -> np.ndarray:
    """Physical values of the stored numbers."""
    header = part.header
    scale, zero, blank = (header.get(key) for key in ("BSCALE", "BZERO", "BLANK"))
    stored = np.asarray(part.data)
    stored = stored.astype(stored.dtype.newbyteorder("="))
    scale, zero = (default if v is None else v for v, default in ((scale, 1), (zero, 0)))
    missing = None if blank is None or stored.dtype.kind == "f" else stored == blank
    if scale == 1 and zero == 2**63 and stored.dtype == np.int64:
        # the convention for unsigned numbers: the sign bit turned
        values: np.ndarray = stored.view(np.uint64) ^ np.uint64(2**63)
    elif scale == 1 and zero == 0:
        values = stored
    else:
        values = stored.astype(float) * float(scale) + float(zero)
    return values if missing is None or not missing.any() else np.where(missing, np.nan, values)
