"""Images of any common kind: pixels, axes, noise; and packed for a report."""

from collections.abc import Sequence
from io import BytesIO
from pathlib import Path

import numpy as np
import xarray as xr

from lidar_mi.arguments import checked_arguments
from lidar_mi.errors import InputError
from lidar_mi.io.exr import axis_of, read_header, read_layers
from lidar_mi.io.pixels.davis import read_davis
from lidar_mi.io.pixels.fits import read_fits
from lidar_mi.io.pixels.frames import Frames, frames_of, grey
from lidar_mi.io.pixels.kinds import kind_of
from lidar_mi.io.pixels.named_arrays import read_hdf5, read_mat, read_npy, read_npz
from lidar_mi.io.pixels.netpbm import read_netpbm
from lidar_mi.io.pixels.pictures import read_jpeg2000, read_picture
from lidar_mi.io.pixels.png import read_png
from lidar_mi.io.pixels.tiff import read_tiff


def read_pixels(path: str | Path, layer: str | None = None, frame: int | None = None) -> np.ndarray:
    """One image of a file of any kind, float64, (height, width), top row first.

    Values are those of the file, of whatever depth and sign: nothing is scaled or cut. Colours are
    averaged in float64, unweighted: where red, green and blue are equal, the value is theirs.
    Transparency is ignored. A FITS image is read as stored, first row first.

    layer: of an EXR file; the name of an array in an npz, mat or HDF5 file, of a part of a FITS
        file. Default: of EXR Y_noisy (what a detector delivered), else Y, or the mean of R, G and
        B; of any file the only one.
    frame: number of the image, from 0; needed where the file has several.

    Raises InputError: no such file, one that cannot be read, or no such layer or frame; several
    frames, and none named; values that float64 does not hold exactly.
    """
    path = Path(path)
    frames = _frames(path, layer)
    if frame is None and frames.count > 1:
        axis = "channels" if frames.channels else "frames"
        raise InputError(
            f"{path}: {frames.count} {axis}; expected --frame, 0 to {frames.count - 1}"
        )
    return _numbered(path, frames, [frame or 0])[0].astype(float)


def read_frames(
    path: str | Path, layer: str | None = None, numbers: Sequence[int] | None = None
) -> np.ndarray:
    """Images of a file as stored, (frames, height, width), top row first.

    The pages of a TIFF file, the planes of a FITS cube or of an array; one for other files. Colours
    as of `read_pixels`.

    layer: as of `read_pixels`.
    numbers: which images, from 0. Default: all, which must not be channels of one moment.

    Raises InputError: as `read_pixels`; pages of different size, channels.
    """
    path = Path(path)
    frames = _frames(path, layer)
    if numbers is None:
        if frames.channels:
            raise InputError(
                f"{path}: {frames.count} channels, not images one after the other; expected frames "
                "in time, or one by --frame where the command has it"
            )
        numbers = range(frames.count)
    return _numbered(path, frames, numbers)


def frames_in(path: str | Path, layer: str | None = None) -> tuple[int, bool]:
    """How many images a file has, and whether they are channels of one moment."""
    if kind_of(Path(path)) in _SINGLE_IMAGE:
        return 1, False
    frames = _frames(Path(path), layer)
    return frames.count, frames.channels


def _numbered(path: Path, frames: Frames, numbers: Sequence[int]) -> np.ndarray:
    for number in numbers:
        if not 0 <= number < frames.count:
            raise InputError(
                f"{path}: frame {number} is not there; expected --frame 0"
                + (f" to {frames.count - 1}" if frames.count > 1 else "")
            )
    return frames.read(numbers)


def _frames(path: Path, layer: str | None) -> Frames:
    """The images of a file, by the reader of its kind."""
    kind = kind_of(path)
    if kind in _WITH_LAYERS:
        return _WITH_LAYERS[kind](path, layer)
    if layer is not None:
        raise InputError(
            f"layer: {layer!r} is not allowed for {path}; only EXR, FITS, npz, mat and HDF5 files "
            "have layers"
        )
    return _WITHOUT_LAYERS[kind](path)


