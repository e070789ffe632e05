"""TIFF, BigTIFF, OME-TIFF, stacks of ImageJ: every depth, layout and compression, by tifffile."""

import logging
import math
import re
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from lidar_mi.errors import InputError
from lidar_mi.io.pixels.frames import Frames, checked, damaged, frames_of, grey, reading
from lidar_mi.io.size import check_size

if TYPE_CHECKING:
    from tifffile import TiffFile, TiffPage

# faults that the library only logs before it reads part of the file
_LOSSES = re.compile(
    r"invalid (page )?offset|invalid next page|corrupted (tag list|file)|circular|"
    r"missing (\d+ )?(frames|pages|files|data|ByteCounts)|series metadata|failed to read|"
    r"out of range|discontiguous|OME series|TiffTag (2[5-9]|3[0-4])\d .*invalid"
)
_IN_ORDER = "TZIQ"
"""Axes of a sequence of images: time, depth, a sequence, an unnamed one."""
_ORDINARY = ("shaped", "uniform", "generic", "page")
"""Series without metadata about axes."""
_MINISWHITE, _MINISBLACK, _RGB, _PALETTE, _YCBCR, _RAW = 0, 1, 2, 3, 6, 34892
_JPEG = (6, 7, 33007)
_PHOTOMETRIC, _EXTRA, _ORIENTATION, _NODATA = 262, 338, 274, 42113
_ALPHA = (1, 2)


def read_tiff(path: Path) -> Frames:
    """The pages of a file, or the axis of time, depth or channels that its metadata state.

    Reduced copies of a page (pyramids, thumbnails) and masks are omitted. A page is turned as its
    orientation says; GDAL's value for missing data becomes NaN.

    Raises InputError: a damaged file, or one that declares too much; several axes in addition to
    height and width; pages of different size; inks, mosaics, palettes of colours, white as 0,
    complex numbers.
    """
    with _opened(path) as file:
        numbers, count, channels = _planes(path, file)
        if numbers is None:
            return frames_of(path, _contiguous(path, file, count))

    def read(chosen: Sequence[int]) -> np.ndarray:
        with _opened(path) as file:
            pages = []
            for number in chosen:
                page: Any = file.pages[numbers[number]]
                # pages can share their pixels
                check_size(path, 8 * len(chosen) * page.imagewidth * page.imagelength)
                pages.append(_pixels(path, page))
                if pages[-1].shape != pages[0].shape:
                    (high, wide), (rows, columns) = pages[-1].shape, pages[0].shape
                    raise InputError(
                        f"{path}: page {numbers[number]} is {wide} x {high} px; expected "
                        f"{columns} x {rows} px as of the first"
                    )
            if len({image.dtype for image in pages}) > 1:
                pages = [image.astype(float) for image in pages]
            return np.stack(pages)

    return Frames(count, read, channels)


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    """The file; messages and exceptions of the library become one line."""
    import tifffile

    logger, lost = logging.getLogger("tifffile"), _Lost()
    former = logger.propagate
    logger.addHandler(lost)
    logger.propagate = False
    try:
        with reading(path, "TIFF"):
            # other files that the metadata name are not opened
            with tifffile.TiffFile(path, _multifile=False) as file:
                yield file
            if lost.messages:
                raise damaged(path, "TIFF", lost.messages[0])
    finally:
        logger.removeHandler(lost)
        logger.propagate = former


class _Lost(logging.Handler):
    """Messages of the library that part of the file is not read."""

    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self.messages: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        message = record.getMessage()
        if _LOSSES.search(message):
            self.messages.append(message.partition("> ")[2] or message)


def _planes(path: Path, file: "TiffFile") -> tuple[list[int] | None, int, bool]:
    """Numbers of the pages that are images, how many images, and whether they are channels.

    No numbers (None): the images follow the first page's and have no pages of their own.
    """
    # a TiffFrame, of which a series may consist, takes what it lacks from its page
    all_pages: Iterable[Any] = file.pages
    whole = [n for n, page in enumerate(all_pages) if not (page.is_reduced or page.is_mask)]
    if not whole:
        raise InputError(f"{path}: no page of full size; expected an image")
    series = file.series
    if file.is_ome and series[0].kind != "ome":
        raise InputError(f"{path}: OME-TIFF whose planes are in other files too; expected one file")
    if series[0].kind in _ORDINARY and not file.is_imagej:
        return whole, len(whole), False
    planes = series[0]
    sizes = dict(zip(planes.get_axes(squeeze=False), planes.get_shape(squeeze=False), strict=True))
    sizes = {axis: n for axis, n in sizes.items() if n > 1 and axis not in "YXS"}
    count = math.prod(sizes.values())
    axes = ", ".join(f"{axis} {n}" for axis, n in sizes.items())
    if len(series) > 1 or len(sizes) > 1:
        raise InputError(
            f"{path}: images along several axes ({axes or f'{len(series)} series'}); expected "
            "height, width and one more: T (time), Z (depth) or C (channels)"
        )
    axis = next(iter(sizes), "T")
    if axis not in (*_IN_ORDER, "C"):
        raise InputError(f"{path}: images along the axis {axis}; expected T (time), Z or C")
    pages = [None if page is None else page.index for page in planes.pages]
    if pages == [whole[0]] and count > 1:
        return None, count, axis == "C"
    if sorted(pages, key=lambda page: -1 if page is None else page) != whole or len(pages) != count:
        raise InputError(
            f"{path}: its metadata state {count} images, {len(whole)} pages are there; expected "
            "as many"
        )
    return [page for page in pages if page is not None], count, axis == "C"


