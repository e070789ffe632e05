"""Positions, radii and circulations of the vortices of a cross-flow wind field."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import scipy
import xarray as xr


@dataclass(frozen=True)
class Core:
    """A vortex core: centre (m), radius of the peak swirl (m), circulation there (m^2 s^-1)."""

    y: float
    z: float
    radius: float
    circulation: float


def find_cores(wind: xr.Dataset, least_circulation: float = 20.0) -> list[Core]:
    """The strongest vortex of either sense of rotation in a wind field (v, w on z, y).

    The centre is the centroid of the vorticity around its peak, iterated over a disc of 5 m. A core
    of up to twice that radius is not biased; where the field's edge cuts the disc, the centre is
    biased inwards: 0.1 m at 3 m from the edge for a core of 3 m. The core radius is that of the
    ring, of rings half a cell apart, on which the mean swirl is largest. Rings extend to the
    nearest edge of the field; a swirl that still increases there (a core at the edge, or uniform
    shear) is no core.

    Returns
    -------
    list of Core
        Port (positive circulation) first; senses whose circulation at the core radius stays below
        ``least_circulation`` are omitted, so a field without vortices gives an empty list.
    """
    y, z = wind["y"].values, wind["z"].values
    v, w = (wind[name].transpose("z", "y").values for name in ("v", "w"))
    vorticity = np.gradient(w, y, axis=1) - np.gradient(v, z, axis=0)
    spacing = y[1] - y[0]
    # over 1 m, as the peak of noise is a single node
    smooth = scipy.ndimage.gaussian_filter(vorticity, 1.0 / spacing)
    lateral, vertical = np.meshgrid(y, z)
    cores = []
    for sign in (1, -1):
        row, column = np.unravel_index(np.argmax(sign * smooth), smooth.shape)
        cy, cz = y[column], z[row]
        for _ in range(10):
            near = np.hypot(lateral - cy, vertical - cz) < 5.0
            # vorticity of the other sense would shift the centroid
            weight = np.clip(sign * vorticity, 0, None) * near
            if not weight.sum() > 0:
                break
            cy = float((weight * lateral).sum() / weight.sum())
            cz = float((weight * vertical).sum() / weight.sum())
        edge = min(cy - y[0], y[-1] - cy, cz - z[0], z[-1] - cz)
        # too few rings for a profile
        if edge < 4 * spacing:
            continue
        rings = np.arange(spacing, edge, spacing / 2)
        profile = sign * _ring_means(v, w, y, z, cy, cz, rings)[2]
        peak = int(np.argmax(profile))
        if peak == len(rings) - 1:
            continue
        radius = rings[peak]
        circulation = sign * 2 * np.pi * radius * profile[peak]
        if abs(circulation) >= least_circulation:
            cores.append(Core(cy, cz, float(radius), float(circulation)))
    return cores


class Rings(NamedTuple):
    """Circulation (m^2 s^-1) and advecting wind of a vortex, from the wind on rings around it."""

    circulation: float
    v: float
    w: float


def ring_averages(
    wind: xr.Dataset,
    core: Core,
    others: Sequence[Core] = (),
    inner: float = 5.0,
    outer: float = 15.0,
) -> Rings | None:
    """Averages over rings around a core, with radii from ``inner`` to ``outer``, m.

    Circulation is 2 pi r times the mean swirl, which vortices beyond the rings do not change (as
    Holzaepfel et al., J. Atmos. Ocean. Technol. 20, 2003, average it). The mean wind on a ring is
    that which advects the vortex: a vortex within does not contribute to it, one beyond
    contributes its wind at the centre.

    Returns
    -------
    Rings or None
        None where the rings leave the field, or come within two radii of another core.
    """
    y, z = wind["y"].values, wind["z"].values
    edge = min(core.y - y[0], y[-1] - core.y, core.z - z[0], z[-1] - core.z)
    near = min(
        (np.hypot(o.y - core.y, o.z - core.z) - 2 * o.radius for o in others), default=np.inf
    )
    if outer > min(edge, near):
        return None
    # half a step more, so that the outermost ring is included
    rings = np.arange(inner, outer + 0.125, 0.25)
    v, w = (wind[name].transpose("z", "y").values for name in ("v", "w"))
    mean_v, mean_w, swirl = _ring_means(v, w, y, z, core.y, core.z, rings)
    return Rings(
        float((2 * np.pi * rings * swirl).mean()), float(mean_v.mean()), float(mean_w.mean())
    )


def _ring_means(
    v: np.ndarray,
    w: np.ndarray,
    y: np.ndarray,
    z: np.ndarray,
    cy: float,
    cz: float,
    rings: np.ndarray,
) -> np.ndarray:
    """Means of v, w and the tangential velocity on rings around (cy, cz), (3, rings), m/s.

    Tangential is positive from +y towards +z.
    By cubic interpolation at equal angles: an average over the nodes near a ring would give a
    spurious swirl of some 0.1 m/s in a uniform flow of 10 m/s.
    """
    angle = np.arange(180) * (2 * np.pi / 180)
    rows = (cz + rings[:, None] * np.sin(angle) - z[0]) / (z[1] - z[0])
    columns = (cy + rings[:, None] * np.cos(angle) - y[0]) / (y[1] - y[0])
    on_v, on_w = (scipy.ndimage.map_coordinates(f, [rows, columns], mode="nearest") for f in (v, w))
    swirl = on_w * np.cos(angle) - on_v * np.sin(angle)
    return np.stack([field.mean(1) for field in (on_v, on_w, swirl)])


def outside_cores(
    y: np.ndarray, z: np.ndarray, cores: Sequence[Core], radii: float = 2.0
) -> np.ndarray:
    """True where a point lies beyond ``radii`` core radii of every core."""
    outside = np.ones(np.broadcast(y, z).shape, bool)
    for core in cores:
        outside &= np.hypot(y - core.y, z - core.z) > radii * core.radius
    return outside
