"""Wind from image files of a user: selection of the frames, their times, their noise."""

import re
from collections.abc import Callable, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal

import numpy as np
import xarray as xr

from lidar_mi.arguments import checked_arguments
from lidar_mi.errors import InputError
from lidar_mi.io.image_times import steps_of
from lidar_mi.io.images import default_layer, frames_in, read_beams, read_images, read_noise
from lidar_mi.retrieval.images.common_grid import on_one_grid
from lidar_mi.retrieval.images.gridding import on_nodes
from lidar_mi.retrieval.wind.pair import retrieve_wind
from lidar_mi.retrieval.wind.pair_input import method_of
from lidar_mi.retrieval.wind.series import retrieve_winds
from lidar_mi.retrieval.wind.synchronised import synchronised

Level = float | xr.DataArray | None

_TOLERANCE = 1e-3
"""Relative difference of a given time step from that of the headers by rounding."""


@checked_arguments
def retrieve_files(
    files: str | Path | Sequence[str | Path],
    *,
    dt: float | None = None,
    frame: Sequence[int] | None = None,
    pairs: Literal["all"] | Sequence[tuple[int, int]] | None = None,
    layer: str | None = None,
    spacing: float | None = None,
    pixels: bool = False,
    noise: float | None = None,
    notice: Callable[[str, float | None], object] | None = None,
    **options: Any,
) -> xr.Dataset:
    """Wind in the image plane from files of images of the same air.

    Parameters
    ----------
    files : path or sequence of path
        In the order of their times, or one file of several frames.
    dt : float, optional
        From each image to the next, s. Default: as the files say.
    frame : sequence of int, optional
        Frames, from 0, of files that hold several: two or more of one file, or one for each file.
    pairs : "all" or sequence of (int, int), optional
        A wind from each pair: each image with the next, or these. Default: one wind from two
        images, or by the method ``variational`` from more.
    layer : str, optional
        Of EXR files, or the array of npz, mat and HDF5 files. Default: ``Y_noisy``, else ``Y``, or
        the only one.
    spacing : float, optional
        Of the pixels of files without axes, m.
    pixels : bool
        Places and motion in pixels; without ``dt`` motion from frame to frame.
    noise : float, optional
        Standard deviation of the images' noise. Default: as the files say, else estimated.
    notice : callable, optional
        Called with the running step and the fraction done; None: not known.
    **options
        Of `retrieve_wind`: ``method``, ``windows``, ``validation``, ``device``.

    Returns
    -------
    xr.Dataset
        As of `retrieve_wind`, with ``pairs`` as of `retrieve_winds`. Attributes: ``layer``, empty
        if the files have none; ``pixel_size`` along z and y, m; ``remarks``, a line each.

    Raises
    ------
    InputError
        Files that are no images, frames or times that are ambiguous, what `retrieve_wind` refuses.

    Examples
    --------
    >>> import lidar_mi as lm
    >>> import numpy as np
    >>> from scipy.ndimage import gaussian_filter
    >>> air = 1 + gaussian_filter(np.random.default_rng(1).normal(size=(32, 54)), 1.5)
    >>> np.save("a.npy", air[:, :48]), np.save("b.npy", air[:, 2:50])
    (None, None)
    >>> wind = lm.retrieve_files(["a.npy", "b.npy"], dt=0.1, spacing=0.5)
    >>> abs(wind["v"].median().item()).__round__()
    10
    """
    inputs = [Path(file) for file in ([files] if isinstance(files, str | Path) else files)]
    if not inputs:
        raise InputError("files: none; expected two images, or a file of two frames")
    if isinstance(pairs, str) and pairs != "all":
        raise InputError(f"pairs: {pairs!r} is not allowed; expected 'all' or pairs of numbers")
    method = options.setdefault("method", "variational")
    if pixels and spacing is not None:
        raise InputError("pixels, spacing: both; expected one of them")
    spacing = 1.0 if pixels else spacing
    layer = layer or _layer(inputs)
    frames_by_file = _frames(inputs, layer, frame, pairs)
    paths = [path for path, numbers in frames_by_file for _ in numbers]
    burst = len(paths) > 2 and pairs is None
    if burst and "more" not in method_of(method).options:
        raise InputError(
            f"{len(paths)} images are not allowed with method {method}; expected two, pairs all "
            "(a wind from each pair), or variational (one wind from all)"
        )
    images = [
        image
        for path, numbers in frames_by_file
        for image in read_images(path, numbers, layer, spacing)
    ]
    per_frame = pixels and dt is None
    remarks: list[str] = []
    if per_frame:
        steps = [1.0] * (len(paths) - 1)
    else:
        steps, remarks = _time_steps(paths, dt, equal=pairs is None)
    noisy = paths if pairs is not None else paths[:1]
    levels = [read_noise(path, layer, spacing) if noise is None else noise for path in noisy]
    beams = [read_beams(path, spacing) for path in paths]
    images, levels, beams = _on_nodes(images, levels, beams, steps)
    beam_times = [scan["beam_time"] for scan in beams if scan is not None and not scan.frozen_air]
    timed = len(beam_times) == len(paths)
    grid = images[0]
    if pairs is not None:
        chosen = list(pairwise(range(len(paths)))) if pairs == "all" else pairs
        wind = retrieve_winds(
            images,
            steps,
            chosen,
            beam_times=beam_times if timed else None,
            notice=notice,
            noise=levels,
            **options,
        )
    else:
        grid, _ = pair = on_one_grid(*images[:2])
        level = levels[0]
        if isinstance(level, xr.DataArray) and pair[0] is not images[0]:
            # noise cannot be interpolated: its median is used
            level = float(level.median())
        if notice is not None:
            notice(f"{method}: {grid.sizes['y']} x {grid.sizes['z']} pixels", None)
        wind = retrieve_wind(
            *pair,
            dt=steps[0],
            noise=level,
            more=images[2:],
            times=on_one_grid(*beam_times[:2]) if timed else None,
            **options,
        )
    if pixels:
        wind = _in_pixels(wind, per_frame=per_frame)
    size = [float(np.diff(grid[axis].values).mean()) for axis in "zy"]
    return wind.assign_attrs(layer=layer or "", pixel_size=size, remarks="\n".join(remarks))