def _contiguous(path: Path, file: "TiffFile", count: int) -> np.ndarray:
    """Images that follow the first page's, as ImageJ writes long stacks."""
    page: Any = file.pages[0]
    _check(path, page, count)
    images = file.series[0].asarray()
    if images.ndim != 3 or len(images) != count or page.samplesperpixel != 1:
        raise InputError(f"{path}: a stack of colours in one page; expected a page for each image")
    return checked(path, images)


def _pixels(path: Path, page: "TiffPage") -> np.ndarray:
    """One number a pixel of a page."""
    extra = _check(path, page)
    axes, image = page.axes, page.asarray()
    if set(axes) - set("YXS"):
        raise InputError(f"{path}: a page with the axes {axes}; expected height and width")
    image = np.moveaxis(image, axes.index("S"), -1) if "S" in axes else image[..., None]
    image = grey(path, image, page.samplesperpixel - extra, extra)
    return _without_gaps(page, _upright(image, page.tags.valueof(_ORIENTATION, 1)))


def _check(path: Path, page: "TiffPage", count: int = 1) -> int:
    """Refuse pixels that are no light or are missing; the number of transparency channels."""
    import tifffile

    samples, photometric = page.samplesperpixel, int(page.photometric)
    extra = [int(kind) for kind in page.tags.valueof(_EXTRA, ())] if _EXTRA in page.tags else []
    if page.dtype is None or page.dtype.kind not in "biuf":
        raise InputError(
            f"{path}: pixels of {page.bitspersample} bits, {page.dtype}; expected real numbers"
        )
    if page.compression not in tifffile.TIFF.DECOMPRESSORS:
        name = getattr(page.compression, "name", page.compression)
        raise InputError(
            f"{path}: compressed by {name}, which is not read; expected another compression: "
            "tiffcp -c lzw FILE NEW"
        )
    check_size(path, 8 * count * page.imagewidth * page.imagelength * samples)
    if _PHOTOMETRIC not in page.tags or photometric == _MINISWHITE:
        raise InputError(
            f"{path}: 0 is white (TIFF min-is-white), and whether its numbers are light or ink is "
            "not known; expected min-is-black: `tiffset -s 262 1 FILE` keeps the numbers"
        )
    if photometric == _PALETTE and not _is_ramp(page.colormap):
        raise InputError(
            f"{path}: numbers of a palette's colours; expected grey, or red, green and blue"
        )
    luma = photometric == _YCBCR and int(page.compression) in _JPEG
    colours = 3 if photometric == _RGB or luma else 1
    if not luma and photometric not in (_MINISBLACK, _RGB, _PALETTE, _RAW):
        raise InputError(
            f"{path}: pixels are {getattr(page.photometric, 'name', photometric)}; expected grey, "
            "or red, green and blue"
        )
    if samples != colours + len(extra) or any(kind not in _ALPHA for kind in extra):
        raise InputError(
            f"{path}: {samples} channels whose meaning is not stated; expected grey or red, green "
            "and blue, with or without transparency"
        )
    offsets, counts, end = page.dataoffsets, page.databytecounts, page.parent.filehandle.size
    if len(offsets) < math.prod(page.chunked) or any(
        not (start > 0 and size > 0 and start + size <= end)
        for start, size in zip(offsets, counts, strict=False)
    ):
        raise damaged(path, "TIFF", "parts of its pixels are not in it")
    return len(extra)


def _is_ramp(colours: np.ndarray | None) -> bool:
    """Whether a palette is grey that rises with the number, so that the number is the light."""
    if colours is None:
        return False
    first = np.asarray(colours[0], float)
    ideal = np.linspace(0, first[-1], len(first))
    # 8 bits scaled to 16: equal within one step
    return bool((colours == colours[0]).all() and first[-1] and abs(first - ideal).max() <= 256)


def _upright(image: np.ndarray, orientation: int) -> np.ndarray:
    """Top row first, left column first."""
    if orientation in (5, 6, 7, 8):
        image = image.T
    rows = -1 if orientation in (3, 4, 7, 8) else 1
    columns = -1 if orientation in (2, 3, 6, 7) else 1
    return image[::rows, ::columns]


def _without_gaps(page: "TiffPage", image: np.ndarray) -> np.ndarray:
    """NaN for the value that GDAL's tag calls missing."""
    if _NODATA not in page.tags:
        return image
    missing = image == page.nodata
    return np.where(missing, np.nan, image) if missing.any() else image
