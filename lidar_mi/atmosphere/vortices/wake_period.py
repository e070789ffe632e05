"""A simulated wake as one period along its axis: periodic as it is, or closed at its ends."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
import xarray as xr

from lidar_mi.errors import InputError

Ends = Literal["mirror", "blend", "refuse"]

# Largest ratio of the roughness at the seam to that within a period.
_ROUGHEST_SEAM = 2.0
# Planes that are equal to this fraction of the largest speed are the same plane.
_SAME_PLANE = 1e-5


@dataclass(frozen=True)
class Closing:
    """How a volume became a period, and what that changed.

    how {"uniform", "periodic", "mirror", "blend"}
    period: m; nan of a uniform wake.
    changed: planes of the period that are not those of the volume.
    divergence, divergence_before: rms divergence over the rms of all gradients (1/s), in and beside
        the planes that were changed, and of all planes of the volume.
    """

    how: str
    period: float
    changed: tuple[int, ...] = ()
    divergence: float = 0.0
    divergence_before: float = 0.0


def one_period(
    flow: xr.Dataset, ends: Ends = "refuse", length: float = 5.0
) -> tuple[xr.Dataset, Closing]:
    """The planes of one period of a wake along x.

    The step from the last plane to the first, and the curvature there, are compared with those
    within the volume: where either is more than twice the largest inside, the volume is not
    periodic. A last plane that repeats the first one is omitted. A wake that is uniform
    along its axis becomes a single plane. A volume that is not periodic is closed:

    mirror
        Its mirror image follows, and the period is twice its length. Circulation and cores stay, u
        falls to 0 at both mirrors by a raised cosine over ``length``, which makes divergence there.
    blend
        Its last ``length`` is blended into the first one by a raised cosine, and the period is
        shorter by that. Differences of the cores are blurred, and differences of u make divergence.

    flow: v, w and maybe u on (x, y, z), x even; maybe tracers.
    ends {"mirror", "blend", "refuse"}
    length: m.

    Raises InputError: a volume of fewer than 4 planes; one that is not periodic, where that is
    refused; one that is shorter than twice ``length``.
    """
    count = flow.sizes["x"]
    if count == 1:
        return flow, Closing("uniform", float("nan"))
    if count < 4:
        raise InputError(
            f"wake.depth: volume is not allowed with {count} planes; expected 4 or more, or "
            "wake.depth: plane"
        )
    values = _winds(flow)
    step = float(flow["x"][1] - flow["x"][0])
    floor = _SAME_PLANE * np.abs(values).max()
    if np.ptp(values, axis=1).max() <= floor:
        return flow.isel(x=[0]), Closing("uniform", float("nan"))
    repeated = np.abs(values[:, -1] - values[:, 0]).max() <= floor
    part, values = (flow.isel(x=slice(0, -1)), values[:, :-1]) if repeated else (flow, values)
    fault = _seam(values, floor)
    if not fault:
        return part, Closing("periodic", part.sizes["x"] * step)
    if ends == "refuse":
        raise InputError(
            "wake.depth: volume is not allowed in an encounter with encounter.wake.ends: refuse, "
            f"as the wake is not periodic along x: {fault}; expected a whole period, "
            "encounter.wake.ends: mirror or blend, or wake.depth: plane"
        )
    planes = max(1, round(length / step))
    if 2 * planes > count - 2:
        raise InputError(
            f"encounter.wake.ends_length: {length:g} m is not allowed with a volume of "
            f"{count * step:.4g} m; expected at most {(count - 2) // 2 * step:.4g} m, or a longer "
            "volume"
        )
    closed, changed = (_mirrored if ends == "mirror" else _blended)(flow, planes)
    # differences reach one plane beyond those that were changed
    count = closed.sizes["x"]
    near = sorted({(k + j) % count for k in changed for j in (-1, 0, 1)})
    return closed, Closing(
        ends,
        count * step,
        changed,
        _divergence(closed, np.array(near), step),
        _divergence(flow, np.arange(1, flow.sizes["x"] - 1), step),
    )


def _winds(flow: xr.Dataset) -> np.ndarray:
    """Components on (component, x, y, z)."""
    names = [name for name in ("u", "v", "w") if name in flow]
    return np.stack([flow[name].transpose("x", "y", "z").values for name in names])


def _seam(values: np.ndarray, floor: float) -> str:
    """The reason why a volume is not periodic; empty: it is."""
    for order in (1, 2):
        # differences about the circle: those of the last `order` places go across the seam
        size = values
        for _ in range(order):
            size = np.roll(size, -1, axis=1) - size
        rms = np.sqrt((size**2).mean((0, 2, 3)))
        inside, seam = rms[:-order].max(), rms[-order:].max()
        if seam > _ROUGHEST_SEAM * inside + floor:
            measure = "step" if order == 1 else "curvature"
            return (
                f"the {measure} from its last plane to its first is {seam / inside:.2g} times the "
                "largest within"
            )
    return ""


def _mirrored(flow: xr.Dataset, planes: int) -> tuple[xr.Dataset, tuple[int, ...]]:
    count = flow.sizes["x"]
    order = [*range(count), *range(count - 2, 0, -1)]
    away = np.minimum(np.arange(count), np.arange(count)[::-1])
    weight = 0.5 * (1 - np.cos(np.pi * np.minimum(away / planes, 1.0)))
    # a mirror across x turns u around
    signs = np.where(np.arange(len(order)) < count, 1.0, -1.0)
    closed = _at_places(flow.isel(x=order), flow)
    if "u" in flow:
        factor = xr.DataArray(weight[order] * signs, dims="x")
        closed = closed.assign(u=(closed["u"] * factor).transpose(*flow["u"].dims))
    changed = tuple(k for k, plane in enumerate(order) if weight[plane] < 1)
    return closed, changed


def _blended(flow: xr.Dataset, planes: int) -> tuple[xr.Dataset, tuple[int, ...]]:
    count = flow.sizes["x"]
    first, last = flow.isel(x=slice(0, planes)), flow.isel(x=slice(count - planes, None))
    weight = 0.5 * (1 - np.cos(np.pi * (np.arange(planes) + 1) / (planes + 1)))
    weights = xr.DataArray(weight, dims="x")
    mixed = {
        name: (weights * field + (1 - weights) * last[name].drop_vars("x")).transpose(*field.dims)
        for name, field in first.drop_vars("x").data_vars.items()
    }
    middle = flow.isel(x=slice(planes, count - planes)).drop_vars("x")
    return _at_places(xr.concat([xr.Dataset(mixed), middle], "x"), flow), tuple(range(planes))


def _at_places(planes: xr.Dataset, flow: xr.Dataset) -> xr.Dataset:
    """The planes, evenly spaced from the first plane of the volume on."""
    x = flow["x"]
    places = float(x[0]) + float(x[1] - x[0]) * np.arange(planes.sizes["x"])
    return planes.assign_coords(x=("x", places, x.attrs))


def _divergence(flow: xr.Dataset, planes: np.ndarray, step: float) -> float:
    """Rms divergence over the rms of all gradients, by central differences about the circle."""
    components = [
        flow[name].transpose("x", "y", "z").values if name in flow else np.zeros(())
        for name in "uvw"
    ]
    total, square = np.zeros(()), 0.0
    for k, values in enumerate(np.broadcast_arrays(*components)):
        for axis, name in enumerate("xyz"):
            if axis == 0:
                slope = (np.roll(values, -1, 0) - np.roll(values, 1, 0)) / (2 * step)
            else:
                slope = np.gradient(values, flow[name].values, axis=axis)
            square = square + np.mean(slope[planes] ** 2)
            total = total + slope[planes] if axis == k else total
    return float(np.sqrt(np.mean(total**2) / square))