def _exr(path: Path, layer: str | None) -> Frames:
    layers = read_layers(path)[1]
    if layer is not None and layer not in layers:
        raise InputError(
            f"{path}: layer {layer!r} is not there; expected one of {', '.join(sorted(layers))}"
        )
    chosen = layer or default_layer(path)
    if chosen:
        return frames_of(path, layers[chosen][None])
    colours = np.stack([layers[name] for name in "RGB"], -1)
    return frames_of(path, grey(path, colours, 3)[None])


_WITH_LAYERS = {"exr": _exr, "fits": read_fits, "npz": read_npz, "mat": read_mat, "hdf5": read_hdf5}
_SINGLE_IMAGE = ("exr", "png", "jpeg2000", "mat")
"""Kinds that hold one image."""
_WITHOUT_LAYERS = {
    "tiff": read_tiff,
    "png": read_png,
    "picture": read_picture,
    "jpeg2000": read_jpeg2000,
    "netpbm": read_netpbm,
    "npy": read_npy,
    "davis": read_davis,
}


def default_layer(path: str | Path) -> str | None:
    """The layer that is read of an EXR file where none is named; None: it has none, or colours.

    What a detector delivered, ``Y_noisy``, comes before ``Y``, which is free of its noise; of any
    other file it is the only layer.

    Raises InputError: one that cannot be read, or several layers of which one has to be named.
    """
    if not _is_exr(path):
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
    if not _is_exr(path):
        return ""
    return str(read_header(path).get("units", ""))


@checked_arguments
def read_image(
    path: str | Path,
    layer: str | None = None,
    spacing: float | None = None,
    frame: int | None = None,
) -> xr.DataArray:
    """Pixels as `read_pixels` gives them, on axes (z, y), ascending, in metres.

    The top row has the largest z and the left column the largest y. Axes come from the header
    attributes ``y`` and ``z`` of the EXR files of our scans; for other files ``spacing``
    (m, from pixel to pixel) puts the image's middle at zero.

    Parameters
    ----------
    path : path
        EXR, TIFF, PNG, JPEG, JPEG 2000, BMP, GIF, WebP, PGM, PPM, PAM, PFM, FITS, npy, npz, mat,
        HDF5 or im7 file. Colours are averaged, transparency is ignored.
    layer : str, optional
        Of an EXR file; the name of an array in an npz, mat or HDF5 file, of a part of a FITS file.
        Default: of EXR Y_noisy (what a detector delivered), else Y, or the mean of R, G and B; of
        any file the only one.
    spacing : float, optional
        From pixel to pixel, m; for files without axes.
    frame : int, optional
        Number of the image, from 0; needed where the file has several.

    Returns
    -------
    xr.DataArray, dims (z, y), m
        Values as in the file, float64.

    Raises
    ------
    InputError
        No such file, one that cannot be read, or no such layer or frame; several frames, and none
        named; no axes and no spacing above 0.

    Examples
    --------
    >>> import lidar_mi as lm
    >>> from PIL import Image
    >>> Image.new("L", (60, 40), 128).save("camera.png")
    >>> image = lm.read_image("camera.png", spacing=0.5)
    >>> image.dims, image.shape, float(image["y"][-1])
    (('z', 'y'), (40, 60), 14.75)
    """
    return _on_axes(path, layer, spacing, read_pixels(path, layer, frame))


def read_images(
    path: str | Path, numbers: Sequence[int], layer: str | None = None, spacing: float | None = None
) -> list[xr.DataArray]:
    """Some images of a file, each as `read_image` gives it; the file is read once."""
    images = read_frames(path, layer, numbers)
    return [_on_axes(path, layer, spacing, frame.astype(float)) for frame in images]


