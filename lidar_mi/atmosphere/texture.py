"""Sub-grid aerosol texture: the fluctuations that a simulation on a metre grid does not resolve."""

from dataclasses import dataclass

import numpy as np
import scipy
import xarray as xr
from numpy.typing import ArrayLike

from lidar_mi.errors import InputError

# Half a gigabyte, at 8 bytes each for the noise and its spectrum.
_LARGEST_GRID = 30_000_000


def _spacing(name: str, values: np.ndarray) -> float:
    values = np.asarray(values, dtype=float)
    steps = np.diff(values)
    if values.ndim != 1 or values.size < 2 or steps[0] <= 0 or np.ptp(steps) > 1e-3 * steps[0]:
        raise InputError(
            f"texture.{name}: axis of shape {values.shape} is not usable; allowed: 1-D, "
            "ascending, equally spaced, 2 nodes or more"
        )
    return (values[-1] - values[0]) / (values.size - 1)


def gaussian_field(
    shape: tuple[int, ...],
    spacing: tuple[float, ...],
    outer_scale: float,
    seed: int,
    slope: float = 5 / 3,
) -> np.ndarray:
    """Periodic Gaussian random field, isotropic, with line spectra that fall with k^-slope.

    The spectral density is (k^2 + k0^2)^(-(slope + d - 1)/2) in d dimensions, k0 = 2 pi/L: its
    integral over the d - 1 other wavenumbers, the line spectrum, is, for 5/3, (k^2 + k0^2)^(-5/6)
    (von Karman's form of the Corrsin-Obukhov spectrum; Monin and Yaglom, Statistical Fluid
    Mechanics 2, 1975, section 21). Waves up to the grid's shortest along each axis are filled;
    those it cannot hold are missing from a line spectrum, which for d = 2 (3) lies below the law by
    5 (8) % at a quarter of the largest wavenumber, 15 (23) % at half, 35 (51) % at the end. Nodes
    of the period have a spacing (m), as has L. The mean is zero; the field is not normalised.
    """
    d = len(shape)
    # the generator by its name: numpy may change the one of default_rng
    noise = np.random.Generator(np.random.PCG64(seed)).standard_normal(shape)
    spectrum = scipy.fft.rfftn(noise, overwrite_x=True)
    frequencies = [scipy.fft.fftfreq(n, s) for n, s in zip(shape[:-1], spacing[:-1], strict=True)]
    frequencies.append(scipy.fft.rfftfreq(shape[-1], spacing[-1]))
    k2 = sum(f**2 for f in np.meshgrid(*frequencies, indexing="ij", sparse=True))
    # Frequencies in cycles per metre: the common 2 pi drops out of the shape.
    # The root of the spectral density, as the noise is an amplitude.
    spectrum *= (k2 + outer_scale**-2) ** (-(slope + d - 1) / 4)
    spectrum.flat[0] = 0
    return scipy.fft.irfftn(spectrum, s=shape, overwrite_x=True)


