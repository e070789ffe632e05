"""Boxes of wind for wind turbines: TurbSim's full fields (.bts), Mann boxes of HAWC2 (.bin).

Both become a volume at rest in its mean wind, on (x, y, z): x along the wind, y to the left facing
along it, z up.
"""

import struct
from pathlib import Path

import numpy as np
import xarray as xr

from lidar_mi.errors import InputError

_BTS_HEAD = struct.Struct("<h4i6f6fi")
_BTS_KINDS = (7, 8)
"""Files of one run, and periodic ones."""

_ATTRS = {"units": "m s-1"}


def read_bts(path: str | Path) -> xr.Dataset:
    """The full field of TurbSim as a volume, by frozen turbulence.

    A grid of the field at the time t is the plane x = -U t, with U the mean wind at the hub
    (Jonkman, TurbSim user's guide v2.00, annex D). Points of the tower below the grid are omitted.

    Raises InputError: not in this format, cut short, or without mean wind.

    Returns
    -------
    xarray.Dataset
        u, v, w (m/s) on (x, y, z), m, ascending; z above the ground. The mean wind is in u.
    """
    path = Path(path)
    data = _content(path)
    if len(data) < _BTS_HEAD.size:
        raise InputError(f"{path}: {len(data)} bytes are no TurbSim field; expected a .bts file")
    kind, nz, ny, tower, steps, dz, dy, dt, mean, _, bottom, *scales, text = _BTS_HEAD.unpack_from(
        data
    )
    plausible = kind in _BTS_KINDS and min(nz, ny, steps) > 0 and tower >= 0 and 0 <= text <= 10_000
    if not plausible or not min(dz, dy, dt) > 0:
        raise InputError(f"{path}: no header of a TurbSim field; expected a .bts file")
    if not mean > 0:
        raise InputError(f"{path}: mean wind at the hub of {mean:g} m/s; expected above 0")
    start, count = _BTS_HEAD.size + text, 3 * (ny * nz + tower)
    expected = start + 2 * count * steps
    if len(data) < expected:
        raise InputError(f"{path}: has {len(data)} bytes of {expected}; the file is cut short")
    raw = np.frombuffer(data, "<i2", count * steps, start).reshape(steps, count)
    # in a step: the component fastest, then y, then z, then the tower
    grid = raw[:, : 3 * ny * nz].reshape(steps, nz, ny, 3)
    slope, offset = np.array(scales[::2], float), np.array(scales[1::2], float)
    wind = (grid[::-1].transpose(3, 0, 2, 1) - offset[:, None, None, None]) / slope[
        :, None, None, None
    ]
    x = -mean * dt * np.arange(steps)[::-1]
    y, z = dy * (np.arange(ny) - (ny - 1) / 2), bottom + dz * np.arange(nz)
    return _volume(wind, x, y, z)


def read_mann(
    path: str | Path, shape: tuple[int, int, int], spacing: tuple[float, float, float], base: float
) -> xr.Dataset:
    """A box of the Mann model as HAWC2 reads it: float32 on (x, y, z), z fastest, no header.

    The axes are those of the generator (Mann, Prob. Eng. Mech. 13, 1998): right-handed, x along the
    wind and ascending, z up. HAWC2 itself turns y and z to the right and down.

    path: file of u; its name ends with u before the suffix, those of v and w with v and w.
    shape: nodes along x, y and z.
    spacing: m.
    base: height of the lowest nodes above the ground, m.

    Raises InputError: a file is missing, or its size is not that of the shape.

    Returns
    -------
    xarray.Dataset
        u, v, w (m/s) on (x, y, z), m; without mean wind.
    """
    components = []
    for component in mann_files(path):
        data, expected = _content(component), 4 * int(np.prod(shape))
        if len(data) != expected:
            raise InputError(
                f"{component}: has {len(data)} bytes; expected {expected} of "
                f"{shape[0]} x {shape[1]} x {shape[2]} nodes"
            )
        components.append(np.frombuffer(data, "<f4").reshape(shape))
    x, y, z = (step * np.arange(nodes) for nodes, step in zip(shape, spacing, strict=True))
    return _volume(np.array(components, float), x, y - y[-1] / 2, z + base)


def mann_files(path: str | Path) -> list[Path]:
    """The files of u, v and w of a Mann box, by that of u.

    Raises InputError: its name does not end with u.
    """
    path = Path(path)
    if not path.stem.endswith("u"):
        raise InputError(f"{path}: expected the file of u, with a name that ends with u")
    return [path.with_name(f"{path.stem[:-1]}{name}{path.suffix}") for name in "uvw"]


def _content(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: {error.strerror}; expected a box of wind") from None


def _volume(wind: np.ndarray, x: np.ndarray, y: np.ndarray, z: np.ndarray) -> xr.Dataset:
    if not np.isfinite(wind).all():
        raise InputError("a box of wind has values that are not finite; expected finite speeds")
    return xr.Dataset(
        {name: (("x", "y", "z"), values, _ATTRS) for name, values in zip("uvw", wind, strict=True)},
        {name: (name, axis, {"units": "m"}) for name, axis in (("x", x), ("y", y), ("z", z))},
    )
