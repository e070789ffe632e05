"""The part of an image's Monte Carlo error that the other image of a pair does not share.

With common random numbers all beams of both images are sampled by the same rays: the error of an
image is a filter of the air, which moves with it. Image velocimetry sees only the rest: by shear
within the beams, by a change of the distance, by decisions along paths of several scatterings.
"""

import numpy as np
import scipy
import xarray as xr

WINDOW = 4.0
"""Standard deviation, px, of the Gaussian window of variances: it holds 4 pi WINDOW^2 = 200 pixels,
so that a variance is known to 10 to 20 %, from one realisation of the error."""


def pair_stderr(scan: xr.Dataset) -> xr.DataArray:
    """Standard error of S0 that the other image of the pair does not share, dims of S0.

    ``S0_pair_stderr`` of common random numbers, else ``S0_stderr``.
    """
    name = "S0_pair_stderr" if "S0_pair_stderr" in scan else "S0_stderr"
    return scan[name]


def unshared_fraction(
    first: np.ndarray, second: np.ndarray, stderr: np.ndarray, rows: np.ndarray, columns: np.ndarray
) -> np.ndarray:
    """Fraction of an image's Monte Carlo variance that the other image does not share, (z, y).

    The variance of (second - first) / 2^(1/2) in a Gaussian window of `WINDOW`, over that stated:
    1 for independent errors, 0 for errors that move with the air. An interpolation between pixels
    adds to it where errors change from pixel to pixel.

    first, second (z, y): a realisation of the Monte Carlo error of each image, of the same random
        numbers; NaN where there is none.
    stderr (z, y): standard error of the first image, same unit.
    rows, columns (z, y): where the air of the first image's pixels is in the second one, px; NaN
        where not known.
    """
    known, at = np.isfinite(second), np.nan_to_num([rows, columns], nan=-1.0)
    moved = scipy.ndimage.map_coordinates(np.where(known, second, 0.0), at, order=3, mode="nearest")
    covered = scipy.ndimage.map_coordinates(known.astype(float), at, order=1, mode="constant")
    off = (moved - first) ** 2 / 2
    counts = np.isfinite(off) & np.isfinite(stderr) & (covered > 0.999)
    different, whole = (
        scipy.ndimage.gaussian_filter(np.where(counts, square, 0.0), WINDOW)
        for square in (off, stderr**2)
    )
    return np.divide(different, whole, out=np.ones_like(whole), where=whole > 0)