def corrsin_obukhov(
    y: ArrayLike,
    z: ArrayLike,
    rms: float,
    outer_scale: float,
    seed: int,
    x: ArrayLike | None = None,
) -> xr.DataArray:
    """Random factor with which small-scale mixing modulates the aerosol.

    Log-normal, exp(g - s^2/2) with s^2 = ln(1 + rms^2), so it is positive with mean 1 and
    relative rms `rms`. g is a piece cut from a `gaussian_field` that is longer than the image by
    `outer_scale` in every direction (there the correlation has fallen to about 1e-3), so
    opposite edges are independent; its mean and standard deviation *over the image* are set to
    0 and s. The factor's own mean and rms therefore scatter only by what the tails do: some
    per cent of the rms in an image of ten outer scales.

    y, z: node positions, m, equally spaced, ascending.
    rms: relative, >= 0; 0 gives ones.
    outer_scale: m, at least two cells.
    seed: >= 0.
    x: gives dims (x, y, z); one node is a slice of the two-dimensional field, more a
        three-dimensional field.

    Raises InputError: values out of range, uneven axes, a field too large for memory.

    Returns
    -------
    xarray.DataArray
        Factor, dimensionless, dims (y, z) or (x, y, z).
    """
    if not (np.isfinite(rms) and rms >= 0):
        raise InputError(f"texture.rms: {rms} is not allowed; it must be >= 0")
    if isinstance(seed, bool) or not isinstance(seed, (int, np.integer)) or seed < 0:
        raise InputError(f"texture.seed: {seed!r} is not allowed; a whole number >= 0 is")
    axes = {"y": np.asarray(y, dtype=float), "z": np.asarray(z, dtype=float)}
    if x is not None:
        axes = {"x": np.atleast_1d(np.asarray(x, dtype=float)), **axes}
    spacing = {
        name: _spacing(name, values)
        for name, values in axes.items()
        if name != "x" or values.size > 1
    }
    if not (np.isfinite(outer_scale) and outer_scale >= 2 * max(spacing.values())):
        raise InputError(
            f"texture.outer_scale: {outer_scale} m is not allowed; it must be at least two "
            f"cells, {2 * max(spacing.values()):g} m"
        )
    sizes = [values.size for values in axes.values()]
    # longer than the image by an outer scale, as the field is periodic
    period = tuple(
        scipy.fft.next_fast_len(int(np.ceil(axes[name].size + outer_scale / step)), real=True)
        for name, step in spacing.items()
    )
    if np.prod(period, dtype=float) > _LARGEST_GRID:
        raise InputError(
            f"texture.outer_scale: {outer_scale} m with {' x '.join(map(str, sizes))} nodes "
            f"needs a grid of {' x '.join(map(str, period))}; allowed: {_LARGEST_GRID} nodes"
        )
    if rms == 0:
        factor = np.ones(sizes)
    else:
        g = gaussian_field(period, tuple(spacing.values()), outer_scale, seed)
        g = g[tuple(slice(axes[name].size) for name in spacing)]
        s = np.sqrt(np.log1p(rms**2))
        g = (g - g.mean()) * (s / g.std())
        # the mean of exp(g) is exp(s^2 / 2)
        factor = np.exp(g - s**2 / 2).reshape(sizes)
    return xr.DataArray(
        factor,
        coords={name: (name, values, {"units": "m"}) for name, values in axes.items()},
        dims=tuple(axes),
        name="texture",
        attrs={
            "units": "1",
            "long_name": "aerosol texture factor",
            "rms": rms,
            "outer_scale": outer_scale,
            "seed": int(seed),
        },
    )


_ORDER = 5  # of the spline through the nodes, as in advection


@dataclass(frozen=True, eq=False)
class PeriodicTexture:
    """The factor of `corrsin_obukhov` anywhere in space, periodic in all directions, without seams.

    coefficients (nx, ny, nz): of the periodic quintic B-spline of the logarithm.
    spacing: of its nodes, m.
    """

    coefficients: np.ndarray
    spacing: tuple[float, float, float]

    @property
    def period(self) -> tuple[float, ...]:
        """Period of the texture along x, y and z, m."""
        return tuple(
            n * step for n, step in zip(self.coefficients.shape, self.spacing, strict=True)
        )

    def at(self, x: ArrayLike, y: ArrayLike, z: ArrayLike) -> np.ndarray:
        """The factor at places (m), which broadcast."""
        places = np.broadcast_arrays(
            *(np.asarray(a, float) / d for a, d in zip((x, y, z), self.spacing, strict=True))
        )
        shape, flat = places[0].shape, np.stack([place.ravel() for place in places])
        logarithm = scipy.ndimage.map_coordinates(
            self.coefficients, flat, order=_ORDER, mode="grid-wrap", prefilter=False
        )
        return np.exp(logarithm).reshape(shape)


def periodic_texture(
    extent: tuple[float, float, float],
    spacing: tuple[float, float, float],
    rms: float,
    outer_scale: float,
    seed: int,
) -> PeriodicTexture:
    """The texture of `corrsin_obukhov` in a period of at least ``extent`` (m).

    Mean and standard deviation of the Gaussian field are set over the period.

    Raises InputError: an outer scale of less than two cells, a period too large for memory.
    """
    if not outer_scale >= 2 * max(spacing):
        raise InputError(
            f"texture.outer_scale: {outer_scale} m is not allowed; it must be at least two "
            f"cells, {2 * max(spacing):g} m"
        )
    # rounding must not add a node to a whole number of them
    nodes = tuple(
        scipy.fft.next_fast_len(int(np.ceil(length / step - 1e-9)), real=True)
        for length, step in zip(extent, spacing, strict=True)
    )
    if np.prod(nodes, dtype=float) > _LARGEST_GRID:
        raise InputError(
            f"texture: a period of {' x '.join(f'{a:g}' for a in extent)} m needs a grid of "
            f"{' x '.join(map(str, nodes))}; allowed: {_LARGEST_GRID} nodes"
        )
    if rms == 0:
        return PeriodicTexture(np.zeros((1, 1, 1)), spacing)
    g = gaussian_field(nodes, spacing, outer_scale, seed)
    s = np.sqrt(np.log1p(rms**2))
    g = (g - g.mean()) * (s / g.std()) - s**2 / 2
    return PeriodicTexture(scipy.ndimage.spline_filter(g, order=_ORDER, mode="grid-wrap"), spacing)
