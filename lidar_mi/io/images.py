"""Images of any common kind: pixels, axes, noise; and packed for a report."""

import math
import warnings
from io import BytesIO
from pathlib import Path

import numpy as np
import xarray as xr

from lidar_mi.arguments import checked_arguments
from lidar_mi.errors import InputError
from lidar_mi.io.exr import axis_of, read_header, read_layers
from lidar_mi.io.size import check_size

FITS = (".fits", ".fit", ".fts")
TIFF = (".tif", ".tiff")


def read_pixels(path: str | Path, layer: str | None = None) -> np.ndarray:
    """Image of an EXR, PNG, TIFF, BMP, JPEG or FITS file, float64, (height, width), top row first.

    Colours are averaged, transparency is left out. Values are those of the file: 8 or 16 bit
    numbers, floats. A FITS image is read as stored, first row first.

    Parameters
    ----------
    layer : str, optional
        Of an EXR file. Default: Y_noisy (what a detector delivered), else Y, or the only one, or
        the mean of R, G and B.

    Raises
    ------
    InputError
        No such file, one that cannot be read, or no such layer.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(
            f"{path}: no such file; expected an EXR, PNG, TIFF, BMP, JPEG or FITS image"
        )
    if _is_exr(path):
        image = _exr(path, layer)
    elif layer is not None:
        raise InputError(f"layer: {layer!r} is not allowed for {path}; only EXR files have layers")
    else:
        image = _fits(path) if path.suffix.lower() in FITS else _image(path)
    return np.array(image, dtype=float)


def read_frames(path: str | Path, layer: str | None = None) -> np.ndarray:
    """All images of a file as stored, (frames, height, width), top row first.

    The pages of a TIFF file, the planes of a FITS cube; one for any other. Colours are averaged.

    Parameters
    ----------
    layer : str, optional
        As of `read_pixels`.

    Raises
    ------
    InputError
        As `read_pixels`; pages of different size.
    """
    path = Path(path)
    if path.is_file() and layer is None and path.suffix.lower() in FITS:
        return _fits_cube(path)
    if path.is_file() and layer is None and path.suffix.lower() in TIFF:
        return _pages(path)
    return read_pixels(path, layer)[None]


def default_layer(path: str | Path) -> str | None:
    """The layer that is read of an EXR file where none is named; None: it has none, or colours.

    What a detector delivered, ``Y_noisy``, comes before ``Y``, which is free of its noise; of any
    other file it is the only layer.

    Raises
    ------
    InputError
        One that cannot be read, or several layers of which one has to be named.
    """
    if not Path(path).is_file() or not _is_exr(path):
        return None
    layers = read_layers(path)[1]
    for name in ("Y_noisy", "Y"):
        if name in layers:
            return name
    if len(layers) == 1:
        return next(iter(layers))
    if {"R", "G", "B"} <= set(layers):
        return None
    raise InputError(f"{path}: expected a layer to be named, one of {', '.join(sorted(layers))}")


def stated_units(path: str | Path) -> str:
    """Units of the values as the header of a rendered EXR file states them; empty otherwise."""
    path = Path(path)
    if not path.is_file() or not _is_exr(path):
        return ""
    return str(read_header(path).get("units", ""))


@checked_arguments
def read_image(
    path: str | Path, layer: str | None = None, spacing: float | None = None
) -> xr.DataArray:
    """Pixels as `read_pixels` gives them, on axes (z, y), ascending, in metres.

    The top row has the largest z and the left column the largest y. Axes come from the header
    attributes ``y`` and ``z`` of the EXR files of our scans; for other files ``spacing``
    (m, from pixel to pixel) puts the image's middle at zero.

    Parameters
    ----------
    path : path
        EXR, PNG, TIFF, BMP, JPEG or FITS file. Colours are averaged.
    layer : str, optional
        Of an EXR file. Default: Y_noisy (what a detector delivered), else Y, or the only one, or
        the mean of R, G and B.
    spacing : float, optional
        From pixel to pixel, m; for files without axes.

    Returns
    -------
    xr.DataArray, dims (z, y), m
        Values as in the file, float64.

    Raises
    ------
    InputError
        No such file, one that cannot be read, or no such layer; no axes and no spacing above 0.

    Examples
    --------
    >>> import lidar_mi as lm
    >>> from PIL import Image
    >>> Image.new("L", (60, 40), 128).save("camera.png")
    >>> image = lm.read_image("camera.png", spacing=0.5)
    >>> image.dims, image.shape, float(image["y"][-1])
    (('z', 'y'), (40, 60), 14.75)
    """
    if spacing is not None and not (np.isfinite(spacing) and spacing > 0):
        raise InputError(f"{path}: spacing: {spacing} m is not allowed; expected a number above 0")
    pixels = read_pixels(path, layer)
    rows, columns = pixels.shape
    header = read_layers(path)[0] if _is_exr(path) else {}
    if spacing is not None:
        y, z = ((np.arange(n) - (n - 1) / 2) * spacing for n in (columns, rows))
    elif {"y", "z"} <= set(header):
        y, z = axis_of(header, "y", columns, path), axis_of(header, "z", rows, path)
    else:
        raise InputError(
            f"{path}: no axes y and z for {columns} x {rows} pixels; expected them in the header "
            "of an EXR file, or --spacing in m"
        )
    metres = {"units": "m"}
    axes = {"z": ("z", z, metres), "y": ("y", y, metres)}
    return xr.DataArray(pixels[::-1, ::-1].copy(), axes, ("z", "y"), layer)


@checked_arguments
def read_noise(
    path: str | Path, layer: str | None = None, spacing: float | None = None
) -> xr.DataArray | None:
    """Standard deviation of an image's noise, on the axes of `read_image`; None if not stated.

    For ``Y`` and ``Y_noisy`` of a run's scans: the light transport's standard error and, with a
    detector, its noise. For any other layer: the one of the same name with ``_stderr``.

    Parameters
    ----------
    path : path
    layer, spacing
        As of `read_image`.

    Returns
    -------
    xr.DataArray, dims (z, y), m, or None
        In the image's unit; None if the file does not state it.

    Raises
    ------
    InputError
        As `read_image`.

    Examples
    --------
    >>> import lidar_mi as lm
    >>> import numpy as np
    >>> import OpenEXR
    >>> layers = {"G": np.full((4, 6), 10.0, "f4"), "G_stderr": np.full((4, 6), 0.5, "f4")}
    >>> OpenEXR.File({}, layers).write("camera.exr")
    >>> float(lm.read_noise("camera.exr", "G", spacing=1.0).max())
    0.5
    """
    if not _is_exr(path):
        return None
    layers, layer = read_layers(path)[1], layer or default_layer(path)
    transport = {"gate000.S0", "gate000.S0_stderr", "Y"}
    if layer in ("Y", "Y_noisy") and transport <= set(layers):
        signal, stderr, scaled = (
            read_image(path, name, spacing) for name in ("gate000.S0", "gate000.S0_stderr", "Y")
        )
        noise = (scaled * stderr / signal.where(signal > 0)).fillna(0.0)
        if layer == "Y_noisy" and "Y_noise_std" in layers:
            detector = read_image(path, "Y_noise_std", spacing)
            noise = noise.copy(data=np.hypot(noise.values, detector.values))
        return noise
    known = f"{layer}_stderr"
    return read_image(path, known, spacing) if known in layers else None


def read_beams(path: str | Path, spacing: float | None = None) -> xr.Dataset | None:
    """When and to where the beams of a scan pointed, on the axes of `read_image`.

    Returns
    -------
    xr.Dataset, dims (z, y), or None
        `beam_time` (s) and, where the pixels are beams beside the nodes, `y_reported` and
        `z_reported` (m). The attribute `frozen_air` is 1 if all beams saw the air of the scan's
        reference time, as simulated ones may. None if the file does not state times.

    Raises
    ------
    InputError
        As `read_image`.
    """
    if not _is_exr(path):
        return None
    header, layers = read_layers(path)
    if "beam_time" not in layers:
        return None
    names = [name for name in ("beam_time", "y_reported", "z_reported") if name in layers]
    found = xr.Dataset({name: read_image(path, name, spacing) for name in names})
    return found.assign_attrs(frozen_air=int(header.get("frozen_air", 0)))


def as_webp(path: str | Path) -> bytes:
    """An image file in colours as lossless WebP, two thirds of its PNG.

    Raises
    ------
    InputError
        No readable image.
    """
    from PIL import Image

    content = BytesIO()
    try:
        with Image.open(path) as image:
            # more compression takes twice as long for 3 % less
            image.convert("RGB").save(content, "WEBP", lossless=True, quality=25, method=1)
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        raise InputError(f"{path}: no readable image ({_short(error)})") from None
    return content.getvalue()


def _is_exr(path: str | Path) -> bool:
    return Path(path).suffix.lower() == ".exr"


def _exr(path, layer):
    layers = read_layers(path)[1]
    if layer is not None:
        if layer not in layers:
            raise InputError(
                f"{path}: layer {layer!r} is not there; expected one of {', '.join(sorted(layers))}"
            )
        return layers[layer]
    named = default_layer(path)
    return layers[named] if named else np.mean([layers[name] for name in "RGB"], axis=0)


def _fits(path):
    cube = _fits_cube(path)
    if len(cube) != 1:
        raise InputError(
            f"{path}: its first image is {' x '.join(map(str, cube.shape))}; expected one of two "
            "dimensions"
        )
    return cube[0]


def _fits_cube(path):
    try:
        from astropy.io import fits
    except ImportError:
        raise InputError(
            f"{path}: FITS files need the library astropy: pip install 'lidar-mi[fits]'"
        ) from None
    with path.open("rb") as file:
        if file.read(6) != b"SIMPLE":
            raise InputError(f"{path}: no readable FITS file (it does not begin as one)")
    try:
        with fits.open(path, memmap=False) as parts:
            shapes = [part.shape for part in parts if part.is_image]
            check_size(path, max((8 * math.prod(shape) for shape in shapes), default=0))
            found = [part.data for part in parts if part.is_image and part.data is not None]
    except InputError:
        raise
    except Exception as error:  # any exception of the library in a damaged file
        raise InputError(f"{path}: no readable FITS file ({_short(error)})") from None
    image = found[0].squeeze() if found else np.zeros(())
    if image.ndim not in (2, 3):
        shape = " x ".join(map(str, found[0].shape)) if found else "none"
        raise InputError(f"{path}: its first image is {shape}; expected two or three dimensions")
    return image.reshape(-1, *image.shape[-2:])


def _opened(path):
    """An image of one of the formats of cameras: reading others may execute programs."""
    from PIL import Image

    with warnings.catch_warnings():
        # its size is checked once it is known
        warnings.simplefilter("ignore", Image.DecompressionBombWarning)
        return Image.open(path, formats=("PNG", "TIFF", "BMP", "JPEG", "WEBP"))


def _image(path):
    try:
        with _opened(path) as file:
            check_size(path, 8 * file.width * file.height * len(file.getbands()))
            return _grey(file)
    except InputError:
        raise
    except Exception as error:  # any exception of the library in a damaged file
        raise InputError(f"{path}: no readable image ({_short(error)})") from None


def _pages(path):
    try:
        with _opened(path) as file:
            number = getattr(file, "n_frames", 1)
            check_size(path, 8 * number * file.width * file.height * len(file.getbands()))
            first, found = file.size, []
            for page in range(number):
                file.seek(page)
                if file.size != first:
                    raise InputError(
                        f"{path}: page {page} is {file.width} x {file.height} px; expected "
                        f"{first[0]} x {first[1]} px as of the first"
                    )
                found.append(_grey(file))
            return np.stack(found)
    except InputError:
        raise
    except Exception as error:  # any exception of the library in a damaged file
        raise InputError(f"{path}: no readable image ({_short(error)})") from None


def _grey(file):
    """Pixels of an image of the library, colours averaged, transparency left out."""
    indirect = file.mode in ("P", "CMYK", "YCbCr", "HSV", "LAB")
    image = file.convert("RGB") if indirect else file
    bands, pixels = image.getbands(), np.asarray(image)
    if pixels.ndim == 2:
        return pixels
    return pixels[..., [k for k, band in enumerate(bands) if band != "A"]].mean(-1)


def _short(error: Exception) -> str:
    return " ".join(str(error).split())[:120]


def panel_cuts(path: str | Path) -> list[float]:
    """Where the panels of a figure side by side part, as fractions of its width.

    A figure of n equal columns parts at white gaps of its full height near k / n; the smallest n
    up to 4 is taken. Empty: one column, or panels that something spans.

    Raises
    ------
    InputError
        No readable image.
    """
    from PIL import Image

    try:
        with Image.open(path) as image:
            pixels = np.asarray(image.convert("L"))
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        raise InputError(f"{path}: no readable image ({_short(error)})") from None
    white = np.flatnonzero((pixels > 250).all(0)) / max(pixels.shape[1], 1)
    # one panel is about as high as it is wide
    most = min(4, round(2 * pixels.shape[1] / max(pixels.shape[0], 1)))
    for columns in range(2, most + 1):
        wanted = [k / columns for k in range(1, columns)]
        near = [white[abs(white - cut) < 0.1 / columns] for cut in wanted]
        if all(gap.size for gap in near):
            return [
                float(gap[abs(gap - cut).argmin()]) for gap, cut in zip(near, wanted, strict=True)
            ]
    return []