def _on_nodes(
    images: list[xr.DataArray],
    levels: list[Level],
    beams: list[xr.Dataset | None],
    steps: Sequence[float],
) -> tuple[list[xr.DataArray], list[Level], list[xr.Dataset | None]]:
    """Images, noise and beams, those of beams that miss the nodes resampled onto them."""
    images, levels, beams = list(images), list(levels), list(beams)
    scans: dict[int, xr.Dataset] = {}
    for number, scan_beams in enumerate(beams):
        if scan_beams is not None and "y_reported" in scan_beams:
            scans[number] = scan_beams.assign(image=images[number])
            level = levels[number] if number < len(levels) else None
            if isinstance(level, xr.DataArray):
                scans[number] = scans[number].assign(image_stderr=level)
    if len(scans) == len(images):
        gridded = synchronised(list(scans.values()), steps, "image")
    else:
        gridded = [on_nodes(scan) for scan in scans.values()]
    for number, scan in zip(scans, gridded, strict=True):
        beams[number], images[number] = scan, scan["image"]
        if "image_stderr" in scan:
            level = scan["image_stderr"]
            if "image_resampling_std" in scan:
                level = (level**2 + scan["image_resampling_std"].fillna(0.0) ** 2) ** 0.5
            levels[number] = level
    return images, levels, beams


def _in_pixels(wind: xr.Dataset, *, per_frame: bool) -> xr.Dataset:
    """A wind of 1 m pixels in units of pixels; ``per_frame``: of 1 s frames in units of frames."""
    wind = wind.copy()
    for variable in wind.variables.values():
        if "units" in variable.attrs:
            unit = re.sub(r"\bm(?=-?\d|\b)", "px", str(variable.attrs["units"]))
            if per_frame:
                unit = re.sub(r"\bs(?=-?\d|\b)", "frame", unit)
            variable.attrs["units"] = unit
    return wind.assign_attrs(dt_units="frame") if per_frame else wind


