"""Arrays under names that hold images: npy, npz, MATLAB and HDF5 files."""

import math
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

import numpy as np

from lidar_mi.errors import InputError
from lidar_mi.io.pixels.frames import Frames, frames_of, reading
from lidar_mi.io.size import check_size

if TYPE_CHECKING:
    import h5py


_COLOURS = 4
"""Largest last axis that may be colours."""
_PACKED = ("scale_factor", "add_offset")


def read_npy(path: Path) -> Frames:
    """An image (height, width) or images (frames, height, width).

    Raises InputError: a damaged file, Python objects, another number of dimensions.
    """
    with reading(path, "npy"):
        with path.open("rb") as file:
            image = _numpy_array(path, file, path.stat().st_size)
    return _stack(path, image)


def read_npz(path: Path, layer: str | None) -> Frames:
    """One array of a NumPy zip file, as `read_npy`; ``layer`` names it where there are several."""
    with reading(path, "npz"):
        with zipfile.ZipFile(path) as packed:
            names = {n.removesuffix(".npy"): n for n in packed.namelist() if n.endswith(".npy")}
            # two dimensions at least: parameters are stored beside images
            shapes = {}
            for name, member in names.items():
                with packed.open(member) as file:
                    shapes[name] = _numpy_header(file)[0]
            chosen = _chosen(path, shapes, layer)
            size = packed.getinfo(names[chosen]).file_size
            check_size(path, size)
            with packed.open(names[chosen]) as file:
                image = _numpy_array(path, file, size)
    return _stack(path, image)


def read_mat(path: Path, layer: str | None) -> Frames:
    """A matrix of a MATLAB file of version 4 to 7; ``layer`` names it where there are several.

    Raises InputError: a damaged file; no or several matrices; an array of more than two dimensions,
    in which images may be first or last.
    """
    from scipy.io import loadmat, whosmat

    numbers = {
        "double",
        "single",
        "logical",
        *(f"{u}int{n}" for u in ("", "u") for n in (8, 16, 32, 64)),
    }
    with reading(path, "MATLAB file"):
        shapes = {name: shape for name, shape, kind in whosmat(path) if kind in numbers}
        chosen = _chosen(path, shapes, layer)
        check_size(path, 8 * math.prod(shapes[chosen]))
        image = loadmat(path, variable_names=[chosen])[chosen]
    return _matrix(path, np.asarray(image))


def read_hdf5(path: Path, layer: str | None) -> Frames:
    """An image or images of an HDF5 file, of MATLAB 7.3 too; ``layer`` is the path of the data set.

    Raises InputError: a damaged file; no or several images; a filter that is not installed; packed
    numbers.
    """
    import h5py

    with reading(path, "HDF5"):
        with h5py.File(path, "r") as file:
            arrays: dict[str, Any] = {}

            def add(name: str, part: Any) -> None:
                if isinstance(part, h5py.Dataset) and part.dtype.kind in "iufb":
                    arrays[name] = part

            file.visititems(add)
            arrays = {name: part for name, part in arrays.items() if not name.startswith("#")}
            chosen = _chosen(path, {name: part.shape for name, part in arrays.items()}, layer)
            part = arrays[chosen]
            _refuse_unreadable(path, part)
            matlab = "MATLAB_class" in part.attrs
            image = part[()]
    return _matrix(path, image.T) if matlab else _stack(path, image)


def _refuse_unreadable(path: Path, part: "h5py.Dataset") -> None:
    """Filters that are not there, values elsewhere, sizes out of proportion, packed numbers."""
    import h5py

    filters = part.id.get_create_plist()
    for number in range(filters.get_nfilters()):
        code, _, _, name = filters.get_filter(number)
        if not h5py.h5z.filter_avail(code):
            raise InputError(
                f"{path}: compressed by {name.decode(errors='replace')[:40]} (HDF5 filter {code}), "
                "which is not installed; expected gzip: h5repack -f GZIP=4 FILE NEW"
            )
    if part.external or part.is_virtual:
        raise InputError(f"{path}: its values are in other files; expected them in this one")
    check_size(path, 8 * math.prod(part.shape))
    if part.chunks is not None:
        check_size(path, math.prod(part.chunks) * part.dtype.itemsize)
    packed = [name for name in _PACKED if name in part.attrs]
    if packed:
        raise InputError(f"{path}: packed numbers ({packed[0]}); expected plain ones")


def _chosen(path: Path, shapes: Mapping[str, tuple[int, ...]], layer: str | None) -> str:
    """The array that is meant: the one named, else the only one of two or three dimensions."""
    images = [n for n, shape in shapes.items() if len(shape) in (2, 3) and min(shape[-2:]) > 1]
    if layer is not None:
        if layer not in shapes:
            raise InputError(
                f"{path}: layer {layer!r} is not there; expected one of {_listed(images)}"
            )
        return layer
    if not images:
        raise InputError(f"{path}: has no array of an image; expected one of two dimensions")
    if len(images) > 1:
        raise InputError(
            f"{path}: {len(images)} arrays; expected --layer, one of {_listed(images)}"
        )
    return images[0]


def _listed(names: list[str]) -> str:
    text = ", ".join(name[:30] for name in names[:4])
    return text + (", ..." if len(names) > 4 else "")


def _numpy_header(file: IO[bytes]) -> tuple[tuple[int, ...], np.dtype]:
    version = np.lib.format.read_magic(file)
    read: dict[Any, Callable[[Any], tuple[tuple[int, ...], bool, np.dtype]]] = {
        (1, 0): np.lib.format.read_array_header_1_0,
        (2, 0): np.lib.format.read_array_header_2_0,
    }
    if version not in read:
        raise ValueError(f"version {version}")
    shape, _, dtype = read[version](file)
    return shape, dtype


def _numpy_array(path: Path, file: IO[bytes], size: int) -> np.ndarray:
    """The array, if the file holds as many bytes as its header says."""
    shape, dtype = _numpy_header(file)
    if dtype.hasobject or dtype.fields:
        raise InputError(f"{path}: objects of Python; expected numbers")
    if math.prod(shape) * dtype.itemsize > size:
        raise ValueError(f"{' x '.join(map(str, shape))} values in {size} bytes")
    file.seek(0)
    return np.lib.format.read_array(file, allow_pickle=False)


def _stack(path: Path, image: np.ndarray) -> Frames:
    """An array as images; refused where its axes may mean something else."""
    if image.ndim not in (2, 3):
        raise InputError(
            f"{path}: an array of {image.ndim} dimensions; expected (height, width) or (frames, "
            "height, width)"
        )
    if image.ndim == 3 and image.shape[-1] <= _COLOURS:
        raise InputError(
            f"{path}: an array of {' x '.join(map(str, image.shape))}; its last axis may be "
            "colours; expected (height, width) or (frames, height, width)"
        )
    return frames_of(path, image.reshape(-1, *image.shape[-2:]))


def _matrix(path: Path, image: np.ndarray) -> Frames:
    if image.ndim != 2:
        raise InputError(
            f"{path}: an array of {' x '.join(map(str, image.shape))}; in MATLAB files images may "
            "be first or last; expected a matrix for each image, chosen by --layer"
        )
    return frames_of(path, image[None])
