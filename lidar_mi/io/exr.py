"""Images as OpenEXR files: one file per scan, one layer per gate and Stokes component.

A scan's file has the pilot's view: top row = largest z, left column = largest y. Layers are
``gate000.S0`` ... ``gate000.S3`` and ``gate000.S0_stderr`` for every gate (and
``gate000.order1.S0``, ... where orders of scattering were separated; ``gate000.S1_stderr`` ...
``gate000.S3_stderr`` and ``gate000.S0_S1_correlation``, of the errors, where light is polarised),
and ``Y``, the attenuated backscatter of the first gate, corrected for range, gate length and the
environment's transmittance, which any viewer shows. Files of a run also have
``gate000.depolarization`` and ``gate000.multiple_scattering_fraction`` with their ``_stderr``, and
with a detector ``gate000.S0_noisy``, ``gate000.S0_noise_std``, ``Y_noisy`` and
``Y_noise_std``. Files of a scan whose beams have times of their own have ``beam_time``,
``y_reported`` and ``z_reported``, when and to where each beam pointed. Everything else (beam
positions, gates, instrument, units, seed, version) is in typed header attributes: those of the data
set, which `lidar_mi.rendering.backscatter` and `lidar_mi.rendering.fringes` fill. A fringe camera's
file has the layers ``S0`` ... ``S3``, ``S0_stderr`` and ``Y``, in the camera's view.
"""

import re
from collections.abc import Sequence
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import OpenEXR

from lidar_mi.arguments import checked_arguments
from lidar_mi.errors import InputError
from lidar_mi.io.atomic import write_atomically
from lidar_mi.io.exr_header import declared
from lidar_mi.io.library_name import library_name
from lidar_mi.io.size import check_size

if TYPE_CHECKING:
    import xarray as xr


MOST_LAYERS = 2**15 - 1
"""Most layers of a file: the library counts them in 16 bits."""
QUANTITIES = ("S0", "S1", "S2", "S3", "S0_stderr")
_MEANING = {
    "S0": "received energy over emitted pulse energy",
    "S1": "Stokes Q about the horizontal axis, over emitted pulse energy",
    "S2": "Stokes U about the horizontal axis, over emitted pulse energy",
    "S3": "Stokes V, over emitted pulse energy",
    "S0_stderr": "Monte Carlo standard error of S0",
}
_LAYER = re.compile(r"gate(\d{1,9})\.(.+)$")
# header entries that describe the file, not the scan
_STRUCTURE = {
    "channels",
    "compression",
    "dataWindow",
    "displayWindow",
    "lineOrder",
    "pixelAspectRatio",
    "screenWindowCenter",
    "screenWindowWidth",
    "type",
    "tiles",
    "name",
    "version",
    "chunkCount",
}


def write_scan(path: str | Path, scan: "xr.Dataset") -> None:
    """Write a scan: S0 ... S3, S0_stderr with dims (gate, z, y), and Y with dims (z, y).

    The file is written whole or not at all; errors as of `write_atomically`. Values are float32.
    Attributes of the dataset become header attributes: float, int, text, and lists of floats keep
    their type.
    """
    path = Path(path)
    # rows from the top, columns from the left, whatever their order in the dataset
    axes = {axis: np.sort(scan[axis].values) for axis in ("y", "z")}
    rows, columns = (np.argsort(-scan[axis].values) for axis in ("z", "y"))

    def pilot(name: str) -> np.ndarray:
        return scan[name].transpose(..., "z", "y").values[..., rows[:, None], columns]

    channels = {name: pilot(name) for name in _once_per_scan(scan)}
    gated = {name: pilot(name) for name in _quantities(scan)}
    for gate in range(scan.sizes["gate"]):
        channels |= {f"gate{gate:03d}.{name}": values[gate] for name, values in gated.items()}
    _write(path, axes | scan.attrs, channels)


def write_fringes(path: str | Path, image: "xr.Dataset") -> None:
    """Write the image of a fringe camera: S0 ... S3, S0_stderr with dims (y, x), y downwards.

    ``Y`` is a copy of S0, so that any viewer shows the rings. Files, values and attributes as in
    `write_scan`.
    """
    layers = {name: image[name].transpose("y", "x").values for name in QUANTITIES}
    _write(Path(path), image.attrs, layers | {"Y": layers["S0"]})


def read_fringes(path: str | Path) -> "xr.Dataset":
    """Read an image written by `write_fringes`; the round trip is exact in float32.

    Raises InputError: not an EXR file, or one without our layers.
    """
    header, layers = read_layers(path)
    if not {*QUANTITIES, "Y"} <= set(layers):
        raise InputError(
            f"{path}: its layers are not an image of a fringe camera; expected "
            f"{', '.join(QUANTITIES)} and Y; it has {', '.join(sorted(layers)) or 'none'}"
        )
    return label_fringes({name: layers[name] for name in QUANTITIES}, header)


