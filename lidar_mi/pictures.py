"""Reading pictures of any common kind into an array of light."""

from pathlib import Path

import numpy as np

from .errors import InputError
from .rendering.exr import read_layers

FITS = (".fits", ".fit", ".fts")


def read_picture(path: str | Path, layer: str | None = None) -> np.ndarray:
    """Picture of an EXR, PNG, TIFF, JPEG or FITS file, float64, (height, width), top row first.

    Colours are averaged, transparency is left out. Values are those of the file: 8 or 16 bit
    numbers, floats. A FITS image is taken as it is stored, first row first.

    Parameters
    ----------
    layer : str, optional
        Of an EXR file. Default: Y, or the only one, or the mean of R, G and B.

    Raises
    ------
    InputError
        No such file, one that cannot be read, or no such layer.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"{path}: no such file; expected an EXR, PNG, TIFF, JPEG or FITS image")
    suffix = path.suffix.lower()
    if suffix == ".exr":
        picture = _exr(path, layer)
    elif layer is not None:
        raise InputError(f"layer: {layer!r} is not allowed for {path}; only EXR files have layers")
    else:
        picture = _fits(path) if suffix in FITS else _image(path)
    return np.array(picture, dtype=float)


def _exr(path, layer):
    layers = read_layers(path)[1]
    if layer is not None:
        if layer not in layers:
            raise InputError(
                f"{path}: layer {layer!r} is not there; expected one of {', '.join(sorted(layers))}"
            )
        return layers[layer]
    if "Y" in layers or len(layers) == 1:
        return layers.get("Y", next(iter(layers.values())))
    if {"R", "G", "B"} <= set(layers):
        return np.mean([layers[name] for name in "RGB"], axis=0)
    raise InputError(f"{path}: expected a layer to be named, one of {', '.join(sorted(layers))}")


def _fits(path):
    try:
        from astropy.io import fits
    except ImportError:
        raise InputError(
            f"{path}: FITS files need the library astropy: pip install 'lidar-mi[fits]'"
        ) from None
    try:
        with fits.open(path, memmap=False) as parts:
            found = [part.data for part in parts if part.is_image and part.data is not None]
    except (OSError, ValueError, TypeError) as error:
        raise InputError(f"{path}: no readable FITS file ({_short(error)})") from None
    if not found or found[0].squeeze().ndim != 2:
        shape = " x ".join(map(str, found[0].shape)) if found else "none"
        raise InputError(f"{path}: its first image is {shape}; expected one of two dimensions")
    return found[0].squeeze()


def _image(path):
    from PIL import Image

    try:
        with Image.open(path) as file:
            if file.mode in ("P", "CMYK", "YCbCr", "HSV", "LAB"):
                file = file.convert("RGB")
            bands, picture = file.getbands(), np.asarray(file)
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        raise InputError(f"{path}: no readable image ({_short(error)})") from None
    if picture.ndim == 2:
        return picture
    colours = [k for k, band in enumerate(bands) if band != "A"]
    return picture[..., colours].mean(-1)


def _short(error: Exception) -> str:
    return " ".join(str(error).split())[:120]