def _on_axes(
    path: str | Path, layer: str | None, spacing: float | None, pixels: np.ndarray
) -> xr.DataArray:
    """Pixels, top row first, on the axes of their file or of even spacing."""
    if spacing is not None and not (np.isfinite(spacing) and spacing > 0):
        raise InputError(f"{path}: spacing: {spacing} m is not allowed; expected a number above 0")
    rows, columns = pixels.shape
    header = read_layers(path)[0] if _is_exr(path) else {}
    if spacing is not None:
        y, z = ((np.arange(n) - (n - 1) / 2) * spacing for n in (columns, rows))
    elif {"y", "z"} <= set(header):
        y, z = axis_of(header, "y", columns, path), axis_of(header, "z", rows, path)
    else:
        raise InputError(
            f"{path}: no axes y and z for {columns} x {rows} pixels; expected them in the header "
            "of an EXR file, --spacing in m, or --pixels"
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
    # images of a pair share random numbers: the part of the noise that they do not share
    unshared = "gate000.S0_pair_stderr"
    error = unshared if unshared in layers else "gate000.S0_stderr"
    if layer in ("Y", "Y_noisy") and {"gate000.S0", error, "Y"} <= set(layers):
        signal, stderr, scaled = (
            read_image(path, name, spacing) for name in ("gate000.S0", error, "Y")
        )
        noise = (scaled * stderr / signal.where(signal > 0)).fillna(0.0)
        if layer == "Y_noisy" and "Y_noise_std" in layers:
            detector = read_image(path, "Y_noise_std", spacing)
            noise = noise.copy(data=np.hypot(noise.values, detector.values))
        return noise
    stderr_layer = f"{layer}_stderr"
    return read_image(path, stderr_layer, spacing) if stderr_layer in layers else None


def read_beams(path: str | Path, spacing: float | None = None) -> xr.Dataset | None:
    """When and to where the beams of a scan pointed, on the axes of `read_image`.

    Returns
    -------
    xr.Dataset, dims (z, y), or None
        `beam_time` (s) and, where the pixels are beams that miss the nodes, `y_reported` and
        `z_reported` (m). The attribute `frozen_air` is 1 if all beams saw the air of the scan's
        reference time, as simulated ones may. None if the file does not state times.
    """
    if not _is_exr(path):
        return None
    header, layers = read_layers(path)
    if "beam_time" not in layers:
        return None
    names = [name for name in ("beam_time", "y_reported", "z_reported") if name in layers]
    beams = xr.Dataset({name: read_image(path, name, spacing) for name in names})
    return beams.assign_attrs(frozen_air=int(header.get("frozen_air", 0)))


def as_webp(path: str | Path) -> bytes:
    """An image file in colours as lossless WebP, two thirds of its PNG."""
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
    return kind_of(Path(path)) == "exr"


def _short(error: Exception) -> str:
    return " ".join(str(error).split())[:120]


def panel_cuts(path: str | Path) -> list[float]:
    """Boundaries of panels side by side, as fractions of a figure's width.

    A figure of n equal columns has white gaps of its full height near k / n; the smallest n up to 4
    is taken. Empty: one column, or an element that spans several.
    """
    from PIL import Image

    try:
        with Image.open(path) as image:
            pixels = np.asarray(image.convert("L"))
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        raise InputError(f"{path}: no readable image ({_short(error)})") from None
    white = np.flatnonzero((pixels > 250).all(0)) / max(pixels.shape[1], 1)
    # a panel is about as high as wide
    most = min(4, round(2 * pixels.shape[1] / max(pixels.shape[0], 1)))
    for columns in range(2, most + 1):
        expected = [k / columns for k in range(1, columns)]
        near = [white[abs(white - cut) < 0.1 / columns] for cut in expected]
        if all(gap.size for gap in near):
            return [
                float(gap[abs(gap - cut).argmin()]) for gap, cut in zip(near, expected, strict=True)
            ]
    return []