def label_fringes(layers: dict[str, np.ndarray], attributes: dict[str, Any]) -> "xr.Dataset":
    """Layers (height, width) of a fringe camera with names, units and pixel numbers as axes."""
    import xarray as xr

    rows, columns = layers["S0"].shape
    image = xr.Dataset(
        {name: (("y", "x"), values) for name, values in layers.items()},
        coords={"y": np.arange(rows), "x": np.arange(columns)},
        attrs=attributes,
    )
    for name, text in _MEANING.items():
        if name in image:
            text = text.replace("emitted pulse energy", "the energy sent through the stop")
            image[name].attrs = {"long_name": text, "units": "1"}
    image["x"].attrs = {"long_name": "pixels to the right of the leftmost", "units": "1"}
    image["y"].attrs = {"long_name": "pixels down from the topmost", "units": "1"}
    return image


def _write(path: Path, attributes: dict[str, Any], channels: dict[str, np.ndarray]) -> None:
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    for key, value in attributes.items():
        header[key] = value.astype(np.float32) if isinstance(value, np.ndarray) else value
    with np.errstate(over="ignore"):
        singles = {k: np.ascontiguousarray(v, dtype=np.float32) for k, v in channels.items()}
    for name, single in singles.items():
        if (np.isinf(single) & np.isfinite(channels[name])).any():
            raise InputError(
                f"{path}: layer {name} has values beyond {np.finfo(np.float32).max:.3g}, the "
                "largest of an EXR file; expected smaller ones"
            )
    if len(singles) > MOST_LAYERS:
        raise InputError(
            f"{path}: {len(singles)} layers are not allowed; expected at most {MOST_LAYERS} in an "
            "EXR file"
        )
    buffer = BytesIO()
    OpenEXR.File(header, singles).write(buffer)
    write_atomically(path, buffer.getvalue())


def read_header(path: str | Path) -> dict[str, Any]:
    """Header attributes of any EXR file; errors as of `read_layers`."""
    return _read(path, header_only=True)[0]


