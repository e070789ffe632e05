"""Flights' lidars as blocks for control design, as files of NumPy and MATLAB."""

import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
import xarray as xr

from lidar_mi.arguments import checked_arguments
from lidar_mi.encounter.control_block.block import control_block
from lidar_mi.encounter.control_block.sensor_samples import flights_in, pooled, samples_of
from lidar_mi.errors import InputError
from lidar_mi.io.folder import make_folder
from lidar_mi.io.json import to_json
from lidar_mi.io.mat_file import write_mat
from lidar_mi.io.npz_file import write_npz
from lidar_mi.io.text import write_text

ABOUT = "blocks.json"

_UNLIKELY = 1e-3
"""P value of a test of the losses below which a remark is made."""


@checked_arguments
def export_control(
    folder: str | Path,
    out: str | Path | None = None,
    *,
    overwrite: bool = False,
    remark: Callable[[str], object] | None = None,
) -> list[Path]:
    """Identify the lidar of flights as a linear filter with delay and coloured noise, and write it.

    Input is the true wind ahead on the wing (means of u, v, w over the span, and the roll gust p),
    output its estimate. Flights of one timing, range and span make a block; the nearest range comes
    first.

    Parameters
    ----------
    folder : path
        Of a flight with the lidar, or one with several of them below it, as of a campaign with
        ``keep: everything``.
    out : path, optional
        Folder of the files. Default: ``control`` in ``folder``.
    overwrite : bool
        Replace files that are there.
    remark : callable, optional
        Called with a line for every range that cannot be identified beside others that can, and
        for lost estimates that no chain describes. Default: a warning.

    Returns
    -------
    list of Path
        ``block_RANGE.npz`` and ``block_RANGE.mat`` of every range, and ``blocks.json``, which says
        what each of their arrays is.

    Raises
    ------
    InputError
        No flight with a lidar, one without wind vectors, too few slabs at every range, a file that
        is there.

    Examples
    --------
    >>> import lidar_mi as lm
    >>> lm.export_control("outputs/gust")            # doctest: +SKIP
    """
    folder = Path(folder)
    out = folder / "control" if out is None else Path(out)
    groups = list(pooled([samples_of(one) for one in flights_in(folder)]))
    blocks = dict(zip(_names([group[0].distance for group in groups]), groups, strict=True))
    by_axis, refused = {}, []
    for name, group in blocks.items():
        try:
            by_axis[name] = control_block(group)
        except InputError as error:
            refused.append(error)
    if not by_axis:
        raise refused[0]
    paths = [out / f"{name}{kind}" for name in by_axis for kind in (".npz", ".mat")]
    paths.append(out / ABOUT)
    there = [path for path in paths if path.exists()]
    if there and not overwrite:
        raise InputError(
            f"{there[0]}: exists; expected another folder (-o DIR), or --overwrite to replace it"
        )
    for text in [
        *map(str, refused),
        *(line for name in by_axis for line in _doubts(by_axis[name])),
    ]:
        (remark or warnings.warn)(text)
    make_folder(out)
    for name, block in by_axis.items():
        write_npz(out / f"{name}.npz", block)
        write_mat(out / f"{name}.mat", block)
    write_text(out / ABOUT, to_json({name: _described(block) for name, block in by_axis.items()}))
    return paths


def _doubts(block: xr.Dataset) -> list[str]:
    """A line for each property of the losses that the chain does not have."""
    where = f"control block at {float(block['range']):.4g} m: lost estimates"
    doubts = []
    if (p := float(block["loss_memory_p"])) < _UNLIKELY:
        doubts.append(f"{where}: the lengths of runs are not geometric (p = {p:.1g})")
    for axis in block["axis"].values[block["loss_gust_p"].values < _UNLIKELY]:
        ratio = float(block["loss_gust_ratio"].sel(axis=axis))
        doubts.append(
            f"{where} depend on the gust: the mean square of {axis} in them is {ratio:.2g} times "
            "that in all"
        )
    return doubts


def _names(distances: list[float]) -> list[str]:
    """Of blocks, by their range in m; those of one range are numbered."""
    names: list[str] = []
    for distance in distances:
        stem = f"block_{distance:.0f}m"
        same = sum(name == stem or name.startswith(f"{stem}_") for name in names)
        names.append(f"{stem}_{same + 1}" if same else stem)
    return names


def _described(block: xr.Dataset) -> dict[str, object]:
    """Axes and numbers of a block, and what each array is."""
    numbers = {
        str(name): value.values.item() for name, value in block.data_vars.items() if not value.ndim
    }
    axes = {
        str(axis): {
            "units": str(block["axis_units"].sel(axis=axis).values),
            "meaning": str(block["axis_meaning"].sel(axis=axis).values),
            **{
                name: float(np.round(block[name].sel(axis=axis), 9))
                for name in ("gain", "gain_stderr", "noise_variance", "noise_variance_stderr")
            },
        }
        for axis in block["axis"].values
    }
    arrays = {
        str(name): {"dims": [str(dim) for dim in value.dims], **value.attrs}
        for name, value in block.variables.items()
    }
    return {"axes": axes, "numbers": numbers, "arrays": arrays}
