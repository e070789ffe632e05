"""Images of one instant from scans that take time: every beam's value advected by the air."""

from collections.abc import Callable, Sequence

import numpy as np
import torch
import xarray as xr
from scipy.interpolate import RegularGridInterpolator
from scipy.spatial import KDTree

from lidar_mi.retrieval.correlation.outliers import validated
from lidar_mi.retrieval.images.common_grid import nearest_filled, on_one_grid
from lidar_mi.retrieval.images.gridding import on_nodes
from lidar_mi.retrieval.wind.options import WindowSizes
from lidar_mi.retrieval.wind.pair import retrieve_wind

Wind = Callable[[np.ndarray], np.ndarray]
"""Places (..., 2), y and z in m, to v and w in m/s."""

_PLACES = ("y_reported", "z_reported")
# Scatter of the times of beams next to each other about a plane, over dt, above which the value of
# a node mixes times.
_MIXED = 0.01
# Beams that are next to each other.
_NEIGHBOURS = 9
# Rounds of advection.
_ROUNDS = 2
# Pixels: the wind only has to be right to a few per cent, as it counts for half a scan at most.
_TEMPLATE, _STRIDE = 16, 4


def synchronised(
    scans: Sequence[xr.Dataset], steps: Sequence[float], image: str
) -> list[xr.Dataset]:
    """Scans on their nodes (`on_nodes`), each at one instant where nodes would mix times.

    A curve that crosses itself, such as a Lissajous figure, returns to the neighbourhood of a beam
    after up to the whole scan, and the air has moved by then: values of different air would be
    averaged. Beams are therefore advected with the air to the mean time m of all scans' beams,

        place(m) = place(t) - integral of the wind from m to t along the path (midpoint rule),

    and resampled from there. The wind is that of `multipass` between two images in succession,
    resampled as they are at first and then from advected beams, twice. An error of this wind counts
    with the time of the beams over dt: 5 % of 12 m/s and 45 ms are 3 cm.

    scans (..., z, y): as `gridding.on_nodes` takes them, with ``beam_time``, s from the reference
        time of each: one that is the same in all, such as the middle of a scan.
    steps: from each reference time to the next, s.
    image: field that the wind is retrieved from.

    Returns
    -------
    list of xr.Dataset
        On their nodes. ``beam_time`` is m all over where beams were advected.
    """
    if not any(mixes_times(scan, min(np.abs(steps))) for scan in scans):
        return [on_nodes(scan) for scan in scans]
    middle = float(np.mean([scan["beam_time"].mean() for scan in scans]))
    scans = [scan.assign(beam_time=scan["beam_time"] - middle) for scan in scans]
    needed = [scan[[image, "beam_time", *_PLACES]] for scan in scans]
    images = [on_nodes(scan, errors=False) for scan in needed]
    for _ in range(_ROUNDS - 1):
        winds = _winds(images, steps, image)
        images = [
            _at_time(0.0, on_nodes(advected(scan, wind), errors=False))
            for scan, wind in zip(needed, winds, strict=True)
        ]
    winds = _winds(images, steps, image)
    return [
        _at_time(middle, on_nodes(advected(scan, wind)))
        for scan, wind in zip(scans, winds, strict=True)
    ]


def mixes_times(scan: xr.Dataset, dt: float) -> bool:
    """Whether beams next to each other look at the air at very different times.

    Times that are linear in place, as in a raster, are resampled exactly. The
    residuals of the times of nine beams about a plane are compared with dt: more than 1 % in the
    median.
    """
    if "beam_time" not in scan or scan.attrs.get("frozen_air"):
        return False
    places = np.stack([scan[name].transpose("z", "y").values.ravel() for name in _PLACES], -1)
    time = scan["beam_time"].transpose("z", "y").values.ravel()
    if len(time) < _NEIGHBOURS or not np.isfinite(places).all():
        return False
    _, near = KDTree(places).query(places, _NEIGHBOURS)
    around, times = places[near], time[near]
    around, times = around - around.mean(1, keepdims=True), times - times.mean(1, keepdims=True)
    slope = np.linalg.pinv(around) @ times[..., None]
    residual = times - (around @ slope)[..., 0]
    return float(np.median(residual.std(1))) > _MIXED * dt


def advected(scan: xr.Dataset, wind: Wind) -> xr.Dataset:
    """The scan with its beams at the places of their air at the time 0.

    scan: with ``y_reported``, ``z_reported`` (m) and ``beam_time`` (s), dims (z, y).
    wind: places (..., 2), y and z in m, to v and w in m/s.
    """
    time = scan["beam_time"].transpose("z", "y").values[..., None]
    place = np.stack([scan[name].transpose("z", "y").values for name in _PLACES], -1)
    half = place - wind(place) * time / 2
    place = place - wind(half) * time
    return scan.assign({name: (("z", "y"), place[..., i]) for i, name in enumerate(_PLACES)})


def _winds(images: Sequence[xr.Dataset], steps: Sequence[float], name: str) -> list[Wind]:
    """Wind of every image: from it to the next one; of the last, from the one before."""
    pairs = zip(images[:-1], images[1:], steps, strict=True)
    winds = [_wind(pair, dt, name) for *pair, dt in pairs]
    return [*winds, winds[-1]]


def _wind(images: Sequence[xr.Dataset], dt: float, name: str) -> Wind:
    """v and w at places, with gaps and outliers filled from their neighbours."""
    # scans by angles have nodes of their own
    pair = on_one_grid(*(_without_gaps(scan[name]) for scan in images))
    template = min(_TEMPLATE, min(pair[0].shape) // 3)
    wind = retrieve_wind(
        *pair,
        dt,
        "multipass",
        windows=WindowSizes(template, 2 * template, _STRIDE),
        times=on_one_grid(*(_without_gaps(scan["beam_time"]) for scan in images)),
        standard_errors=False,
        checks=False,
    )
    valid = wind["flag"] == 0
    components = np.stack([wind[c].where(valid).transpose("z", "y").values for c in "vw"])
    filled, _ = validated(torch.as_tensor(components), 2)
    axes = wind["y"].values, wind["z"].values
    low, high = (np.array([axis[end] for axis in axes]) for end in (0, -1))
    known = RegularGridInterpolator(axes, filled.numpy().transpose(2, 1, 0))
    return lambda places: known(places.clip(low, high))


def _without_gaps(image: xr.DataArray) -> xr.DataArray:
    """The nearest value beyond the beams, so that only vectors there fail."""
    image = image.transpose("z", "y")
    return image.copy(data=nearest_filled(image.values))


def _at_time(time: float, scan: xr.Dataset) -> xr.Dataset:
    return scan.assign(beam_time=0.0 * scan["beam_time"] + time)
