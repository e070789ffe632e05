"""The image pair of the velocity benchmarks: exact images of an exactly known wind.

Two Lamb-Oseen vortices advect a band-limited texture, a sum of plane waves that is evaluated at the
origin of the air of every pixel: without interpolation, so all error is the method's.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
import xarray as xr

from lidar_mi.atmosphere.vortices.vortex import Vortex, velocity, vortex_pair
from tests.support.flows import axes, data_array, origin, plane_waves, texture

SPACING, DT = 0.5, 0.1
CIRCULATION, SEPARATION, CORE_RADIUS = 400.0, 47.1, 3.0
CORRELATION_LENGTH, CONTRAST = 3.0, 0.2


@dataclass(frozen=True)
class Pair:
    """Two images dt apart and the flow between them.

    Attributes
    ----------
    first, second : xarray.DataArray, dims (z, y)
        Mean 1, `noise` times that of white noise in each.
    v, w : xarray.DataArray, dims (z, y)
        The true wind at the pixels' centres, m s^-1; it does not change in dt.
    vortices : tuple of Vortex
        Port, starboard: their `y` and `z` are the cores' positions, m.
    noise : float
    """

    first: xr.DataArray
    second: xr.DataArray
    v: xr.DataArray
    w: xr.DataArray
    vortices: tuple[Vortex, ...]
    noise: float = 0.0


def vortex_pair_images(
    noise: float = 0.0,
    seed: int = 1,
    columns: int = 219,
    rows: int = 139,
    circulation: float = CIRCULATION,
    contrast: float = CONTRAST,
    correlation_length: float = CORRELATION_LENGTH,
    vortices: Sequence[Vortex] | None = None,
) -> Pair:
    """The pair: image 2 is at every pixel the texture of the air there, as it was at time 0.

    Parameters
    ----------
    noise : float
        Standard deviation of the white noise of each image, as a fraction of its mean.
    seed : int
        Of texture and noise; the texture does not depend on the noise level.
    columns, rows : int
        Pixels along y and z, 0.5 m each.
    circulation : float
        Of the two vortices, m^2 s^-1.
    contrast : float
        Rms of the texture over its mean.
    correlation_length : float
        The texture's autocorrelation is exp(-(r / length)^2); px.
    vortices : sequence of Vortex, optional
        In place of the pair of 47.1 m separation and 3 m core radius in the image's middle.
    """
    y, z = axes(columns, rows, SPACING)
    grid = np.meshgrid(y, z)
    if vortices is None:
        vortices = vortex_pair(circulation, SEPARATION, CORE_RADIUS)
    wind = partial(velocity, vortices)
    waves = plane_waves(seed, correlation_length, SPACING)
    images = [texture(waves, *grid, contrast), texture(waves, *origin(wind, *grid, DT), contrast)]
    random = np.random.default_rng([seed, 1])
    images = [image + noise * random.standard_normal(image.shape) for image in images]
    fields = [data_array(a, y, z) for a in (*images, *wind(*grid))]
    return Pair(*fields, tuple(vortices), noise)


def drifting_pair_images(
    vortices: Sequence[Vortex],
    mean_wind: tuple[float, float] = (0.0, 0.0),
    noise: float = 0.0,
    seed: int = 1,
    columns: int = 219,
    rows: int = 139,
    replaced: float = 0.0,
) -> Pair:
    """Images DT / 2 before and after the vortices are where they are said to be.

    The pair moves with the mean wind and the mean of the winds that each vortex has from the other;
    the wind is steady in its frame.

    Parameters
    ----------
    vortices : sequence of Vortex
        Port, starboard.
    mean_wind : (float, float)
        v, w of the ambient air, m s^-1.
    noise, seed, columns, rows
        See `vortex_pair_images`.
    replaced : float
        Fraction of the texture's variance that is of other air in image 2.
    """
    y, z = axes(columns, rows, SPACING)
    lateral, vertical = np.meshgrid(y, z)
    mutual = [velocity([a], b.y, b.z) for a, b in (vortices, vortices[::-1])]
    drift = np.mean(mutual, axis=0) + mean_wind

    def wind(y, z):
        v, w = velocity(vortices, y, z)
        return v + mean_wind[0] - drift[0], w + mean_wind[1] - drift[1]

    air, other = (plane_waves([seed, k], CORRELATION_LENGTH, SPACING) for k in (0, 1))
    random = np.random.default_rng([seed, 2])
    images = []
    for time, new in ((-DT / 2, 0.0), (DT / 2, replaced)):
        place = origin(wind, lateral - drift[0] * time, vertical - drift[1] * time, time, 4)
        image = 1 + np.sqrt(1 - new) * (texture(air, *place, CONTRAST) - 1)
        if new:
            image += np.sqrt(new) * (texture(other, *place, CONTRAST) - 1)
        images.append(image + noise * random.standard_normal(image.shape))
    v, w = wind(lateral, vertical)
    fields = [data_array(a, y, z) for a in (*images, v + drift[0], w + drift[1])]
    return Pair(*fields, tuple(vortices), noise)