def _frames(
    files: Sequence[Path], layer: str | None, numbers: Sequence[int] | None, pairs: object
) -> list[tuple[Path, Sequence[int]]]:
    """The selected frames of each file; an ambiguous selection is refused with the choices."""
    if len(files) == 1:
        return [(files[0], _of_one_file(files[0], layer, numbers, pairs))]
    if numbers is None:
        for path in files:
            count, _ = frames_in(path, layer)
            if count > 1:
                example = ",".join("0" for _ in files[:4])
                raise InputError(
                    f"{path}: {count} frames; expected frame with a number for each file, such "
                    f"as {example}, or this file alone"
                )
        numbers = [0]
    if len(numbers) not in (1, len(files)):
        raise InputError(
            f"frame: {len(numbers)} numbers are not allowed with {len(files)} files; expected "
            f"one, or {len(files)}"
        )
    numbers_of_files = [*numbers] * len(files) if len(numbers) == 1 else numbers
    return [(path, [number]) for path, number in zip(files, numbers_of_files, strict=True)]


def _of_one_file(
    path: Path, layer: str | None, numbers: Sequence[int] | None, pairs: object
) -> Sequence[int]:
    if numbers is not None:
        if pairs is not None:
            raise InputError("frame, pairs: both with one file; expected one of them")
        if len(numbers) < 2:
            raise InputError(f"frame: one frame of {path}; expected two, such as 0,1")
        return numbers
    count, channels = frames_in(path, layer)
    if count == 1:
        raise InputError(f"{path}: one image; expected two files, or a file of two frames")
    if channels:
        raise InputError(
            f"{path}: {count} channels of one moment by what the file says; expected frame 0,1 "
            "to take two as images one after the other"
        )
    if count > 2 and pairs is None:
        raise InputError(
            f"{path}: {count} frames; expected frame with two of them, such as 0,1, or pairs "
            "all (a wind from each with the next)"
        )
    return range(count)


def _layer(paths: Sequence[Path]) -> str | None:
    """The layer that all files have by default; None: they have no names of layers."""
    layers = {path: default_layer(path) for path in paths}
    names = set(layers.values())
    if "Y_noisy" in names and len(names) > 1:
        noiseless = next(path for path, name in layers.items() if name != "Y_noisy")
        raise InputError(
            f"{noiseless}: without the layer Y_noisy, which other images have; expected layer, "
            "such as Y for all"
        )
    return names.pop() if len(names) == 1 else None


def _time_steps(
    paths: Sequence[Path], dt: float | None, *, equal: bool
) -> tuple[list[float], list[str]]:
    """Time steps from image to image, as given or from the files; remarks on contradictions."""
    from_headers = steps_of(paths)
    count = len(paths) - 1
    if from_headers is None:
        if dt is None:
            raise InputError("dt: missing, and the files do not say it; expected seconds")
        return [dt] * count, []
    text = ", ".join(f"{step:g}" for step in dict.fromkeys(from_headers))
    unequal = any(
        abs(step - from_headers[0]) > _TOLERANCE * abs(from_headers[0]) for step in from_headers
    )
    if dt is not None:
        remarks = []
        if min(from_headers) <= 0:
            remarks.append(
                f"by their headers ({text} s) an image is not later than the one before: v and w "
                "have the opposite sign if the images are swapped"
            )
        elif unequal or abs(dt - from_headers[0]) > _TOLERANCE * from_headers[0]:
            remarks.append(f"dt is {dt:g} s as given, but {text} s by the headers of the files")
        return [dt] * count, remarks
    if min(from_headers) <= 0:
        raise InputError(
            f"{paths[0]}: {text} s to the next image by the headers; expected images in the order "
            "of their times, or dt"
        )
    if unequal and equal:
        raise InputError(f"dt: {text} s by the headers; expected images of equal steps, or dt")
    return from_headers, []