def read_layers(path: str | Path) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Header attributes and all layers of any EXR file, rows from the top.

    Raises InputError: there is no such file, or it is no readable EXR.
    """
    return _read(path)


def _read(
    path: str | Path, *, header_only: bool = False
) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    path = Path(path)
    if not path.is_file():
        raise InputError(f"{path}: no such file; expected an OpenEXR image")
    try:
        size, count = declared(path)
    except ValueError as error:
        raise InputError(f"{path}: not a readable OpenEXR image ({error})") from None
    check_size(path, size)
    try:
        with (
            library_name(path) as name,
            OpenEXR.File(name, separate_channels=True, header_only=header_only) as file,
        ):
            header = {k: v for k, v in file.header().items() if k not in _STRUCTURE}
            layers = {} if header_only else _layers(file.parts)
            whole = header_only or len(file.parts) == count
    except Exception:  # any exception of the library in a damaged file
        raise InputError(f"{path}: not a readable OpenEXR image") from None
    if not whole:
        raise InputError(f"{path}: not a readable OpenEXR image (part of it is missing)")
    if not header_only and len({pixels.shape for pixels in layers.values()}) != 1:
        raise InputError(f"{path}: not a readable OpenEXR image (its layers differ in size)")
    return header, layers


def _layers(parts: Sequence[Any]) -> dict[str, np.ndarray]:
    """Pixels by the names of channels; of several parts by PART.CHANNEL."""
    names = [part.name() if len(parts) > 1 else "" for part in parts]
    layers = {}
    for number, (name, part) in enumerate(zip(names, parts, strict=True)):
        prefix = name if names.count(name) == 1 else f"{name or 'part'}{number}"
        for channel, content in part.channels.items():
            layers[f"{prefix}.{channel}" if prefix else channel] = np.array(content.pixels)
    return layers


def axis_of(header: dict[str, Any], name: str, size: int, path: str | Path) -> np.ndarray:
    """A header's axis of an image, ascending, m.

    Raises InputError: not as many finite, ascending numbers as the image has pixels.
    """
    try:
        values = np.asarray(header[name], float)
    except (TypeError, ValueError):
        values = np.empty(0)
    if values.shape != (size,) or not np.isfinite(values).all() or (np.diff(values) <= 0).any():
        raise InputError(
            f"{path}: header attribute {name} of {values.size} numbers is no axis of {size} "
            "pixels; expected as many finite numbers, ascending"
        )
    return values


@checked_arguments
def read_scan(path: str | Path) -> "xr.Dataset":
    """Read a scan of the backscatter lidar from an EXR file; the round trip is exact in float32.

    Parameters
    ----------
    path : path
        Such as ``image_t1.exr`` of a run folder.

    Returns
    -------
    xr.Dataset, dims (gate, z, y), y and z ascending, m
        Stokes vector ``S0`` ... ``S3`` (received over emitted pulse energy) with standard errors,
        depolarisation, orders of scattering; ``Y`` (z, y), the range-corrected attenuated
        backscatter of the first gate, m^-1 sr^-1; behind a detector ``Y_noisy``. Attributes say
        how it was made.

    Raises
    ------
    InputError
        Not an EXR file, or one without a scan's layers or axes.

    Examples
    --------
    >>> import lidar_mi as lm
    >>> scan = lm.read_scan("image_t1.exr")                              # doctest: +SKIP
    >>> wind = lm.retrieve_wind(scan["Y"], later["Y"], scan.attrs["dt"])  # doctest: +SKIP
    """
    import xarray as xr

    header, layers = read_layers(path)
    gates: dict[int, dict[str, np.ndarray]] = {}
    for name, pixels in layers.items():
        if match := _LAYER.match(name):
            gates.setdefault(int(match[1]), {})[match[2]] = pixels
    complete = gates and all(
        set(QUANTITIES) <= set(layer) and set(layer) == set(gates[min(gates)])
        for layer in gates.values()
    )
    if not complete or "Y" not in layers or not {"y", "z"} <= set(header):
        raise InputError(
            f"{path}: its layers are not a lidar scan; expected Y and, the same of every gate, "
            "gate000.S0 ... gate000.S3, gate000.S0_stderr, header attributes y and z; it has "
            f"{', '.join(sorted(layers)) or 'none'}"
        )
    rows, columns = layers["Y"].shape
    y, z = (axis_of(header, *axis, path) for axis in (("y", columns), ("z", rows)))
    header = {key: value for key, value in header.items() if key not in ("y", "z")}
    variables: dict[str, Any] = {
        quantity: (
            ("gate", "z", "y"),
            np.stack([gates[g][quantity][::-1, ::-1] for g in sorted(gates)]),
        )
        for quantity in gates[min(gates)]
    }
    for name, pixels in layers.items():
        if not _LAYER.match(name):
            variables[name] = (("z", "y"), pixels[::-1, ::-1])
    return label_scan(
        xr.Dataset(variables, coords={"gate": sorted(gates), "y": y, "z": z}, attrs=header)
    )


def _quantities(scan: "xr.Dataset") -> list[str]:
    """Variables of a scan for every gate."""
    return [str(name) for name, variable in scan.data_vars.items() if "gate" in variable.dims]


def _once_per_scan(scan: "xr.Dataset") -> list[str]:
    """Variables of a scan without gates: Y, what a detector adds, times and places of beams."""
    return [
        str(name) for name, variable in scan.data_vars.items() if set(variable.dims) == {"z", "y"}
    ]


def unpack(
    image: np.ndarray, names: list[str], gates: int
) -> dict[str, tuple[tuple[str, ...], np.ndarray]]:
    """A rendered tensor (rows from the top, y falling) as variables on (gate, z, y), ascending."""
    rows, columns, _ = image.shape
    values = image.reshape(rows, columns, gates, len(names))[::-1, ::-1]
    return {
        name: (("gate", "z", "y"), values[..., k].transpose(2, 0, 1))
        for k, name in enumerate(names)
    }


def label_scan(scan: "xr.Dataset") -> "xr.Dataset":
    """The same scan with CF names and units on its variables."""
    import lidar_mi.plots  # noqa: F401 - scan.lidar.plot()

    meaning = _MEANING | {
        "S0_mc_error": "a realisation of the Monte Carlo error of S0, of numbers common to beams",
        "S0_pair_stderr": "Monte Carlo standard error of S0 that the other image does not share",
        "S0_largest_share": "largest share of one Monte Carlo sample in the variance of S0",
        **{f"S{k}_stderr": f"Monte Carlo standard error of S{k}" for k in (1, 2, 3)},
        "S0_S1_correlation": "correlation of the Monte Carlo errors of S0 and S1",
        "depolarization": "linear depolarisation ratio",
        "depolarization_stderr": "standard error of the linear depolarisation ratio",
        "multiple_scattering_fraction": "fraction of light scattered more than once",
        "multiple_scattering_fraction_stderr": "standard error of the fraction of light scattered "
        "more than once",
        "S0_noisy": "S0 with the detector's noise",
        "S0_noise_std": "standard deviation of the noise of S0_noisy",
    }
    for name in _quantities(scan):
        order = name.removeprefix("order").removesuffix(".S0")
        text = meaning.get(name, f"S0 of scattering order {order}")
        if scan.attrs.get(f"{name}_is_bound"):
            text = f"upper bound of the {text}"
        scan[name].attrs = {"long_name": text, "units": "1"}
    backscatter = "m-1 sr-1"
    once = {
        "Y": (
            "attenuated backscatter of the first gate, corrected for range and environment",
            backscatter,
        ),
        "Y_noisy": ("attenuated backscatter with the detector's noise", backscatter),
        "Y_noise_std": ("standard deviation of the noise of Y_noisy", backscatter),
        "beam_time": ("time of the beam, from the scan's reference time", "s"),
        "y_reported": ("distance to port, in the middle of the gates, of the reported beam", "m"),
        "z_reported": ("height, in the middle of the gates, of the reported beam", "m"),
    }
    for name in _once_per_scan(scan):
        text, units = once.get(name, (name, backscatter))
        scan[name].attrs = {"long_name": text, "units": units}
    scan["y"].attrs = {"long_name": "distance to port", "units": "m", "axis": "Y"}
    scan["z"].attrs = {
        "long_name": "height above the beam axis",
        "units": "m",
        "axis": "Z",
        "positive": "up",
    }
    return scan
